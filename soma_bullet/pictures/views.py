"""What a film should show when: who does what, where it happens, and from how near."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import Array, apply
from soma_bullet.pictures.camera import Camera
from soma_bullet.pictures.caption import Phase, holds, phases
from soma_bullet.world.log import ExecutionLog

Frame = tuple[tuple[float, float], tuple[float, float]]
# of the picture, right and up: what matters stays inside; the caption is below
FRAME: Frame = ((-0.80, 0.80), (-0.66, 0.82))
PORTRAIT: Frame = ((-0.97, 0.97), (-0.97, 0.93))  # the same for a picture without words
HAND = 0.11  # [m] from the fingertips to the wrist, which is to be in the picture
HOLD = 2.0  # [s] that the finished assembly is shown at the end


@dataclass(frozen=True)
class View:
    """Where the camera is to be from `start` to `end` [s of the film].

    Attributes:
        times: of the simulation [s], at which the view is to show much.
        subjects: points (n, 3) [m] that stay in the picture.
        pieces: whose surfaces are to be seen.
        direction: of an arrow that is to be seen from its side (3,), or zero.
    """

    kind: str
    start: float
    end: float
    times: tuple[float, ...]
    subjects: Array
    pieces: tuple[str, ...]
    direction: Array


def framed(
    points: Array,
    yaw: float,
    pitch: float,
    nearest: float,
    aspect: float,
    fov: float = 42.0,
    frame: Frame = FRAME,
) -> Camera:
    """The nearest camera of these angles that has all points (n, 3) within the frame, and not nearer than
    `nearest` [m]."""
    axes = Camera((0.0, 0.0, 0.0), 1.0, yaw, pitch, fov).axes
    local = points @ axes
    half = np.tan(np.deg2rad(fov) / 2) * np.array((aspect, 1.0))
    low, high = np.array(frame).T * half

    def slack(distance: float) -> tuple[Array, Array]:
        depth = (distance - local[:, 2:]).clip(
            1e-3
        )  # of the points before a camera this far from the origin's plane
        return (local[:, :2] - high * depth).max(axis=0), (local[:, :2] - low * depth).min(axis=0)

    near, far = float(local[:, 2].max()) + 0.05, float(local[:, 2].max()) + 10.0
    for _ in range(40):
        middle = (near + far) / 2
        left, right = slack(middle)
        near, far = (near, middle) if (left <= right).all() else (middle, far)
    centre = float(local[:, 2].mean())
    plane = max(far, centre + nearest)
    left, right = slack(plane)
    target = axes @ np.array((*((left + right) / 2), centre))
    return Camera(tuple(target.tolist()), plane - centre, yaw, pitch, fov)


def views(log: ExecutionLog, assembly: Assembly, speed: float) -> list[View]:
    """What the film is to show, in order: every pick, every insertion, and the end, which stays for HOLD."""
    found = []
    for phase in phases(log):
        if phase.kind == "pick" and any(s.kind == "grasp" for s in phase.segments):
            grasp = next(s for s in phase.segments if s.kind == "grasp")
            found.append(_view("pick", log, assembly, phase, (grasp.start, grasp.end), speed))
        elif phase.kind == "insert":
            slow = next((s for s in phase.segments if s.kind == "place"), phase.segments[0])
            found.append(_view("insert", log, assembly, phase, (slow.start, phase.end), speed))
    found = _one_at_a_time(found)
    last = float(log.times[-1])
    built = [name for name in assembly.names if is_there(log, assembly, name, last)]
    surfaces = [surface(log, assembly, last, name) for name in built] or [
        _goal(log, assembly, n) for n in assembly.names
    ]
    points = np.concatenate(surfaces)
    home = max((p.start for p in phases(log) if p.kind == "final"), default=last)
    times = (
        *np.linspace(max(home - 2.0, 0.0), home, 4).tolist(),
        last,
    )  # the arms leave the picture without crossing it
    points = np.concatenate((points, points * (1, 1, 0.82)))  # the foot of the stand is worth seeing as well
    return [
        *found,
        View("end", home / speed, last / speed + HOLD, times, points, assembly.names, np.zeros(3)),
    ]


def _one_at_a_time(found: list[View]) -> list[View]:
    """Views that do not overlap: insertions first, then picks."""
    kept: list[View] = []
    for view in sorted(found, key=lambda v: (v.kind != "insert", v.start)):
        if all(view.end <= other.start or other.end <= view.start for other in kept):
            kept.append(view)
    return sorted(kept, key=lambda v: v.start)


def _view(
    kind: str, log: ExecutionLog, assembly: Assembly, phase: Phase, span: tuple[float, float], speed: float
) -> View:
    subjects = [_goal(log, assembly, phase.piece)]
    arms = {phase.arm} | ({arm for arm, _ in holds(log, span[0])} if kind == "insert" else set())
    begin = span[0] if kind == "pick" else phase.start
    for time in (begin, span[1]):
        subjects += [hand(log, time, arm) for arm in sorted(arms)]
        subjects.append(surface(log, assembly, time, phase.piece))
    times = (*span, phase.end) if kind == "pick" else (phase.start, (phase.start + span[0]) / 2, *span)
    direction = phase.direction if kind == "insert" else np.zeros(3)
    return View(
        kind, span[0] / speed, span[1] / speed, times, np.concatenate(subjects), (phase.piece,), direction
    )


def sample(log: ExecutionLog, time: float) -> int:
    return int(np.searchsorted(log.times, time).clip(0, len(log.times) - 1))


def hand(log: ExecutionLog, time: float, arm: str) -> Array:
    T_world_tcp = log.tcp_pose(sample(log, time), arm)
    return np.stack((T_world_tcp[:3, 3], apply(T_world_tcp, (0.0, 0.0, -HAND))))


def _goal(log: ExecutionLog, assembly: Assembly, name: str) -> Array:
    k = assembly.index(name)
    return apply(log.T_world_assembly @ assembly.goals[k], assembly.pieces[k].vertices)


def surface(log: ExecutionLog, assembly: Assembly, time: float, name: str) -> Array:
    """Points on a piece (n, 3) in the world: its vertices, a little inside, and the middles of its
    triangles."""
    piece = assembly.pieces[assembly.index(name)]
    corners = 0.97 * piece.vertices + 0.03 * piece.vertices.mean(axis=0)
    points = np.concatenate((corners, piece.vertices[piece.faces].mean(axis=1)))
    return apply(log.piece_pose(sample(log, time), name), points)


def is_there(log: ExecutionLog, assembly: Assembly, name: str, time: float) -> bool:
    """Whether a piece is anywhere near its goal: what fell off is not to draw the camera away."""
    end = log.piece_pose(sample(log, time), name)[:3, 3]
    goal = (log.T_world_assembly @ assembly.goals[assembly.index(name)])[:3, 3]
    return float(np.linalg.norm(end - goal)) < 0.05
