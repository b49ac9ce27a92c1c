"""The camera of a film that looks for itself: wide where a piece is picked, closer where it is inserted,
never in a hurry.

Each view frames what matters at that time. Its angles are those from which, by rays, most of it is seen,
chosen for all views together so that the camera turns little; how far it moves in between is bounded by the
time there is for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import Array, apply, tangents
from soma_bullet.pictures.camera import Arrow, Camera
from soma_bullet.pictures.caption import Phase, phases
from soma_bullet.pictures.sight import Sight
from soma_bullet.pictures.views import PORTRAIT, View, framed, hand, is_there, sample, surface, views
from soma_bullet.world.log import ExecutionLog

YAWS, PITCHES = tuple(range(-75, 76, 15)), (-14.0, -21.0, -28.0, -36.0, -46.0)  # [deg]

NEAREST = {"pick": 0.95, "insert": 0.46, "end": 0.44}  # [m]
LIKED = {
    "pick": (30.0, -27.0),
    "insert": (35.0, -22.0),
    "end": (32.0, -18.0),
}  # [deg] yaw to either side, and pitch; of equals
ZOOM_RATE = 0.9  # change of the distance's logarithm a second
TURN_RATE = 20.0  # [deg/s] of yaw
TURN_COST = 0.006  # of one degree, in fractions of what is seen
DRIFT = 8.0  # [deg] of yaw during the last hold
ARROW_LENGTH = (0.05, 0.08)  # [m]
ASIDE = 0.034  # [m] from the path of the piece's centre to the arrow beside it
SEEN = 4e-3  # [m] a ray that ends nearer to its point has seen it
BLOCKED_COST = 2.5  # of a picture whose middle is full of what is before the action


@dataclass(frozen=True)
class Take:
    """Camera and arrow (None where there is none) of every frame."""

    cameras: tuple[Camera, ...]
    arrows: tuple[Arrow | None, ...]


def direct(
    log: ExecutionLog,
    assembly: Assembly,
    sight: Sight,
    times: Array,
    speed: float,
    aspect: float,
    fixed: Camera | None = None,
) -> Take:
    """Cameras and arrows at the times of the frames [s of the film], `speed` times which are simulated
    seconds.

    Args:
        sight: of the cell and the pieces; is moved about.
        fixed: a camera that stays.
    """
    if fixed is None:
        wanted = views(log, assembly, speed)
        cameras = cameras_at(times, wanted, calmed(wanted, choose(log, assembly, wanted, sight, aspect)))
    else:
        cameras = [fixed] * len(times)
    arrows: list[Arrow | None] = [None] * len(times)
    for phase in phases(log):
        frames = np.flatnonzero((times * speed >= phase.start) & (times * speed <= phase.end))
        if phase.kind == "insert" and phase.direction.any() and len(frames):
            arrow = _arrow(log, assembly, phase, sight, [cameras[frames[0]], cameras[frames[-1]]])
            for k in frames:
                arrows[k] = arrow
    return Take(tuple(cameras), tuple(arrows))


def _arrow(
    log: ExecutionLog, assembly: Assembly, phase: Phase, sight: Sight, cameras: Sequence[Camera]
) -> Arrow:
    """An arrow that ends beside the piece's goal, on the side where the cameras see most of it."""
    k = assembly.index(phase.piece)
    goal = apply(log.T_world_assembly, assembly.goal_centres[k])
    travel = sum(float(np.linalg.norm(s.offset)) for s in phase.segments if s.kind in ("insert", "place"))
    length = float(np.clip(travel, *ARROW_LENGTH))
    along, side = phase.direction, tangents(phase.direction)
    shaft = goal - np.linspace(0.0, length, 9)[:, None] * along
    offsets = [
        ASIDE * (np.cos(a) * side[0] + np.sin(a) * side[1])
        for a in np.linspace(0, 2 * np.pi, 12, endpoint=False)
    ]
    seen = np.zeros(len(offsets))
    for time, camera in zip((phase.start, phase.end), cameras, strict=True):
        _place(sight, log, time)
        seen += [float(_seen(sight, [camera], shaft + offset)[0]) for offset in offsets]
        # of equals, the one that stands clear of the piece in the picture, and not below it
        seen += [0.3 * float(camera.axes[:, 0] @ o) ** 2 / ASIDE**2 + 0.1 * o[2] / ASIDE for o in offsets]
    return Arrow(goal + offsets[int(seen.argmax())] - length * along, along, length)


# --- choosing -----------------------------------------------------------------------------------------------


