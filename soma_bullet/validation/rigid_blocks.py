"""Statics of rigid blocks twice: the planner's own model with its signed margin, and compas-cra as an
independent judge.

compas-cra gets nothing but meshes, densities and the coefficient of friction: contacts, equilibrium matrix,
friction cones (eight sides about the circle; ours have twelve of the mean radius) and solver (IPOPT) are its
own. In its rigid-block equilibrium contacts may pull, at a high price: the blocks stand where none has to.

Source: G. T. C. Kao et al., "Coupled rigid-block analysis", Computer-Aided Design 146 (2022), Eq. 6.
"""

from __future__ import annotations

import contextlib
import io
from typing import Any

import numpy as np
from scipy.optimize import linprog

from soma_bullet.assembly.model import Assembly
from soma_bullet.errors import InputError, SomaBulletError
from soma_bullet.frames import Array, Indices, apply
from soma_bullet.planner.equilibrium import (
    LARGEST,
    PYRAMID,
    Sides,
    active_contacts,
    contact_columns,
    disturbance_angles,
    equilibrium_margin,
)

FAN = 48  # directions of the polygon that stands for a circle of accelerations
WIDE = 30.0  # [edges] half the width of the support; the unit is the shortest edge of a piece
SAME = 1e-6  # [g]
# factors on friction with which an octagon about the circle has the circle's radius on average, holds the
# polygon of PYRAMID sides, and fits into it
ALIKE = 2 / (1 + 1 / np.cos(np.pi / 8))
HOLDS = 2 / (1 + np.cos(np.pi / PYRAMID))
FITS = np.cos(np.pi / PYRAMID) * HOLDS * np.cos(np.pi / 8)
WEIGHTS = (100.0, 1.0, 1e4)  # mean weights of a piece that are tried
NEAR = 1e-6  # [edges] within which faces touch
SMALLEST = 1e-4  # [edges2] of a contact


def signed_margin(assembly: Assembly, placed: frozenset[int], sides: Sides) -> float:
    """Distance [g] of the origin from the edge of the set of horizontal accelerations under which the placed
    pieces stand.

    Positive inside: the margin of `equilibrium_margin`. Negative outside: the least acceleration that would
    make them stand; -inf where none does."""
    margin = equilibrium_margin(assembly, placed, frozenset(), sides)
    if margin > 0.0:
        return margin
    columns, load, push_x, push_y = _balance(assembly, placed, sides)
    count = columns.shape[1]
    angles = 2 * np.pi * np.arange(FAN) / FAN
    # unknowns: contact forces, the acceleration (x, y), and its size, which is to be least
    rows = np.column_stack([columns, push_x, push_y, np.zeros(len(load))])
    fan = np.hstack(
        [np.zeros((FAN, count)), np.cos(angles)[:, None], np.sin(angles)[:, None], -np.ones((FAN, 1))]
    )
    cost = np.concatenate([np.zeros(count + 2), [1.0]])
    bounds = [(0.0, None)] * count + [(None, None)] * 3
    found = linprog(cost, fan, np.zeros(FAN), rows, -load, bounds)
    return -abs(float(found.fun)) if found.status == 0 else -np.inf


def weakest_direction(assembly: Assembly, placed: frozenset[int], sides: Sides, margin: float) -> float:
    """The horizontal direction [rad] in which the margin of `equilibrium_margin` is attained."""
    columns, load, push_x, push_y = _balance(assembly, placed, sides)
    count = columns.shape[1]
    limits = {}
    for angle in disturbance_angles(assembly, placed).tolist():
        push = np.cos(angle) * push_x + np.sin(angle) * push_y
        cost = np.concatenate([np.zeros(count), [-1.0]])
        found = linprog(cost, A_eq=np.column_stack([columns, push]), b_eq=-load, bounds=(0.0, LARGEST))
        limits[angle] = -float(found.fun) if found.status == 0 else 0.0
        if limits[angle] < margin + SAME:
            return angle
    return min(limits, key=lambda angle: limits[angle])


def _balance(assembly: Assembly, placed: frozenset[int], sides: Sides) -> tuple[Array, Array, Array, Array]:
    """Of all placed pieces, none of them held: wrenches of the contacts, of gravity, and of 1 g along x and
    along y."""
    free = sorted(placed)
    contacts = active_contacts(assembly, placed, frozenset(), sides)
    columns = [contact_columns(contact, assembly, free, frozenset(), sides) for contact in contacts]
    masses = np.array([assembly.pieces[k].mass for k in free])
    scale = np.concatenate([[1, 1, 1, *[1 / assembly.pieces[k].radius] * 3] for k in free])
    wrenches = np.zeros((3, len(free), 6))
    for axis in range(3):
        wrenches[axis, :, axis] = masses / masses.mean()
    push_x, push_y, lift = wrenches.reshape(3, -1)
    return np.hstack(columns) * scale[:, None], -lift, push_x, push_y


