"""Which ground map fixes have looked at already: the errors of a map belong to the ground, and return with it."""

from bisect import bisect_left

import numpy as np

KEPT = 40  # fixes: more than there are nodes in the graph, to which a late one can belong
SAME_GROUND_SHARE = 0.5  # of the height: fixes closer together than this share their errors ...
# ... and a fix over ground that was seen counts at least this much, but no more in a second, however many there are:
# of light, wind and the camera's own noise, which change, a second of five frames has not more than one of two.
MIN_NEW, MIN_NEW_PER_S, LEAST = 0.1, 0.2, 1e-3


class CorrelatedFixes:
    """The fixes that were believed, in order of the times of their frames, whenever they came."""

    def __init__(self) -> None:
        self._fixes: list[tuple[float, np.ndarray]] = []  # time, place (2,)

    @property
    def newest_s(self) -> float | None:
        return self._fixes[-1][0] if self._fixes else None

    def new_m(self, t_s: float, place_m: np.ndarray, most_m: float) -> float:
        """How much of the ground at ``place_m`` (2,) no fix has seen, as way: ``most_m`` where all is new.

        One that comes late, between two others, adds to the way over which they have seen what it makes that way
        longer: together they count as much as in their order."""
        after = bisect_left(self._fixes, t_s, key=lambda fix: fix[0])
        beside = [other for _, other in self._fixes[max(0, after - 1) : after + 1]]
        ways_m = [min(float(np.hypot(*(place_m - other))), most_m) for other in beside]
        if not beside:
            return most_m
        if after in (0, len(self._fixes)):
            return ways_m[0]
        return max(0.0, sum(ways_m) - min(float(np.hypot(*(beside[1] - beside[0]))), most_m))

    def share(self, t_s: float, place_m: np.ndarray, height_m: float) -> float:
        """What a fix there, so high above the ground, counts: the rest of it was said by others."""
        reach_m = SAME_GROUND_SHARE * height_m
        after = bisect_left(self._fixes, t_s, key=lambda fix: fix[0])
        since_s = min((abs(t_s - other_s) for other_s, _ in self._fixes[max(0, after - 1) : after + 1]), default=np.inf)
        least = min(MIN_NEW, MIN_NEW_PER_S * since_s)
        return max(self.new_m(t_s, place_m, reach_m) / reach_m, least, LEAST)

    def add(self, t_s: float, place_m: np.ndarray) -> None:
        self._fixes.insert(bisect_left(self._fixes, t_s, key=lambda fix: fix[0]), (t_s, place_m))
        del self._fixes[:-KEPT]
