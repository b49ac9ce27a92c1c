"""Plan an assembly, build it with two arms in physics, judge it, film it: the same job as the console script
`soma-episode`."""

from soma_bullet.cli.episode import run_episode

if __name__ == "__main__":
    raise SystemExit(run_episode())
