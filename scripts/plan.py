"""Plan an assembly, explain and draw the plan, without robot or simulator: the same job as the console script
`soma-plan`."""

from soma_bullet.cli.plan import plan

if __name__ == "__main__":
    raise SystemExit(plan())
