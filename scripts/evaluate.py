"""Run many seeded episodes and say how often they succeed: the same job as the console script
`soma-evaluate`."""

from soma_bullet.cli.evaluate import evaluate

if __name__ == "__main__":
    raise SystemExit(evaluate())
