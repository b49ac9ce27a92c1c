"""Captions: what happens in an execution, in words, and how the words are drawn on a frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from importlib import util
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from soma_bullet.frames import Array
from soma_bullet.pictures import look
from soma_bullet.world.log import ExecutionLog, SegmentRecord

PHASES = {
    "transit": "pick", "approach": "pick", "grasp": "pick", "lift": "pick", "transfer": "bring",
    "insert": "insert", "place": "insert", "back_off": "insert", "lower": "put down", "set_down": "put down",
    "release": "release", "retreat": "release",
}  # fmt: skip
FAILURES = {"jammed": "{piece} jams", "lost": "{piece} is not between the fingers"}


@dataclass(frozen=True)
class Caption:
    """Words on a frame: a line, a smaller one below it, a note at the right, and the colour of the bar at the
    left."""

    text: str
    subtitle: str = ""
    note: str = ""
    rgb: look.Colour = look.NEUTRAL


@dataclass(frozen=True)
class Phase:
    """Neighbouring segments that are one action to a viewer.

    Attributes:
        kind: `pick`, `bring`, `insert`, `put down`, `release`, or the kind of its segments where that is none
            of them.
        start, end: [s] of simulated time.
    """

    kind: str
    arm: str
    piece: str
    segments: tuple[SegmentRecord, ...]

    @property
    def start(self) -> float:
        return self.segments[0].start

    @property
    def end(self) -> float:
        return self.segments[-1].end

    @property
    def direction(self) -> Array:
        """Unit direction of the straight travel (3,), zero where there is none."""
        travel = np.sum(
            [s.offset for s in self.segments if s.kind in ("insert", "place")] or np.zeros((1, 3)), axis=0
        )
        return travel / max(float(np.linalg.norm(travel)), 1e-9)


def phases(log: ExecutionLog) -> tuple[Phase, ...]:
    """The phases of an episode in the order in which they begin; those of different arms may overlap."""
    found = []
    for arm in dict.fromkeys(segment.arm for segment in log.segments):
        kinds: list[str] = []
        mine = [segment for segment in log.segments if segment.arm == arm]
        for segment in mine:
            settles = segment.kind == "settle" and kinds
            kinds.append(kinds[-1] if settles else PHASES.get(segment.kind, segment.kind))
        for (kind, piece), group in groupby(
            zip(kinds, mine, strict=True), key=lambda item: (item[0], item[1].piece)
        ):
            found.append(Phase(kind, arm, piece, tuple(segment for _, segment in group)))
    return tuple(sorted(found, key=lambda phase: phase.start))


def holds(log: ExecutionLog, time: float) -> tuple[tuple[str, str], ...]:
    """(arm, piece) of every hand that holds a placed piece at `time` [s]: from its settling until the hand
    lets go."""
    held: dict[str, str] = {}
    last: dict[str, str] = {}
    for segment in sorted(log.segments, key=lambda s: s.start):
        if segment.start > time:
            break
        if segment.kind == "settle" and last.get(segment.arm) != "set_down":
            held[segment.arm] = segment.piece
        elif segment.kind in ("release", "ablation"):
            held.pop(segment.arm, None)
        last[segment.arm] = segment.kind
    return tuple(sorted(held.items()))


def says(phase: Phase) -> str:
    """A phase in words."""
    arm, piece = phase.arm, phase.piece
    if phase.kind == "insert":
        return f"{arm} inserts {piece} along {vector(phase.direction)}"
    return {
        "pick": f"{arm} takes {piece}",
        "put down": f"{arm} puts {piece} down the other way",
        "bring": f"{arm} brings {piece}",
        "release": f"{arm} lets go of {piece}",
        "follow": f"{arm} lets {piece} down",
        "ablation": f"ablation: {arm} lets go of {piece}",
        "home": f"{arm} goes home",
        "final": "settling",
    }.get(phase.kind, f"{arm}: {phase.kind} {piece}")


def vector(values: ArrayLike) -> str:
    """Numbers with two decimals at most: (0, 0.71, −0.71)."""
    texts = (
        f"{value + 0.0:.2f}".rstrip("0").rstrip(".") for value in np.round(np.asarray(values, float), 2) + 0.0
    )
    return f"({', '.join(texts)})".replace("-", "−")


def narration(log: ExecutionLog, least: float) -> list[tuple[float, str, str]]:
    """Lines as (from when on [s], words, piece), each on show for half of `least` [s] at least.

    What is over before there was time to say it is not said; nor that a hand follows what it holds, mostly
    for the blink of an eye, where that does not last; nor that an arm goes home while another does something.
    """
    lines: list[tuple[float, float, str, str]] = []
    busy = [phase for phase in phases(log) if phase.kind != "home"]
    for phase in phases(log):
        if phase.kind == "follow" and phase.end - phase.start < 0.5 * least:
            continue  # over before it could be read
        if phase.kind == "home" and any(
            other.start < phase.end and phase.start < other.end for other in busy
        ):
            continue
        late = (
            least if phase.kind == "ablation" else 0.0
        )  # by which it may be said afterwards, as a failure may
        lines.append((phase.start, phase.end + late, says(phase), phase.piece))
        failed = [s for s in phase.segments if s.outcome in FAILURES]
        lines += [
            (s.end, s.end + least, f"{s.arm}: {FAILURES[s.outcome].format(piece=s.piece)}", s.piece)
            for s in failed
        ]
    shown: list[tuple[float, str, str]] = []
    free = -np.inf  # when the line before has been on show for long enough
    for start, end, words, piece in lines:
        begin = max(start, free)
        if begin < end:
            shown.append((begin, words, piece))
            free = begin + 0.5 * least
    return shown


# --- drawing ------------------------------------------------------------------------------------------------


@lru_cache(maxsize=16)
def _font(points: int, bold: bool):
    from PIL import ImageFont

    spec = util.find_spec("matplotlib")
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        file = Path(folder) / "mpl-data/fonts/ttf" / ("DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf")
        if file.is_file():
            return ImageFont.truetype(str(file), points)
    return ImageFont.load_default(points)


@lru_cache(maxsize=32)
def _band(size: tuple[int, int], caption: Caption):
    """The lower edge as an RGBA picture; the note is left to the frame."""
    from PIL import Image, ImageDraw

    width, height = size
    unit, tall = height / 720, band_height(height, caption)
    band = Image.new("RGBA", size, (0, 0, 0, 0))
    draw = ImageDraw.Draw(band)
    top, left = height - tall, round(32 * unit)
    draw.rectangle((0, top, width, height), fill=(18, 22, 28, 205))
    draw.rectangle((0, top, round(8 * unit), height), fill=(*(round(255 * c) for c in caption.rgb), 255))
    draw.text(
        (left, top + round(12 * unit)),
        caption.text,
        font=_font(round(25 * unit), True),
        fill=(255, 255, 255, 255),
    )
    if caption.subtitle:
        draw.text(
            (left, top + round(47 * unit)), caption.subtitle, font=_font(round(18 * unit), False), fill=_GREY
        )
    return band


_GREY = (214, 220, 228, 255)


def band_height(height: int, caption: Caption) -> int:
    """Pixels that a caption takes of a frame `height` pixels high."""
    return round((80 if caption.subtitle else 56) * height / 720)


def draw_caption(frame: NDArray[np.uint8], caption: Caption) -> NDArray[np.uint8]:
    """The frame (h, w, 3) with a band along its lower edge."""
    from PIL import Image, ImageDraw

    picture = Image.fromarray(frame)
    band = _band(picture.size, Caption(caption.text, caption.subtitle, "", caption.rgb))
    picture.paste(band, mask=band)
    if caption.note:
        width, height = picture.size
        place = (width - round(32 * height / 720), height - band_height(height, caption) / 2)
        ImageDraw.Draw(picture).text(
            place, caption.note, font=_font(round(18 * height / 720), False), fill=_GREY, anchor="rm"
        )
    return np.asarray(picture)
