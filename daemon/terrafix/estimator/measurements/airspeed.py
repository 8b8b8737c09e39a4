"""The air that a plane flies through, for when nobody sees the ground.

While pictures tell the velocity, a Kalman filter learns the wind, how much faster than its airspeed sensor reads the
vehicle goes through the air (at 2000 m by a tenth; the place of a tube matters as much), and how gusty it is. When they
do not, airspeed and heading tell the velocity: it grows wrong with the wind that changes, where accelerations, added
up, grow wrong with the square of the time.

As in ArduPilot's filter (NavEKF3, airspeed and sideslip fusion) a vehicle that flies by wings is taken to fly where it
heads. For one that does not, the rest looks like gusts, and what is told is worth that little."""

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from terrafix.core.gate import GATE
from terrafix.estimator.factors.custom_factors import robust
from terrafix.estimator.factors.linearization_cache import custom_factor

LEAST_MPS = 8.0  # slower, a pitot tube reads noise, and wings do not carry
WIND_SIGMA_MPS, SCALE_SIGMA = 15.0, 0.1  # 1-sigma before anything was learnt
# A fixed wing in 7 m/s of wind (thor_flight75: 329 s, 20 to 80 m above the ground): velocity less airspeed and wind
# scatters by 1.5 m/s along and 1.9 across, forgotten in 4 s; what is left after that changes by 1.0 in half a minute.
GUST_MPS, GUST_S = 1.5, 5.0
LEAST_GUST_MPS = 0.5
WIND_WALK, SCALE_WALK = 0.2, 5e-4  # m/s and a share, per square root of a second
GUSTS_LEARNT_S = 60.0
LEARN_EVERY_S = 1.0
LEARNS_FROM_MPS = 3.0  # 1-sigma of a velocity that tells of the wind, and of a wind that tells of gusts
TELLS_MPS = 8.0  # ... and of one that the wind tells: after a straight leg it knows little of the way back
HELD = 0.25  # share by which an airspeed may change unseen: autopilots hold it, a tube that ices up does not
DISTRUST_S = 5.0  # a sensor that contradicts what is seen for so long has changed: all is learnt anew


@dataclass(frozen=True)
class AirspeedObservation:
    """The velocity (2,) east and north [m/s] that is told through the air: ``still_mps`` is the speed over ground that
    it would have in calm air, along the heading, ``yaw_rad`` by the autopilot; and the wind. Its covariance: ``common``
    (2, 2) of what was wrong of it when pictures told it last, ``changed`` (2, 2) of what has changed since, ``gust2``
    (each axis) of what is forgotten in GUST_S."""

    still_mps: float
    yaw_rad: float
    wind_mps: np.ndarray
    common: np.ndarray
    changed: np.ndarray
    gust2: float

    def velocity(self, heading_bias_rad: float) -> np.ndarray:
        return self.wind_mps + self.still_mps * _ahead(self.yaw_rad - heading_bias_rad)

    def agrees_with(self, velocity_mps: np.ndarray, cov: np.ndarray, heading_bias_rad: float) -> bool:
        """With a velocity (2,) that is known otherwise, to ``cov`` (2, 2)."""
        off_mps = velocity_mps - self.velocity(heading_bias_rad)
        now = self.common + self.changed + self.gust2 * np.eye(2)
        return float(off_mps @ np.linalg.solve(now + cov, off_mps)) <= GATE[2]

    def cov(self, dt_s: float, unseen_s: float) -> np.ndarray:
        """(2, 2) for one of the frames that come every ``dt_s``, ``unseen_s`` after the last that was seen.

        They are told to a filter that takes noise for white, and the place must come to be as uncertain as it is: a
        gust counts for all frames that it lasts; a wind that is wrong by P for all since then, P t^2 of the way; one
        that walks off by q t comes to q t^3 / 3."""
        gusts = self.gust2 * max(1.0, 2.0 * GUST_S / dt_s) * np.eye(2)
        frames = unseen_s / dt_s
        return gusts + max(1.0, 2.0 * frames) * self.common + max(1.0, frames) * self.changed


