"""A smooth curve through noisy samples: the quintic smoothing spline, as a Kalman smoother.

A state of value, rate and acceleration that is driven by white jerk has the smoothing spline of fifth degree as its
posterior mean (Wahba, "Improper priors, spline smoothing and the problem of guarding against model errors", 1978; in
state-space form Kohn and Ansley, SIAM J. Sci. Stat. Comput. 8, 1987). Between two samples that mean is the polynomial
of fifth degree that value, rate and acceleration at both ends determine. How smooth: as near to the samples as the
vehicle could have flown. Likelihood does not help there: errors of a truth that last for seconds look like motion."""

import math
from dataclasses import dataclass

import numpy as np

RATIOS = tuple(10.0**k for k in np.arange(6.0, -8.1, -0.25).tolist())  # jerk density over sample variance, from rough
LOOK_S = 0.1  # between two looks at the acceleration
FAR = 1e5  # variance of what is not known at the start, over that of a sample and of a second of jerk


@dataclass(frozen=True)
class Curve:
    """``at(t_s)``: value, rate and acceleration of D quantities that belong together."""

    t_s: np.ndarray  # (N,) of the samples
    states: np.ndarray  # (N, 3, D) value, rate, acceleration there
    off: float  # root mean square distance of the samples from it

    def at(self, t_s: np.ndarray) -> np.ndarray:
        """(M,) times -> (M, 3, D); before the first sample and after the last the rate stays."""
        i = np.clip(np.searchsorted(self.t_s, t_s, side="right") - 1, 0, len(self.t_s) - 2)
        h = (self.t_s[i + 1] - self.t_s[i])[:, None, None]
        inside = np.clip(t_s, self.t_s[0], self.t_s[-1])
        scale = np.concatenate([np.ones_like(h), h, h * h], axis=1)
        c = _HERMITE @ np.concatenate([self.states[i] * scale, self.states[i + 1] * scale], axis=1)  # of u^0 .. u^5
        k = np.arange(6)[:, None]
        u = ((inside - self.t_s[i]) / h[:, 0, 0])[:, None, None] ** k
        value = (c * u).sum(1)
        rate = (c[:, 1:] * k[1:] * u[:, :-1]).sum(1) / h[:, 0]
        bend = (c[:, 2:] * (k * (k - 1))[2:] * u[:, :-2]).sum(1) / h[:, 0] ** 2
        out = (t_s - inside)[:, None]
        return np.stack([value + rate * out, rate, np.where(out == 0.0, bend, 0.0)], axis=1)


# value, rate, acceleration at 0 and 1 -> coefficients of the polynomial of fifth degree
_HERMITE = np.linalg.inv(
    np.array(
        [[math.perm(k, d) * (at ** (k - d) if k >= d else 0) for k in range(6)] for at in (0, 1) for d in range(3)]
    )
)


def smooth(t_s: np.ndarray, samples: np.ndarray, most: float) -> Curve:
    """(N,) increasing times, (N, D) samples, N >= 2; ``most``: largest acceleration (norm over D) that can be."""
    inside = np.arange(t_s[0], t_s[-1], LOOK_S)
    for ratio in RATIOS:
        curve = _smoothed(t_s, samples, ratio)
        if np.linalg.norm(curve.at(inside)[:, 2], axis=1).max() <= most:
            break
    return curve


@dataclass(frozen=True)
class _Filtered:
    """Covariances are in units of the sample variance."""

    states: np.ndarray  # (N, 3, D)
    covariances: np.ndarray  # (N, 3, 3)
    predicted: np.ndarray  # (N, 3, D), from the sample before
    ahead: np.ndarray  # (N, 3, 3), of these


def _smoothed(t_s: np.ndarray, samples: np.ndarray, ratio: float) -> Curve:
    """Rauch, Tung, Striebel: backwards over what the filter left."""
    run = _filter(t_s, samples, ratio)
    states = run.states.copy()
    for k in range(len(t_s) - 2, -1, -1):
        step = _transition(t_s[k + 1] - t_s[k])
        gain = np.linalg.solve(run.ahead[k + 1], step @ run.covariances[k]).T
        states[k] = run.states[k] + gain @ (states[k + 1] - run.predicted[k + 1])
    off = math.sqrt(float(((states[:, 0] - samples) ** 2).sum(1).mean()))
    return Curve(t_s, states, off)


def _filter(t_s: np.ndarray, samples: np.ndarray, ratio: float) -> _Filtered:
    count, wide = samples.shape
    states, predicted = np.zeros((count, 3, wide)), np.zeros((count, 3, wide))
    covariances, ahead = np.zeros((count, 3, 3)), np.zeros((count, 3, 3))
    x = np.zeros((3, wide))
    x[0] = samples[0]
    p = np.diag([1.0, FAR * (1.0 + ratio), FAR * (1.0 + ratio)])
    for k in range(count):
        if k:
            dt = t_s[k] - t_s[k - 1]
            step = _transition(dt)
            x, p = step @ x, step @ p @ step.T + ratio * _jerk(dt)
            predicted[k], ahead[k] = x, p
            s = p[0, 0] + 1.0
            d = samples[k] - x[0]
            gain = p[:, 0] / s
            x = x + np.outer(gain, d)
            p = p - np.outer(gain, p[0])
        states[k], covariances[k] = x, p
    return _Filtered(states, covariances, predicted, ahead)


def _transition(dt: float) -> np.ndarray:
    return np.array([[1.0, dt, 0.5 * dt * dt], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])


def _jerk(dt: float) -> np.ndarray:
    """Covariance that white jerk of unit density makes in ``dt``."""
    return np.array(
        [
            [dt**5 / 20, dt**4 / 8, dt**3 / 6],
            [dt**4 / 8, dt**3 / 3, dt**2 / 2],
            [dt**3 / 6, dt**2 / 2, dt],
        ]
    )
