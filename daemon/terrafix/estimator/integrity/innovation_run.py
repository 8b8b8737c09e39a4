"""Runs of consecutive map fixes whose innovations agree with each other.

A single rejected fix is an outlier. Several with the same offset from the estimate are evidence that the estimate is
wrong."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

CONSISTENT_M = 15.0  # m: largest distance of an offset from the mean of its run [tuned]


@dataclass
class InnovationRun:
    """``offsets_m``: horizontal offsets (2,), east and north, of consecutive fixes from the estimate of their frame."""

    offsets_m: list[np.ndarray] = field(default_factory=list)
    _estimates: list[tuple[int, np.ndarray]] = field(default_factory=list)  # node of each fix, and its estimate (2,)
    poses: int = 0  # number of camera poses among them; the others are coarse
    _first_m: np.ndarray = field(default_factory=lambda: np.zeros(2))  # estimate at the first fix of the run
    _span_m: float = 0.0  # from there to the estimate at the last fix

    def add(self, offset_m: np.ndarray, p_m: np.ndarray, *, position_only: bool, node: int = -1) -> bool:
        """Adds a fix at ``node``, with the estimate at ``p_m`` (2,). -> whether it agrees with the run. If not, the run
        is cleared and the fix begins a new one."""
        if self.offsets_m and float(np.hypot(*(offset_m - np.mean(self.offsets_m, axis=0)))) > CONSISTENT_M:
            self.clear()
        agrees = bool(self.offsets_m)
        if not agrees:
            self._first_m = p_m
        self.offsets_m.append(offset_m)
        self._estimates.append((node, p_m))
        self.poses += not position_only
        self._span_m = float(np.hypot(*(p_m - self._first_m)))
        return agrees

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
        """At least ``count`` fixes (with ``poses_only``: camera poses) agree, over more than ``min_span_m`` of flight.
        The span excludes one mistake that repeats over the same ground."""
        return (self.poses if poses_only else len(self.offsets_m)) >= count and self._span_m > min_span_m

    def clear(self) -> None:
        self.offsets_m, self._estimates, self.poses, self._span_m = [], [], 0, 0.0
