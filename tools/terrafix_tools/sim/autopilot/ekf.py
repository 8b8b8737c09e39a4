"""The navigation filter of the simulated autopilot, with the gates, holds and resets of ArduPilot's EKF3.

Horizontal states: position, velocity and wind (east, north), errors of the level accelerations (forward, right) and
of the compass. GPS corrects position and velocity; in a plane, airspeed and the absence of sideslip correct the
velocity against the air, so that it can dead-reckon. Height comes from the barometer, smoothed by the accelerometer.
Gate, limits, peak hold and resets are the measured ones of the firmware; process noises are set so that a wrong
position is taken over as fast as the firmware did it."""

import math
from collections import deque
from enum import StrEnum

import numpy as np

from terrafix.core.geodesy import LocalFrame, rot_w_b
from terrafix_tools.sim.autopilot.gps import Fix
from terrafix_tools.sim.interfaces import Navigation, Readings

GRAVITY_MPS2 = 9.80665
GATE_SIGMAS = 5.0  # EK3_POS_I_GATE and EK3_VEL_I_GATE 500
GLITCH_RADIUS_M = 25.0  # EK3_GLITCH_RAD: a filter less sure than this takes any position
ACCURACY_M = (0.5, 100.0)  # EK3_POSNE_M_NSE, and the firmware's upper limit
SPEED_ACCURACY_MPS = (0.35, 50.0)
GATE_SPEED_NOISE_MPS = 0.5  # the velocity gate does not look at the reported accuracy
PEAK_HOLD_S = 5.0
RETRY_S = 10.0  # no position passes for so long: the next one is taken by a reset,
RETRY_NO_VELOCITY_S = 7.0  # sooner when nothing else bounds the velocity
FEW_SATELLITES = {5: 1.4}  # factor on the noises; fewer: 2.0, more: 1.0
ACCEL_NOISE = 0.06  # m^2/s^3, velocity variance that a second of prediction adds
WIND_NOISE = 5e-4  # m^2/s^3
BIAS_SIGMA_MPS2, BIAS_NOISE = 0.05, 1e-5  # level acceleration error: a tilt of 0.3 degrees; m^2/s^5
YAW_SIGMA_RAD, YAW_NOISE = math.radians(4.0), 1e-7
WIND_SIGMA_MPS = 6.0
AIRSPEED_SIGMA_MPS = 1.4  # EK3_EAS_M_NSE
SIDESLIP_SIGMA_RAD = 0.05
AIR_PERIOD_S = 0.1  # between two corrections by the air
FLYING_MPS = 8.0  # slower air tells no direction
BARO_TIME_S = 1.5  # how fast height follows the barometer
HISTORY_S = 0.5
E, N, VE, VN, WE, WN, BF, BR, YAW = range(9)


class Fusion(StrEnum):
    FUSED = "fused"
    REJECTED = "rejected"
    RESET = "reset"


