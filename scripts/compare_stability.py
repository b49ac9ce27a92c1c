"""Compare the planner's verdicts on stability with contact physics and with rigid blocks."""

from soma_bullet.cli.compare_stability import compare_stability

if __name__ == "__main__":
    raise SystemExit(compare_stability())
