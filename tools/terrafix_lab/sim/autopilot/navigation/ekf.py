"""Navigation filter of the simulated autopilot, with the gates, hold times and resets of ArduPilot's EKF3.

Horizontal states: position, velocity and wind (east, north), errors of the level accelerations (forward, right) and of
the compass. GPS corrects position and velocity; in a plane, airspeed and zero sideslip correct the air velocity, so
that it can dead-reckon. Height comes from the barometer, smoothed by the accelerometer. Gate, limits, peak hold and
resets are measured on the firmware; the process noises are tuned so that a wrong position is taken over as fast as on
the firmware.
"""

import math
from collections import deque
from enum import StrEnum

import numpy as np

from terrafix.core.geodesy import LocalFrame, rot_w_b
from terrafix_lab.sim.autopilot.navigation.gps import Fix
from terrafix_lab.sim.interfaces import Navigation, Readings

GRAVITY_MPS2 = 9.80665
GATE_SIGMAS = 5.0  # EK3_POS_I_GATE and EK3_VEL_I_GATE 500
GLITCH_RADIUS_M = 25.0  # EK3_GLITCH_RAD: a filter with a larger 1-sigma accepts any position
ACCURACY_M = (0.5, 100.0)  # EK3_POSNE_M_NSE, and the firmware's upper limit
SPEED_ACCURACY_MPS = (0.35, 50.0)
GATE_SPEED_NOISE_MPS = 0.5  # the velocity gate does not use the reported accuracy
PEAK_HOLD_S = 5.0
POSITION_TIMEOUT_S = 10.0  # position time-out: after it the next position is taken by a reset;
POSITION_TIMEOUT_NO_VELOCITY_S = 7.0  # shorter when nothing else bounds the velocity
SATELLITE_FACTORS = {5: 1.4}  # factor on the noises; fewer satellites: 2.0, more: 1.0
ACCEL_NOISE = 0.06  # m^2/s^3, velocity process noise
WIND_NOISE = 5e-4  # m^2/s^3
BIAS_SIGMA_MPS2, BIAS_NOISE = 0.05, 1e-5  # level acceleration error: a tilt of 0.3 degrees; m^2/s^5
YAW_SIGMA_RAD, YAW_NOISE = math.radians(4.0), 1e-7
WIND_SIGMA_MPS = 6.0
AIRSPEED_SIGMA_MPS = 1.4  # EK3_EAS_M_NSE
SIDESLIP_SIGMA_RAD = 0.05
AIR_PERIOD_S = 0.1  # between two airspeed and sideslip updates
MIN_AIRSPEED_MPS = 8.0  # below this airspeed the direction of the air velocity is undefined
BARO_TIME_S = 1.5  # time constant of the height's convergence to the barometer
BARO_STEP_S = 0.1  # longest step of that filter, which diverges with steps as long as its time constant [spec: 1 / 15]
HISTORY_S = 0.5
E, N, VE, VN, WE, WN, BF, BR, YAW = range(9)


class Fusion(StrEnum):
    FUSED = "fused"
    REJECTED = "rejected"
    RESET = "reset"


