"""The sensor suite of a vehicle, with the attitude and height of its autopilot, and seeded errors.

Errors are drawn once (biases, scales) or are random walks; reading the same flight again gives the same values.
"""

import math
from collections.abc import Sequence

import numpy as np

from terrafix.core.geodesy import LocalFrame
from terrafix_lab.sim.camera.mount import FIXED, CameraMount
from terrafix_lab.sim.interfaces import Readings, State
from terrafix_lab.sim.sensors.errors import TYPICAL, SensorErrors
from terrafix_lab.sim.sensors.gnss import Gnss
from terrafix_lab.sim.sensors.gnss_events import AnyEvent
from terrafix_lab.sim.vehicle.motion import GRAVITY_MPS2

BLOCK = 512  # number of samples for which random numbers are drawn at once
AIRBORNE_M = 0.5  # height above which the motors run
GYRO, ACCEL, GYRO_WALK, ACCEL_WALK, ATTITUDE, YAW, BARO, BARO_WALK, AIR = (
    slice(0, 3),
    slice(3, 6),
    slice(6, 9),
    slice(9, 12),
    slice(12, 14),
    14,
    15,
    16,
    17,
)
DRAWS = 19  # of a step; another number gives other flights of a seed


class VehicleSensors:
    """Call ``read`` once for every state, in order of time. ``airspeed``: whether the vehicle measures it."""

    def __init__(
        self,
        frame: LocalFrame,
        *,
        seed: int = 0,
        errors: SensorErrors = TYPICAL,
        events: Sequence[AnyEvent] = (),
        airspeed: bool = True,
        mount: CameraMount = FIXED,
    ) -> None:
        rng = np.random.default_rng([seed, 31])
        self._noise = np.random.default_rng([seed, 32])
        self._errors, self._has_airspeed, self._mount = errors, airspeed, mount
        self._gnss = Gnss(frame, seed=seed, events=events)
        self._gyro_bias = rng.normal(0.0, 1.0, 3) * errors.gyro_bias_radps
        self._accel_bias = rng.normal(0.0, 1.0, 3) * errors.accel_bias_mps2
        self._gyro_scale = 1.0 + rng.normal(0.0, 1.0, 3) * errors.gyro_scale
        self._accel_scale = 1.0 + rng.normal(0.0, 1.0, 3) * errors.accel_scale
        self._level = (rng.normal(0.0, 1.0, 2) * errors.attitude_level_rad).tolist()
        drawn = float(rng.normal(0.0, 1.0)) * errors.yaw_sigma_rad
        self._yaw_bias_rad = drawn if errors.yaw_constant_rad is None else errors.yaw_constant_rad
        self._magnetic_phases = rng.uniform(0.0, 2.0 * math.pi, 2).tolist()
        self._baro_bias_m = float(rng.normal(0.0, 1.0)) * errors.baro_bias_m
        self._baro_scale = 1.0 + float(rng.normal(0.0, 1.0)) * errors.baro_scale
        self._air_scale = 1.0 + float(rng.normal(0.0, 1.0)) * errors.airspeed_scale
        self._attitude_drift = (rng.normal(0.0, 1.0, 2) * errors.attitude_slow_rad).tolist()
        self._yaw_drift = float(rng.normal(0.0, 1.0)) * errors.yaw_slow_rad
        self._baro_static = float(rng.normal(0.0, 1.0)) * errors.baro_static
        self._last_s: float | None = None
        self._start_m = 0.0
        self._draws, self._at = np.empty((0, DRAWS)), 0

    def read(self, state: State) -> Readings:
        e = self._errors
        if self._last_s is None:
            self._last_s, self._start_m = state.t_s - 0.02, float(state.p_b_in_w_m[2])
        dt_s = max(1e-3, state.t_s - self._last_s)
        self._last_s = state.t_s
        draws = self._next_draws()
        root = math.sqrt(dt_s)
        self._gyro_bias = self._gyro_bias + draws[GYRO_WALK] * (e.gyro_walk * root)
        self._accel_bias = self._accel_bias + draws[ACCEL_WALK] * (e.accel_walk * root)
        flying = state.agl_m > AIRBORNE_M
        gyro_sigma = math.hypot(e.gyro_noise / root, e.vibration_radps * flying)
        accel_sigma = math.hypot(e.accel_noise / root, e.vibration_mps2 * flying)
        pitch_error, roll_error = self._attitude_errors(dt_s, draws[ATTITUDE])
        return Readings(
            t_s=state.t_s,
            gyro_b_radps=state.rates_b_radps * self._gyro_scale + self._gyro_bias + draws[GYRO] * gyro_sigma,
            accel_b_mps2=state.force_b_mps2 * self._accel_scale + self._accel_bias + draws[ACCEL] * accel_sigma,
            yaw_rad=math.remainder(state.yaw_rad + self._yaw_error(state.yaw_rad, dt_s, float(draws[YAW])), math.tau),
            pitch_rad=state.pitch_rad + pitch_error,
            roll_rad=state.roll_rad + roll_error,
            baro_amsl_m=self._baro(state, float(draws[BARO]), float(draws[BARO_WALK]) * root),
            airspeed_mps=self._airspeed(state, float(draws[AIR])),
            gnss=self._gnss.read(state),
            gimbal=self._mount.reported(state),
        )

    def _next_draws(self) -> np.ndarray:
        """Next standard normal numbers (DRAWS,)."""
        if self._at >= len(self._draws):
            self._draws, self._at = self._noise.normal(size=(BLOCK, DRAWS)), 0
        self._at += 1
        return self._draws[self._at - 1]

    def _attitude_errors(self, dt_s: float, draws: np.ndarray) -> tuple[float, float]:
        """Returns pitch and roll error, rad."""
        decay = math.exp(-dt_s / self._errors.attitude_slow_s) if self._errors.attitude_slow_s else 0.0
        driving_sigma = self._errors.attitude_slow_rad * math.sqrt(1.0 - decay * decay)
        self._attitude_drift = [
            decay * self._attitude_drift[0] + driving_sigma * float(draws[0]),
            decay * self._attitude_drift[1] + driving_sigma * float(draws[1]),
        ]
        return self._level[0] + self._attitude_drift[0], self._level[1] + self._attitude_drift[1]

    def _yaw_error(self, yaw_rad: float, dt_s: float, draw: float) -> float:
        e = self._errors
        decay = math.exp(-dt_s / e.yaw_slow_s) if e.yaw_slow_s else 0.0
        self._yaw_drift = decay * self._yaw_drift + e.yaw_slow_rad * math.sqrt(1.0 - decay * decay) * draw
        deviation = math.sin(yaw_rad + self._magnetic_phases[0]) + 0.5 * math.sin(
            2.0 * yaw_rad + self._magnetic_phases[1]
        )
        return self._yaw_bias_rad + e.yaw_by_heading_rad * deviation + self._yaw_drift

    def _baro(self, state: State, draw: float, walk: float) -> float:
        self._baro_bias_m += self._errors.baro_walk * walk
        climbed_m = float(state.p_b_in_w_m[2]) - self._start_m
        over_ground_mps = float(np.linalg.norm(state.velocity_enu_mps))  # replaces an unknown airspeed
        wind_mps = over_ground_mps if math.isnan(state.airspeed_mps) else state.airspeed_mps
        dynamic_m = self._baro_static * wind_mps**2 / (2.0 * GRAVITY_MPS2)
        error_m = self._baro_bias_m + dynamic_m + self._errors.baro_noise_m * draw
        return self._start_m + self._baro_scale * climbed_m + error_m

    def _airspeed(self, state: State, draw: float) -> float | None:
        if not self._has_airspeed:
            return None
        return max(0.0, state.airspeed_mps * self._air_scale + self._errors.airspeed_noise_mps * draw)
