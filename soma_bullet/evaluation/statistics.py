"""How sure a rate is, and a difference between two runs that saw the same: intervals and the exact McNemar
test."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import binom, binomtest

from soma_bullet.evaluation.line import DIGITS

CONFIDENCE = 0.95


def wilson(successes: int, count: int) -> tuple[float, float]:
    """95 % interval of a success rate (E. Wilson, 1927)."""
    interval = binomtest(successes, count).proportion_ci(0.95, method="wilson")
    return round(float(interval.low), DIGITS), round(float(interval.high), DIGITS)


@dataclass(frozen=True)
class Pairs:
    """How often what was tried in A and in B went well."""

    both: int = 0
    only_a: int = 0
    only_b: int = 0
    neither: int = 0

    @property
    def count(self) -> int:
        """Of all pairs."""
        return self.both + self.only_a + self.only_b + self.neither

    @property
    def p(self) -> float:
        """Exact two-sided McNemar test: how likely a difference so uneven would be if neither were better."""
        differing = self.only_a + self.only_b
        return float(binomtest(self.only_a, differing).pvalue) if differing else 1.0

    @staticmethod
    def of(outcomes: Iterable[tuple[bool, bool]]) -> Pairs:
        """Counted from (well in A, well in B)."""
        found = list(outcomes)
        return Pairs(
            *(found.count(kind) for kind in ((True, True), (True, False), (False, True), (False, False)))
        )


@dataclass(frozen=True)
class Rate:
    """How many of how many, with the 95 % Wilson interval; of nothing it is 0 to 1."""

    good: int
    count: int
    low: float
    high: float

    @staticmethod
    def of(good: int, count: int) -> Rate:
        """With its interval."""
        return Rate(good, count, *(wilson(good, count) if count else (0.0, 1.0)))


@dataclass(frozen=True)
class Contrast:
    """One number of every pair.

    Attributes:
        count: of pairs.
        median_a, median_b: NaN where there are none; difference: the median of B less A.
        low, high: 95 % interval of that median, from order statistics; infinite where there are too few
            pairs.
    """

    count: int
    median_a: float
    median_b: float
    difference: float
    low: float
    high: float


@dataclass(frozen=True)
class Extremes:
    """Of some numbers, NaN where there are none."""

    count: int
    median: float
    p95: float
    largest: float


def contrast(values: Sequence[tuple[float, float]]) -> Contrast:
    """Of numbers in A and in B, pair by pair."""
    if not values:
        return Contrast(0, np.nan, np.nan, np.nan, -np.inf, np.inf)
    a, b = np.array(values, float).T
    difference, count = np.sort(b - a), len(values)
    # as many values below the median as a fair coin gives heads: the interval leaves out at most 2.5 % on
    # each side
    out = int(binom.ppf((1.0 - CONFIDENCE) / 2, count, 0.5)) - 1
    low, high = (difference[out], difference[-1 - out]) if out >= 0 else (-np.inf, np.inf)
    return Contrast(
        count, float(np.median(a)), float(np.median(b)), float(np.median(difference)), float(low), float(high)
    )


def extremes(values: Sequence[float]) -> Extremes:
    """Median, 95th percentile and largest of numbers."""
    if not values:
        return Extremes(0, np.nan, np.nan, np.nan)
    median, p95 = np.percentile(values, [50, 95])
    return Extremes(len(values), float(median), float(p95), float(max(values)))
