"""Correlation of the errors of map fixes that observe the same ground.

The position error of a map belongs to the ground. It repeats in every fix over that ground, so that fixes close
together are not independent. This module gives the share of information that a fix adds to those before it."""

from bisect import bisect_left

import numpy as np

MAX_FIXES = 40  # fixes remembered: more than the window has nodes, to any of which a late fix can belong [tuned]
CORRELATION_HEIGHTS = 0.5  # heights above ground: fixes closer together than this share their map error [tuned]
# Smallest information share of a fix over known ground: absolute, and per second since the nearest fix. Light, wind
# and camera noise do change between frames, but five frames in a second observe no more of them than two. [tuned]
MIN_SHARE, MIN_SHARE_PER_S = 0.1, 0.2
MIN_SHARE_FLOOR = 1e-3  # share of information: keeps the covariance of fixes at the same time finite [tuned]


class CorrelatedFixes:
    """Accepted fixes, sorted by the times of their frames; they may be added in any order."""

    def __init__(self) -> None:
        self._fixes: list[tuple[float, np.ndarray]] = []  # time [s], horizontal position (2,) [m]

    @property
    def newest_s(self) -> float | None:
        """Time of the newest frame with a fix; None: there is none."""
        return self._fixes[-1][0] if self._fixes else None

    def new_ground_m(self, t_s: float, p_m: np.ndarray, max_m: float) -> float:
        """Length of the flown path that a fix at ``t_s``, ``p_m`` (2,) adds to the observed one [m].

        Each distance is limited to ``max_m``, which is also the result where there is no other fix. A late fix between
        two others adds the detour over it, so that the sum over all fixes does not depend on their order of arrival."""
        after = bisect_left(self._fixes, t_s, key=lambda fix: fix[0])
        neighbours = [other for _, other in self._fixes[max(0, after - 1) : after + 1]]
        distances_m = [min(float(np.hypot(*(p_m - other))), max_m) for other in neighbours]
        if not neighbours:
            return max_m
        if after in (0, len(self._fixes)):
            return distances_m[0]
        return max(0.0, sum(distances_m) - min(float(np.hypot(*(neighbours[1] - neighbours[0]))), max_m))

    def information_share(self, t_s: float, p_m: np.ndarray, agl_m: float) -> float:
        """Share (0, 1] of a fix at ``p_m`` (2,), ``agl_m`` above ground, that is independent of the fixes before it.

        The caller divides the covariance of the fix by it."""
        correlation_m = CORRELATION_HEIGHTS * agl_m
        after = bisect_left(self._fixes, t_s, key=lambda fix: fix[0])
        since_s = min((abs(t_s - other_s) for other_s, _ in self._fixes[max(0, after - 1) : after + 1]), default=np.inf)
        min_share = min(MIN_SHARE, MIN_SHARE_PER_S * since_s)
        return max(self.new_ground_m(t_s, p_m, correlation_m) / correlation_m, min_share, MIN_SHARE_FLOOR)

    def add(self, t_s: float, p_m: np.ndarray) -> None:
        """An accepted fix of the frame at ``t_s``, at ``p_m`` (2,)."""
        self._fixes.insert(bisect_left(self._fixes, t_s, key=lambda fix: fix[0]), (t_s, p_m))
        del self._fixes[:-MAX_FIXES]
