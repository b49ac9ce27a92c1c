"""What an assisting grasp can take: the certificate of a hold (paper Sec. IV-F asks for the grasp; this shows
that it holds).

The held piece is a body like the others; its hand is two pad patches that react within pad friction and the
grip force. The pads share twice the grip force: one may take more while the other takes less. The margin is
the factor by which the specified load could grow: a horizontal disturbance of every placed piece and the push
of the next insertion, on top of gravity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from soma_bullet.assembly.contact import proportions
from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import Array, tangents
from soma_bullet.grasp.hand import Hand
from soma_bullet.planner.equilibrium import (
    PYRAMID,
    Sides,
    active_contacts,
    contact_columns,
)
from soma_bullet.planner.options import HoldLoad
from soma_bullet.planner.programs import RayProgram

# A pad's pressure is spread out: four points at the mean distance of a square's points from its centre twist
# like the patch, (sqrt(2) + asinh(1)) / 6 of its side.
PATCH = (np.sqrt(2) + np.arcsinh(1.0)) / 6
GRAVITY = 9.81  # [m/s2]
SMALLEST_MARGIN = 1.0  # of a certificate: a hold with less would slip


@dataclass(frozen=True)
class HoldCertificate:
    """Evidence that a hold holds.

    Attributes:
        margin: factor by which the load could grow; at least 1 holds.
        load: what it was asked to resist.
        grip_force: [N].
        friction: between pad and piece.
        wrench: the largest wrench (6,) of the load on the held piece alone about the TCP [N, N m].
    """

    margin: float
    load: HoldLoad
    grip_force: float
    friction: float
    wrench: tuple[float, float, float, float, float, float]


def certify_hold(
    assembly: Assembly,
    hand: Hand,
    placed: frozenset[int],
    held: int,
    T_assembly_tcp: Array,
    sides: Sides,
    upcoming: int | None = None,
    direction: Array | None = None,
    load: HoldLoad | None = None,
    contact: float = 1.0,
) -> HoldCertificate:
    """Certificate of holding one placed piece by a grasp.

    Args:
        T_assembly_tcp: the hand (4, 4); x closes.
        sides: `dropped`, or `frictionless` where the state counts on side contacts.
        upcoming, direction: the next piece and its unit assembly direction (3,), if there is one.
        contact: fraction of the pad that lies on the piece.
    """
    load = load or HoldLoad()
    bodies = sorted(placed)
    friction = float(np.sqrt(assembly.pieces[held].friction * hand.pad_friction))
    active = active_contacts(assembly, placed, frozenset(), sides)
    columns = [contact_columns(c, assembly, bodies, frozenset({held}), sides) for c in active]
    pads = _pad_columns(hand, T_assembly_tcp, assembly.goal_centres[held], friction, contact)
    block = np.zeros((6 * len(bodies), pads.shape[1]))
    row = 6 * bodies.index(held)
    block[row : row + 6] = pads
    matrix = np.hstack([*columns, block])
    grip = np.zeros(matrix.shape[1])
    grip[matrix.shape[1] - pads.shape[1] :] = 1.0
    scaling = np.concatenate([[1, 1, 1, *([1 / assembly.pieces[k].radius] * 3)] for k in bodies])
    program = RayProgram(matrix, scaling, (grip[None], np.array([2 * hand.grip_force])))
    gravity = np.zeros((len(bodies), 6))
    gravity[:, 2] = [-assembly.pieces[k].mass * GRAVITY for k in bodies]
    push = _insertion_push(assembly, bodies, upcoming, direction, load.push)
    margins, largest = [], np.zeros(6)
    for angle in 2 * np.pi * np.arange(8) / 8:
        sway = np.zeros((len(bodies), 6))
        sway[:, :2] = np.outer(-gravity[:, 2] * load.disturbance, (np.cos(angle), np.sin(angle)))
        margins.append(program.farthest(gravity.ravel(), (push + sway).ravel()))
        wrench = (gravity + push + sway)[bodies.index(held)]
        wrench[3:] += np.cross(assembly.goal_centres[held] - T_assembly_tcp[:3, 3], wrench[:3])
        largest = max(largest, wrench, key=lambda w: float(np.linalg.norm(w[:3])))
        if margins[-1] <= 0:
            break
    fx, fy, fz, mx, my, mz = (float(v) for v in np.round(largest, 6) + 0.0)
    return HoldCertificate(max(0.0, min(margins)), load, hand.grip_force, friction, (fx, fy, fz, mx, my, mz))


def _pad_columns(hand: Hand, T_tcp: Array, com: Array, friction: float, contact: float) -> Array:
    """Wrenches (6, m) on the held piece of forces at the pads' points, each with a normal part of 1."""
    wrenches = []
    reach = hand.pad_size * PATCH * np.sqrt(contact)
    for side in (1.0, -1.0):
        normal = -side * T_tcp[:3, 0]
        t, b = tangents(normal)
        angles = 2 * np.pi * np.arange(PYRAMID) / PYRAMID
        forces = normal + friction * (np.cos(angles)[:, None] * t + np.sin(angles)[:, None] * b)
        for y, z in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            # the gap between the pads does not matter for the moment of a pair of pads: both act at their own
            # plane
            point = T_tcp[:3, 3] + y * reach[0] * T_tcp[:3, 1] + z * reach[1] * T_tcp[:3, 2]
            wrenches.append(np.hstack([forces, np.cross(point - com, forces)]))
    return np.vstack(wrenches).T


def _insertion_push(
    assembly: Assembly, bodies: list[int], upcoming: int | None, direction: Array | None, force: float
) -> Array:
    """Wrench (bodies, 6) of the next piece pressing along its direction on the placed pieces that it will
    touch.

    They share it by area, or by length where one has no area.
    """
    push = np.zeros((len(bodies), 6))
    if upcoming is None or direction is None:
        return push
    touched = [c for c in assembly.contacts_of(upcoming, frozenset(bodies)) if c.body_a in bodies]
    pressed = [c for c in touched if float(c.normal @ direction) < -0.1]
    parts = proportions(pressed)
    for c, part in zip(pressed, parts, strict=True):
        row = bodies.index(c.body_a)
        share = direction * force * part / sum(parts)
        push[row, :3] += share
        push[row, 3:] += np.cross(c.points.mean(axis=0) - assembly.goal_centres[c.body_a], share)
    return push
