"""What is evaluated, and what differs from episode to episode."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from soma_bullet.option import NOT_NEGATIVE, SEED, Options, Range, Words, flags
from soma_bullet.options import EpisodeOptions
from soma_bullet.task.feed_options import FeedOptions

if TYPE_CHECKING:
    pass

VARIED = ("friction", "mass", "perception", "feed")
SPREAD_OF = {"friction": ("friction",), "mass": ("mass",), "perception": ("mm", "deg", "errors", "square")}
COUNTED = ("assembly", "episodes", "seed", "film")  # fields on which no line depends but by its seed
SHARE = Range(0, 1, below=True)


@dataclass(frozen=True)
class Spread(Options):
    """By how much what varies does."""

    friction: Annotated[float, SHARE] = 0.2
    """Largest relative deviation of an episode's factor on all friction coefficients; uniform."""
    mass: Annotated[float, SHARE] = 0.2
    """The same of its factor on all masses."""
    mm: Annotated[float, NOT_NEGATIVE] = 0.5
    """One sigma of the error of the perceived places in x and in y [mm]; of uniform errors their largest
    length."""
    deg: Annotated[float, NOT_NEGATIVE] = 0.5
    """One sigma of the error of the perceived yaws [deg]; of uniform errors the largest."""
    errors: Literal["normal", "uniform"] = "normal"
    """How the errors of perception are spread: normal, or uniform over a disc and an interval."""
    square: bool = True
    """Inexactly perceived pieces are squared before they are picked; --spread.no-square: they are picked as
    seen."""


@dataclass(frozen=True)
class EvaluationOptions(Options):
    """What is evaluated."""

    names: ClassVar[Mapping[str, str]] = {"episode": ""}
    unset: ClassVar[frozenset[str]] = frozenset(
        {"episode.seed", "episode.feed.poses", "episode.feed.noise_mm", "episode.feed.noise_deg"}
        | {"episode.feed.errors", "episode.feed.square"}
    )

    assembly: str
    """An assembly file, or the name of one that comes with the package."""
    episodes: Annotated[int, Range(1)] = 20
    """How many."""
    seed: Annotated[int, SEED] = 0
    """Of the first episode; the others follow on."""
    vary: Annotated[tuple[str, ...], Words(VARIED)] = ("feed",)
    """What differs between episodes beside the places of the pieces: any of friction, mass, perception, feed,
    separated by commas, or none. feed: every steady resting pose; without it pieces lie in the one from which
    they are easiest to grasp."""
    spread: Spread = Spread()
    """By how much what varies does."""
    episode: EpisodeOptions = EpisodeOptions()
    """What all episodes have in common; what varies does so about it."""

    @property
    def seeds(self) -> range:
        """Of the episodes."""
        return range(self.seed, self.seed + self.episodes)

    def conditions(self) -> dict[str, Any]:
        """All that a line depends on beside assembly, seed and versions, by the names of the command line."""
        found = {}
        for flag in flags(type(self)):
            if not set(flag.path) & set(COUNTED):
                value = flag.value(self)
                found[flag.name] = list(value) if isinstance(value, tuple) else value
        vary = [name for name in VARIED if name in self.vary]
        return found | {"--vary": ",".join(vary) or "none"}

    def faults(self, prefix: str = "--") -> list[str]:
        """As of all options; the last seed is one too, and what does not vary has no spread."""
        faults = super().faults(prefix)
        last = SEED.fault(self.seeds[-1]) if not faults else ""
        if last:
            faults.append(f"{prefix}episodes {self.episodes}: the last seed {last}")
        usual = Spread()
        for name, fields in SPREAD_OF.items():
            for field in fields if name not in self.vary else ():
                if getattr(self.spread, field) != getattr(usual, field):
                    faults.append(f"{prefix}spread.{field}: {name} does not vary, see {prefix}vary")
        feed, plain = self.episode.feed, FeedOptions(layout=self.episode.feed.layout)
        if feed != plain or self.episode.seed != EpisodeOptions.seed:
            faults.append("episode: its seed, and poses and errors of its feed, must be left alone")
        return faults


def draw(seed: int, options: EvaluationOptions) -> dict[str, float]:
    """The factors of one episode; each depends on the seed alone, whatever else varies."""
    drawn: dict[str, float] = {}
    from soma_bullet.seeds import stream

    for name in ("friction", "mass"):
        if name in options.vary:
            spread = getattr(options.spread, name)
            drawn[name] = round(float(stream(seed, name).uniform(1.0 - spread, 1.0 + spread)), 6)
    return drawn


def episode_options(seed: int, options: EvaluationOptions) -> EpisodeOptions:
    """Everything that decides one episode."""
    drawn, spread, common = draw(seed, options), options.spread, options.episode
    feed = replace(common.feed, poses="all" if "feed" in options.vary else "preferred")
    if "perception" in options.vary:
        feed = replace(
            feed, noise_mm=spread.mm, noise_deg=spread.deg, errors=spread.errors, square=spread.square
        )
    physics = replace(
        common.physics,
        friction=common.physics.friction * drawn.get("friction", 1.0),
        mass=common.physics.mass * drawn.get("mass", 1.0),
    )
    return replace(common, seed=seed, feed=feed, physics=physics, film=None)
