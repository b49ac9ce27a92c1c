"""Writes the meshes of the example assemblies (meshes/<product>/*.obj, .stl, .ply, .glb); the .toml files are
written by hand.

Every piece lies in its own frame, with the origin in the middle of its underside unless its function says
otherwise; sizes here are in mm, files in the unit of their assembly. The same bytes each time."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import trimesh
from manifold3d import CrossSection, FillRule, Manifold

from soma_bullet.frames import Array

Solids = dict[str, Manifold]  # by the name of the mesh file

ROUND = 24  # sections of a peg and of its hole: equal, so that they fit face to face
FINE = 16  # ... of thinner ones
COARSE = 12  # ... of the thinnest; each costs parts and planning time
PER_MM = {"mm": 1.0, "cm": 0.1, "m": 1e-3, "in": 1 / 25.4}


def block(x: float, y: float, z: float) -> Manifold:
    """A box on the plane z = 0, x and y about the origin."""
    return Manifold.cube([x, y, z], True).translate([0, 0, z / 2])


def peg(radius: float, height: float, sections: int = ROUND) -> Manifold:
    """A cylinder on the plane z = 0."""
    return Manifold.cylinder(height, radius, radius, sections)


def prism(corners: Sequence[Sequence[float]] | Array, depth: float) -> Manifold:
    """A polygon of the plane (x, z), given anticlockwise, with a thickness along y about the origin."""
    section = CrossSection([np.asarray(corners, float).tolist()], FillRule.Positive)
    return Manifold.extrude(section, depth).translate([0, 0, -depth / 2]).rotate([90, 0, 0])


def dowel() -> Solids:
    """A round peg and a block with a blind hole."""
    return {"block.obj": block(50, 40, 30) - peg(8, 30).translate([0, 0, 12]), "dowel.obj": peg(8, 50)}


def bracket() -> Solids:
    """Sizes are whole eighths of an inch. The bracket's origin is in the middle of the underside of its
    web."""
    inch = 25.4
    web = block(3.5 * inch, 0.75 * inch, 0.375 * inch)
    flange = block(0.375 * inch, 0.75 * inch, 0.75 * inch).translate([1.5625 * inch, 0, -0.75 * inch])
    return {
        "post.obj": block(0.75 * inch, 0.75 * inch, 2 * inch),
        "bracket.obj": web + flange + flange.mirror([1, 0, 0]),
    }


def sliding_lid() -> Solids:
    """The lid's way is a groove in three walls, over the lower fourth one at -x; its origin is below its
    handle."""
    room = block(64, 44, 40).translate([0, 0, 6])
    groove = block(75, 50, 4).translate([-2.5, 0, 32])
    entrance = block(20, 44, 20).translate([-40, 0, 32])
    box = block(80, 60, 40) - room - groove - entrance
    lid = block(75, 50, 4) + block(30, 10, 20).translate([2.5, 0, 4])
    return {"box.stl": box, "cargo.stl": block(24, 24, 24), "lid.stl": lid}


def leaning_bridge() -> Solids:
    """An A of two legs and one of two rafters; each origin lies in the axis of its pair, on the plane that it
    stands on."""

    def pair(foot: float, rise: float, width: float) -> tuple[Manifold, Manifold]:
        """Beams with feet at -foot and foot, and axes that meet at `rise`; the first butts against the second
        from below."""
        along = np.array((foot, rise)) / np.hypot(foot, rise)
        across = np.array((-along[1], along[0])) * width / 2
        axis = np.array([-along, along]) * 300.0 - (foot, 0)
        band = CrossSection([[*(axis - across), *(axis + across)[::-1]]], FillRule.Positive)
        first = band ^ CrossSection.square([600, rise], False).translate([-300, 0])
        second = first.mirror([1, 0])
        # the larger piece: a sliver is left where the first would come out above the second
        stump = max((first - second).decompose(), key=lambda part: part.area())
        return prism(stump.to_polygons()[0], 18), prism(second.to_polygons()[0], 18)

    under, over = pair(20, 60, 14)
    low, high = pair(45, 44, 13)
    return {"leg_under.obj": under, "leg_over.obj": over, "rafter_under.obj": low, "rafter_over.obj": high}


def arch() -> Solids:
    """Stones of a round arch; the origin of all is the centre of the arch, its springing line the plane that
    it stands on."""
    inner, outer, depth = 30.0, 50.0, 24.0

    def stone(start: float, stop: float) -> Manifold:
        angles = np.deg2rad(np.linspace(start, stop, round((stop - start) / 9) + 1))
        arc = np.column_stack([np.cos(angles), np.sin(angles)])
        return prism(np.vstack([arc * outer, arc[::-1] * inner]), depth)

    shoulder = block(24, depth, 26).translate([54, 0, 0]) - Manifold.cylinder(60, 40, 40, 64, True).rotate(
        [90, 0, 0]
    )
    return {
        "springer.ply": stone(0, 36) + shoulder,
        "haunch.ply": stone(36, 72),
        "keystone.ply": stone(72, 108),
    }


def gears() -> Solids:
    """Ten and fourteen teeth of module 3, straight-sided, with play at the flanks; hubs to grip them by.

    The pinion's teeth are half a tooth on, so that its bore, like all, lies with its sections as its shaft
    does."""

    def gear(teeth: int, ahead: float = 0.0, module: float = 3.0) -> Manifold:
        pitch = module * teeth / 2
        # radius, and half the angle of a tooth there in pitches; the tooth is thinner than half a pitch:
        # backlash
        profile = ((pitch - 1.1 * module, 0.36), (pitch, 0.22), (pitch + 0.9 * module, 0.09))
        corners = []
        for k in range(teeth):
            for radius, half in (*[(r, -h) for r, h in profile], *[(r, h) for r, h in profile[::-1]]):
                angle = 2 * np.pi * (k + ahead + half) / teeth
                corners.append((radius * np.cos(angle), radius * np.sin(angle)))
        rim = Manifold.extrude(CrossSection([corners], FillRule.Positive), 10)
        return rim + peg(9, 22, FINE) - peg(4, 30, COARSE)

    hole = peg(4, 20, COARSE).translate([0, 0, 5])
    plate = block(82, 48, 14) - hole.translate([-21, 0, 0]) - hole.translate([15, 0, 0])
    return {
        "plate.glb": plate,
        "shaft.glb": peg(4, 50, COARSE),
        "pinion.glb": gear(10, 0.5),
        "wheel.glb": gear(14),
    }


def dovetail() -> Solids:
    """A slide in a groove that is wider at the bottom and closed at +y, and the pin that locks it."""
    tongue = [(-8, 0), (8, 0), (8 + 7, -12), (-8 - 7, -12)][::-1]
    carriage = prism(tongue, 40) + block(40, 40, 14)
    groove = prism(tongue, 40).translate([0, -5, 20])
    base = block(64, 50, 20) - groove - peg(4, 40, FINE).translate([0, -5, 3])
    return {
        "base.stl": base,
        "slide.stl": carriage - peg(4, 60, FINE).translate([0, 0, -20]),
        "pin.stl": peg(4, 30, FINE) + block(16, 16, 18).translate([0, 0, 29]),
    }


def stool() -> Solids:
    """Lies on its seat. A leg's origin is at its shoulder; the tenon is below."""
    seat = peg(36, 14, 32)
    for angle in (90, 210, 330):
        seat -= peg(5, 20, FINE).rotate([0, 0, -angle]).translate([22, 0, 6]).rotate([0, 0, angle])
    leg = peg(7.5, 46, FINE) + peg(5, 8, FINE).translate([0, 0, -8])
    return {"seat.obj": seat, "leg.obj": leg}


