"""The camera of a film that looks for itself: wide where a piece is picked, closer where it is inserted, never in a hurry.

Each view frames what matters at that time. Its angles are those from which, by rays, most of it is seen, chosen for all views
together so that the camera turns little; how far it moves in between is bounded by the time there is for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import Array, apply
from soma_bullet.sim.camera import Camera, Sight
from soma_bullet.sim.caption import Phase, holds, phases
from soma_bullet.sim.log import ExecutionLog

YAWS, PITCHES = tuple(range(-75, 76, 15)), (-18.0, -28.0, -38.0)  # [deg]
FRAME = ((-0.80, 0.80), (-0.66, 0.82))  # of the picture, right and up: what matters stays inside; the caption is below
NEAREST = {"pick": 0.95, "insert": 0.55, "end": 0.55}  # [m]
ZOOM_RATE = 0.75  # change of the distance's logarithm a second
TURN_RATE = 16.0  # [deg/s] of yaw
TURN_COST = 0.006  # of one degree, in fractions of what is seen
HAND = 0.11  # [m] from the fingertips to the wrist, which is to be in the picture
DRIFT = 8.0  # [deg] of yaw during the last hold
SEEN = 4e-3  # [m] a ray that ends nearer to its point has seen it
BLOCKED_COST = 0.8  # of a picture that is full of what is near the camera


@dataclass(frozen=True)
class View:
    """Where the camera is to be from `start` to `end` [s of the film].

    Attributes:
        times: of the simulation [s], at which the view is to show much.
        subjects: points (n, 3) [m] that stay in the picture.
        piece: whose surface is to be seen; None for all.
    """

    kind: str
    start: float
    end: float
    times: tuple[float, ...]
    subjects: Array
    pieces: tuple[str, ...]


def framed(points: Array, yaw: float, pitch: float, nearest: float, aspect: float, fov: float = 35.0) -> Camera:
    """The nearest camera of these angles that has all points (n, 3) within FRAME, and not nearer than `nearest` [m]."""
    axes = Camera((0.0, 0.0, 0.0), 1.0, yaw, pitch, fov).axes
    local = points @ axes
    half = np.tan(np.deg2rad(fov) / 2) * np.array((aspect, 1.0))
    low, high = np.array(FRAME).T * half

    def slack(distance: float) -> tuple[Array, Array]:
        depth = (distance - local[:, 2:]).clip(1e-3)  # of the points before a camera this far from the origin's plane
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


def views(log: ExecutionLog, assembly: Assembly, speed: float, hold: float) -> list[View]:
    """What the film is to show, in order: every pick, every insertion, and the end, which stays for `hold` [s]."""
    found = []
    for phase in phases(log):
        if phase.kind == "pick" and any(s.kind == "grasp" for s in phase.segments):
            grasp = next(s for s in phase.segments if s.kind == "grasp")
            found.append(_view("pick", log, assembly, phase, (grasp.start, grasp.end), speed))
        elif phase.kind == "insert":
            slow = next((s for s in phase.segments if s.kind == "place"), phase.segments[0])
            found.append(_view("insert", log, assembly, phase, (slow.start, phase.end), speed))
    last = float(log.times[-1])
    points = np.concatenate([_surface(log, assembly, last, name) for name in assembly.names if _is_placed(log, assembly, name)] or
                            [_goal(log, assembly, name) for name in assembly.names])  # fmt: skip
    home = max((p.start for p in phases(log) if p.kind == "final"), default=last)
    points = np.concatenate((points, points * (1, 1, 0.82)))  # the foot of the stand is worth seeing as well
    return [*found, View("end", home / speed, last / speed + hold, (last,), points, assembly.names)]


def _view(kind: str, log: ExecutionLog, assembly: Assembly, phase: Phase, span: tuple[float, float], speed: float) -> View:
    subjects = [_goal(log, assembly, phase.piece)]
    arms = {phase.arm} | ({arm for arm, _ in holds(log, span[0])} if kind == "insert" else set())
    begin = span[0] if kind == "pick" else phase.start
    for time in (begin, span[1]):
        subjects += [_hand(log, time, arm) for arm in sorted(arms)]
        subjects.append(_surface(log, assembly, time, phase.piece))
    times = (span[0], span[1]) if kind == "pick" else ((phase.start + span[0]) / 2, span[0], span[1])
    return View(kind, span[0] / speed, span[1] / speed, times, np.concatenate(subjects), (phase.piece,))


def _sample(log: ExecutionLog, time: float) -> int:
    return int(np.searchsorted(log.times, time).clip(0, len(log.times) - 1))


def _hand(log: ExecutionLog, time: float, arm: str) -> Array:
    T_world_tcp = log.tcp_pose(_sample(log, time), arm)
    return np.stack((T_world_tcp[:3, 3], apply(T_world_tcp, (0.0, 0.0, -HAND))))


def _goal(log: ExecutionLog, assembly: Assembly, name: str) -> Array:
    k = assembly.index(name)
    return apply(log.T_world_assembly @ assembly.goals[k], assembly.pieces[k].vertices)


def _surface(log: ExecutionLog, assembly: Assembly, time: float, name: str) -> Array:
    """Points on a piece (n, 3) in the world: its vertices, a little inside, and the middles of its triangles."""
    piece = assembly.pieces[assembly.index(name)]
    corners = 0.97 * piece.vertices + 0.03 * piece.vertices.mean(axis=0)
    points = np.concatenate((corners, piece.vertices[piece.faces].mean(axis=1)))
    return apply(log.piece_pose(_sample(log, time), name), points)


def _is_placed(log: ExecutionLog, assembly: Assembly, name: str) -> bool:
    """Whether a piece ended up anywhere near its goal: what fell off is not to draw the camera away."""
    end = log.piece_pose(-1, name)[:3, 3]
    goal = (log.T_world_assembly @ assembly.goals[assembly.index(name)])[:3, 3]
    return float(np.linalg.norm(end - goal)) < 0.05


# --- choosing ----------------------------------------------------------------------------------------------------------


def choose(log: ExecutionLog, assembly: Assembly, wanted: Sequence[View], sight: Sight, aspect: float) -> list[Camera]:
    """A camera for each view: the angles that together show the most and turn the least."""
    angles = list(product(YAWS, PITCHES))
    values = np.array([_values(log, assembly, view, angles, sight, aspect) for view in wanted])
    yaws, pitches = np.array(angles).T
    turns = np.abs(yaws[:, None] - yaws) + 1.5 * np.abs(pitches[:, None] - pitches)
    best, back = values[0], []
    for k in range(1, len(wanted)):
        gap = max(wanted[k].start - wanted[k - 1].end, 0.3)
        too_far = turns > TURN_RATE * gap * (1.0 + 1e-9)
        total = best[:, None] - TURN_COST * turns - np.where(too_far, 0.02 * (turns - TURN_RATE * gap), 0.0)
        back.append(total.argmax(axis=0))
        best = total.max(axis=0) + values[k]
    path = [int(best.argmax())]
    for previous in reversed(back):
        path.append(int(previous[path[-1]]))
    return [framed(v.subjects, *angles[a], NEAREST[v.kind], aspect) for v, a in zip(wanted, reversed(path), strict=True)]


def _values(
    log: ExecutionLog, assembly: Assembly, view: View, angles: Sequence[tuple[float, float]], sight: Sight, aspect: float
) -> Array:
    """How much of what a view is about is seen from each pair of angles, 0..1, less what stands in the camera's way."""
    cameras = [framed(view.subjects, *angle, NEAREST[view.kind], aspect) for angle in angles]
    total = np.zeros(len(cameras))
    for time in view.times:
        sample = _sample(log, time)
        sight.place(dict(zip(log.joint_names, log.joints[sample].tolist(), strict=True)),
                    {name: log.piece_pose(sample, name) for name in log.piece_names})  # fmt: skip
        surface = np.concatenate([_surface(log, assembly, time, name) for name in view.pieces])
        hands = np.concatenate([_hand(log, time, arm)[:1] for arm in log.arm_names]) if view.kind == "insert" else surface[:0]
        for k, camera in enumerate(cameras):
            total[k] += _seen(sight, camera, surface) - BLOCKED_COST * _blocked(sight, camera, aspect)
            if len(hands):
                total[k] += 0.15 * _seen(sight, camera, hands, 0.03)
    total /= len(view.times)
    yaws = np.array([camera.yaw for camera in cameras])
    return total - 0.0015 * np.abs(np.abs(yaws) - 30.0)  # of equals, the three-quarter view


