"""The stage of one episode: everything is loaded and placed here, before the clock starts; afterwards only
forces move it.

The only constraints couple the two fingers of a hand (JOINT_GEAR), as the gears of a parallel gripper do.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from soma_bullet.assembly.model import Assembly
from soma_bullet.bullet.bodies import write_piece_urdf
from soma_bullet.bullet.quiet import pybullet as p
from soma_bullet.bullet.quiet import silenced
from soma_bullet.frames import Array, inverse, to_quat_xyzw
from soma_bullet.frames import from_quat_xyzw as transform_of
from soma_bullet.robot.compose import compose_urdf
from soma_bullet.robot.model import Cell
from soma_bullet.task.segment import DT
from soma_bullet.world.options import SUBSTEPS, Physics

SOLVERS = {"dantzig": p.CONSTRAINT_SOLVER_LCP_DANTZIG, "pgs": p.CONSTRAINT_SOLVER_LCP_SI}
Part = tuple[int, int]  # body and link; -1 is the body itself

FRICTION_ERP = 0.8  # of what an anchored contact has slid, how much is undone in a step
GEAR_ERP = 0.2
GEAR_FORCE = 1e4  # [N]
TABLE_FRICTION = 0.5
# Bodies give way a little where they touch: 1 N sinks in by 4 um between two that do. Contacts of rigid boxes
# vanish as soon as rounding parts them, and the other pad then kicks the piece; what is pinched gets forces
# that grow with the solver's passes. With a quarter of the damping a piece that leans lightly on another
# bounces for ever, and creeps.
STIFFNESS, DAMPING = 5e5, 4e3  # [N/m], [N s/m] of one body's contact
# [N/m] of a body that is not made of boxes: one point may carry what else four corners share
POINT_STIFFNESS = 5e6
# [m] lever at which a body resists turning about a contact's normal, half of what two have that touch: where
# faces meet the simulator may list a single corner, on which a piece would spin under the least push
TORSION = 1e-3
# [m/s] that a grip may be worth in one step to the lightest piece: what the pads do not balance within a step
# throws it. Pieces of 7 g are held at 3 m/s, and squeezed out at 9 m/s
JERKED = 6.5


def substeps(physics: Physics, cell: Cell, assembly: Assembly) -> int:
    """Time steps for each sample of a trajectory: as the options say, or the fewest in which no hand's grip
    could bring the lightest piece to more than JERKED."""
    if physics.substeps is not None:
        return physics.substeps
    own = max(arm.hand.grip_force for arm in cell.arms)
    force = own if physics.grip_force is None else physics.grip_force
    lightest = physics.mass * min(piece.mass for piece in assembly.pieces)
    return int(np.clip(np.ceil(force * DT / lightest / JERKED), SUBSTEPS.low, SUBSTEPS.high))


class Stage:
    """Robot, table, stand and pieces in physics.

    Args:
        cell, assembly: what is loaded.
        stand: footprint of the stand [m].
        poses: T_world_piece (4, 4) of each piece at the start.
        home: joints (n,) [rad] of each arm at the start.
        frames: whether the arms keep the links of their URDF that have neither mass nor shape.
    """

    def __init__(
        self,
        cell: Cell,
        assembly: Assembly,
        stand: tuple[float, float],
        poses: Mapping[str, Array],
        home: Sequence[Array],
        physics: Physics,
        frames: bool = False,
    ):
        self.cell, self.assembly, self.physics, self._frames = cell, assembly, physics, frames
        # two that touch have the product of theirs as coefficient of friction
        self.roughness: dict[Part, float] = {}
        self.client = p.connect(p.DIRECT)
        with tempfile.TemporaryDirectory() as folder, silenced():
            self.substeps = substeps(physics, cell, assembly)
            self.time_step = DT / self.substeps  # [s]
            p.setGravity(0, 0, -physics.gravity, physicsClientId=self.client)
            p.setPhysicsEngineParameter(
                fixedTimeStep=self.time_step,
                numSolverIterations=physics.iterations,
                deterministicOverlappingPairs=1,
                enableFileCaching=0,
                frictionERP=FRICTION_ERP,
                physicsClientId=self.client,
                constraintSolverType=SOLVERS[physics.solver],
            )
            self._load_fixtures(stand)
            self._load_robot(Path(folder), stand)
            self._load_pieces(Path(folder), poses)
        self._couple_fingers()
        self._place_robot(home)
        self.targets = [np.array(q, float) for q in home]

    def close(self) -> None:
        """Free the simulator."""
        p.disconnect(physicsClientId=self.client)

    # --- loading, before the clock starts -------------------------------------------------------------------

    def _load_robot(self, folder: Path, stand: tuple[float, float]) -> None:
        """Each arm is a body of its own: its rows of the solver are shorter, and what it holds is solved by
        itself.

        Dantzig's solver loses its grip on pieces when there are two such bodies, so it gets both arms as one.
        """
        arms = self.cell.arms
        self.robots: list[int] = []  # an arm's body
        self.links: dict[str, Part] = {}
        self.joints: dict[str, Part] = {}
        self.moving_joints: tuple[str, ...] = ()
        kept = None if self._frames else {arm.prefixed(arm.hand.mount_link) for arm in arms}
        for k, group in enumerate([[arm] for arm in arms] if self.physics.solver == "pgs" else [arms]):
            file = folder / f"arms{k}.urdf"
            compose_urdf(self.cell, stand, file, visuals=False, fixtures=False, arms=group, frames=kept)
            flags = p.URDF_USE_INERTIA_FROM_FILE | p.URDF_USE_SELF_COLLISION
            body = p.loadURDF(str(file), useFixedBase=True, flags=flags, physicsClientId=self.client)
            self.robots += [body] * len(group)
            count = p.getNumJoints(body, physicsClientId=self.client)
            info = [p.getJointInfo(body, joint, physicsClientId=self.client) for joint in range(count)]
            self.joints |= {row[1].decode(): (body, row[0]) for row in info}
            self.links |= {row[12].decode(): (body, row[0]) for row in info}
            self.moving_joints += tuple(row[1].decode() for row in info if row[2] != p.JOINT_FIXED)
        for pair in self.cell.never_checked:
            if all(name in self.fixtures or name in self.links for name in pair):  # the others have no shape
                (body_a, link_a), (body_b, link_b) = (self._part(name) for name in pair)
                p.setCollisionFilterPair(body_a, body_b, link_a, link_b, 0, physicsClientId=self.client)
        self.moving: dict[int, list[int]] = {body: [] for body in self.robots}  # body -> its `moving_joints`
        for body, joint in map(self.joints.__getitem__, self.moving_joints):
            self.moving[body].append(joint)
        self.arm_joints = [[self.joints[name][1] for name in arm.joint_names] for arm in self.cell.arms]
        self.finger_joints = [[self.joints[name][1] for name in arm.finger_joints] for arm in self.cell.arms]
        self.finger_links = [[self.links[name] for name in arm.finger_links] for arm in self.cell.arms]
        self.finger_masses = [
            [p.getDynamicsInfo(*part, physicsClientId=self.client)[0] for part in parts]
            for parts in self.finger_links
        ]
        self.tcp_on_mount = [to_quat_xyzw(arm.hand.T_mount_tcp) for arm in self.cell.arms]
        # a link's index is that of the joint above it
        self.wrists = [self.links[arm.prefixed(arm.hand.mount_link)][1] for arm in self.cell.arms]
        self.hand_links = [self._below(*part) for part in zip(self.robots, self.wrists, strict=True)]
        self.hand_masses = [
            [p.getDynamicsInfo(body, link, physicsClientId=self.client)[0] for link in links]
            for body, links in zip(self.robots, self.hand_links, strict=True)
        ]
        scale = np.sqrt(self.physics.friction)
        for arm, links in zip(self.cell.arms, self.finger_links, strict=True):
            for body, link in links:
                self._surface(body, link, np.sqrt(arm.hand.pad_friction) * scale, anchor=True)

    def _below(self, body: int, link: int) -> list[int]:
        """A link and all that it carries."""
        carried = {link}
        for joint in range(link + 1, p.getNumJoints(body, physicsClientId=self.client)):  # parents come first
            if p.getJointInfo(body, joint, physicsClientId=self.client)[16] in carried:
                carried.add(joint)
        return sorted(carried)

    def _part(self, name: str) -> Part:
        """What a name of the cell stands for."""
        return (self.fixtures[name], -1) if name in self.fixtures else self.links[name]

    def part_names(self) -> dict[Part, str]:
        """Every body and link that can touch another, with its name: links of the arms, fixtures, pieces."""
        bodies = {(body, -1): name for name, body in {**self.fixtures, **self.pieces}.items()}
        return {part: name for name, part in self.links.items()} | bodies

    def _load_fixtures(self, stand: tuple[float, float]) -> None:
        """Table and stand as bodies of their own: contacts with them then do not couple pieces that lie
        apart."""
        table, height = self.cell.table, self.cell.stand_height
        boxes = {
            "table": (table.size, (*table.centre, -table.size[2] / 2), TABLE_FRICTION),
            "stand": (
                np.array((*stand, height)),
                (*self.cell.stand_centre, height / 2),
                self.assembly.support.friction,
            ),
        }
        self.fixtures: dict[str, int] = {}
        for name, (size, centre, friction) in boxes.items():
            shape = p.createCollisionShape(
                p.GEOM_BOX, halfExtents=(size / 2).tolist(), physicsClientId=self.client
            )
            self.fixtures[name] = p.createMultiBody(
                0, shape, basePosition=[float(v) for v in centre], physicsClientId=self.client
            )
            self._surface(self.fixtures[name], -1, np.sqrt(friction * self.physics.friction))

    def touches_flat(self, piece: str) -> bool:
        """Whether Bullet finds all corners of its contact with a pad at once, as between boxes; else point
        after point."""
        return self.assembly.pieces[self.assembly.index(piece)].decomposition.kind == "boxes"

    def _surface(
        self, body: int, link: int, coefficient: float, anchor: bool = False, stiffness: float = STIFFNESS
    ) -> None:
        """Set friction and softness. Bullet multiplies two bodies' coefficients: with the root of each they
        meet in the mean.

        They rub against turning about a contact's normal as well, like a soft finger. Two that give way do so
        one after the other, like springs in series."""
        self.roughness[body, link] = float(coefficient)
        p.changeDynamics(
            body,
            link,
            lateralFriction=float(coefficient),
            spinningFriction=float(TORSION * coefficient),
            rollingFriction=0.0,
            frictionAnchor=int(anchor),
            contactStiffness=stiffness,
            contactDamping=DAMPING,
            physicsClientId=self.client,
        )

    def _load_pieces(self, folder: Path, poses: Mapping[str, Array]) -> None:
        self.pieces: dict[str, int] = {}
        self.T_inertial_piece: dict[str, Array] = {}
        for piece in self.assembly.pieces:
            urdf = write_piece_urdf(piece, folder)
            body = p.loadURDF(str(urdf), flags=p.URDF_USE_INERTIA_FROM_FILE, physicsClientId=self.client)
            info = p.getDynamicsInfo(body, -1, physicsClientId=self.client)
            T_piece_inertial = transform_of(info[3], info[4])
            position, quat_xyzw = to_quat_xyzw(poses[piece.name] @ T_piece_inertial)
            p.resetBasePositionAndOrientation(body, position, quat_xyzw, physicsClientId=self.client)
            stiffness = STIFFNESS if self.touches_flat(piece.name) else POINT_STIFFNESS
            self._surface(
                body, -1, np.sqrt(piece.friction * self.physics.friction), anchor=True, stiffness=stiffness
            )
            if self.physics.asleep:
                p.changeDynamics(
                    body,
                    -1,
                    activationState=p.ACTIVATION_STATE_ENABLE_SLEEPING,
                    sleepThreshold=self.physics.asleep**2,
                    physicsClientId=self.client,
                )
            if self.physics.mass != 1.0:
                inertia = [self.physics.mass * value for value in info[2]]
                p.changeDynamics(
                    body,
                    -1,
                    mass=info[0] * self.physics.mass,
                    localInertiaDiagonal=inertia,
                    physicsClientId=self.client,
                )
            self.pieces[piece.name] = body
            self.T_inertial_piece[piece.name] = inverse(T_piece_inertial)

    def _couple_fingers(self) -> None:
        for body, (first, second) in zip(self.robots, self.finger_joints, strict=True):
            gear = p.createConstraint(
                body, first, body, second, jointType=p.JOINT_GEAR, jointAxis=[1, 0, 0],
                parentFramePosition=[0, 0, 0], childFramePosition=[0, 0, 0], physicsClientId=self.client,
            )  # fmt: skip
            p.changeConstraint(
                gear, gearRatio=-1, erp=GEAR_ERP, maxForce=GEAR_FORCE, physicsClientId=self.client
            )

    def _place_robot(self, home: Sequence[Array]) -> None:
        for body, joints, q in zip(self.robots, self.arm_joints, home, strict=True):
            for joint, angle in zip(joints, q, strict=True):
                p.resetJointState(body, joint, float(angle), physicsClientId=self.client)

    def constraints(self) -> tuple[str, ...]:
        """Every constraint that is in the world now."""
        names = {joint: name for name, joint in self.joints.items()}
        kinds = {
            p.JOINT_GEAR: "gear",
            p.JOINT_FIXED: "fixed",
            p.JOINT_POINT2POINT: "point",
            p.JOINT_PRISMATIC: "prismatic",
        }
        found = []
        for k in range(p.getNumConstraints(physicsClientId=self.client)):
            unique = p.getConstraintUniqueId(k, physicsClientId=self.client)
            row = p.getConstraintInfo(unique, physicsClientId=self.client)
            body_a, joint_a, body_b, joint_b, kind = row[:5]
            ends = [names.get(end, f"body {end[0]}") for end in ((body_a, joint_a), (body_b, joint_b))]
            found.append(f"{kinds.get(kind, kind)}: {ends[0]} - {ends[1]}")
        return tuple(found)
