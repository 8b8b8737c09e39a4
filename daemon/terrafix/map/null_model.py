"""What the best wrong place of a map scores: the null model of a search, "the vehicle is on none of this map".

A search compares places with each other, and on any map one of them is the best. Whether it is good enough is decided
against flights that cannot be on the map: mirrored ground is nowhere on it. Each stretch of new ground gives one value,
the evidence of the best place. Its tail beyond a high quantile is exponential (peaks over threshold with shape zero:
Pickands, "Statistical inference using extreme order statistics", 1975; Davison and Smith, "Models for exceedances over
high thresholds", 1990), and a maximum over N places moves with log N (Gumbel)."""

import math
from collections.abc import Sequence
from typing import Self

import msgspec
import numpy as np

VERSION = 1  # of what is scored; a table of another version is not used
# A flight whose vehicle is on none of the map may find a place there with this probability, over all of it: half for
# searches, half for single frames.
WRONG_FLIGHTS = 1e-3
TAIL_FROM = 0.9  # quantile from which on values belong to the tail
# The excess over that quantile of a map that nobody has measured counts as so many values in the fit of one that
# somebody has: a dozen flights leave ten to twenty values in the tail.
PRIOR_EXCESSES = 10.0
DECIMALS = 4  # of what is stored


class Tail(msgspec.Struct, frozen=True, kw_only=True):
    """Upper tail of a statistic of wrong places. ``share`` of its values lie above ``above``; ``count`` excesses over
    that, with ``excess`` as their sum, say how fast it falls off.

    With the conjugate (Gamma) prior of an exponential rate, the predictive tail is a Lomax one: it falls off as the
    exponential does as far as values reach, and more slowly beyond, as what is not known of the rate demands."""

    above: float
    share: float
    count: float
    excess: float

    def log_probability(self, value: float) -> float:
        """Of a value at least this large; 0 below the tail."""
        if value <= self.above:
            return 0.0
        return math.log(self.share) - self.count * math.log1p((value - self.above) / self.excess)

    def exceeded_with(self, log_probability: float) -> float:
        """The value that is reached with this probability; the beginning of the tail, where that is likelier."""
        nats = max(math.log(self.share) - log_probability, 0.0)
        return self.above + self.excess * math.expm1(nats / self.count)

    @classmethod
    def of(cls, values: Sequence[float], prior: "Tail") -> Self:
        """``values``: of wrong places, at least one; ``prior``: of other maps."""
        above = float(np.quantile(values, TAIL_FROM))
        beyond = [value - above for value in values if value > above]
        mean_excess = prior.excess / prior.count
        return cls(
            above=round(above, DECIMALS),
            share=round(1.0 - TAIL_FROM, DECIMALS),
            count=len(beyond) + PRIOR_EXCESSES,
            excess=round(sum(beyond) + PRIOR_EXCESSES * mean_excess, DECIMALS),
        )


class NullRow(msgspec.Struct, frozen=True, kw_only=True):
    """At one height. ``search``: log likelihood ratio of the best place in a stretch of new ground, of ``places`` that
    could have been the best. ``frame``: what a single frame comes to at a place that is checked, in the standard
    deviations of ``chance.Chance``. ``patches``: mean and standard deviation of all of these, in its units before
    anything was learnt."""

    agl_m: float
    places: float
    search: Tail
    frame: Tail
    patches: tuple[float, float]

    def enough(self, places: float, log_probability: float) -> float:
        """Evidence that the best of ``places`` wrong ones reaches with this probability."""
        return self.search.exceeded_with(log_probability - max(math.log(places / self.places), 0.0))


class NullModel(msgspec.Struct, frozen=True, kw_only=True):
    """Of one layer of a map. ``rows``: at the heights that it was learnt for, at least one."""

    version: int
    matcher: str  # whose features
    rows: tuple[NullRow, ...]

    def at(self, agl_m: float) -> NullRow:
        """The row whose height is nearest, as a ratio."""
        return min(self.rows, key=lambda row: abs(math.log(row.agl_m / agl_m)))


# Of a map that nobody has measured: twenty flights on maps of other places, 388 stretches, 3906 frames at places
# (docs/search.md, "Wrong maps, measured"; ``bench/wrong_maps.py``). The places are their mean: of maps that are pooled
# the larger ones give more of the tail.
USUAL = NullRow(
    agl_m=100.0,
    places=24_000.0,
    search=Tail(above=2.2, share=0.1, count=39.0, excess=58.0),
    frame=Tail(above=1.5, share=0.1, count=391.0, excess=240.0),
    patches=(0.0, 1.0),
)


def null_at(model: NullModel | None, matcher: str, agl_m: float) -> NullRow:
    """The row for a height; that of a usual map without a model, or with one of another version or matcher."""
    usable = model is not None and model.version == VERSION and model.matcher == matcher and model.rows
    return model.at(agl_m) if model is not None and usable else USUAL


class FlightBudget:
    """The probability of a wrong find that a whole flight may spend, over decisions without an end: the k-th gets
    1 / (k (k + 1)) of it, which add up to one (the union bound, whatever one decision says of the next)."""

    def __init__(self, probability: float = 0.5 * WRONG_FLIGHTS) -> None:
        self._log_probability = math.log(probability)
        self._decisions = 0

    def spend(self) -> None:
        """One more decision, on new ground."""
        self._decisions += 1

    @property
    def log_probability(self) -> float:
        """That the decision which is due is wrong."""
        k = max(self._decisions, 1)
        return self._log_probability - math.log(k * (k + 1))