def tower() -> Solids:
    """Rings that get smaller on a peg, and a knob with a blind hole on its end."""
    foot = peg(32, 10, 32) + peg(7, 72, FINE)
    rings = {
        f"ring{k}.ply": peg(radius, 14, 32) - peg(7, 14, FINE) for k, radius in enumerate((28, 23, 18), 1)
    }
    knob = peg(12, 22, 32) - peg(7, 10, FINE)
    return {"foot.ply": foot, **rings, "knob.ply": knob}


def hinge() -> Solids:
    """The pin's origin is below its knob, its shank goes down; so it lies along -x at its goal. A hand grips
    the knob."""
    bore = peg(6, 100, FINE).translate([0, 0, -50]).rotate([0, 90, 0])
    cheek = block(10, 28, 40).translate([15, 0, 8])
    clevis = block(44, 34, 8) + cheek + cheek.mirror([1, 0, 0]) - bore.translate([0, 0, 34])
    link = block(20, 24, 72) - bore.translate([0, 0, 26])
    return {
        "clevis.stl": clevis,
        "link.stl": link,
        "pin.stl": peg(6, 46, FINE).translate([0, 0, -46]) + peg(10, 22, FINE),
    }


def crate() -> Solids:
    """A box and two dividers that are halved over each other."""
    box = block(76, 76, 36) - block(64, 64, 40).translate([0, 0, 6])
    wall = block(64, 10, 42)
    slot = block(10, 20, 30)
    return {
        "box.obj": box,
        "lower.obj": wall - slot.translate([0, 0, 21]),
        "upper.obj": wall - slot.translate([0, 0, -9]),
    }


