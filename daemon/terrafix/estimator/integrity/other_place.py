"""The other place: where the vehicle is if the estimate follows wrong map matches, and how much must be left to that.

Map matches that agree with each other and not with the graph mean that one of the two is wrong, and nothing here says
which: rows of houses and fields agree with themselves for minutes. Whichever the estimate follows, its covariance
reaches the other one until enough new ground has spoken against it. A place that the map told before the two disagreed,
and tells again, has the map on both sides of the disagreement: to be wrong it would take two such patterns."""

from dataclasses import dataclass, field

import numpy as np

from terrafix.estimator.integrity.innovation_run import AGREE_M

AGREEING = 2  # refused matches in a row that agree with each other: one alone is a mistake
EVEN = 0.5  # probability of the other place when nothing is known but that the two disagree
FORGET_OVER = 5.0  # of the height: so far flies a repeating pattern, and so far the other place fades to a third ...
TOLD_LASTS = 2.0  # ... or so much farther, if the map had told it before: a plane crosses long rows at any height
# A start coordinate is no pattern that repeats: one in 400 is wrong by far more than it claims
# (anchor/verification/lock_monitor.py), and three poses that agree with each other say more against it, and a quarter
# of a height is new ground for one.
START_LASTS = 0.05
FORGOTTEN = 0.01
REACHED = 1 / 9  # from this probability on three sigmas reach the other place


@dataclass
class OtherPlace:
    """``offset_m`` (2,): from the estimate to the other place, known to ``cov_m2`` (2, 2)."""

    offset_m: np.ndarray = field(default_factory=lambda: np.zeros(2))
    cov_m2: np.ndarray = field(default_factory=lambda: np.zeros((2, 2)))
    _repeats: float = 0.0  # probability that a pattern is as long as the way over which the map has spoken for us
    _two: bool = False  # ... and that it takes two of them
    _is_start: bool = False  # the other place is the start, which no map match has ever borne out
    _before_m: np.ndarray | None = None  # from the estimate to where the map had it before; None: nowhere, or in doubt

    @property
    def probability(self) -> float:
        """Of the other place."""
        return self._repeats**2 if self._two else self._repeats

    def disagreed(self, offsets_m: list[np.ndarray], cov_m2: np.ndarray, *, fixed: bool) -> None:
        """Matches in a row that were refused, as offsets (2,) from the estimate, the last one known to ``cov_m2``.
        ``fixed``: the map has placed the estimate."""
        if len(offsets_m) < AGREEING:
            return
        if self._repeats == 0.0:
            self._before_m = np.zeros(2) if fixed else None
        self._is_start = not fixed
        self._is_at(np.mean(offsets_m, axis=0), cov_m2)

    def left(self, offset_m: np.ndarray, cov_m2: np.ndarray) -> None:
        """The estimate has gone over to the other place, ``offset_m`` (2,) away: the old one is the rival now."""
        if self._before_m is not None:
            self._before_m = self._before_m - offset_m
        self._is_at(-offset_m, cov_m2)

    def _is_at(self, offset_m: np.ndarray, cov_m2: np.ndarray) -> None:
        self.offset_m, self.cov_m2, self._repeats, self._two = offset_m, cov_m2, EVEN, False

    def fade(self, new_heights: float, mode_mass: float) -> None:
        """A camera pose agreed with the estimate over new ground, in heights flown since the last one.

        ``mode_mass``: of the belief, where the pose is. The belief began at the start, and what it has left of that is
        in the rest."""
        self._two = self._was_at(np.zeros(2))
        lasts = TOLD_LASTS if self._was_at(self.offset_m) else START_LASTS if self._is_start else 1.0
        over = FORGET_OVER * lasts
        self._repeats *= float(np.exp(-new_heights / over))
        if self._is_start:
            self._repeats = min(self._repeats, 1.0 - mode_mass)
        if self.probability <= FORGOTTEN:
            self._repeats = 0.0

    def _was_at(self, offset_m: np.ndarray) -> bool:
        """The map had told this one of the two places, as an offset (2,) from the estimate, before they disagreed."""
        if self._before_m is None:
            return False
        off_m = float(np.hypot(*(self._before_m - offset_m)))
        return off_m <= min(AGREE_M, 0.5 * float(np.hypot(*self.offset_m)))

    def spread_m2(self) -> np.ndarray:
        """(2, 2) of the two places about the estimate.

        That of the mean would shrink ``cov_m2`` with the probability, too; but if it is the other place, it lies aside
        of the offset by as much as ever, and while the ellipse reaches as far as that it has to reach it there."""
        aside_m2 = min(1.0, self.probability / REACHED) * self.cov_m2
        return np.asarray(self.probability * np.outer(self.offset_m, self.offset_m) + aside_m2)
