"""Antipodal grasps on opposite facets, flat or of a curved face (paper Sec. IV-C: find facets, sample them,
pair them)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from shapely import affinity

from soma_bullet.assembly.facets import Facet
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.frames import Array, Indices, readonly
from soma_bullet.grasp.hand import Hand
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.grasp.options import SamplingOptions

SMALLEST_OVERLAP = 1e-8  # [m2] of opposite faces
# a line of length l twists with mu F l / 4, a square of that side with mu F l (sqrt(2) + asinh(1)) / 6
LINE = (1.5 / (np.sqrt(2) + np.arcsinh(1.0))) ** 2


@dataclass(frozen=True, eq=False)
class GraspSet:
    """n grasps of one piece, by hands of several kinds.

    Attributes:
        Ts_piece_tcp: (n, 4, 4); x is the closing axis, z the approach direction.
        widths: distance between the pads (n,) [m].
        contact: fraction of the pad on the piece (n,), in 0..1.
        kinds: kind of the hand (n,), an index of `HandSet.kinds`; ascending as they are sampled.
    """

    Ts_piece_tcp: Array
    widths: Array
    contact: Array
    kinds: Indices

    def __len__(self) -> int:
        return len(self.widths)

    def take(self, indices: Indices) -> GraspSet:
        """The grasps at `indices`, in that order."""
        return GraspSet(
            readonly(self.Ts_piece_tcp[indices]),
            readonly(self.widths[indices]),
            readonly(self.contact[indices]),
            readonly(self.kinds[indices], int),
        )


def sample_grasps(piece: Workpiece, hands: HandSet, options: SamplingOptions | None = None) -> GraspSet:
    """All antipodal grasps of `piece` that the hands can close on, whatever is around it: kind after kind.

    The set depends on the piece and the hands alone (a grid, no random numbers), so that qualities of orders
    compare."""
    options = options or SamplingOptions()
    sampled = [_sampled(piece, hand, options) for hand in hands.kinds]
    Ts, widths, contact = (np.concatenate(parts) for parts in zip(*sampled, strict=True))
    kinds = np.repeat(np.arange(len(sampled)), [len(widths) for _, widths, _ in sampled])
    return GraspSet(readonly(Ts), readonly(widths), readonly(contact), readonly(kinds, int))


def _sampled(piece: Workpiece, hand: Hand, options: SamplingOptions) -> tuple[Array, Array, Array]:
    """T_piece_tcp (n, 4, 4), widths (n,) [m] and contact (n,) of the grasps by one hand."""
    friction = np.sqrt(piece.friction * hand.pad_friction)
    widest = hand.opening - 2 * options.opening_margin
    transforms, widths, contacts = [], [], []
    facets = piece.facets
    for i, first in enumerate(facets):
        for second in facets[i + 1 :]:
            width = first.offset + second.offset  # opposite normals: the distance between the planes
            angle = np.arccos(np.clip(-first.normal @ second.normal, -1, 1))
            if angle > np.deg2rad(2.0) or angle > np.arctan(friction):
                continue
            if not options.smallest_width <= width <= widest:
                continue
            flat = shapely.transform(second.polygon, lambda xy, s=second, f=first: s.lift(xy) @ f.basis.T)
            overlap = first.polygon.intersection(flat)
            if overlap.area < SMALLEST_OVERLAP:
                continue
            curved = bool(first.turn or second.turn)
            for points, roll, fraction in _pad_placements(overlap, hand.pad_size, options, curved):
                rotation = _orientation(first, roll)
                for point, part in zip(points, fraction, strict=True):
                    transform = np.eye(4)
                    transform[:3, :3] = rotation
                    transform[:3, 3] = first.lift(point[None])[0] - first.normal * width / 2
                    transforms.append(transform)
                    widths.append(width)
                    contacts.append(part)
    return np.array(transforms).reshape(-1, 4, 4), np.array(widths), np.array(contacts)


def _orientation(facet: Facet, roll: float) -> Array:
    """Columns: closing axis along the facet's normal, and the approach direction at `roll` [rad] in the
    facet's basis."""
    approach = np.cos(roll) * facet.basis[0] + np.sin(roll) * facet.basis[1]
    return np.column_stack([facet.normal, np.cross(approach, facet.normal), approach])


def _pad_placements(
    overlap: shapely.Geometry, pad_size: Array, options: SamplingOptions, curved: bool
) -> list[tuple[Array, float, Array]]:
    """For each roll: grid points (k, 2) on the overlap, the roll [rad], and the fraction of the pad that lies
    on it (k,).

    On a curved face a pad touches along a line: its length counts, and as a contact it is worth the patch
    that twists like it."""
    low, high = np.array(overlap.bounds[:2]), np.array(overlap.bounds[2:])
    axes = [_ticks(low[k], high[k], options.spacing) for k in range(2)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    grid = grid[shapely.contains_xy(overlap.buffer(1e-7), grid[:, 0], grid[:, 1])]
    width, height = pad_size  # y and z of the hand
    pad = shapely.box(
        -height / 2, -width / 2, height / 2, width / 2
    )  # drawn with the approach along the first axis
    placements = []
    for k in range(options.rolls):
        roll = 2 * np.pi * k / options.rolls
        turned = np.array(affinity.rotate(pad, roll, origin=(0, 0), use_radians=True).exterior.coords)
        pads = shapely.polygons(turned[None] + grid[:, None])
        shared = shapely.intersection(pads, overlap)
        if curved:
            line = np.minimum(shapely.length(shared) / 2 / pad_size.min(), 1.0)
            fraction, good = np.round(LINE * line**2, 9), line >= options.smallest_contact
        else:
            fraction = np.round(shapely.area(shared) / pad.area, 9)
            good = fraction >= options.smallest_contact
        placements.append((grid[good], roll, fraction[good]))
    return placements


def _ticks(low: float, high: float, spacing: float) -> Array:
    """Points of [low, high] at most `spacing` apart, symmetric about the middle, half a step from the
    ends."""
    count = max(1, int(np.ceil(round((high - low) / spacing, 6))))
    return low + (np.arange(count) + 0.5) * (high - low) / count
