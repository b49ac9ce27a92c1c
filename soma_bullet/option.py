"""What all options have in common: a range beside the default, and the name by which the command line knows
each.

Options are frozen dataclasses in modules that import next to nothing, so that `--help` answers at once. The
string under a field is its documentation and the help of its flag."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Protocol, get_args, get_origin, get_type_hints

from soma_bullet.errors import InputError


class Rule(Protocol):
    """What a value must be; stands in the annotation of a field: `Annotated[float, POSITIVE]`."""

    def fault(self, value: Any) -> str:
        """What would be right; empty where the value is."""


@dataclass(frozen=True)
class Range:
    """A finite number between two bounds, each of which counts unless it is said to be beyond."""

    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    """Whether `low` itself is too low."""
    below: bool = False
    """Whether `high` itself is too high."""

    def fault(self, value: float) -> str:
        """What would be right; empty where the value is."""
        low = value > self.low if self.above else value >= self.low
        high = value < self.high if self.below else value <= self.high
        return "" if low and high and math.isfinite(value) else f"must {self._wanted()}"

    def _wanted(self) -> str:
        if self.high == math.inf:
            if self.low == 0:
                return "be positive" if self.above else "not be negative"
            return f"be {'above' if self.above else 'at least'} {self.low}"
        if not (self.above or self.below):
            return f"be from {self.low} to {self.high}"
        low = f"{'above' if self.above else 'at least'} {self.low}"
        return f"be {low} and {'below' if self.below else 'at most'} {self.high}"


@dataclass(frozen=True)
class Words:
    """Any of some words; a flag takes them separated by commas."""

    names: tuple[str, ...]
    nothing: str = "none"
    """What stands for none of them."""

    def fault(self, value: tuple[str, ...]) -> str:
        """What is wrong; empty where nothing is."""
        strange = [word for word in value if word not in self.names]
        return f"{', '.join(map(repr, strange))} is none of {', '.join(self.names)}" if strange else ""

    def read(self, text: str) -> tuple[str, ...]:
        """The words of a text."""
        words = (word.strip() for word in text.split(","))
        return tuple(word for word in words if word and word != self.nothing)


POSITIVE, NOT_NEGATIVE = Range(0, above=True), Range(0)
SEED = Range(0, 2**31 - 1)


@dataclass(frozen=True)
class Flag:
    """One option.

    Attributes:
        name: of its flag, as `--feed.noise-mm`.
        path: names of the fields that lead to it, as `("feed", "noise_mm")`.
        kind: its annotation, with what it must be.
        owner: the dataclass whose field it is.
    """

    name: str
    path: tuple[str, ...]
    kind: Any
    owner: type[Options]

    def value(self, options: Any) -> Any:
        """Its value among `options`; None also where the options that it belongs to are None."""
        for name in self.path:
            options = None if options is None else getattr(options, name)
        return options

    @property
    def negative(self) -> str:
        """The flag that says no, of what is true or false: `--execution.no-together`."""
        group, dot, name = self.name.removeprefix("--").rpartition(".")
        return f"--{group}{dot}no-{name}"

    def text(self, value: Any) -> str:
        """The flag with a value, as one would type it."""
        if isinstance(value, bool):
            return self.name if value else self.negative
        values = value if isinstance(value, tuple) else (value,)
        if isinstance(value, tuple) and all(isinstance(word, str) for word in value):
            known = any(isinstance(rule, Words) for rule in get_args(self.kind))
            return f"{self.name} {','.join(value)}" if known else " ".join(f"{self.name} {w}" for w in value)
        return " ".join([self.name, *(f"{v:g}" if isinstance(v, float) else str(v) for v in values)])


class Options:
    """Base of all options.

    Attributes:
        names: flags that are not called as their field is: another name; of options within options "" where
            their flags do without the name of the field in front.
        unset: fields that no flag sets, those of options within it as `feed.poses`.
    """

    names: ClassVar[Mapping[str, str]] = {}
    unset: ClassVar[frozenset[str]] = frozenset()

    def faults(self, prefix: str = "--") -> list[str]:
        """A sentence for every value that is out of its range: the flag, the value and what would be right.

        Args:
            prefix: what stands before the names of the flags.
        """
        found: list[str] = []
        for field, hint, flag in _fields(type(self), prefix):
            value = getattr(self, field)
            if isinstance(value, Options):
                found += value.faults(flag)
            elif value is not None and options_in(hint) is None:
                fault = next(filter(None, _faults(hint, value)), "")
                found += [f"{Flag(flag, (field,), hint, type(self)).text(value)}: {fault}"] if fault else []
        return found

    def check(self, prefix: str = "--") -> None:
        """Raises InputError with all faults at once, where there are any."""
        faults = self.faults(prefix)
        if faults:
            raise InputError("options", faults)


def flags(
    kind: type[Options],
    prefix: str = "--",
    path: tuple[str, ...] = (),
    unset: frozenset[tuple[str, ...]] = frozenset(),
) -> Iterator[Flag]:
    """Every option of a dataclass that a flag sets, those of the options within it included; `prefix` stands
    before the names of the flags, `path` before the paths of the fields."""
    left_out = unset | {(*path, *name.split(".")) for name in kind.unset}
    for field, hint, name in _fields(kind, prefix):
        here, inner = (*path, field), options_in(hint)
        if here in left_out:
            continue
        if inner is None:
            yield Flag(name, here, hint, kind)
        else:
            yield from flags(inner, name, here, left_out)


def _fields(kind: type[Options], prefix: str) -> Iterator[tuple[str, Any, str]]:
    """Each field with its annotation and its flag; of options within it what their flags begin with."""
    hints = get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):  # type: ignore[arg-type]
        name = kind.names.get(field.name, field.name.replace("_", "-"))
        inner = options_in(hints[field.name]) is not None
        yield field.name, hints[field.name], f"{prefix}{name}{'.' if inner and name else ''}"


def options_in(hint: Any) -> type[Options] | None:
    """The options that an annotation `Kind` or `Kind | None` stands for; None where it stands for a value."""
    candidates = [hint, *get_args(hint)]
    return next((kind for kind in candidates if isinstance(kind, type) and issubclass(kind, Options)), None)


def changed(options: Options, default: Options) -> dict[str, str]:
    """The options that differ from those of `default`: flag -> flag with its value."""
    pairs = ((flag, flag.value(options), flag.value(default)) for flag in flags(type(options)))
    return {flag.name: flag.text(value) for flag, value, usual in pairs if value != usual}


def _faults(kind: Any, value: Any) -> Iterator[str]:
    """What is wrong with a value of an annotated kind, part by part."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        yield from _faults(arguments[0], value)
        for rule in arguments[1:]:
            if hasattr(rule, "fault"):
                yield rule.fault(value)
    elif origin is Literal:
        if value not in arguments:
            yield f"must be one of {', '.join(map(str, arguments))}"
    elif origin is tuple:
        inner = arguments[:1] * len(value) if arguments[-1] is ... else arguments
        for part, of in zip(value, inner, strict=True):
            yield from _faults(of, part)
    else:  # of a union the kind that is no None
        for part in arguments:
            if part is not type(None):
                yield from _faults(part, value)
