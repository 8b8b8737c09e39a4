"""The position filter of the autopilot peer: inertial prediction, GPS with the gate and the reset of ArduPilot's EKF3.

Two states a horizontal axis. The gate, the accuracy limits, the peak hold and the 10 s reset are the measured ones;
the noises are set so that steps are taken over about as fast as the firmware did it (tests compare with its table)."""

import math
import random
from collections import deque
from enum import StrEnum

from terrafix.link.carry import distance_m, offset
from terrafix_tools.sim.peer_gps import Fix

GATE_SIGMAS = 5.0  # EK3_POS_I_GATE and EK3_VEL_I_GATE 500
RESET_AFTER_S = 10.0
GLITCH_RADIUS_M = 25.0  # EK3_GLITCH_RAD: a filter less sure than this takes any position
ACCURACY_M = (0.5, 100.0)  # limits of the position noise
SPEED_ACCURACY_MPS = (0.3, 50.0)
GATE_SPEED_NOISE_MPS = 0.5  # EK3_VELNE_M_NSE: the velocity gate does not look at the reported accuracy
PEAK_HOLD_S = 5.0
ACCEL_NOISE_MPS2 = 0.35  # white, per second of prediction
ACCEL_BIAS_MPS2 = 0.02  # 1-sigma of the accelerometers' error that stays
HISTORY_S = 0.4


class Fusion(StrEnum):
    FUSED = "fused"
    REJECTED = "rejected"
    RESET = "reset"


class PositionFilter:
    """North and east in metres around where it started; one covariance, as both axes have the same noises."""

    def __init__(self, lat_deg: float, lon_deg: float, velocity_ne: tuple[float, float], seed: int) -> None:
        rng = random.Random(seed)
        self._origin = (lat_deg, lon_deg)
        self._p = [0.0, 0.0]
        self._v = list(velocity_ne)
        self._bias = [rng.gauss(0.0, ACCEL_BIAS_MPS2) for _ in range(2)]
        self._rng = rng
        self._ppp, self._ppv, self._pvv = 1.0, 0.0, 0.09
        self._accuracy_m = 0.0
        self._fix_s: float | None = None
        self._passed_s: float | None = None
        self._history: deque[tuple[float, float, float]] = deque()
        self.velocity_rejected = 0

    def predict(self, t_s: float, dt_s: float, dv_ne_mps: tuple[float, float]) -> None:
        """``dv_ne_mps``: true change of velocity over ``dt_s``; the accelerometers add their errors."""
        for i in range(2):
            dv = dv_ne_mps[i] + self._bias[i] * dt_s + self._rng.gauss(0.0, 0.02) * math.sqrt(dt_s)
            self._p[i] += self._v[i] * dt_s + 0.5 * dv * dt_s
            self._v[i] += dv
        self._ppp += 2 * self._ppv * dt_s + self._pvv * dt_s**2
        self._ppv += self._pvv * dt_s
        self._pvv += ACCEL_NOISE_MPS2**2 * dt_s
        self._history.append((t_s, self._p[0], self._p[1]))
        while t_s - self._history[0][0] > HISTORY_S:
            self._history.popleft()

    def fuse(self, fix: Fix, now_s: float) -> Fusion:
        """One 3D fix that arrived at ``now_s`` and was measured at ``fix.t_s``."""
        accuracy_m = self._held_accuracy(fix.horizontal_m, now_s)
        self._fuse_velocity(fix)
        measured = self._metres(fix.lat_deg, fix.lon_deg)
        then = min(self._history, key=lambda h: abs(h[0] - fix.t_s), default=(now_s, *self._p))
        innovation = [measured[i] - then[1 + i] for i in range(2)]
        variance = accuracy_m**2
        ratio = sum(d * d for d in innovation) / (GATE_SIGMAS**2 * 2 * (self._ppp + variance))
        self._passed_s = now_s if self._passed_s is None else self._passed_s
        if ratio > 1.0 and math.sqrt(2 * self._ppp) <= GLITCH_RADIUS_M and now_s - self._passed_s <= RESET_AFTER_S:
            return Fusion.REJECTED
        if ratio > 1.0:
            self._p = [self._p[i] + innovation[i] for i in range(2)]
            self._v = [fix.velocity_ned_mps[0], fix.velocity_ned_mps[1]]
            self._ppp, self._ppv, self._passed_s = variance, 0.0, now_s
            self._history.clear()
            return Fusion.RESET
        gain_p, gain_v = self._ppp / (self._ppp + variance), self._ppv / (self._ppp + variance)
        for i in range(2):
            self._p[i] += gain_p * innovation[i]
            self._v[i] += gain_v * innovation[i]
        self._pvv -= gain_v * self._ppv
        self._ppv *= 1.0 - gain_p
        self._ppp *= 1.0 - gain_p
        self._passed_s = now_s
        return Fusion.FUSED

    def position(self) -> tuple[float, float]:
        """-> (lat_deg, lon_deg)"""
        return offset(*self._origin, self._p[1], self._p[0])

    def velocity(self) -> tuple[float, float]:
        return self._v[0], self._v[1]

    def error_m(self, lat_deg: float, lon_deg: float) -> float:
        return distance_m(*self.position(), lat_deg, lon_deg)

    def _held_accuracy(self, reported_m: float | None, now_s: float) -> float:
        """Accuracy rises at once and falls with a time constant of 5 s; unknown is taken for the best."""
        dt_s = 0.0 if self._fix_s is None else now_s - self._fix_s
        self._fix_s = now_s
        fallen_m = self._accuracy_m * max(0.0, 1.0 - dt_s / PEAK_HOLD_S)
        self._accuracy_m = max(fallen_m, reported_m or 0.0)
        return min(ACCURACY_M[1], max(ACCURACY_M[0], self._accuracy_m))

    def _fuse_velocity(self, fix: Fix) -> None:
        innovation = [fix.velocity_ned_mps[i] - self._v[i] for i in range(2)]
        gate = GATE_SIGMAS**2 * 2 * (self._pvv + GATE_SPEED_NOISE_MPS**2)
        if sum(d * d for d in innovation) > gate:
            self.velocity_rejected += 1
            return
        noise = min(SPEED_ACCURACY_MPS[1], max(SPEED_ACCURACY_MPS[0], fix.speed_mps or 0.0)) ** 2
        gain_v, gain_p = self._pvv / (self._pvv + noise), self._ppv / (self._pvv + noise)
        for i in range(2):
            self._v[i] += gain_v * innovation[i]
            self._p[i] += gain_p * innovation[i]
        self._ppp -= gain_p * self._ppv
        self._ppv *= 1.0 - gain_v
        self._pvv *= 1.0 - gain_v

    def _metres(self, lat_deg: float, lon_deg: float) -> tuple[float, float]:
        """-> (north, east) of a point, around where it started."""
        lat0, lon0 = self._origin
        north = math.copysign(distance_m(lat0, lon0, lat_deg, lon0), lat_deg - lat0)
        turn = math.remainder(lon_deg - lon0, 360.0)
        return north, math.copysign(distance_m(lat_deg, lon0, lat_deg, lon_deg), turn)