class Ekf:
    """``predict`` at every step, ``fuse`` for every fix in use."""

    def __init__(self, frame: LocalFrame, start: Navigation, *, flies_by_air: bool) -> None:
        """``flies_by_air``: a fixed wing, which does not slip; only there wind is estimated."""
        self._frame, self._by_air = frame, flies_by_air
        self._x = np.zeros(9)
        self._x[:2], self._x[VE : VN + 1] = start.p_b_in_w_m[:2], start.velocity_enu_mps[:2]
        sigma_wind = WIND_SIGMA_MPS if flies_by_air else 0.0
        sigmas = [1.0, 1.0, 0.3, 0.3, sigma_wind, sigma_wind, BIAS_SIGMA_MPS2, BIAS_SIGMA_MPS2, YAW_SIGMA_RAD]
        self._cov = np.diag(np.square(sigmas))
        self._up, self._climb = float(start.p_b_in_w_m[2]), float(start.velocity_enu_mps[2])
        self._attitude = (start.yaw_rad, start.pitch_rad, start.roll_rad)
        self._airspeed, self._airspeed_is_new = start.airspeed_mps, False
        self._history: deque[tuple[float, np.ndarray]] = deque()
        self._accuracy_m, self._fix_s = 0.0, -math.inf
        self._air_s = -math.inf
        self.passed_s: float | None = None  # when a position last passed; the start counts as one
        self.rejecting_since_s: float | None = None
        self.position_ratio = self.velocity_ratio = 0.0  # squared innovation over squared gate
        self.velocity_rejected = 0

    # --- out ---

    def navigation(self) -> Navigation:
        yaw, pitch, roll = self._attitude
        return Navigation(
            p_b_in_w_m=np.array([self._x[E], self._x[N], self._up]),
            velocity_enu_mps=np.array([self._x[VE], self._x[VN], self._climb]),
            yaw_rad=math.remainder(yaw + float(self._x[YAW]), math.tau),
            pitch_rad=pitch,
            roll_rad=roll,
            airspeed_mps=self._airspeed,
        )

    def wind_enu_mps(self) -> tuple[float, float]:
        return float(self._x[WE]), float(self._x[WN])

    def horizontal_sigma_m(self) -> float:
        return math.sqrt(float(self._cov[E, E] + self._cov[N, N]))

    def retry_s(self) -> float:
        """How long no position may pass before the filter gives its own up."""
        bounded = self._by_air or self.rejecting_since_s is not None
        return RETRY_S if bounded else RETRY_NO_VELOCITY_S

    # --- in ---

    def predict(self, readings: Readings, dt_s: float, *, use_airspeed: bool) -> None:
        yaw, pitch, roll = self._attitude = (readings.yaw_rad, readings.pitch_rad, readings.roll_rad)
        self.passed_s = readings.t_s if self.passed_s is None else self.passed_s
        x = self._x
        accel = rot_w_b(yaw + x[YAW], pitch, roll) @ readings.accel_b_mps2
        s, c = math.sin(yaw + x[YAW]), math.cos(yaw + x[YAW])
        ae = accel[0] - x[BF] * s - x[BR] * c
        an = accel[1] - x[BF] * c + x[BR] * s
        x[E] += x[VE] * dt_s + 0.5 * ae * dt_s**2
        x[N] += x[VN] * dt_s + 0.5 * an * dt_s**2
        x[VE] += ae * dt_s
        x[VN] += an * dt_s
        f = np.eye(9)
        f[E, VE] = f[N, VN] = dt_s
        f[VE, BF], f[VE, BR], f[VE, YAW] = -s * dt_s, -c * dt_s, an * dt_s
        f[VN, BF], f[VN, BR], f[VN, YAW] = -c * dt_s, s * dt_s, -ae * dt_s
        self._cov = f @ self._cov @ f.T
        wind = WIND_NOISE if self._by_air else 0.0
        noise = (0.0, 0.0, ACCEL_NOISE, ACCEL_NOISE, wind, wind, BIAS_NOISE, BIAS_NOISE, YAW_NOISE)
        self._cov[np.diag_indices(9)] += np.multiply(noise, dt_s)
        self._history.append((readings.t_s, x[:4].copy()))
        while readings.t_s - self._history[0][0] > HISTORY_S:
            self._history.popleft()
        self._fuse_baro(readings, float(accel[2]) - GRAVITY_MPS2, dt_s)
        if readings.airspeed_mps is not None:
            self._airspeed, self._airspeed_is_new = readings.airspeed_mps, True
        if self._by_air and readings.t_s - self._air_s >= AIR_PERIOD_S:
            self._air_s = readings.t_s
            self._fuse_air(self._airspeed if use_airspeed and self._airspeed_is_new else None, yaw)
            self._airspeed_is_new = False

    def fuse(self, fix: Fix, now_s: float, *, position: bool = True, velocity: bool = True) -> Fusion | None:
        """One 3D fix that arrived at ``now_s``; ``position`` and ``velocity``: what the source set takes of it.

        None: its position is not wanted."""
        accuracy_m = self._held_accuracy(fix.horizontal_m, now_s)
        few = FEW_SATELLITES.get(fix.satellites, 1.0 if fix.satellites > 5 else 2.0)
        then = min(self._history, key=lambda h: abs(h[0] - fix.t_s), default=(now_s, self._x[:4].copy()))[1]
        if velocity:
            self._fuse_velocity(fix, then, few)
        if not position:
            return None
        innovation = np.array(self._frame.to_local(fix.lat_deg, fix.lon_deg)) - then[:2]
        variance = (accuracy_m * few) ** 2
        spread = self._cov[E, E] + self._cov[N, N] + 2 * variance
        self.position_ratio = float(innovation @ innovation / (GATE_SIGMAS**2 * spread))
        timed_out = self.passed_s is not None and now_s - self.passed_s >= self.retry_s() - 1e-6
        if self.position_ratio > 1.0 and self.horizontal_sigma_m() <= GLITCH_RADIUS_M and not timed_out:
            self.rejecting_since_s = now_s if self.rejecting_since_s is None else self.rejecting_since_s
            return Fusion.REJECTED
        self.passed_s, self.rejecting_since_s = now_s, None
        if self.position_ratio > 1.0 or timed_out:
            self.reset(self._x[:2] + innovation, math.sqrt(variance))
            if velocity:
                vn, ve, _ = fix.velocity_ned_mps
                self._x[VE], self._x[VN] = ve, vn
            return Fusion.RESET
        self._draw_to(E, self._x[:2] + innovation, variance)
        return Fusion.FUSED

    def reset(self, p_en_m: np.ndarray, sigma_m: float) -> None:
        """Hard: the position is now there, and tells nothing about the other states."""
        self._x[:2] = p_en_m
        self._cov[:2, :] = 0.0
        self._cov[:, :2] = 0.0
        self._cov[E, E] = self._cov[N, N] = sigma_m**2
        self._history.clear()

    def hold_position(self) -> None:
        """Without any aid a copter's filter assumes that it stands still."""
        self._x[VE] = self._x[VN] = 0.0

    def _held_accuracy(self, reported_m: float | None, now_s: float) -> float:
        """Accuracy rises at once and falls with a time constant of 5 s; unknown is taken for the best."""
        fallen_m = self._accuracy_m * max(0.0, 1.0 - (now_s - self._fix_s) / PEAK_HOLD_S)
        self._fix_s = now_s
        self._accuracy_m = max(fallen_m, reported_m or 0.0)
        return min(ACCURACY_M[1], max(ACCURACY_M[0], self._accuracy_m))

    def _fuse_velocity(self, fix: Fix, then: np.ndarray, few: float) -> None:
        vn, ve, _ = fix.velocity_ned_mps
        innovation = np.array([ve, vn]) - then[2:]
        gate = GATE_SIGMAS**2 * (self._cov[VE, VE] + self._cov[VN, VN] + 2 * GATE_SPEED_NOISE_MPS**2)
        self.velocity_ratio = float(innovation @ innovation / gate)
        if self.velocity_ratio > 1.0:
            self.velocity_rejected += 1
            return
        noise = min(SPEED_ACCURACY_MPS[1], max(SPEED_ACCURACY_MPS[0], fix.speed_mps or 0.0)) * few
        self._draw_to(VE, self._x[VE : VN + 1] + innovation, noise**2)

    def _fuse_air(self, airspeed_mps: float | None, yaw_rad: float) -> None:
        """Airspeed, where it is measured; and a wing does not slip: the air comes from ahead."""
        air = self._x[VE : VN + 1] - self._x[WE : WN + 1]
        speed = float(np.hypot(*air))
        if speed < FLYING_MPS:
            return
        if airspeed_mps is not None:
            h = np.zeros(9)
            h[VE : VN + 1], h[WE : WN + 1] = air / speed, -air / speed
            self._update(h, airspeed_mps - speed, AIRSPEED_SIGMA_MPS**2)
        s, c = math.sin(yaw_rad + self._x[YAW]), math.cos(yaw_rad + self._x[YAW])
        h = np.zeros(9)
        h[VE], h[VN], h[WE], h[WN] = c, -s, -c, s
        h[YAW] = -float(air[0] * s + air[1] * c)
        self._update(h, -float(air[0] * c - air[1] * s), (SIDESLIP_SIGMA_RAD * speed) ** 2)

    def _fuse_baro(self, readings: Readings, accel_up_mps2: float, dt_s: float) -> None:
        """Second-order complementary filter, critically damped."""
        error_m = readings.baro_amsl_m - self._up
        self._climb += (accel_up_mps2 + error_m / BARO_TIME_S**2) * dt_s
        self._up += (self._climb + 2.0 * error_m / BARO_TIME_S) * dt_s

    def _draw_to(self, first: int, measured: np.ndarray, variance: float) -> None:
        """East and north of position or velocity, one after the other; each sees what the one before has moved."""
        for axis in range(2):
            h = np.zeros(9)
            h[first + axis] = 1.0
            self._update(h, float(measured[axis] - self._x[first + axis]), variance)

    def _update(self, h: np.ndarray, residual: float, variance: float) -> None:
        ph = self._cov @ h
        gain = ph / (float(h @ ph) + variance)
        self._x += gain * residual
        self._cov -= np.outer(gain, ph)