def wedge_clamp() -> Solids:
    """A trough, a workpiece, and two wedges; the second one is 4 mm short of the floor, so that it jams
    before it lands, also when it has slid as far as the gaps let it."""
    trough = block(100, 36, 46) - block(80, 60, 46).translate([0, 0, 8])
    fixed = prism([(-13, 0), (13, 0), (13, 40), (1, 40)], 36)
    driven = prism([(-20, 4), (-4.6, 4), (12.9, 54), (-20, 54)], 36)
    return {"trough.obj": trough, "work.obj": block(40, 36, 44), "fixed.obj": fixed, "driven.obj": driven}


def burr() -> Solids:
    """The six-piece burr without a hollow inside: only the key comes out first; the origin of all is its
    centre."""
    unit = 9.0

    def bar(low: tuple[int, int, int], high: tuple[int, int, int]) -> Manifold:
        """A box between two corners, in units."""
        size = [unit * (b - a) for a, b in zip(low, high, strict=True)]
        return Manifold.cube(size).translate([unit * a for a in low])

    post = bar((-2, -1, -4), (0, 1, 4)) - bar((-1, -1, -2), (0, 1, 2))
    cross = bar((-4, -2, -1), (4, 0, 1)) - bar((-2, -1, -1), (2, 0, 1)) - bar((-1, -2, 0), (1, -1, 1))
    beam = bar((-1, -4, -2), (1, 4, 0)) - bar((-1, -2, -1), (1, -1, 0)) - bar((-1, 1, -1), (1, 2, 0))
    return {"post.obj": post, "cross.obj": cross, "beam.obj": beam, "key.obj": bar((-1, -4, 0), (1, 4, 2))}


def dominoes() -> Solids:
    """A block, and dominoes that lean: each touches the one before it with its upper edge alone. They stand
    on their lower edges."""
    return {"block.obj": block(40, 30, 64), "domino.obj": block(10, 30, 60)}


def leonardo() -> Solids:
    """Square beams: three along the bridge and two across it. The origin of the long ones is in the middle of
    their underside as well."""
    return {"long.obj": block(118, 12, 12), "cross.obj": block(12, 60, 12)}


PRODUCTS: tuple[tuple[Callable[[], Solids], str], ...] = (
    (dowel, "mm"),
    (bracket, "in"),
    (sliding_lid, "mm"),
    (leaning_bridge, "cm"),
    (arch, "mm"),
    (gears, "m"),
    (dovetail, "in"),
    (stool, "mm"),
    (tower, "cm"),
    (hinge, "mm"),
    (crate, "mm"),
    (wedge_clamp, "mm"),
    (burr, "mm"),
    (dominoes, "mm"),
    (leonardo, "mm"),
)


def tidy(body: Manifold) -> trimesh.Trimesh:
    """The surface [mm] with its corners and triangles in an order that follows from the shape."""
    raw = body.to_mesh64()
    corners = np.round(np.asarray(raw.vert_properties)[:, :3], 6) + 0.0
    faces = np.asarray(raw.tri_verts, int)
    order = np.lexsort(corners.T[::-1])
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    faces = rank[faces]
    faces = np.array([np.roll(face, -face.argmin()) for face in faces])
    return trimesh.Trimesh(corners[order], faces[np.lexsort(faces.T[::-1])], process=False)


def write(body: Manifold, path: Path, unit: str) -> None:
    """Write one piece in the format that the ending of its name says."""
    mesh = tidy(body)
    mesh.apply_scale(PER_MM[unit])
    if path.suffix == ".obj":
        lines = [f"# {path.parent.name}: {path.stem}, unit {unit}", f"o {path.stem}"]
        lines += ["v " + " ".join(f"{value:.7g}" for value in vertex) for vertex in mesh.vertices]
        lines += ["f " + " ".join(str(corner + 1) for corner in face) for face in mesh.faces]
        path.write_text("\n".join(lines) + "\n")
        return
    content = mesh.export(file_type=path.suffix[1:])
    path.write_bytes(content.encode() if isinstance(content, str) else content)


def main(folder: Path) -> None:
    """Write the meshes of all products into their folders under `folder`."""
    for product, unit in PRODUCTS:
        place = folder / product.__name__
        place.mkdir(parents=True, exist_ok=True)
        for name, body in product().items():
            write(body, place / name, unit)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "folder", nargs="?", type=Path, default=Path(__file__).resolve().parents[1] / "meshes"
    )
    main(parser.parse_args().folder)
