"""The paper's figure of orders for any plan: a row an order, a still a step, its qualities above it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from soma_bullet.assembly.model import Assembly
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.pictures.raster import Color
from soma_bullet.pictures.sheet import DPI, INK, QUIET, Sheet, format_of
from soma_bullet.pictures.still import GREEN, GROUPS, RED, Scene, StepStills
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.orders import OrderRow
from soma_bullet.planner.qualities import Qualities
from soma_bullet.report.table import number

TITLES = {
    "stability": ("stability S", "what stands, nothing held"),
    "graspability": ("graspability G", "grasps of the upcoming piece"),
    "assisting": ("assisting grasps", "held piece, S with the hold"),
    "assemblability": ("assemblability A", "assembly direction"),
}
BANNER: Color = (1.0, 0.945, 0.68)
RULE: Color = (0.80, 0.81, 0.84)
WIDEST = 16  # cells side by side; more are wrapped
MARGIN, LABEL, SCORE = (
    0.2,
    1.25,
    0.75,
)  # [in] of the sheet, of the names at the left, of the score at the right
GAP, NUMBER, TITLE, REASON = (
    0.16,
    0.2,
    0.42,
    0.22,
)  # [in] between groups, above a still, above a group, below a row
CAPTION = 0.62  # [in] of legend and caption


def draw_orders(
    assembly: Assembly,
    hands: HandSet,
    plan: AssemblyPlan,
    path: Path | str,
    rows: int = 6,
    qualities: Qualities | None = None,
) -> Path:
    """Draw the best `rows` orders by rank, the chosen one always among them, into a PNG, SVG or PDF.

    Args:
        qualities: those that the plan was made with, to share what was evaluated.

    Raises:
        InputError: the ending of `path` is none of these.
    """
    format_of(path)  # a wrong ending is said before the work
    shown = best_rows(plan, rows)
    layout = Layout(len(assembly.pieces), tuple(not row.feasible for row in shown))
    side = round(layout.cell * DPI)
    stills = StepStills(assembly, qualities or Qualities(assembly, hands, plan.options), side, side)
    sheet = Sheet(layout.width, layout.height)
    if layout.lines == 1:
        for group in GROUPS:
            _title(sheet, group, *layout.group(0, group), layout)
    scenes = stills.frame(shown)
    for k, row in enumerate(shown):
        _draw_row(sheet, layout, k, row, row.order == plan.order, assembly, stills, scenes[k])
    _legend(sheet, layout, assembly, plan, len(shown))
    return sheet.save(path, colors=256)


def best_rows(plan: AssemblyPlan, count: int) -> tuple[OrderRow, ...]:
    """The best rows of a plan by rank; the last makes way for the chosen one where that ranks lower."""
    shown = plan.orders[:count]
    if all(row.order != plan.order for row in shown):
        chosen = next(row for row in plan.orders if row.order == plan.order)
        shown = (*shown[:-1], chosen)
    return shown


def minima(values: Sequence[float]) -> list[tuple[int, int]]:
    """The smallest values as ranges of steps, start and end: one range over all where all are the same."""
    least = min(values)
    found = [
        k for k, value in enumerate(values) if value == least or math.isclose(value, least, rel_tol=1e-9)
    ]
    return [(0, len(values))] if len(found) == len(values) else [(k, k + 1) for k in found]


@dataclass(frozen=True)
class Layout:
    """Where everything goes, in inches from the top left corner.

    Attributes:
        steps: of an order.
        failed: for each row whether a line says why it cannot be built.
    """

    steps: int
    failed: tuple[bool, ...]

    @property
    def lines(self) -> int:
        """Lines of stills that an order takes: all four groups side by side, or two, or one."""
        return 1 if 4 * self.steps <= WIDEST else 2 if 2 * self.steps <= WIDEST else 4

    @property
    def across(self) -> int:
        """Groups side by side."""
        return 4 // self.lines

    @property
    def cell(self) -> float:
        """Side of a still: 1.2 in, smaller where many stand side by side."""
        return round(min(1.2, 14.4 / (self.across * self.steps)) * DPI) / DPI

    @property
    def width(self) -> float:
        return 2 * MARGIN + LABEL + SCORE + self.across * (self.steps * self.cell + GAP) + GAP

    @property
    def line_height(self) -> float:
        return self.cell + NUMBER + 0.1 + self.heading

    @property
    def heading(self) -> float:
        """Height of the titles over every line of stills, where they are not over the first row alone."""
        return 0.3 if self.lines > 1 else 0.0

    def row_top(self, row: int) -> float:
        """Top of a row of the figure."""
        above = sum(self.lines * self.line_height + 0.1 + REASON * failed for failed in self.failed[:row])
        return MARGIN + (TITLE if self.lines == 1 else 0.0) + above

    def row_height(self, row: int) -> float:
        return self.row_top(row + 1) - self.row_top(row) - 0.04

    @property
    def height(self) -> float:
        return self.row_top(len(self.failed)) + CAPTION + MARGIN / 2

    def group(self, row: int, name: str) -> tuple[float, float]:
        """Left and top of a group's first number."""
        place = GROUPS.index(name)
        left = MARGIN + LABEL + GAP + place % self.across * (self.steps * self.cell + GAP)
        top = self.row_top(row) + place // self.across * self.line_height + 0.05 + self.heading
        return left, top


