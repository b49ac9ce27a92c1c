"""Rigid transforms and the few vector helpers that every stage needs.

`T_a_b` (4, 4) maps coordinates in b to coordinates in a; `Ts_` is a batch (n, 4, 4).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.int_]


def readonly(array: ArrayLike, dtype: type = float) -> NDArray:
    """A read-only copy of `array`: what frozen values carry."""
    copy: NDArray = np.array(array, dtype=dtype)
    copy.setflags(write=False)
    return copy


def make_transform(rotation: ArrayLike | None = None, translation: ArrayLike | None = None) -> Array:
    """T (4, 4) from a rotation matrix (3, 3) and a translation (3,) [m]; identity where omitted."""
    transform = np.eye(4)
    if rotation is not None:
        transform[:3, :3] = rotation
    if translation is not None:
        transform[:3, 3] = translation
    return transform


def inverse(transforms: ArrayLike) -> Array:
    """Inverse of rigid transforms (..., 4, 4)."""
    transforms = np.asarray(transforms, float)
    result = np.zeros_like(transforms)
    rotation_t = np.swapaxes(transforms[..., :3, :3], -1, -2)
    result[..., :3, :3] = rotation_t
    result[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation_t, transforms[..., :3, 3])
    result[..., 3, 3] = 1.0
    return result


def apply(transform: ArrayLike, points: ArrayLike) -> Array:
    """Points (..., 3) [m] moved by one transform (4, 4)."""
    transform = np.asarray(transform, float)
    return np.asarray(points, float) @ transform[:3, :3].T + transform[:3, 3]


def translate(transform: ArrayLike, offset: ArrayLike) -> Array:
    """The transform (4, 4) with its origin moved by `offset` (3,) [m], expressed in the outer frame."""
    moved = np.array(transform, float)
    moved[:3, 3] += offset
    return moved


def rotation_about(axis: ArrayLike, angle: float) -> Array:
    """Rotation matrix (3, 3) about a unit axis (3,) by `angle` [rad]."""
    return Rotation.from_rotvec(np.asarray(axis, float) * angle).as_matrix()


def rotation_angle(rotation_a: ArrayLike, rotation_b: ArrayLike) -> float:
    """Angle [rad] of the rotation between two rotation matrices (3, 3)."""
    turn = np.asarray(rotation_a).T @ np.asarray(rotation_b)
    sine = np.array(
        (turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])
    )  # twice the axis' share
    return float(np.arctan2(np.sqrt(sine @ sine), np.trace(turn) - 1.0))


def from_quat_xyzw(translation: ArrayLike, quat_xyzw: ArrayLike) -> Array:
    """T (4, 4) from a translation (3,) [m] and a quaternion (x, y, z, w)."""
    return make_transform(Rotation.from_quat(quat_xyzw).as_matrix(), translation)


def to_quat_xyzw(transform: ArrayLike) -> tuple[Array, Array]:
    """Translations (..., 3) [m] and quaternions (x, y, z, w) (..., 4), w >= 0, of transforms (..., 4, 4)."""
    transform = np.asarray(transform, float)
    quat_xyzw = Rotation.from_matrix(transform[..., :3, :3].reshape(-1, 3, 3)).as_quat(canonical=True)
    return transform[..., :3, 3].copy(), quat_xyzw.reshape(*transform.shape[:-2], 4)


def tangents(normal: ArrayLike) -> tuple[Array, Array]:
    """Unit tangents t, b of a unit normal (3,): t = n x z, or the frame's x where n is vertical; b = n x
    t."""
    normal = np.asarray(normal, float)
    tangent = np.cross(normal, (0.0, 0.0, 1.0))
    length = np.linalg.norm(tangent)
    tangent = np.array((1.0, 0.0, 0.0)) if length < 1e-6 else tangent / length
    return tangent, np.cross(normal, tangent)
