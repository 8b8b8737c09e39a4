"""Null model of the map search: distribution of the best score when the vehicle is not on the map.

A search compares places with each other, and on any map one of them scores best. The detection threshold for that best
score comes from flights that cannot be on the map: mirrored ground does not occur on it. Each stretch of new ground
gives one sample, the log likelihood ratio of the best place. The tail beyond a high quantile is exponential (peaks over
threshold with shape zero: Pickands, "Statistical inference using extreme order statistics", 1975; Davison and Smith,
"Models for exceedances over high thresholds", 1990), and a maximum over N places shifts with log N (Gumbel)."""

import math
from collections.abc import Sequence
from typing import Self

import msgspec
import numpy as np

SCORE_VERSION = 1  # version of the score definition; a stored model of another version is not used
# Probability of a false detection over a whole flight, for a vehicle that is nowhere on the map: half for the search,
# half for single-frame localization.
FALSE_DETECTIONS_PER_FLIGHT = 1e-3
TAIL_QUANTILE = 0.9  # quantile that is the threshold of the tail
# Weight of the default model's mean excess in the fit of a measured map, as a number of pseudo-observations. A dozen
# flights leave ten to twenty values in the tail.
PRIOR_COUNT = 10.0
DECIMALS = 4  # of stored values


class Tail(msgspec.Struct, frozen=True, kw_only=True):
    """Upper tail of a score under the null hypothesis. A ``share`` of the scores exceeds the threshold ``above``;
    ``count`` is the number of excesses over it and ``excess`` their sum, which give the decay rate.

    With the conjugate (Gamma) prior on an exponential rate, the predictive tail is a Lomax distribution: it decays
    exponentially in the range of the observations and more slowly beyond, according to the uncertainty of the rate."""

    above: float
    share: float
    count: float
    excess: float

    def log_probability(self, value: float) -> float:
        """Log probability of a score of at least ``value``; 0 below the threshold."""
        if value <= self.above:
            return 0.0
        return math.log(self.share) - self.count * math.log1p((value - self.above) / self.excess)

    def exceedance_value(self, log_probability: float) -> float:
        """Score that is exceeded with this log probability; at least the threshold ``above``."""
        nats = max(math.log(self.share) - log_probability, 0.0)
        return self.above + self.excess * math.expm1(nats / self.count)

    @classmethod
    def fit(cls, values: Sequence[float], prior: "Tail") -> Self:
        """Fits the tail. ``values``: scores of wrong places, at least one; ``prior``: tail of other maps."""
        above = float(np.quantile(values, TAIL_QUANTILE))
        excesses = [value - above for value in values if value > above]
        mean_excess = prior.excess / prior.count
        return cls(
            above=round(above, DECIMALS),
            share=round(1.0 - TAIL_QUANTILE, DECIMALS),
            count=len(excesses) + PRIOR_COUNT,
            excess=round(sum(excesses) + PRIOR_COUNT * mean_excess, DECIMALS),
        )


class NullRow(msgspec.Struct, frozen=True, kw_only=True):
    """Null model at one height above ground.

    ``search``: tail of the log likelihood ratio of the best place in a stretch of new ground, out of ``places``
    candidates. ``frame``: tail of a single frame's score at a verified place, in standard deviations of
    ``verification.patch_null.PatchNull``. ``patches``: mean and standard deviation of those scores, in the same units
    before online adaptation."""

    agl_m: float
    places: float
    search: Tail
    frame: Tail
    patches: tuple[float, float]

    def detection_threshold(self, places: float, log_probability: float) -> float:
        """Detection threshold (log likelihood ratio): exceeded by the best of ``places`` wrong ones at this rate."""
        return self.search.exceedance_value(log_probability - max(math.log(places / self.places), 0.0))


class NullModel(msgspec.Struct, frozen=True, kw_only=True):
    """Null model of one map layer. ``rows``: one per measured height, at least one."""

    version: int
    matcher: str  # name of the describer
    rows: tuple[NullRow, ...]

    def row_at(self, agl_m: float) -> NullRow:
        """Row with the nearest height, by ratio."""
        return min(self.rows, key=lambda row: abs(math.log(row.agl_m / agl_m)))


# Default for an unmeasured map: twenty flights on maps of other places, 388 stretches, 3906 frames at places
# (docs/search.md, "Wrong maps, measured"). ``places`` is their mean: in a pooled sample the larger maps contribute more
# of the tail.
DEFAULT_NULL = NullRow(
    agl_m=100.0,
    places=24_000.0,
    search=Tail(above=2.2, share=0.1, count=39.0, excess=58.0),
    frame=Tail(above=1.5, share=0.1, count=391.0, excess=240.0),
    patches=(0.0, 1.0),
)


def null_row_for(model: NullModel | None, matcher: str, agl_m: float) -> NullRow:
    """Row for a height. The default row when there is no model, or it is of another version or another describer."""
    usable = model is not None and model.version == SCORE_VERSION and model.matcher == matcher and model.rows
    return model.row_at(agl_m) if model is not None and usable else DEFAULT_NULL


class FalseAlarmBudget:
    """False alarm budget of a flight over an unlimited number of decisions: the k-th decision may use a share of
    1 / (k (k + 1)). The shares add up to one (union bound; it needs no independence of the decisions)."""

    def __init__(self, probability: float = 0.5 * FALSE_DETECTIONS_PER_FLIGHT) -> None:
        self._log_probability = math.log(probability)
        self._decisions = 0

    def spend(self) -> None:
        """Counts one more decision, on new ground."""
        self._decisions += 1

    @property
    def log_probability(self) -> float:
        """Log of the false alarm probability that the current decision may use."""
        k = max(self._decisions, 1)
        return self._log_probability - math.log(k * (k + 1))
