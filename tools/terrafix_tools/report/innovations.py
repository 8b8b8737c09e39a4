"""Innovations of one measurement over a flight: test ratios, and components in units of their 1-sigma."""

import math
from dataclasses import dataclass, field

import numpy as np

from terrafix.messages import MeasurementVerdict, Verdict

OUTSIDE_SIGMA = 2.0
NORMAL_OUTSIDE = 0.0455  # share of N(0, 1) beyond 2 sigma


@dataclass(frozen=True)
class Tested:
    """A verdict with a test ratio. ``normalised``: each component of the innovation over its 1-sigma."""

    t_ns: int
    frame_id: int
    accepted: bool
    test_ratio: float
    normalised: tuple[float, ...]
    detail: str


@dataclass(frozen=True)
class Spread:
    """Statistics of normalised innovations. Of consistent ones: mean 0, deviation 1, outside 0.0455."""

    count: int
    mean: float
    deviation: float
    outside: float  # share beyond 2 sigma


@dataclass
class Innovations:
    tested: list[Tested] = field(default_factory=list)

    def take(self, verdict: MeasurementVerdict) -> None:
        """A verdict without a test ratio has no innovation, and is left out."""
        if verdict.test_ratio is None or not math.isfinite(verdict.test_ratio):
            return
        pairs = zip(verdict.innovation, verdict.innovation_variance, strict=False)
        self.tested.append(
            Tested(
                verdict.t_ns,
                verdict.frame_id,
                verdict.verdict is Verdict.ACCEPTED,
                verdict.test_ratio,
                tuple(value / math.sqrt(variance) for value, variance in pairs if variance > 0),
                verdict.detail,
            )
        )

    @property
    def components(self) -> int:
        """Number of components of most innovations; others (a match without heading) are not in the spread."""
        counts = [len(one.normalised) for one in self.tested]
        return max(set(counts), key=counts.count) if counts else 0

    def normalised(self) -> np.ndarray:
        """(N, components) accepted innovations; rejected ones are not expected to be normally distributed."""
        count = self.components
        found = [one.normalised for one in self.tested if one.accepted and len(one.normalised) == count]
        return np.array(found, dtype=float).reshape(len(found), count)


def spread_of(values: np.ndarray) -> Spread | None:
    """``values``: (N,). None: too few for a deviation."""
    if len(values) < 2:
        return None
    return Spread(
        len(values),
        float(values.mean()),
        float(values.std(ddof=1)),
        float((np.abs(values) > OUTSIDE_SIGMA).mean()),
    )
