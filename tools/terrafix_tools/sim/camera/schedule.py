"""When pictures are taken and when they arrive: steady, dropped, late, or not at all for a while."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Picture:
    """One exposure of a camera that counts all of them, also those that are lost on the way."""

    index: int
    t_s: float  # of the exposure
    arrives_s: float  # at the computer; inf: never


@dataclass(frozen=True)
class Schedule:
    """What happens to picture ``index`` is a function of (seed, index)."""

    rate_hz: float = 2.0
    jitter_s: float = 0.0  # 1-sigma of the time of exposure
    drop_share: float = 0.0  # pictures that never arrive
    delay_s: float = 0.0  # of every picture
    late_share: float = 0.0  # pictures that take longer ...
    late_s: float = 0.0  # ... by up to this
    stalls_s: tuple[tuple[float, float], ...] = ()  # from, to: nothing arrives that was taken in between
    seed: int = 0

    def pictures(self, duration_s: float) -> Iterator[Picture]:
        """All exposures from time zero on, in their order; a late one may arrive after its successors."""
        for index in range(round(duration_s * self.rate_hz)):
            yield self.picture(index)

    def picture(self, index: int) -> Picture:
        jitter, drop, late, lateness = self._draws(index)
        t_s = max(0.0, index / self.rate_hz + self.jitter_s * jitter)
        stalled = any(begin <= t_s < end for begin, end in self.stalls_s)
        if stalled or drop < self.drop_share:
            return Picture(index, t_s, float("inf"))
        return Picture(index, t_s, t_s + self.delay_s + (self.late_s * lateness if late < self.late_share else 0.0))

    def _draws(self, index: int) -> tuple[float, float, float, float]:
        rng = np.random.default_rng([self.seed, 29, index])
        jitter = float(np.clip(rng.normal(), -3.0, 3.0))
        return jitter, float(rng.random()), float(rng.random()), float(rng.random())
