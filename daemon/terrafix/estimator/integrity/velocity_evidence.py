"""What the velocity of images tells of the rate at which their delay changes.

While the delay grows by ``r`` seconds a second, images show (1 - r) of the velocity. A wrong height or lens does not
explain it: it begins without an acceleration. One Kalman filter of position and velocity for each rate, moved on by
inertial readings, with the interaction of the interacting multiple model estimator (Blom and Bar-Shalom 1988)."""

import numpy as np

from terrafix.core.gate import GATE
from terrafix.estimator.integrity.offset_drift import RATES

SEEN = 1.0 - RATES  # (R,) of the velocity [spec: d(t - offset) / dt]
# A tilt that is wrong moves inertial readings by its part of gravity, for as long as the error lasts.
BIAS_SIGMA_MPS2, BIAS_S = 0.17, 10.0  # m/s^2, s [spec: a degree, attitude_slow_s of the simulated sensors]
WHITE_SIGMA_MPS2 = 0.03  # per root hertz [spec: NOISE_FLOOR_MPS2 of models/motion_model.py]
# 1-sigma of a position by images, share of the height: first guess, and lower limit [measured: docs/decisions/058]
SIGMA_SHARE, MIN_SIGMA_SHARE = 0.004, 0.001
# Updates over which it is learnt, and what the first guess counts as. [spec: as in time_offset.py]
NOISE_MEMORY, FIRST_GUESS = 250.0, 20.0
# Of a change of velocity: a wrong height scales it as well. With 0.05 turns looked like drifts.
TURN_SHARE = 0.3  # [measured: docs/decisions/058]
INDEPENDENT_DISPLACEMENT_SHARE = (
    0.5  # of the displacements: two consecutive ones share a frame and a keyframe [spec: 1 / 2]
)
# Of Student's t: odometry with an outlier that its residuals do not show is little evidence.
DEGREES_OF_FREEDOM = 5.0  # [measured: docs/decisions/058]
EVIDENCE_SIZE = 3  # of a state [spec: below]


class VelocityEvidence:
    """``forget`` after a gap; ``update`` with the motion of each span. Vectors are complex: east + j north."""

    def __init__(self) -> None:
        # (R, 3): off the newest position that was seen [m], velocity [m/s], error of inertial readings [m/s^2].
        self._state: np.ndarray | None = None
        self._cov = np.zeros((len(RATES), EVIDENCE_SIZE, EVIDENCE_SIZE))  # on each axis
        self._noise = SIGMA_SHARE**2  # variance of a position on each axis [heights^2]
        self._updates = FIRST_GUESS  # that it rests on

    def forget(self) -> None:
        self._state = None

    def update(
        self, joint: np.ndarray, moved_m: complex, span_s: float, changed: tuple[complex, float], agl_m: float
    ) -> np.ndarray:
        """-> (R,) log likelihood of each rate. ``joint`` (R, R): probabilities of a rate before (row) and now (column).
        ``moved_m``: since the frame before, at the height ``agl_m`` above ground; ``changed``: change of velocity by
        inertial readings [m/s], and its variance on each axis beyond their noise [m^2/s^2]."""
        change_mps, beyond_m2ps2 = changed
        rates, noise_m2 = len(RATES), max(self._noise, MIN_SIGMA_SHARE**2) * agl_m**2
        if self._state is None:
            self._state = np.column_stack([np.zeros(rates), moved_m / span_s / SEEN, np.zeros(rates)])
            of_v = np.column_stack([np.ones(rates), 1.0 / (span_s * SEEN)])
            self._cov = np.zeros((rates, EVIDENCE_SIZE, EVIDENCE_SIZE))
            self._cov[:, :2, :2] = noise_m2 * of_v[:, :, None] * of_v[:, None, :]
            self._cov[:, 1, 1] *= 2.0  # two frames
            self._cov[:, 2, 2] = BIAS_SIGMA_MPS2**2
            return np.zeros(rates)
        state, cov = self._mixed(joint / np.maximum(joint.sum(axis=0), 1e-300), self._state)
        keeps = float(np.exp(-span_s / BIAS_S))
        forward = np.tile(np.diag([1.0, 1.0, keeps]), (rates, 1, 1))
        forward[:, 0, 1], forward[:, 1, 2] = SEEN * span_s, span_s
        by_change = np.column_stack([0.5 * SEEN * span_s, np.ones(rates), np.zeros(rates)])
        state = np.einsum("rij,rj->ri", forward, state) + by_change * change_mps
        cov = forward @ cov @ forward.transpose(0, 2, 1)
        variance_mps = beyond_m2ps2 + WHITE_SIGMA_MPS2**2 * span_s + (TURN_SHARE * abs(change_mps)) ** 2
        cov += variance_mps * by_change[:, :, None] * by_change[:, None, :]
        cov[:, 2, 2] += (1.0 - keeps**2) * BIAS_SIGMA_MPS2**2
        innovation, variance = moved_m - state[:, 0], cov[:, 0, 0] + noise_m2
        distance2 = np.abs(innovation) ** 2 / variance
        if distance2.min() > GATE[2]:  # at no rate: images or inertial readings are wrong
            self.forget()
            return np.zeros(rates)
        likely2 = 0.5 * np.abs(innovation) ** 2 - cov[:, 0, 0]
        likely2 = float(joint.sum(axis=0) @ np.clip(likely2 / agl_m**2, 0.0, GATE[2] * self._noise) / joint.sum())
        self._updates = min(self._updates + 1.0, NOISE_MEMORY)
        self._noise += (likely2 - self._noise) / self._updates
        gain = cov[:, :, 0] / variance[:, None]
        state += gain * innovation[:, None]
        state[:, 0] -= moved_m
        self._state, self._cov = state, cov - gain[:, :, None] * cov[:, None, 0, :]
        nu = DEGREES_OF_FREEDOM
        log = INDEPENDENT_DISPLACEMENT_SHARE * (-0.5 * (nu + 2.0) * np.log1p(distance2 / nu) - np.log(variance))
        # A larger velocity is rather a zoom or a squeezed image than a camera that is ever less late.
        if log[RATES < 0.0].max() > log[0] + 1.0:  # nat: more than noise
            self.forget()
            return np.zeros(rates)
        return np.asarray(np.where(RATES < 0.0, np.minimum(log, log[0]), log))

    def _mixed(self, share: np.ndarray, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States (R, 3) and covariances (R, 3, 3) at the beginning of the span, by the rate in it. ``share`` (R, R): of
        each rate before (row) in the rate now (column)."""
        mixed = share.T @ state
        apart = state[:, None, :] - mixed[None, :, :]
        spread = 0.5 * (apart[..., :, None] * apart[..., None, :].conj()).real  # of the two axes
        return mixed, np.einsum("ij,ijkl->jkl", share, self._cov[:, None] + spread)
