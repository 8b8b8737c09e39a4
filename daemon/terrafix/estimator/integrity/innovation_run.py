"""Runs of consecutive map fixes whose innovations agree with each other.

A single rejected fix is an outlier. Several with the same offset from the estimate are evidence that the estimate is
wrong."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from terrafix.core.gate import GATE

CONSISTENT_M = 15.0  # m: largest distance of an offset from the mean of its run [tuned]


@dataclass(frozen=True)
class _Fix:
    """``offset_m`` (2,) from the estimate, ``place_m`` (2,), time and the estimate's claim (2, 2)."""

    offset_m: np.ndarray
    place_m: np.ndarray
    t_s: float
    cov_m2: np.ndarray


@dataclass
class InnovationRun:
    """``offsets_m``: horizontal offsets (2,), east and north, of consecutive fixes from the estimate of their frame."""

    offsets_m: list[np.ndarray] = field(default_factory=list)
    _estimates: list[tuple[int, np.ndarray]] = field(default_factory=list)  # node of each fix, and its estimate (2,)
    poses: int = 0  # number of camera poses among them; the others are coarse
    _first: "_Fix | None" = None
    _last: "_Fix | None" = None

    def add(
        self,
        offset_m: np.ndarray,
        p_m: np.ndarray,
        *,
        position_only: bool,
        node: int = -1,
        t_s: float = 0.0,
        cov_m2: np.ndarray | None = None,
    ) -> bool:
        """Adds a fix at ``node``, with the estimate at ``p_m`` (2,) and the claim ``cov_m2`` (2, 2), at ``t_s``. ->
        whether it agrees with the run. If not, the run is cleared and the fix begins a new one. An estimate whose claim
        grows from fix to fix does not know its velocity: the second offset may be farther off by as much, and those
        after it where the two lead to."""
        fix = _Fix(offset_m, p_m + offset_m, t_s, np.zeros((2, 2)) if cov_m2 is None else cov_m2)
        if self._first is not None and not self._agrees(fix):
            self.clear()
        agrees = bool(self.offsets_m)
        self._first, self._last = self._first or fix, fix
        self.offsets_m.append(offset_m)
        self._estimates.append((node, p_m))
        self.poses += not position_only
        return agrees

    def _agrees(self, fix: "_Fix") -> bool:
        assert self._first is not None and self._last is not None
        if float(np.hypot(*(fix.offset_m - np.mean(self.offsets_m, axis=0)))) <= CONSISTENT_M:
            return True
        grown_m2 = max(float(np.linalg.eigvalsh(fix.cov_m2 - self._last.cov_m2)[-1]), 0.0)
        if len(self.offsets_m) == 1:
            apart_m, limit_m = fix.offset_m - self._last.offset_m, float(np.sqrt(CONSISTENT_M**2 + GATE[2] * grown_m2))
            return float(np.hypot(*apart_m)) <= limit_m
        led_to_m = self._last.offset_m + self.drift_mps * (fix.t_s - self._last.t_s)
        return grown_m2 > 0.0 and float(np.hypot(*(fix.offset_m - led_to_m))) <= CONSISTENT_M

    @property
    def drift_mps(self) -> np.ndarray:
        """(2,) by which the offset has grown: the error of the estimate's velocity; zero for fewer than two times."""
        if self._first is None or self._last is None or self._last.t_s <= self._first.t_s:
            return np.zeros(2)
        return np.asarray((self._last.offset_m - self._first.offset_m) / (self._last.t_s - self._first.t_s))

    def re_estimate(self, estimate_m: Callable[[int], np.ndarray | None]) -> None:
        """Refers the fixes to the present estimate (2,) of their nodes; None: the node has left the window, its offset
        stays. An estimate that is far from its last fix turns about that place with every measurement of the heading,
        and the fixes would seem to contradict each other."""
        for i, (node, then_m) in enumerate(self._estimates):
            now_m = estimate_m(node)
            if now_m is not None:
                self.offsets_m[i] = self.offsets_m[i] + then_m - now_m
                self._estimates[i] = node, now_m

    def is_confirmed(self, count: int, min_span_m: float, *, poses_only: bool = False) -> bool:
        """At least ``count`` fixes (with ``poses_only``: camera poses) agree, over more than ``min_span_m`` of ground.
        The span excludes one mistake that repeats over the same ground."""
        if self._first is None or self._last is None:
            return False
        span_m = float(np.hypot(*(self._last.place_m - self._first.place_m)))
        return (self.poses if poses_only else len(self.offsets_m)) >= count and span_m > min_span_m

    def clear(self) -> None:
        self.offsets_m, self._estimates, self.poses, self._first, self._last = [], [], 0, None, None