def choose(
    log: ExecutionLog, assembly: Assembly, wanted: Sequence[View], sight: Sight, aspect: float
) -> list[Camera]:
    """A camera for each view: the angles that together show the most and turn the least."""
    angles = list(product(YAWS, PITCHES))
    values = np.array([_values(log, assembly, view, angles, sight, aspect) for view in wanted])
    yaws, pitches = np.array(angles).T
    turns = np.abs(yaws[:, None] - yaws) + 1.2 * np.abs(pitches[:, None] - pitches)
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
    return [
        framed(v.subjects, *angles[a], NEAREST[v.kind], aspect)
        for v, a in zip(wanted, reversed(path), strict=True)
    ]


def _values(
    log: ExecutionLog,
    assembly: Assembly,
    view: View,
    angles: Sequence[tuple[float, float]],
    sight: Sight,
    aspect: float,
) -> Array:
    """How much of what a view is about is seen from each pair of angles, 0..1, less what stands in the
    camera's way."""
    cameras = [framed(view.subjects, *angle, NEAREST[view.kind], aspect) for angle in angles]
    total = np.zeros(len(cameras))
    for time in view.times:
        _place(sight, log, time)
        shown = np.concatenate([surface(log, assembly, time, name) for name in view.pieces])
        total += _seen(sight, cameras, shown) - BLOCKED_COST * _blocked(sight, cameras, aspect)
        built = [surface(log, assembly, time, n) for n in assembly.names if is_there(log, assembly, n, time)]
        if view.kind == "pick" and built:
            total += 0.5 * _seen(sight, cameras, np.concatenate(built))
        if view.kind == "insert":
            tips = np.concatenate([hand(log, time, arm)[:1] for arm in log.arm_names])
            total += 0.15 * _seen(sight, cameras, tips, 0.03)
    total /= len(view.times)
    yaw, pitch = LIKED[view.kind]
    for k, camera in enumerate(cameras):
        total[k] -= 0.0015 * abs(abs(camera.yaw) - yaw) + 0.005 * abs(camera.pitch - pitch)
        total[k] += 0.5 * float(np.linalg.norm(np.cross(view.direction, camera.axes[:, 2])))
    return total


def _place(sight: Sight, log: ExecutionLog, time: float) -> None:
    at = sample(log, time)
    joints = dict(zip(log.joint_names, log.joints[at].tolist(), strict=True))
    sight.place(joints, {name: log.piece_pose(at, name) for name in log.piece_names})


def _seen(sight: Sight, cameras: Sequence[Camera], points: Array, within: float = SEEN) -> Array:
    """Fraction of points (n, 3) that are in sight of each camera."""
    eyes = np.repeat([camera.eye for camera in cameras], len(points), axis=0)
    ends = np.tile(points, (len(cameras), 1))
    short = (1.0 - sight.reach(eyes, ends)) * np.linalg.norm(ends - eyes, axis=1)
    return (short < within).reshape(len(cameras), -1).mean(axis=1)


def _blocked(sight: Sight, cameras: Sequence[Camera], aspect: float) -> Array:
    """Fraction of the middle of each camera's picture that something fills which is clearly before the
    target."""
    u, v = (side.ravel() for side in np.meshgrid(np.linspace(-0.75, 0.75, 11), np.linspace(-0.5, 0.75, 6)))
    starts, ends = [], []
    for camera in cameras:
        half = np.tan(np.deg2rad(camera.fov) / 2)
        rays = np.stack((u * half * aspect, v * half, -np.ones_like(u)), axis=1) @ camera.axes.T
        starts.append(np.broadcast_to(camera.eye, rays.shape))
        ends.append(camera.eye + 0.75 * camera.distance * rays)
    reached = sight.reach(np.concatenate(starts), np.concatenate(ends))
    return (reached < 1.0).reshape(len(cameras), -1).mean(axis=1)


def portrait(log: ExecutionLog, assembly: Assembly, sight: Sight, aspect: float) -> Camera:
    """The camera of the still: the assembly between the two arms, from where most of it is seen."""
    end = float(log.times[-1])
    _place(sight, log, end)
    shown = np.concatenate([surface(log, assembly, end, name) for name in assembly.names])
    cameras = [
        framed(sight.robot(), yaw, -15.0, 1.0, aspect, 24.0, PORTRAIT)
        for yaw in (-60, -45, -30, -15, 15, 30, 45, 60)
    ]
    away = np.abs(np.abs([camera.yaw for camera in cameras]) - 30.0)
    return cameras[int((_seen(sight, cameras, shown) - 0.002 * away).argmax())]


# --- moving -------------------------------------------------------------------------------------------------


def calmed(wanted: Sequence[View], cameras: Sequence[Camera]) -> list[Camera]:
    """The cameras, those that are close drawn back as far as the time for the moves to and from the wide ones
    asks."""
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
    """The camera at each time of the film [s]: at rest in each view, minimum jerk in between, a slow turn in
    the last."""
    keys = [
        (t, camera)
        for view, camera in zip(wanted[:-1], cameras[:-1], strict=True)
        for t in (view.start, view.end)
    ]
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
