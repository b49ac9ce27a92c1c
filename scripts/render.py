"""Make another video, or a still, of an episode from its log: the same job as the console script
`soma-render`."""

from soma_bullet.cli.render import render

if __name__ == "__main__":
    raise SystemExit(render())
