"""Innovations that keep one sign: a wrong state, not noise.

Each of them may pass its gate. Odometry that is always shorter than the prediction says that velocity is wrong (late
stamps of a busy camera, inertial readings at wrong times, images of another scale), and the estimate follows it along
the track by metres in each frame. The generalised likelihood ratio of a mean that is not zero tests them as a run
(Willsky and Jones 1976; PX4 EKF2 and ArduPilot EKF3 gate each innovation alone, and time out)."""

import math
from collections import deque

import numpy as np

from terrafix.core.gate import GATE

INNOVATIONS_PER_HOUR = 36_000.0  # [spec: ten frames a second]
# A false alarm costs the fix until the next map match, a missed one is a wrong position.
INNOVATION_FALSE_ALARM_HOURS = 3.0  # [spec: one in some flights]
INDEPENDENT_RUNS = 7.0  # of those that end with an innovation [measured: docs/decisions/059]
RUN_SIZE = 20  # innovations of the longest run [spec: two seconds at ten frames a second]
MIN_RUN = 2  # innovations: one is an outlier [spec: no run]
MAX_SIGMAS = math.sqrt(GATE[3])  # of an innovation that counts; a larger one is an outlier as well [spec: core/gate.py]


class SignedInnovations:
    """``sum_m`` (2,): of the innovations of the most likely run, east and north: as far as the estimate has followed
    it; ``largest_m`` (2,): of one of them. ``alarm``: whether the run is too long, or too far to one side, to be
    noise."""

    def __init__(self) -> None:
        self._residuals_m: deque[np.ndarray] = deque(maxlen=RUN_SIZE)
        self._standardised: deque[np.ndarray] = deque(maxlen=RUN_SIZE)
        # Under the hypothesis of no shift each run exceeds t nats with probability exp(-t) (chi-square, two degrees).
        self._limit = math.log(INNOVATIONS_PER_HOUR * INNOVATION_FALSE_ALARM_HOURS * INDEPENDENT_RUNS)
        self.sum_m, self.largest_m, self.alarm = np.zeros(2), np.zeros(2), False

    def add(self, residual_m: np.ndarray, cov_m2: np.ndarray) -> None:
        """One innovation (2,), east and north, and its covariance (2, 2)."""
        z = np.linalg.solve(np.linalg.cholesky(cov_m2), residual_m)
        z *= min(1.0, MAX_SIGMAS / max(float(np.linalg.norm(z)), 1e-9))
        self._residuals_m.appendleft(residual_m)
        self._standardised.appendleft(z)
        counts = np.arange(1, len(self._standardised) + 1)
        sums = np.cumsum(np.array(self._standardised), axis=0)
        nats = np.where(counts < MIN_RUN, 0.0, 0.5 * np.sum(sums**2, axis=1) / counts)
        run = int(np.argmax(nats)) + 1
        residuals_m = np.array(self._residuals_m)[:run]
        self.sum_m = residuals_m.sum(axis=0)
        self.largest_m = residuals_m[np.argmax(np.hypot(*residuals_m.T))]
        self.alarm = bool(nats[run - 1] > self._limit)
