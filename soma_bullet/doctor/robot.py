"""Checks of what it does with robots: kinematics, collisions, physics."""

from __future__ import annotations

import time
from collections.abc import Iterator

from soma_bullet.doctor.finding import AGAIN, Finding
from soma_bullet.options import EpisodeOptions

CELL = EpisodeOptions.cell
REACH = 1e-6  # [m] by which a pose may be missed on the way through inverse and forward kinematics
FALL = 0.2  # [s] of physics
SUNK, SAGGED = 2e-3, 0.5  # [m], [deg] by which pieces may sink or hover then, and an arm may sag


def check_robot() -> Iterator[Finding]:
    """Inverse kinematics there and back, and a collision check, with the default cell."""
    import numpy as np

    from soma_bullet.assembly.file import load_assembly
    from soma_bullet.robot.cell import load_cell
    from soma_bullet.task.workcell import Workcell

    workcell = Workcell(load_assembly("soma3"), load_cell(CELL))
    robot, idle = workcell.robot, workcell.idle()
    for arm, q in enumerate(robot.home):
        pose = robot.tcp(arm, q)
        found = robot.inverse(arm, pose, q)
        off = max((float(np.abs(robot.tcp(arm, other) - pose).max()) for other in found), default=np.inf)
        back = len(found) > 0 and float(np.abs(found[0] - q).max()) < 1e-6
        good = back and off < REACH
        says = (
            f"{robot.arm(arm).name} arm at home: {len(found)} ways to reach its pose, all within {off:.0e} m"
        )
        advice = "" if good else f"{AGAIN} eaik pin"
        yield Finding("inverse kinematics", "good" if good else "bad", says, advice)
    scene = workcell.scene(idle, 0)
    free = not scene.collides(workcell.configuration(idle, 0, robot.home[0]))
    through = robot.home[0] + np.array(
        [0.0, 1.2, 0.0, 0.0, 0.0, 0.0]
    )  # [rad] the shoulder bends forward and down
    hit = any(
        scene.collides(workcell.configuration(idle, 0, robot.home[0] + share * (through - robot.home[0])))
        for share in np.linspace(0.0, 2.0, 21)
    )
    good = free and hit
    says = (
        "home is free, an arm that bends down collides"
        if good
        else f"home free: {free}, an arm that bends down collides: {hit}"
    )
    yield Finding("collision check", "good" if good else "bad", says, "" if good else f"{AGAIN} coal pin")


def check_physics() -> Iterator[Finding]:
    """PyBullet without a window, and a short run of the real world: what lies on the table must stay
    there."""
    import numpy as np

    from soma_bullet.assembly.file import load_assembly
    from soma_bullet.bullet.simulator import BulletSimulator
    from soma_bullet.frames import apply, translate
    from soma_bullet.robot.cell import load_cell
    from soma_bullet.task.workcell import Workcell
    from soma_bullet.world.options import Physics

    assembly, cell = load_assembly("soma3"), load_cell(CELL)
    workcell = Workcell(assembly, cell)
    side, start = cell.feed_areas[0].mean(axis=1), time.perf_counter()
    poses = {}
    for k, piece in enumerate(
        assembly.pieces
    ):  # as their meshes are, one beside the other, a hair above the table
        poses[piece.name] = translate(
            np.eye(4), (side[0], side[1] + 0.12 * (k - 1), 1e-4 - piece.vertices[:, 2].min())
        )
    world = BulletSimulator(cell, assembly, workcell.robot.stand_size, poses, workcell.robot.home, Physics())
    try:
        yield Finding(
            "pybullet, no window", "good", f"the cell is loaded in {time.perf_counter() - start:.1f} s"
        )
        start, steps = time.perf_counter(), round(FALL / world.time_step)
        for _ in range(steps):
            world.step()
        factor = FALL / (time.perf_counter() - start)
        found = world.piece_poses()
        lowest = min(float(apply(found[piece.name], piece.vertices)[:, 2].min()) for piece in assembly.pieces)
        sag = float(np.rad2deg(np.abs(np.subtract(world.measured_joints(), workcell.robot.home)).max()))
    finally:
        world.close()
    good = abs(lowest) < SUNK and sag < SAGGED
    says = f"{FALL:g} s in {steps} steps, {factor:.1f} times as fast as real time; "
    says += f"pieces stay on the table to {abs(lowest) * 1e3:.2f} mm, arms at home to {sag:.3f} deg"
    yield Finding("physics", "good" if good else "bad", says, "" if good else f"{AGAIN} pybullet numpy")