def _seen(sight: Sight, camera: Camera, points: Array, within: float = SEEN) -> float:
    """Fraction of points that are in sight of a camera."""
    short = (1.0 - sight.reach(camera.eye, points)) * np.linalg.norm(points - camera.eye, axis=1)
    return float((short < within).mean())


def _blocked(sight: Sight, camera: Camera, aspect: float) -> float:
    """Fraction of the picture that something fills which is nearer than half the way to the target."""
    half = np.tan(np.deg2rad(camera.fov) / 2)
    u, v = (side.ravel() for side in np.meshgrid(np.linspace(-0.9, 0.9, 9), np.linspace(-0.9, 0.9, 5)))
    rays = np.stack((u * half * aspect, v * half, -np.ones_like(u)), axis=1) @ camera.axes.T
    return float((sight.reach(camera.eye, camera.eye + 0.55 * camera.distance * rays) < 1.0).mean())


# --- moving ------------------------------------------------------------------------------------------------------------


def calmed(wanted: Sequence[View], cameras: Sequence[Camera]) -> list[Camera]:
    """The cameras, those that are close drawn back as far as the time for the moves to and from the wide ones asks."""
    logs = np.log([camera.distance for camera in cameras])
    for _ in cameras:
        for k, view in enumerate(wanted):
            for other in (k - 1, k + 1):
                if view.kind == "insert" and 0 <= other < len(wanted):
                    early, late = sorted((k, other))
                    gap = max(wanted[late].start - wanted[early].end, 0.0)
                    logs[k] = max(logs[k], logs[other] - ZOOM_RATE * gap)
    return [replace(camera, distance=float(np.exp(d))) for camera, d in zip(cameras, logs, strict=True)]


