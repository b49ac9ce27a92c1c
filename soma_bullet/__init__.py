"""Dual-arm assembly: plan from meshes and goal poses, build with two arms in contact physics, judge by final
poses."""
