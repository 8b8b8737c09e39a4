"""The alternative position: where the vehicle is if the estimate follows wrong map matches (``Cause.ELSEWHERE``).

Map matches that agree with each other and not with the graph mean that one of the two is wrong, and no on-board
measurement can decide between them: rows of houses and fields are self-consistent for minutes. Whichever position the
estimate follows, the published covariance includes the other one until matches over enough new ground support the
estimate. A position that the map supported before the disagreement, and supports again after it, is more reliable: to
be wrong it takes two such repeating patterns."""

import math
from dataclasses import dataclass, field

import numpy as np

from terrafix.core.agreement import RANGES, Agreement, Cause, Observed
from terrafix.estimator.integrity.innovation_run import CONSISTENT_M

MIN_CONSISTENT = 2  # consecutive rejected matches that agree with each other; a single one is an outlier [tuned]
# New ground counts by half where the map supported the alternative before: a plane crosses long rows of fields at any
# height. [tuned]
SHARE_MAPPED = 0.5
# It counts twenty times if the alternative is the start coordinate. That is no repeating pattern: one start in 400 is
# wrong by far more than its sigma (anchor/verification/lock_monitor.py). Three poses that agree with each other are
# stronger evidence against it, and a pose observes new ground after a quarter of a height. [tuned]
SHARE_START = 20.0
# Log odds of two repeating patterns, each as probable as none. [spec: 0.5 squared]
TWO_PATTERNS = math.log(0.25 / 0.75)
# Smallest probability at which the published 3-sigma ellipse reaches the alternative position.
REACHED_PROBABILITY = 1 / 9  # [spec: probability p gives sigma = offset * sqrt(p)]


@dataclass
class AlternativePosition:
    """``offset_m`` (2,): from the estimate to the alternative position, with covariance ``cov_m2`` (2, 2); its
    probability is that of ``Cause.ELSEWHERE`` in ``agreement``, by default without any other cause."""

    agreement: Agreement = field(default_factory=lambda: Agreement({Cause.ELSEWHERE: RANGES[Cause.ELSEWHERE]}))
    offset_m: np.ndarray = field(default_factory=lambda: np.zeros(2))
    cov_m2: np.ndarray = field(default_factory=lambda: np.zeros((2, 2)))
    _is_start: bool = False  # the alternative is the start coordinate, which no map match has confirmed
    _mapped_m: np.ndarray | None = None  # offset to where the map had the vehicle before; None: nowhere, or ambiguous
    _patterns: int = 1  # repeating patterns that it takes for the alternative to be right

    @property
    def weight(self) -> float:
        """Weight, 0..1, of the alternative position in the mixture; 0: there is none."""
        return self.agreement.weight(Cause.ELSEWHERE)

    def spawn(self, offsets_m: list[np.ndarray], cov_m2: np.ndarray, *, fixed: bool) -> None:
        """Consecutive rejected matches, as offsets (2,) from the estimate; ``cov_m2`` (2, 2): of the last one.
        ``fixed``: the estimate had a map fix before. No effect for fewer than MIN_CONSISTENT matches."""
        if len(offsets_m) < MIN_CONSISTENT:
            return
        if self.weight == 0.0:
            self._mapped_m = np.zeros(2) if fixed else None
        self._is_start = not fixed
        self._begin(np.mean(offsets_m, axis=0), cov_m2)

    def switch(self, offset_m: np.ndarray, cov_m2: np.ndarray) -> None:
        """The estimate was moved by ``offset_m`` (2,) to the alternative; its old position becomes the alternative."""
        if self._mapped_m is not None:
            self._mapped_m = self._mapped_m - offset_m
        self._begin(-offset_m, cov_m2)

    def _begin(self, offset_m: np.ndarray, cov_m2: np.ndarray) -> None:
        self.offset_m, self.cov_m2, self._patterns = offset_m, cov_m2, 1
        self.agreement.begin(Cause.ELSEWHERE)

    def on_pose(self, new_heights: float, mode_mass: float) -> None:
        """A camera pose agreed with the estimate, ``new_heights`` (in heights above ground) after the last one.

        ``mode_mass``: mass of the anchor's belief in the mode of the pose. The belief began at the start coordinate;
        what it still has there is part of the rest."""
        if self._patterns == 1 and self._was_mapped(np.zeros(2)):
            self._patterns = 2
            self.agreement.add(Cause.ELSEWHERE, TWO_PATTERNS)
        share = SHARE_START if self._is_start else 1.0
        if self._was_mapped(self.offset_m):
            share = SHARE_MAPPED
        self.agreement.observe(Observed.POSE, Cause.ELSEWHERE, self._patterns * share * new_heights)
        if self._is_start:
            self.agreement.at_most(Cause.ELSEWHERE, 1.0 - mode_mass)

    def _was_mapped(self, offset_m: np.ndarray) -> bool:
        """Whether the map supported the position at ``offset_m`` (2,) from the estimate before the disagreement."""
        if self._mapped_m is None:
            return False
        distance_m = float(np.hypot(*(self._mapped_m - offset_m)))
        return distance_m <= min(CONSISTENT_M, 0.5 * float(np.hypot(*self.offset_m)))

    def moments_m2(self) -> np.ndarray:
        """Second moments (2, 2) of the alternative about the estimate, times its weight.

        In the moments of a mixture ``cov_m2`` is weighted by the probability, too. Here it has its full weight from
        REACHED_PROBABILITY on: the true position may lie aside of the offset by as much as ever, and an ellipse that
        reaches as far as the offset must reach that position."""
        aside_m2 = min(1.0, self.weight / REACHED_PROBABILITY) * self.cov_m2
        return np.asarray(self.weight * np.outer(self.offset_m, self.offset_m) + aside_m2)