def cameras_at(times: Array, wanted: Sequence[View], cameras: Sequence[Camera]) -> list[Camera]:
    """The camera at each time of the film [s]: at rest in each view, minimum jerk in between, a slow turn in the last."""
    keys = [(t, camera) for view, camera in zip(wanted[:-1], cameras[:-1], strict=True) for t in (view.start, view.end)]
    keys += [(wanted[-1].start, cameras[-1]), (wanted[-1].end, cameras[-1].orbited(DRIFT))]
    stops = np.array([time for time, _ in keys])
    rows = np.array([_row(camera) for _, camera in keys])
    found = []
    for time in times:
        k = int(np.searchsorted(stops, time, side="right"))
        if k in (0, len(stops)):
            row = rows[min(k, len(stops) - 1)]
        else:
            s = (time - stops[k - 1]) / max(stops[k] - stops[k - 1], 1e-9)
            row = rows[k - 1] + (10 * s**3 - 15 * s**4 + 6 * s**5) * (rows[k] - rows[k - 1])
        found.append(_camera(row))
    return found


def _row(camera: Camera) -> list[float]:
    return [*camera.target, float(np.log(camera.distance)), camera.yaw, camera.pitch, camera.fov]


def _camera(row: Array) -> Camera:
    x, y, z, log_distance, yaw, pitch, fov = row.tolist()
    return Camera((x, y, z), float(np.exp(log_distance)), yaw, pitch, fov)
