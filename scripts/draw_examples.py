"""Draws docs/examples.png: an exploded view of every example assembly, with no piece that hangs in the
air."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = (
    "dowel",
    "bracket",
    "sliding_lid",
    "crate",
    "dovetail",
    "hinge",
    "wedge_clamp",
    "stool",
    "tower",
    "gears",
    "leaning_bridge",
    "arch",
    "burr",
    "soma3",
    "soma4",
    "cube",
)
COLUMNS = 4
TILE = (480, 384)  # [pixels]
COLORS = 256  # a palette is enough for a drawing, and makes the file a fifth as large


def draw(name: str, path: Path) -> None:
    """Draw the exploded view of one example into `path`."""
    from soma_bullet.assembly.file import load_assembly
    from soma_bullet.grasp.hand import load_hand
    from soma_bullet.grasp.hand_set import HandSet
    from soma_bullet.pictures.exploded import draw_exploded
    from soma_bullet.planner.options import HoldLoad, PlannerOptions
    from soma_bullet.planner.plan import make_plan

    assembly = load_assembly(name)
    # the stones of the arch would give way to the usual 2 N of the last insertion
    options = PlannerOptions(analyzers=("grounded",), load=HoldLoad(push=1.0 if name == "arch" else 2.0))
    hands = HandSet.alike(load_hand(ROOT / "robots" / "ur5e_pair" / "hand.toml"))
    draw_exploded(assembly, make_plan(assembly, hands, options), path)


def main(path: Path) -> None:
    """Draw all examples and put them together on one sheet."""
    from PIL import Image

    rows = -(-len(EXAMPLES) // COLUMNS)
    sheet = Image.new("RGB", (TILE[0] * COLUMNS, TILE[1] * rows), "white")
    with tempfile.TemporaryDirectory() as folder:
        for k, name in enumerate(EXAMPLES):
            tile = Path(folder) / f"{name}.png"
            draw(name, tile)
            with Image.open(tile) as image:
                small = image.convert("RGB").resize(TILE, Image.Resampling.LANCZOS)
            sheet.paste(small, (k % COLUMNS * TILE[0], k // COLUMNS * TILE[1]))
    flat = sheet.quantize(COLORS, Image.Quantize.MAXCOVERAGE, kmeans=4, dither=Image.Dither.NONE)
    flat.save(path, optimize=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", nargs="?", type=Path, default=ROOT / "docs" / "examples.png")
    main(parser.parse_args().path)