def require_compas_cra() -> None:
    """Raises InputError where compas-cra is not installed."""
    try:
        import compas_cra.equilibrium  # noqa: F401
    except ImportError as error:
        raise InputError(
            "compas-cra", f"is needed for this comparison ({error}); install the extra `test`"
        ) from None


class RigidBlocks:
    """An assembly in compas-cra; its contacts are found once.

    Raises:
        InputError: compas-cra is not installed, or the coefficients of friction differ (it knows one).
    """

    def __init__(self, assembly: Assembly):
        require_compas_cra()
        from compas_assembly.datastructures import Block
        from compas_cra.algorithms import assembly_interfaces_numpy
        from compas_cra.datastructures import CRA_Assembly

        self.friction = assembly.support.friction
        if any(piece.friction != self.friction for piece in assembly.pieces):
            raise InputError(
                assembly.name, "compas-cra knows one coefficient of friction; give all bodies the same"
            )
        unit = min(float(piece.mesh.edges_unique_length.min()) for piece in assembly.pieces)
        self.blocks: Any = CRA_Assembly()
        for piece, goal in zip(assembly.pieces, assembly.goals, strict=True):
            corners = apply(goal, piece.vertices) / unit
            faces = _short_edge_first(corners, np.asarray(piece.faces, int))
            self.blocks.add_block(Block.from_vertices_and_faces(corners.tolist(), faces.tolist()))
        mean_weight = float(np.mean([piece.mass for piece in assembly.pieces])) / unit**3
        # of pieces whose mean weight is 1; the support's does not matter
        self.densities = [*(piece.density / mean_weight for piece in assembly.pieces), 1.0]
        slab = np.array(
            [
                [x, y, z]
                for z in (-1, 0)
                for x, y in ((-WIDE, -WIDE), (WIDE, -WIDE), (WIDE, WIDE), (-WIDE, WIDE))
            ]
        )
        sides = [[3, 2, 1, 0], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
        support = Block.from_vertices_and_faces(
            (slab + (0, 0, assembly.support.height / unit)).tolist(), sides
        )
        self.blocks.set_boundary_condition(self.blocks.add_block(support))
        with contextlib.redirect_stdout(io.StringIO()):
            assembly_interfaces_numpy(self.blocks, nmax=len(assembly.pieces) + 1, tmax=NEAR, amin=SMALLEST)

    def pull(self, acceleration: float = 0.0, angle: float = 0.0, friction: float = 1.0) -> float:
        """Largest pull at a contact that equilibrium needs, in mean weights of a piece.

        Args:
            acceleration: horizontal [g], in the direction `angle` [rad]: the blocks are tilted for it.
            friction: factor on the coefficient.
        """
        tilt, axis = float(np.arctan(acceleration)), [-float(np.sin(angle)), float(np.cos(angle)), 0.0]
        with contextlib.redirect_stdout(io.StringIO()):
            self.blocks.rotate_assembly([0.0, 0.0, 0.0], axis, tilt, is_rad=True)
            try:
                return self._solved(self.friction * friction)
            finally:
                self.blocks.rotate_assembly([0.0, 0.0, 0.0], axis, -tilt, is_rad=True)

    def _solved(self, friction: float) -> float:
        from compas_cra.equilibrium import rbe_solve

        for weight in WEIGHTS:
            for block, share in zip(self.blocks.blocks(), self.densities, strict=True):
                block.attributes["density"] = share * weight
            with contextlib.suppress(ValueError):  # IPOPT gives up on a few: other units of force help it
                rbe_solve(self.blocks, mu=friction, density=1.0)
                edges = self.blocks.graph.edges()
                patches = [
                    patch for edge in edges for patch in self.blocks.graph.edge_attribute(edge, "interfaces")
                ]
                return max(float(force["c_nn"]) for patch in patches for force in patch.forces) / weight
        raise SomaBulletError(f"compas-cra finds no solution with friction {friction:.4g}")


def _short_edge_first(corners: Array, faces: Indices) -> Indices:
    """Triangles (f, 3) turned so that they start with their shortest edge.

    compas-cra clips faces in frames along their first edge; with a diagonal there it finds, now and then, a
    contact that is not there."""
    lengths = np.linalg.norm(corners[np.roll(faces, -1, axis=1)] - corners[faces], axis=2)
    first = lengths.argmin(axis=1)
    return faces[np.arange(len(faces))[:, None], (first[:, None] + np.arange(3)) % 3]
