"""Sensor errors of a small autopilot. Values are 1-sigma over many vehicles where a seed draws one of them.

Inertial noise and scale: InvenSense ICM-42688-P data sheet (DS-000347); an ArduCopter's log at 49 Hz shows the same
noise at rest (0.0004 rad/s, 0.008 to 0.011 m/s^2) and, in flight, the vibration below (0.2 to 0.3 m/s^2, 0.03).

Attitude, heading, barometer: as in that copter's flight and a fixed wing's (docs/simulated-flights.md).
"""

import math
from dataclasses import dataclass

GRAVITY_MG = 9.80665e-3  # m/s^2


@dataclass(frozen=True)
class SensorErrors:
    """Any field can be increased, or set to zero for a perfect sensor."""

    gyro_noise: float = math.radians(0.0028)  # rad/s per root hertz
    gyro_bias_radps: float = math.radians(0.1)  # turn-on bias after the calibration on the ground
    gyro_walk: float = math.radians(0.002)  # rad/s per root second
    gyro_scale: float = 0.003
    accel_noise: float = 70e-6 * 9.80665  # m/s^2 per root hertz
    accel_bias_mps2: float = 5.0 * GRAVITY_MG
    accel_walk: float = 0.02 * GRAVITY_MG  # m/s^2 per root second
    accel_scale: float = 0.003
    vibration_mps2: float = 0.25  # only with running motors: in the air
    vibration_radps: float = 0.02
    yaw_constant_rad: float | None = None  # None: drawn with the sigma below
    yaw_sigma_rad: float = math.radians(2.0)
    # Amplitude of the magnetic deviation by iron on board: one period per turn, plus half of it with two periods.
    # ArduPilot accepts a calibration with an error of up to 16 mGauss (AP_Compass.h), of a horizontal field of 200 at
    # middle latitudes: 4.6 degrees, 2.6 (rms) below that.
    yaw_by_heading_rad: float = math.radians(2.6)
    yaw_slow_rad: float = math.radians(1.5)  # of the attitude filter, Gauss-Markov
    yaw_slow_s: float = 15.0
    attitude_level_rad: float = math.radians(0.3)  # misalignment of the board in the frame
    attitude_slow_rad: float = math.radians(0.65)  # of the attitude filter, Gauss-Markov
    attitude_slow_s: float = 10.0
    baro_bias_m: float = 1.5
    baro_walk: float = 0.04  # m per root second: weather, temperature
    baro_scale: float = 0.005  # of the height above take-off: non-standard atmosphere
    baro_static: float = 0.15  # share of the dynamic pressure in the static pressure
    baro_noise_m: float = 0.12
    airspeed_scale: float = 0.02
    airspeed_noise_mps: float = 0.25


TYPICAL = SensorErrors()
