"""Sensor errors have the configured size and form, and are reproducible."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest

from terrafix_lab.sim.interfaces import Readings
from terrafix_lab.sim.sensors.clock import Clock
from terrafix_lab.sim.sensors.errors import TYPICAL, SensorErrors
from terrafix_lab.sim.sensors.suite import VehicleSensors
from vehicle_missions import PLACE
from vehicle_state import STEP_S, changes, state

KEPT = {"yaw_constant_rad", "yaw_slow_s", "attitude_slow_s"}
PERFECT = replace(TYPICAL, **{f.name: 0.0 for f in fields(SensorErrors) if f.name not in KEPT})


def read(sensors: VehicleSensors, seconds: float, **changes: object) -> list[Readings]:
    return [sensors.read(state(i * STEP_S, **changes)) for i in range(round(seconds / STEP_S))]


def test_without_errors_the_readings_are_the_truth() -> None:
    sensors = VehicleSensors(PLACE, errors=PERFECT)
    turned = state(0.0, roll_rad=0.3, pitch_rad=-0.1, rates_b_radps=np.array([0.1, -0.2, 0.3]), agl_m=40.0)
    reading = sensors.read(turned)
    assert reading.gyro_b_radps == pytest.approx([0.1, -0.2, 0.3])
    assert reading.accel_b_mps2 == pytest.approx([0.0, 0.0, -9.80665])
    assert (reading.yaw_rad, reading.pitch_rad, reading.roll_rad) == pytest.approx((math.pi / 2, -0.1, 0.3))
    assert (reading.baro_amsl_m, reading.airspeed_mps) == pytest.approx((500.0, 20.0))


def test_inertial_noise_is_that_of_the_data_sheet_on_the_ground_and_vibration_in_flight() -> None:
    """White noise of density d, sampled at 50 Hz: d * sqrt(50)."""
    still = read(VehicleSensors(PLACE, seed=1), 60.0, agl_m=0.0)
    gyro = np.array([r.gyro_b_radps for r in still])
    accel = np.array([r.accel_b_mps2 for r in still])
    assert np.diff(gyro, axis=0).std() / math.sqrt(2) == pytest.approx(math.radians(0.0028) * math.sqrt(50), rel=0.05)
    assert np.diff(accel, axis=0).std() / math.sqrt(2) == pytest.approx(70e-6 * 9.81 * math.sqrt(50), rel=0.05)
    flying = np.array([r.accel_b_mps2 for r in read(VehicleSensors(PLACE, seed=1), 60.0)])
    assert np.diff(flying, axis=0).std() / math.sqrt(2) == pytest.approx(TYPICAL.vibration_mps2, rel=0.05)


def test_biases_of_many_vehicles_have_the_configured_sigma() -> None:
    first = [VehicleSensors(PLACE, seed=seed).read(state(0.0, agl_m=0.0)) for seed in range(300)]
    gyro = np.array([r.gyro_b_radps for r in first])
    assert gyro.std() == pytest.approx(TYPICAL.gyro_bias_radps, rel=0.12)
    assert abs(gyro.mean()) < 0.15 * TYPICAL.gyro_bias_radps
    yaw = [math.remainder(r.yaw_rad - math.pi / 2, math.tau) for r in first]
    assert 0.8 < np.std(yaw) / math.hypot(TYPICAL.yaw_sigma_rad, TYPICAL.yaw_by_heading_rad * math.sqrt(0.625)) < 1.25


def test_the_bias_random_walk_grows_with_the_root_of_time() -> None:
    ends = []
    for seed in range(40):
        errors = replace(PERFECT, gyro_walk=1e-3)
        ends.append(read(VehicleSensors(PLACE, seed=seed, errors=errors), 16.0)[-1].gyro_b_radps)
    assert np.std(ends) == pytest.approx(1e-3 * 4.0, rel=0.2)


def test_the_compass_error_has_a_deviation_by_heading_and_a_constant() -> None:
    errors = replace(PERFECT, yaw_constant_rad=math.radians(15.0), yaw_by_heading_rad=math.radians(2.0))
    sensors = VehicleSensors(PLACE, seed=3, errors=errors)
    found = []
    for i, yaw in enumerate(np.linspace(0.0, math.tau, 200, endpoint=False)):
        reading = sensors.read(state(i * STEP_S, yaw_rad=float(yaw)))
        found.append(math.degrees(math.remainder(reading.yaw_rad - yaw, math.tau)))
    assert np.mean(found) == pytest.approx(15.0, abs=0.05)
    assert 1.5 < np.ptp(found) / 2 < 3.2


@pytest.mark.slow
def test_the_attitude_error_is_a_gauss_markov_process() -> None:
    """A first-order process with standard deviation s and time constant T changes by s * sqrt(2 - 2 exp(-t / T))."""
    flights = [VehicleSensors(PLACE, seed=seed) for seed in range(24)]
    read_by_flight = [[sensors.read(state(0.2 * i)) for i in range(1000)] for sensors in flights]
    roll = np.array([[r.roll_rad for r in readings] for readings in read_by_flight])
    yaw = np.array([[r.yaw_rad for r in readings] for readings in read_by_flight])
    for t_s in (1.0, 10.0, 30.0):
        of_roll, of_yaw = (math.sqrt(2.0 - 2.0 * math.exp(-t_s / memory_s)) for memory_s in (10.0, 15.0))
        assert changes(roll, round(t_s / 0.2)) == pytest.approx(0.65 * of_roll, rel=0.15)
        assert changes(yaw, round(t_s / 0.2)) == pytest.approx(1.5 * of_yaw, rel=0.15)


def test_the_barometer_has_a_share_of_the_dynamic_pressure() -> None:
    """The share is specific to the vehicle; the error grows with the square of the airspeed."""
    errors = replace(PERFECT, baro_static=0.15)
    flights = [VehicleSensors(PLACE, seed=seed, errors=errors) for seed in range(60)]
    speeds = (0.0, 10.0, 20.0)
    read_by_flight = np.array([[f.read(state(0.02 * v, airspeed_mps=v)).baro_amsl_m for v in speeds] for f in flights])
    above = read_by_flight[:, 1:] - read_by_flight[:, :1]
    assert np.std(above[:, 1]) == pytest.approx(0.15 * 20.0**2 / 19.6, rel=0.25)
    assert above[:, 0] == pytest.approx(0.25 * above[:, 1])


def test_the_scale_error_of_the_barometer_refers_to_the_start() -> None:
    sensors = VehicleSensors(PLACE, seed=1, errors=replace(PERFECT, baro_scale=0.1))
    sensors.read(state(0.0))
    low = sensors.read(state(0.02)).baro_amsl_m
    high = sensors.read(state(0.04, p_b_in_w_m=np.array([0.0, 0.0, 700.0]))).baro_amsl_m
    assert low == pytest.approx(500.0)
    assert abs(high - 700.0) > 1.0


def test_the_same_seed_gives_the_same_readings() -> None:
    def all_readings(seed: int) -> list[float]:
        return [float(v) for r in read(VehicleSensors(PLACE, seed=seed), 5.0) for v in (*r.gyro_b_radps, r.baro_amsl_m)]

    assert all_readings(4) == all_readings(4)
    assert all_readings(4) != all_readings(5)


def test_the_clock_of_the_autopilot_has_its_own_offset_and_drift() -> None:
    clock = Clock(offset_s=100.0, drift=50e-6)
    assert clock.boot_ns(0.0) == 100_000_000_000
    assert clock.boot_ns(1000.0) - clock.boot_ns(0.0) == 1_000_050_000_000
    assert Clock.of(3) == Clock.of(3) != Clock.of(4)


def test_a_course_without_airspeed_has_a_barometer_error_by_ground_speed() -> None:
    reading = VehicleSensors(PLACE, seed=1).read(state(0.0, airspeed_mps=float("nan")))
    assert abs(reading.baro_amsl_m - 500.0) < 50.0
