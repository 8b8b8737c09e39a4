"""Heights and headings of camera poses on the map against those that were told."""

import math

from terrafix.estimator.monitors.cusum import Cusum, threshold

POSES_PER_HOUR = 3600.0
# What is allowed of a constant error: 3 of its described sigmas (0.3 % of descriptions that are honest are beyond).
ALLOWED = 3.0
SCATTER = 0.05  # 1-sigma of one pose's height, a share of it


class OffsetMonitor:
    """One told quantity against the map's. ``sigma``: of its constant error as described; ``scatter``: of one pose."""

    def __init__(self, sigma: float, scatter: float) -> None:
        self._allowed, self._scatter = ALLOWED * sigma, scatter
        self._test = Cusum(threshold(POSES_PER_HOUR))
        self.mean = 0.0

    @property
    def active(self) -> bool:
        return self._test.active

    def add(self, off: float) -> None:
        """Told less seen. The fault is an error of 2 scatters beyond what is allowed; its absence, the allowed one."""
        beyond = (abs(off) - self._allowed) / self._scatter
        self._test.add(2.0 * (beyond - 1.0))  # of N(allowed + 2 scatters) over N(allowed)
        self.mean += 0.2 * (off - self.mean) if self.mean else off


def told_over_seen(told_m: float, seen_m: float) -> float:
    """Logarithm of two heights above the ground below."""
    return math.log(max(told_m, 1.0) / max(seen_m, 1.0))
