"""The alternative position: where the vehicle is if the estimate follows wrong map matches, and its probability.

Map matches that agree with each other and not with the graph mean that one of the two is wrong, and no on-board
measurement can decide between them: rows of houses and fields are self-consistent for minutes. Whichever position the
estimate follows, the published covariance includes the other one until matches over enough new ground support the
estimate. A position that the map supported before the disagreement, and supports again after it, is more reliable: to
be wrong it takes two such repeating patterns."""

from dataclasses import dataclass, field

import numpy as np

from terrafix.estimator.integrity.innovation_run import CONSISTENT_M

MIN_CONSISTENT = 2  # consecutive rejected matches that agree with each other; a single one is an outlier [tuned]
INITIAL_PROBABILITY = 0.5  # of the alternative when the disagreement begins: both positions are equally likely [tuned]
# Heights of new ground over which the probability falls to 1/e: the length of a repeating pattern. [tuned]
DECAY_HEIGHTS = 5.0
# Factor of DECAY_HEIGHTS if the map supported the alternative before: a plane crosses long rows of fields at any
# height. [tuned]
DECAY_FACTOR_MAPPED = 2.0
# Factor of DECAY_HEIGHTS if the alternative is the start coordinate. That is no repeating pattern: one start in 400 is
# wrong by far more than its sigma (anchor/verification/lock_monitor.py). Three poses that agree with each other are
# stronger evidence against it, and a pose observes new ground after a quarter of a height. [tuned]
DECAY_FACTOR_START = 0.05
MIN_PROBABILITY = 0.01  # the alternative is removed at or below it [tuned]
# Smallest probability at which the published 3-sigma ellipse reaches the alternative position.
REACHED_PROBABILITY = 1 / 9  # [spec: probability p gives sigma = offset * sqrt(p)]


@dataclass
class AlternativePosition:
    """``offset_m`` (2,): from the estimate to the alternative position, with covariance ``cov_m2`` (2, 2)."""

    offset_m: np.ndarray = field(default_factory=lambda: np.zeros(2))
    cov_m2: np.ndarray = field(default_factory=lambda: np.zeros((2, 2)))
    # Probability of a repeating pattern as long as the path over which the map has supported the estimate.
    _pattern_probability: float = 0.0
    _needs_two_patterns: bool = False  # the alternative is true only if there are two such patterns
    _is_start: bool = False  # the alternative is the start coordinate, which no map match has confirmed
    _mapped_m: np.ndarray | None = None  # offset to where the map had the vehicle before; None: nowhere, or ambiguous

    @property
    def probability(self) -> float:
        """Probability, 0..1, of the alternative position; 0: there is none."""
        return self._pattern_probability**2 if self._needs_two_patterns else self._pattern_probability

    def spawn(self, offsets_m: list[np.ndarray], cov_m2: np.ndarray, *, fixed: bool) -> None:
        """Consecutive rejected matches, as offsets (2,) from the estimate; ``cov_m2`` (2, 2): of the last one.
        ``fixed``: the estimate had a map fix before. No effect for fewer than MIN_CONSISTENT matches."""
        if len(offsets_m) < MIN_CONSISTENT:
            return
        if self._pattern_probability == 0.0:
            self._mapped_m = np.zeros(2) if fixed else None
        self._is_start = not fixed
        self._reset(np.mean(offsets_m, axis=0), cov_m2)

    def switch(self, offset_m: np.ndarray, cov_m2: np.ndarray) -> None:
        """The estimate was moved by ``offset_m`` (2,) to the alternative; its old position becomes the alternative."""
        if self._mapped_m is not None:
            self._mapped_m = self._mapped_m - offset_m
        self._reset(-offset_m, cov_m2)

    def _reset(self, offset_m: np.ndarray, cov_m2: np.ndarray) -> None:
        self.offset_m, self.cov_m2 = offset_m, cov_m2
        self._pattern_probability, self._needs_two_patterns = INITIAL_PROBABILITY, False

    def decay(self, new_heights: float, mode_mass: float) -> None:
        """A camera pose agreed with the estimate, ``new_heights`` (in heights above ground) after the last one.

        ``mode_mass``: mass of the anchor's belief in the mode of the pose. The belief began at the start coordinate;
        what it still has there is part of the rest."""
        self._needs_two_patterns = self._was_mapped(np.zeros(2))
        factor = DECAY_FACTOR_START if self._is_start else 1.0
        if self._was_mapped(self.offset_m):
            factor = DECAY_FACTOR_MAPPED
        over = DECAY_HEIGHTS * factor
        self._pattern_probability *= float(np.exp(-new_heights / over))
        if self._is_start:
            self._pattern_probability = min(self._pattern_probability, 1.0 - mode_mass)
        if self.probability <= MIN_PROBABILITY:
            self._pattern_probability = 0.0

    def _was_mapped(self, offset_m: np.ndarray) -> bool:
        """Whether the map supported the position at ``offset_m`` (2,) from the estimate before the disagreement."""
        if self._mapped_m is None:
            return False
        distance_m = float(np.hypot(*(self._mapped_m - offset_m)))
        return distance_m <= min(CONSISTENT_M, 0.5 * float(np.hypot(*self.offset_m)))

    def inflation_m2(self) -> np.ndarray:
        """Addition (2, 2) to the published covariance: second moments of both positions about the estimate.

        In the moments of a mixture ``cov_m2`` is weighted by the probability, too. Here it has its full weight from
        REACHED_PROBABILITY on: the true position may lie aside of the offset by as much as ever, and an ellipse that
        reaches as far as the offset must reach that position."""
        aside_m2 = min(1.0, self.probability / REACHED_PROBABILITY) * self.cov_m2
        return np.asarray(self.probability * np.outer(self.offset_m, self.offset_m) + aside_m2)
