"""Innovation of a measurement and what was decided on it, with the quantities that PX4 EKF2 logs of its aid sources."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from terrafix.messages import Verdict


@dataclass(frozen=True)
class Innovation:
    """Measured less predicted: ``residual`` (n,) with ``covariance`` (n, n) of measurement and prediction together.
    ``limit``: of the squared Mahalanobis distance."""

    residual: np.ndarray
    covariance: np.ndarray
    limit: float

    @classmethod
    def scalar(cls, residual: float, sigma: float, gate_sigmas: float) -> "Innovation":
        """One degree of freedom with a gate at ``gate_sigmas``."""
        return cls(np.array([residual]), np.array([[sigma**2]]), gate_sigmas**2)

    @cached_property
    def mahalanobis2(self) -> float:
        """Squared Mahalanobis distance, n degrees of freedom."""
        return float(self.residual @ np.linalg.solve(self.covariance, self.residual))

    @property
    def test_ratio(self) -> float:
        """Squared Mahalanobis distance over its limit: above 1 the measurement is rejected (PX4: `test_ratio`)."""
        return self.mahalanobis2 / self.limit

    @property
    def is_accepted(self) -> bool:
        return self.mahalanobis2 <= self.limit

    def verdict(self, measurement: str, detail: str = "", rejected: Verdict = Verdict.INNOVATION) -> "FusionVerdict":
        """The verdict of the gate. ``rejected``: of an innovation beyond ``limit``."""
        return FusionVerdict(measurement, Verdict.ACCEPTED if self.is_accepted else rejected, self, detail)


@dataclass(frozen=True)
class FusionVerdict:
    """What was done with one measurement. ``innovation``: None where it was not evaluated."""

    measurement: str
    verdict: Verdict
    innovation: Innovation | None = None
    detail: str = ""