def _title(sheet: Sheet, group: str, left: float, top: float, layout: Layout) -> None:
    """The title of a group and what its colours mean: on two lines over the figure, on one over a line of
    stills."""
    middle = left + layout.steps * layout.cell / 2
    heading, explanation = TITLES[group]
    red, green, blue = {"graspability": GREEN, "assisting": RED}.get(group, QUIET)
    color = (0.8 * red, 0.8 * green, 0.8 * blue)
    if layout.lines == 1:
        sheet.text(middle, top - 0.36, heading, 10, bold=True, align="center")
        sheet.text(middle, top - 0.18, explanation, 7.5, color, align="center")
    else:
        sheet.text(middle - 0.06, top - 0.12, heading, 9, bold=True, align="right")
        sheet.text(middle + 0.06, top - 0.12, explanation, 7.5, color)


def _draw_row(
    sheet: Sheet, layout: Layout, k: int, row: OrderRow, chosen: bool, assembly: Assembly, stills: StepStills,
    scenes: dict[str, list[Scene]],
) -> None:  # fmt: skip
    top, height = layout.row_top(k), layout.row_height(k)
    if chosen:
        sheet.box(MARGIN / 2, top, layout.width - MARGIN, height, fill=BANNER, name="chosen")
    elif k:
        sheet.line([(MARGIN, top - 0.02), (layout.width - MARGIN, top - 0.02)], RULE)
    ink = INK if row.feasible else QUIET
    _order(sheet, layout, k, row, chosen, assembly)
    values = {
        "stability": row.s,
        "graspability": row.g,
        "assisting": row.s_recomputed,
        "assemblability": row.a,
    }
    for group in GROUPS:
        left, start = layout.group(k, group)
        if layout.lines > 1:
            _title(sheet, group, left, start, layout)
        if GROUPS.index(group) % layout.across:
            sheet.line(
                [(left - GAP / 2, start - 0.02), (left - GAP / 2, start + NUMBER + layout.cell + 0.02)],
                RULE,
                0.8,
            )
        for step, scene in enumerate(scenes[group]):
            x = left + step * layout.cell
            sheet.image(stills.image(scene, row.feasible), x, start + NUMBER, f"still-{k}-{group}-{step}")
            label = number(values[group][step])
            if group == "assisting":
                label = f"{' + '.join(row.held[step]) or 'none'}, {label}"
            sheet.text(x + layout.cell / 2, start + NUMBER / 2, label, 8, ink, align="center")
        for first, end in minima(values[group]):
            box = (
                left + first * layout.cell + 0.02,
                start,
                (end - first) * layout.cell - 0.04,
                NUMBER + layout.cell,
            )
            sheet.box(
                *box, edge=RED if row.feasible else RULE, line=1.1, name=f"minimum-{k}-{group}-{first}-{end}"
            )
    middle = top + layout.lines * layout.line_height / 2
    right = layout.width - MARGIN - 0.08
    sheet.text(right, middle - 0.09, "score" if row.feasible else "infeasible", 7, QUIET, align="right")
    sheet.text(
        right,
        middle + 0.09,
        number(row.score) if row.feasible else "0",
        10.5,
        ink,
        bold=chosen,
        align="right",
    )
    if row.reason:
        sheet.text(
            MARGIN + LABEL + GAP, top + height - REASON / 2, f"cannot be built: {row.reason}", 7.5, QUIET
        )


def _order(sheet: Sheet, layout: Layout, k: int, row: OrderRow, chosen: bool, assembly: Assembly) -> None:
    """The names of an order, first on top, each with its colour."""
    pitch = min(0.24, layout.lines * layout.line_height / (layout.steps + 2))
    middle = layout.row_top(k) + layout.lines * layout.line_height / 2
    top = middle - (layout.steps - 1) / 2 * pitch
    if chosen:
        sheet.text(MARGIN + 0.08, top - pitch, "chosen order", 7.5, bold=True)
    for step, name in enumerate(row.order):
        y = top + step * pitch
        sheet.text(MARGIN + 0.16, y, str(step + 1), 7.5, QUIET, align="right")
        sheet.box(
            MARGIN + 0.24,
            y - 0.055,
            0.11,
            0.11,
            fill=assembly.pieces[assembly.index(name)].color,
            radius=0.02,
        )
        sheet.text(MARGIN + 0.42, y, name, 8.5, INK if row.feasible else QUIET, bold=chosen)


def _legend(sheet: Sheet, layout: Layout, assembly: Assembly, plan: AssemblyPlan, shown: int) -> None:
    """Colours of the pieces, and what the figure shows."""
    y = layout.row_top(len(layout.failed)) + 0.16
    sheet.line([(MARGIN, y - 0.12), (layout.width - MARGIN, y - 0.12)], RULE)
    x = MARGIN + 0.08
    for piece in assembly.pieces:
        sheet.box(x, y, 0.13, 0.13, fill=piece.color, radius=0.02)
        sheet.text(x + 0.19, y + 0.065, piece.name, 8)
        x += 0.42 + 0.075 * len(piece.name)
    marks = "red frame: smallest of its quality in the order (all the same: one frame)   yellow: chosen order"
    sheet.text(layout.width - MARGIN - 0.08, y + 0.065, marks, 8, QUIET, align="right")
    some = f"all {shown} orders" if shown == len(plan.orders) else f"{shown} of {len(plan.orders)} orders"
    # paper mode leaves the holds out of the score where an order needs none
    bare = plan.options.stability == "paper" and any(
        row.feasible and row.stable_throughout for row in plan.orders
    )
    caption = (
        f"{assembly.name}: {some} by rank; stability as in {plan.options.stability} mode; "
        f"hand {plan.named_hands}, {plan.options.hands} hands; "
        f"score = min S × min G × min A, with S "
        f"{'of what stands, nothing held' if bare else 'with the holds'}"
    )
    sheet.text(MARGIN + 0.08, y + 0.32, caption, 8.5)
