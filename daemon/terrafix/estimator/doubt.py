"""What is left of a position that the map speaks against: its covariance, until frames or a search have decided."""

from dataclasses import dataclass

import numpy as np

from terrafix.core.start import SEARCHED_START_M
from terrafix.messages import MapMatch, Origin, Verdict


@dataclass
class Doubt:
    """``sigma_m``: 1-sigma per horizontal axis, on top of what the graph claims. The graph keeps its shape meanwhile:
    odometry goes on in it."""

    sigma_m: float = 0.0
    start_m: float = 0.0  # the same of a start that is not known: it lasts until a place is found

    @classmethod
    def of(cls, origin: Origin) -> "Doubt":
        """A start that is searched is all doubt: as a prior so wide it would make the graph ill-conditioned."""
        return cls(start_m=origin.start_sigma_m if origin.start_sigma_m > SEARCHED_START_M else 0.0)

    def hear(self, match: MapMatch) -> str:
        """-> what to say of a match whose verdict is LOST; empty for any other."""
        self.sigma_m = match.lost_sigma_m
        return f"lost; search: {match.step.value}" if match.verdict is Verdict.LOST else ""

    def added(self, cov: np.ndarray) -> np.ndarray:
        """``cov`` (6, 6), east and north first, with the doubt."""
        cov = cov.copy()
        cov[:2, :2] += max(self.sigma_m, self.start_m) ** 2 * np.eye(2)
        return cov