class Ekf:
    """``predict`` at every step, ``fuse`` for every fix of the GPS in use."""

    def __init__(self, frame: LocalFrame, start: Navigation, *, fixed_wing: bool) -> None:
        """``fixed_wing``: assumes zero sideslip and estimates wind."""
        self._frame, self._fixed_wing = frame, fixed_wing
        self._x = np.zeros(9)
        self._x[:2], self._x[VE : VN + 1] = start.p_b_in_w_m[:2], start.velocity_enu_mps[:2]
        sigma_wind = WIND_SIGMA_MPS if fixed_wing else 0.0
        sigmas = [1.0, 1.0, 0.3, 0.3, sigma_wind, sigma_wind, BIAS_SIGMA_MPS2, BIAS_SIGMA_MPS2, YAW_SIGMA_RAD]
        self._cov = np.diag(np.square(sigmas))
        self._up, self._climb = float(start.p_b_in_w_m[2]), float(start.velocity_enu_mps[2])
        self._attitude = (start.yaw_rad, start.pitch_rad, start.roll_rad)
        self._airspeed, self._airspeed_is_new = start.airspeed_mps, False
        self._history: deque[tuple[float, np.ndarray]] = deque()
        self._accuracy_m, self._fix_s = 0.0, -math.inf
        self._air_s = -math.inf
        self.last_pass_s: float | None = (
            None  # time of the last position that passed the gate; initialised at the start
        )
        self.rejecting_since_s: float | None = None
        self.position_ratio = self.velocity_ratio = 0.0  # squared innovation over squared gate
        self.velocity_rejected = 0

    # --- output ---

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

    def position_timeout_s(self) -> float:
        """Position time-out: time without an accepted position after which the filter resets."""
        velocity_bounded = self._fixed_wing or self.rejecting_since_s is not None
        return POSITION_TIMEOUT_S if velocity_bounded else POSITION_TIMEOUT_NO_VELOCITY_S

    # --- input ---

    def predict(self, readings: Readings, dt_s: float, *, use_airspeed: bool) -> None:
        yaw, pitch, roll = self._attitude = (readings.yaw_rad, readings.pitch_rad, readings.roll_rad)
        self.last_pass_s = readings.t_s if self.last_pass_s is None else self.last_pass_s
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
        wind = WIND_NOISE if self._fixed_wing else 0.0
        noise = (0.0, 0.0, ACCEL_NOISE, ACCEL_NOISE, wind, wind, BIAS_NOISE, BIAS_NOISE, YAW_NOISE)
        self._cov[np.diag_indices(9)] += np.multiply(noise, dt_s)
        self._history.append((readings.t_s, x[:4].copy()))
        while readings.t_s - self._history[0][0] > HISTORY_S:
            self._history.popleft()
        self._fuse_baro(readings, float(accel[2]) - GRAVITY_MPS2, dt_s)
        if readings.airspeed_mps is not None:
            self._airspeed, self._airspeed_is_new = readings.airspeed_mps, True
        if self._fixed_wing and readings.t_s - self._air_s >= AIR_PERIOD_S:
            self._air_s = readings.t_s
            self._fuse_air(self._airspeed if use_airspeed and self._airspeed_is_new else None, yaw)
            self._airspeed_is_new = False

    def fuse(self, fix: Fix, now_s: float, *, position: bool = True, velocity: bool = True) -> Fusion | None:
        """Fuses one 3D fix that arrived at ``now_s``; ``position`` and ``velocity``: use by the source set.

        Returns None when the position is not used.
        """
        accuracy_m = self._peak_held_accuracy(fix.horizontal_m, now_s)
        satellite_factor = SATELLITE_FACTORS.get(fix.satellites, 1.0 if fix.satellites > 5 else 2.0)
        past_state = min(self._history, key=lambda h: abs(h[0] - fix.t_s), default=(now_s, self._x[:4].copy()))[1]
        if velocity:
            self._fuse_velocity(fix, past_state, satellite_factor)
        if not position:
            return None
        innovation = np.array(self._frame.to_local(fix.lat_deg, fix.lon_deg)) - past_state[:2]
        variance = (accuracy_m * satellite_factor) ** 2
        innovation_variance = self._cov[E, E] + self._cov[N, N] + 2 * variance
        self.position_ratio = float(innovation @ innovation / (GATE_SIGMAS**2 * innovation_variance))
        timed_out = self.last_pass_s is not None and now_s - self.last_pass_s >= self.position_timeout_s() - 1e-6
        if self.position_ratio > 1.0 and self.horizontal_sigma_m() <= GLITCH_RADIUS_M and not timed_out:
            self.rejecting_since_s = now_s if self.rejecting_since_s is None else self.rejecting_since_s
            return Fusion.REJECTED
        self.last_pass_s, self.rejecting_since_s = now_s, None
        if self.position_ratio > 1.0 or timed_out:
            self.reset(self._x[:2] + innovation, math.sqrt(variance))
            if velocity:
                vn, ve, _ = fix.velocity_ned_mps
                self._x[VE], self._x[VN] = ve, vn
            return Fusion.RESET
        self._fuse_pair(E, self._x[:2] + innovation, variance)
        return Fusion.FUSED

    def reset(self, p_en_m: np.ndarray, sigma_m: float) -> None:
        """Resets the position and its correlations with the other states."""
        self._x[:2] = p_en_m
        self._cov[:2, :] = 0.0
        self._cov[:, :2] = 0.0
        self._cov[E, E] = self._cov[N, N] = sigma_m**2
        self._history.clear()

    def hold_position(self) -> None:
        """Without any aiding a copter's filter assumes zero velocity."""
        self._x[VE] = self._x[VN] = 0.0

    def _peak_held_accuracy(self, reported_m: float | None, now_s: float) -> float:
        """Peak hold: the accuracy rises at once and falls with a time constant of 5 s; unknown counts as the best."""
        decayed_m = self._accuracy_m * max(0.0, 1.0 - (now_s - self._fix_s) / PEAK_HOLD_S)
        self._fix_s = now_s
        self._accuracy_m = max(decayed_m, reported_m or 0.0)
        return min(ACCURACY_M[1], max(ACCURACY_M[0], self._accuracy_m))

    def _fuse_velocity(self, fix: Fix, past_state: np.ndarray, satellite_factor: float) -> None:
        vn, ve, _ = fix.velocity_ned_mps
        innovation = np.array([ve, vn]) - past_state[2:]
        gate = GATE_SIGMAS**2 * (self._cov[VE, VE] + self._cov[VN, VN] + 2 * GATE_SPEED_NOISE_MPS**2)
        self.velocity_ratio = float(innovation @ innovation / gate)
        if self.velocity_ratio > 1.0:
            self.velocity_rejected += 1
            return
        noise = min(SPEED_ACCURACY_MPS[1], max(SPEED_ACCURACY_MPS[0], fix.speed_mps or 0.0)) * satellite_factor
        self._fuse_pair(VE, self._x[VE : VN + 1] + innovation, noise**2)

    def _fuse_air(self, airspeed_mps: float | None, yaw_rad: float) -> None:
        """Fuses airspeed, if measured, and zero sideslip."""
        air = self._x[VE : VN + 1] - self._x[WE : WN + 1]
        speed = float(np.hypot(*air))
        if speed < MIN_AIRSPEED_MPS:
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
        """Second-order complementary filter, critically damped. A long ``dt_s`` (a simulation that waits for the
        processor) is divided into steps."""
        steps = max(1, math.ceil(dt_s / BARO_STEP_S))
        for _ in range(steps):
            error_m = readings.baro_amsl_m - self._up
            self._climb += (accel_up_mps2 + error_m / BARO_TIME_S**2) * (dt_s / steps)
            self._up += (self._climb + 2.0 * error_m / BARO_TIME_S) * (dt_s / steps)

    def _fuse_pair(self, first: int, measured: np.ndarray, variance: float) -> None:
        """Scalar updates of east and north of position or velocity in sequence."""
        for axis in range(2):
            h = np.zeros(9)
            h[first + axis] = 1.0
            self._update(h, float(measured[axis] - self._x[first + axis]), variance)

    def _update(self, h: np.ndarray, residual: float, variance: float) -> None:
        ph = self._cov @ h
        gain = ph / (float(h @ ph) + variance)
        self._x += gain * residual
        self._cov -= np.outer(gain, ph)
