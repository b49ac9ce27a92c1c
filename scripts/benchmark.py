"""Time planner, motions, physics and whole episodes: the same job as the console script `soma-benchmark`."""

from soma_bullet.cli.benchmark import benchmark

if __name__ == "__main__":
    raise SystemExit(benchmark())
