"""Fill a drawn figure with Soma pieces, plan it, and build it: the same job as the console script
`soma-figure`."""

from soma_bullet.cli.figure import figure

if __name__ == "__main__":
    raise SystemExit(figure())
