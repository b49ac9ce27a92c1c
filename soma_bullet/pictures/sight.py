"""What a camera would see of the pieces, and what would be in its way."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from soma_bullet.bullet.quiet import pybullet, silenced
from soma_bullet.frames import Array, to_quat_xyzw
from soma_bullet.pictures import look
from soma_bullet.pictures.camera import PieceVisual

_RAYS = 8000  # in one call; PyBullet takes 16384


class Sight:
    """Rays against the collision shapes of the cell and of the pieces; a context manager.

    Args:
        urdf: the cell with its collision shapes, as `compose_urdf` writes it.
    """

    def __init__(self, urdf: Path, pieces: Sequence[PieceVisual]):
        p = self._p = pybullet
        with silenced(), tempfile.TemporaryDirectory() as folder:
            self.client = p.connect(p.DIRECT)
            self._robot = p.loadURDF(str(urdf), useFixedBase=True, physicsClientId=self.client)
            count = p.getNumJoints(self._robot, physicsClientId=self.client)
            infos = [p.getJointInfo(self._robot, i, physicsClientId=self.client) for i in range(count)]
            self._joints = {info[1].decode(): info[0] for info in infos}
            self._pieces = {}
            for piece in pieces:
                handle, file = tempfile.mkstemp(
                    suffix=".obj", dir=folder
                )  # PyBullet caches by name: never the same
                os.close(handle)
                Path(file).write_text(look.flat_obj(piece.vertices, piece.faces))
                shape = p.createCollisionShape(
                    p.GEOM_MESH,
                    fileName=file,
                    flags=p.GEOM_FORCE_CONCAVE_TRIMESH,
                    physicsClientId=self.client,
                )
                self._pieces[piece.name] = p.createMultiBody(0, shape, physicsClientId=self.client)

    def __enter__(self) -> Sight:
        return self

    def __exit__(self, *_: object) -> None:
        with silenced():
            self._p.disconnect(physicsClientId=self.client)

    def place(self, joint_positions: Mapping[str, float], poses: Mapping[str, ArrayLike]) -> None:
        """Poses the cell and the pieces, T_world_piece (4, 4) by name."""
        for name, value in joint_positions.items():
            self._p.resetJointState(
                self._robot, self._joints[name], float(value), physicsClientId=self.client
            )
        for name, pose in poses.items():
            position, quat_xyzw = to_quat_xyzw(pose)
            self._p.resetBasePositionAndOrientation(
                self._pieces[name], position, quat_xyzw, physicsClientId=self.client
            )
        self._p.performCollisionDetection(physicsClientId=self.client)

    def robot(self) -> Array:
        """Corners of the boxes around the robots' links (n, 3), table and stand left out."""
        p, corners = self._p, []
        for joint in self._joints.values():
            link = p.getJointInfo(self._robot, joint, physicsClientId=self.client)[12].decode()
            if link not in ("table", "stand") and p.getCollisionShapeData(
                self._robot, joint, physicsClientId=self.client
            ):
                corners += list(
                    product(*zip(*p.getAABB(self._robot, joint, physicsClientId=self.client), strict=True))
                )
        return np.array(corners)

    def reach(self, starts: Array, ends: Array) -> Array:
        """How far rays between points (n, 3) get, as a fraction (n,): 1 where nothing is in the way."""
        fractions: list[float] = []
        for k in range(0, len(starts), _RAYS):
            pairs = starts[k : k + _RAYS].tolist(), ends[k : k + _RAYS].tolist()
            fractions += [
                row[2] for row in self._p.rayTestBatch(*pairs, numThreads=1, physicsClientId=self.client)
            ]
        return np.array(fractions)
