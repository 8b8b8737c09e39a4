"""Timing of exposures and of their arrival: regular, dropped, late, or stalled."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Exposure:
    """One exposure. The index counts all exposures, also those that are lost."""

    index: int
    t_s: float  # of the exposure
    arrives_s: float  # arrival at the computer; inf: never


@dataclass(frozen=True)
class Schedule:
    """The timing of image ``index`` is a function of (seed, index)."""

    rate_hz: float = 2.0
    jitter_s: float = 0.0  # 1-sigma of the time of exposure
    drop_share: float = 0.0  # share of images that never arrive
    delay_s: float = 0.0  # of every image
    late_share: float = 0.0  # share of images that take longer ...
    late_s: float = 0.0  # ... by up to this
    stalls_s: tuple[tuple[float, float], ...] = ()  # (from, to): images taken in between do not arrive
    seed: int = 0

    def exposures(self, duration_s: float) -> Iterator[Exposure]:
        """Yields all exposures from time zero on in their order; a late one may arrive after its successors."""
        for index in range(round(duration_s * self.rate_hz)):
            yield self.exposure(index)

    def exposure(self, index: int) -> Exposure:
        jitter, drop, late, lateness = self._draws(index)
        t_s = max(0.0, index / self.rate_hz + self.jitter_s * jitter)
        stalled = any(begin <= t_s < end for begin, end in self.stalls_s)
        if stalled or drop < self.drop_share:
            return Exposure(index, t_s, float("inf"))
        return Exposure(index, t_s, t_s + self.delay_s + (self.late_s * lateness if late < self.late_share else 0.0))

    def _draws(self, index: int) -> tuple[float, float, float, float]:
        rng = np.random.default_rng([self.seed, 29, index])
        jitter = float(np.clip(rng.normal(), -3.0, 3.0))
        return jitter, float(rng.random()), float(rng.random()), float(rng.random())
