"""Quintic smoothing spline through noisy samples, computed as a Kalman smoother.

A state of value, rate and acceleration driven by white jerk has the smoothing spline of fifth degree as its posterior
mean (Wahba, "Improper priors, spline smoothing and the problem of guarding against model errors", 1978; in state-space
form Kohn and Ansley, SIAM J. Sci. Stat. Comput. 8, 1987). Between two samples the mean is the polynomial of fifth
degree determined by value, rate and acceleration at both ends. The smoothness is the least at which the acceleration
stays within the vehicle's limit. Maximum likelihood is not suitable: errors of the truth that last for seconds look
like motion.
"""

import math
from dataclasses import dataclass

import numpy as np

RATIOS = tuple(10.0**k for k in np.arange(6.0, -8.1, -0.25).tolist())  # jerk density over sample variance, from rough
CHECK_INTERVAL_S = 0.1  # sampling interval of the acceleration check
INITIAL_VARIANCE_RATIO = 1e5  # initial variance of unknown states, relative to that of a sample and of a second of jerk


@dataclass(frozen=True)
class Curve:
    """A fitted curve of D quantities; ``at(t_s)`` gives value, rate and acceleration."""

    t_s: np.ndarray  # (N,) of the samples
    states: np.ndarray  # (N, 3, D) value, rate, acceleration at the samples
    rms: float  # root mean square distance of the samples from the curve

    def at(self, t_s: np.ndarray) -> np.ndarray:
        """Evaluates the curve at (M,) times: (M, 3, D); outside the samples the rate is constant."""
        i = np.clip(np.searchsorted(self.t_s, t_s, side="right") - 1, 0, len(self.t_s) - 2)
        h = (self.t_s[i + 1] - self.t_s[i])[:, None, None]
        inside = np.clip(t_s, self.t_s[0], self.t_s[-1])
        scale = np.concatenate([np.ones_like(h), h, h * h], axis=1)
        c = _HERMITE @ np.concatenate([self.states[i] * scale, self.states[i + 1] * scale], axis=1)  # of u^0 .. u^5
        k = np.arange(6)[:, None]
        u = ((inside - self.t_s[i]) / h[:, 0, 0])[:, None, None] ** k
        value = (c * u).sum(1)
        rate = (c[:, 1:] * k[1:] * u[:, :-1]).sum(1) / h[:, 0]
        acceleration = (c[:, 2:] * (k * (k - 1))[2:] * u[:, :-2]).sum(1) / h[:, 0] ** 2
        extrapolation_s = (t_s - inside)[:, None]
        return np.stack(
            [value + rate * extrapolation_s, rate, np.where(extrapolation_s == 0.0, acceleration, 0.0)], axis=1
        )


# (value, rate, acceleration at 0 and 1) -> coefficients of the polynomial of fifth degree
_HERMITE = np.linalg.inv(
    np.array(
        [[math.perm(k, d) * (at ** (k - d) if k >= d else 0) for k in range(6)] for at in (0, 1) for d in range(3)]
    )
)


def smooth(t_s: np.ndarray, samples: np.ndarray, max_acceleration: float) -> Curve:
    """Fits (N,) increasing times and (N, D) samples, N >= 2; ``max_acceleration``: limit (norm over D)."""
    inside = np.arange(t_s[0], t_s[-1], CHECK_INTERVAL_S)
    for ratio in RATIOS:
        curve = _rts_smoother(t_s, samples, ratio)
        if np.linalg.norm(curve.at(inside)[:, 2], axis=1).max() <= max_acceleration:
            break
    return curve


@dataclass(frozen=True)
class _Filtered:
    """Kalman filter output; covariances are in units of the sample variance."""

    states: np.ndarray  # (N, 3, D)
    covariances: np.ndarray  # (N, 3, 3)
    predicted: np.ndarray  # (N, 3, D), predicted from the sample before
    predicted_cov: np.ndarray  # (N, 3, 3), of the predictions


def _rts_smoother(t_s: np.ndarray, samples: np.ndarray, ratio: float) -> Curve:
    """Rauch-Tung-Striebel smoother: backward pass over the filter output."""
    filtered = _filter(t_s, samples, ratio)
    states = filtered.states.copy()
    for k in range(len(t_s) - 2, -1, -1):
        step = _transition(t_s[k + 1] - t_s[k])
        gain = np.linalg.solve(filtered.predicted_cov[k + 1], step @ filtered.covariances[k]).T
        states[k] = filtered.states[k] + gain @ (states[k + 1] - filtered.predicted[k + 1])
    rms = math.sqrt(float(((states[:, 0] - samples) ** 2).sum(1).mean()))
    return Curve(t_s, states, rms)


def _filter(t_s: np.ndarray, samples: np.ndarray, ratio: float) -> _Filtered:
    count, dims = samples.shape
    states, predicted = np.zeros((count, 3, dims)), np.zeros((count, 3, dims))
    covariances, predicted_cov = np.zeros((count, 3, 3)), np.zeros((count, 3, 3))
    x = np.zeros((3, dims))
    x[0] = samples[0]
    p = np.diag([1.0, INITIAL_VARIANCE_RATIO * (1.0 + ratio), INITIAL_VARIANCE_RATIO * (1.0 + ratio)])
    for k in range(count):
        if k:
            dt = t_s[k] - t_s[k - 1]
            step = _transition(dt)
            x, p = step @ x, step @ p @ step.T + ratio * _jerk_covariance(dt)
            predicted[k], predicted_cov[k] = x, p
            s = p[0, 0] + 1.0
            d = samples[k] - x[0]
            gain = p[:, 0] / s
            x = x + np.outer(gain, d)
            p = p - np.outer(gain, p[0])
        states[k], covariances[k] = x, p
    return _Filtered(states, covariances, predicted, predicted_cov)


def _transition(dt: float) -> np.ndarray:
    return np.array([[1.0, dt, 0.5 * dt * dt], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])


def _jerk_covariance(dt: float) -> np.ndarray:
    """Covariance of white jerk of unit density over ``dt``."""
    return np.array(
        [
            [dt**5 / 20, dt**4 / 8, dt**3 / 6],
            [dt**4 / 8, dt**3 / 3, dt**2 / 2],
            [dt**3 / 6, dt**2 / 2, dt],
        ]
    )
