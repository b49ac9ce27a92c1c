"""An assembly file of two boxes, one on the other, and the lines of it that tests replace."""

from __future__ import annotations

GOOD = """
name = "tower"
unit = "mm"
[defaults]
clearance = 0.2
[[piece]]
name = "lower"
mesh = "box.obj"
goal = { position = [0, 0, 10], rpy_deg = [0, 0, 90] }
[[piece]]
name = "upper"
mesh = "box.obj"
density = 500
friction = 0.3
clearance = 0.1
color = "#ff8000"
goal = { position = [0, 0, 30.0], quat_wxyz = [0.7071, 0, 0, -0.7071] }
"""
LOWER_GOAL = "position = [0, 0, 10]"
UPPER_GOAL = "position = [0, 0, 30.0]"
