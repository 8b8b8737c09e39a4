"""Innovations that keep one sign: a wrong state, not noise.

Each of them may pass its gate. Odometry that is always shorter than the prediction says that velocity is wrong (late
stamps of a busy camera, inertial readings at wrong times), and the estimate follows it along the track by metres in
each frame. Map poses that are always ahead say that the estimate is too sure of itself. Page's CUSUM (1954) tests them
as a run, as the calibration monitors test theirs (PX4 EKF2 and ArduPilot EKF3 gate each innovation alone, and time
out)."""

import math

import numpy as np

from terrafix.core.gate import GATE
from terrafix.estimator.monitors.cusum import Cusum, threshold

# Mean of the standardised innovations under the hypothesis of a wrong state: half of what a gate lets pass.
SHIFT = 0.5 * math.sqrt(GATE[3])  # [spec: chi-square, 3 degrees of freedom, 99.9 %]
INNOVATIONS_PER_HOUR = 36_000.0  # [spec: ten frames a second]
# a false alarm costs seconds of a fix, a missed one is a wrong position [spec: one flight]
INNOVATION_FALSE_ALARM_HOURS = 1.0
AXES_AND_SIGNS = tuple((axis, sign) for axis in range(2) for sign in (1.0, -1.0))  # [spec: east and north, each sign]


class SignedInnovations:
    """``sum_m`` (2,): of the innovations of the present run, east and north: as far as the estimate has followed it."""

    def __init__(self) -> None:
        self._tests = [
            Cusum(threshold(INNOVATIONS_PER_HOUR, len(AXES_AND_SIGNS), INNOVATION_FALSE_ALARM_HOURS))
            for _ in AXES_AND_SIGNS
        ]
        self.sum_m = np.zeros(2)

    def add(self, residual_m: np.ndarray, cov_m2: np.ndarray, share: float = 1.0) -> None:
        """One innovation (2,), east and north, and its covariance (2, 2); ``share``: of it that is independent of those
        before."""
        z = residual_m / np.sqrt(np.diag(cov_m2))
        for test, (axis, sign) in zip(self._tests, AXES_AND_SIGNS, strict=True):
            test.add(share * (SHIFT * sign * float(z[axis]) - 0.5 * SHIFT**2))
        self.sum_m = self.sum_m + residual_m if any(test.sum > 0.0 for test in self._tests) else np.zeros(2)

    @property
    def alarm(self) -> bool:
        """Whether the run is too long to be noise."""
        return any(test.active for test in self._tests)
