"""Timings of planner, motions, physics and whole episodes."""
