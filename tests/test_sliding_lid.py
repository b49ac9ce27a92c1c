"""A lid that goes in level: its box would be pushed away, unless a hand holds it."""

from __future__ import annotations

import pytest

import soma_bullet as sb


@pytest.mark.slow
def test_a_box_is_held_while_its_lid_slides_in() -> None:
    assembly, cell = sb.load_assembly("sliding_lid"), sb.load_cell("ur5e_pair")
    plan = sb.make_plan(assembly, cell.hands)
    before = next(
        step for step, after in zip(plan.steps, plan.steps[1:], strict=False) if after.piece == "lid"
    )
    assert [hold.piece for hold in before.holds] == ["box"]
    program = sb.make_program(assembly, cell, plan)
    log = sb.execute(assembly, cell, plan, program)
    verdict = sb.judge(log, assembly, cell)
    assert verdict.success, verdict.causes
    assert max(insertion.neighbours_mm for insertion in verdict.insertions) < 1.0
