"""Execution in PyBullet: the world, the hands, the log, the judge, and pictures of it."""