class WindEstimator:
    """``seen`` with every velocity that pictures tell; ``tells`` when they do not."""

    def __init__(self) -> None:
        self._gust2 = GUST_MPS**2
        self._forget()

    def _forget(self) -> None:
        self._x = np.zeros(3)  # wind east, north [m/s], logarithm of the speed through the air over what is read
        self._p = np.diag([WIND_SIGMA_MPS, WIND_SIGMA_MPS, SCALE_SIGMA]) ** 2
        self._t_s: float | None = None  # of x and P
        self._read_mps = 0.0  # then
        self._refused_s: float | None = None  # since when what is read has contradicted what is seen

    def seen(
        self, t_s: float, velocity_mps: np.ndarray, cov: np.ndarray, read_mps: float | None, yaw_rad: float
    ) -> None:
        """``velocity_mps`` (3,) in the world with ``cov`` (3, 3); ``read_mps`` by the sensor; ``yaw_rad``: the true
        heading."""
        level = _level(read_mps, velocity_mps[2])
        since_s = None if self._t_s is None else t_s - self._t_s
        if read_mps is None or level is None or np.trace(cov[:2, :2]) > 2.0 * LEARNS_FROM_MPS**2:
            return
        if since_s is not None and since_s < LEARN_EVERY_S:
            return
        dt_s = LEARN_EVERY_S if since_s is None else since_s
        self._t_s, self._p = t_s, self._later(t_s)
        still, h = self._by_state(level, yaw_rad)
        off = velocity_mps[:2] - self._x[:2] - still
        known, seen = h @ self._p @ h.T, cov[:2, :2] + self._gust2 * np.eye(2)
        if float(off @ np.linalg.solve(known + seen, off)) > GATE[2]:
            self._refused_s = t_s if self._refused_s is None else self._refused_s
            if t_s - self._refused_s > DISTRUST_S:
                self._forget()
            return
        self._refused_s, self._read_mps = None, read_mps
        if np.trace(known + cov[:2, :2]) < 2.0 * LEARNS_FROM_MPS**2:
            # What is wrong of the wind is not taken off: it was learnt from these very gusts.
            now = max(float(off @ off - np.trace(cov[:2, :2])) / 2.0, 0.0)
            share = -np.expm1(-min(dt_s, GUST_S) / GUSTS_LEARNT_S)
            self._gust2 = max(self._gust2 + share * (now - self._gust2), LEAST_GUST_MPS**2)
        s = known + max(1.0, 2.0 * GUST_S / dt_s) * seen  # both are much the same a second later
        gain = np.linalg.solve(s, h @ self._p).T
        self._x = self._x + gain @ off
        self._p = self._p - gain @ h @ self._p

    def tells(
        self, t_s: float, read_mps: float | None, yaw_rad: float | None, up_mps: float
    ) -> AirspeedObservation | None:
        """``yaw_rad`` as the autopilot says it; ``up_mps``: how fast it climbs. None: too little is known."""
        level = _level(read_mps, up_mps)
        if read_mps is None or level is None or yaw_rad is None or self._t_s is None or self._refused_s is not None:
            return None
        if not abs(read_mps - self._read_mps) <= HELD * self._read_mps:
            return None
        _, h = self._by_state(level, yaw_rad)
        common, changed = h @ self._p @ h.T, h @ (self._later(t_s) - self._p) @ h.T
        if np.linalg.eigvalsh(common + changed)[-1] > TELLS_MPS**2:
            return None
        return AirspeedObservation(
            level * float(np.exp(self._x[2])), yaw_rad, self._x[:2].copy(), common, changed, self._gust2
        )

    def doubt(self, t_s: float) -> None:
        """What is told contradicts what is known otherwise: no word more before pictures bear it out."""
        self._refused_s = t_s

    def _later(self, t_s: float) -> np.ndarray:
        """P at ``t_s``."""
        dt_s = 0.0 if self._t_s is None else max(t_s - self._t_s, 0.0)
        return self._p + np.diag([WIND_WALK, WIND_WALK, SCALE_WALK]) ** 2 * dt_s

    def _by_state(self, level_mps: float, yaw_rad: float) -> tuple[np.ndarray, np.ndarray]:
        """-> velocity (2,) through the air, and that of the one over ground by x (2, 3)."""
        still = level_mps * float(np.exp(self._x[2])) * _ahead(yaw_rad)
        return still, np.column_stack([np.eye(2), still])


def air_factor(velocity_key: int, bias_key: int, air: AirspeedObservation, cov: np.ndarray) -> gtsam.CustomFactor:
    """What airspeed and heading say of V, with the heading bias in B. With a tail: tubes ice up and fill with water."""

    def error(_this: Any, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        v, bias = values.atVector(velocity_key), values.atVector(bias_key)
        if jacobians is not None:
            by_v, by_b = np.zeros((2, len(v)), order="F"), np.zeros((2, len(bias)), order="F")
            by_v[:, :2] = np.eye(2)
            east, north = air.still_mps * _ahead(air.yaw_rad - bias[2])
            by_b[:, 2] = north, -east
            jacobians[:] = [by_v, by_b]
        return np.asarray(v[:2] - air.velocity(float(bias[2])))

    return custom_factor(robust(cov), [velocity_key, bias_key], error)


def _level(read_mps: float | None, up_mps: float) -> float | None:
    """Of an airspeed, the part over the ground; None: there is none, or it is too slow to tell."""
    if read_mps is None or read_mps < LEAST_MPS:
        return None
    return float(np.sqrt(max(read_mps**2 - up_mps**2, 0.25 * read_mps**2)))


def _ahead(heading_rad: float) -> np.ndarray:
    return np.array([np.sin(heading_rad), np.cos(heading_rad)])
