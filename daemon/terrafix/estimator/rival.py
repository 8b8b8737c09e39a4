"""The other place: where the vehicle is if the estimate follows wrong map matches, and how much must be left to that.

Map matches that agree with each other and not with the graph mean that one of the two is wrong, and nothing here says
which: rows of houses and fields agree with themselves for minutes. Whichever the estimate follows, its covariance
reaches the other one until enough new ground has spoken against it."""

from dataclasses import dataclass, field

import numpy as np

AGREEING = 2  # refused matches in a row that agree with each other: one alone is a mistake
EVEN = 0.5  # probability of the other place when nothing is known but that the two disagree
FORGET_OVER = 5.0  # of the height: so far flies a repeating pattern, and so far the other place fades to a third
FORGOTTEN = 0.01


@dataclass
class Rival:
    """``offset_m`` (2,): from the estimate to the other place, known to ``cov_m2`` (2, 2); ``probability`` of it."""

    offset_m: np.ndarray = field(default_factory=lambda: np.zeros(2))
    cov_m2: np.ndarray = field(default_factory=lambda: np.zeros((2, 2)))
    probability: float = 0.0

    def disagreed(self, offsets_m: list[np.ndarray], cov_m2: np.ndarray) -> None:
        """Matches in a row that were refused, as offsets (2,) from the estimate, the last one known to ``cov_m2``."""
        if len(offsets_m) >= AGREEING:
            self.offset_m, self.cov_m2, self.probability = np.mean(offsets_m, axis=0), cov_m2, EVEN

    def left(self, offset_m: np.ndarray, cov_m2: np.ndarray) -> None:
        """The estimate has gone over to the other place, ``offset_m`` (2,) away: the old one is the rival now."""
        self.offset_m, self.cov_m2, self.probability = -offset_m, cov_m2, EVEN

    def fade(self, new_heights: float) -> None:
        """A match agreed with the estimate over new ground, in heights flown since the last one."""
        self.probability *= float(np.exp(-new_heights / FORGET_OVER))
        if self.probability < FORGOTTEN:
            self.probability = 0.0

    def added(self, cov: np.ndarray) -> np.ndarray:
        """``cov`` (6, 6), east and north first, with the spread of the two places."""
        cov = cov.copy()
        cov[:2, :2] += self.spread_m2()
        return cov

    def spread_m2(self) -> np.ndarray:
        """(2, 2) of the two places about the estimate.

        That of the mean would shrink ``cov_m2`` with the probability, too; but if it is the other place, it lies aside
        of the offset by as much as ever, and the ellipse would no longer reach it there."""
        if self.probability == 0.0:
            return np.zeros((2, 2))
        return np.asarray(self.probability * np.outer(self.offset_m, self.offset_m) + self.cov_m2)
