"""Innovations that keep one sign: a wrong state, not noise.

Each of them may pass its gate. Odometry that is always shorter than the prediction says that velocity is wrong (late
stamps of a busy camera, inertial readings at wrong times, images of another scale), and the estimate follows it along
the track by metres in each frame. The generalised likelihood ratio of a mean that is not zero tests them as a run
(Willsky and Jones 1976; PX4 EKF2 and ArduPilot EKF3 gate each innovation alone, and time out)."""

import math
from collections import deque

import numpy as np

from terrafix.core.gate import GATE
from terrafix.estimator.integrity.velocity_evidence import FIRST_GUESS, NOISE_MEMORY

INNOVATIONS_PER_HOUR = 36_000.0  # [spec: ten frames a second]
# A false alarm costs the fix until the next map match, a missed one is a wrong position.
INNOVATION_FALSE_ALARM_HOURS = 3.0  # [spec: one in some flights]
INDEPENDENT_RUNS = 2.2  # of those that end with an innovation [measured: docs/decisions/059]
RUN_SIZE = 5  # innovations of the longest run: the velocity has followed by then [measured: docs/decisions/059]
MIN_RUN = 2  # innovations: one is an outlier [spec: no run]
# Claims of odometry contain what all of its motions have in common (height, lens), and the velocity that they are
# compared with has it, too: innovations are smaller than claimed. Least share of the variance that is left to them.
MIN_VARIANCE_SHARE = 0.5  # [measured: docs/decisions/059]
MAX_SIGMAS = math.sqrt(GATE[3])  # of an innovation that counts; a larger one is an outlier as well [spec: core/gate.py]


class SignedInnovations:
    """``run``: innovations of the most likely run; ``sum_m`` (2,): of these, east and north: as far as the estimate has
    followed it. ``alarm``: whether the run is too long, or too far to one side, to be noise."""

    def __init__(self) -> None:
        self._residuals_m: deque[np.ndarray] = deque(maxlen=RUN_SIZE)
        self._standardised: deque[np.ndarray] = deque(maxlen=RUN_SIZE)
        self._variance, self._updates = 1.0, FIRST_GUESS  # of a claimed one, as learnt, and what it rests on
        # Under the hypothesis of no shift each run exceeds t nats with probability exp(-t) (chi-square, two degrees).
        self._limit = math.log(INNOVATIONS_PER_HOUR * INNOVATION_FALSE_ALARM_HOURS * INDEPENDENT_RUNS)
        self.run, self.sum_m, self.alarm = 0, np.zeros(2), False

    def forget(self) -> None:
        """The run has ended; what is learnt stays."""
        self._residuals_m.clear()
        self._standardised.clear()
        self.alarm = False

    def add(self, residual_m: np.ndarray, cov_m2: np.ndarray, *, inertial: bool) -> None:
        """One innovation (2,), east and north, and its covariance (2, 2). ``inertial``: of a prediction by inertial
        readings; without them manoeuvres are part of the noise, and keep their sign."""
        claimed = np.linalg.solve(np.linalg.cholesky(cov_m2), residual_m)
        share = min(max(self._variance, MIN_VARIANCE_SHARE), 1.0) if inertial else 1.0
        z = claimed / math.sqrt(share)
        z *= min(1.0, MAX_SIGMAS / max(float(np.linalg.norm(z)), 1e-9))
        self._updates = min(self._updates + 1.0, NOISE_MEMORY)
        self._variance += (min(0.5 * float(claimed @ claimed), GATE[2]) - self._variance) / self._updates
        self._residuals_m.appendleft(residual_m)
        self._standardised.appendleft(z)
        counts = np.arange(1, len(self._standardised) + 1)
        sums = np.cumsum(np.array(self._standardised), axis=0)
        nats = np.where(counts < MIN_RUN, 0.0, 0.5 * np.sum(sums**2, axis=1) / counts)
        self.run = int(np.argmax(nats)) + 1
        self.sum_m = np.array(self._residuals_m)[: self.run].sum(axis=0)
        self.alarm = bool(nats[self.run - 1] > self._limit)
