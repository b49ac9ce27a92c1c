"""Compare two evaluations seed by seed: the same job as the console script `soma-compare`."""

from soma_bullet.cli.compare import compare

if __name__ == "__main__":
    raise SystemExit(compare())
