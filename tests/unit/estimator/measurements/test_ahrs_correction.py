"""Corrections of the AHRS attitude, detected with the gyroscopes, and used only as far as these measured them."""

import math
from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from inertial_flight import InertialFlight, flown
from terrafix.core.geodesy import rot_w_b
from terrafix.core.pose import exp_so3, log_so3
from terrafix.estimator.measurements.ahrs_correction import (
    COAST_S,
    ORDINARY_RADPS,
    UNAIDED_RAD,
    UNAIDED_S,
    AhrsCorrectionMonitor,
)
from terrafix.estimator.measurements.telemetry_buffer import Attitude, Telemetry
from terrafix.estimator.models.motion_model import TILT_CORRELATION_S
from terrafix.messages import Imu, VehicleState

S = 1_000_000_000
HZ = 50
SIGMA_RAD = math.radians(0.7)
YAW_SIGMA_RAD = math.radians(3.0)


def angles(t: float) -> tuple[float, float, float]:
    """Yaw, pitch, roll [rad] of a plane that rolls into turns."""
    return 1.0 + 0.4 * t, 0.05 * math.sin(t), 0.6 * math.sin(0.8 * t)


def simulate(
    seconds: float,
    off: Callable[[float], float],
    imu_from_s: float = 0.0,
    yaw_off: Callable[[float], float] = lambda t: 0.0,
) -> Telemetry:
    """Telemetry of that plane: true gyroscopes, attitude with the errors ``off`` in roll and ``yaw_off`` [rad]."""
    telemetry, step_s = Telemetry(), 1.0 / HZ
    for i in range(round(seconds * HZ) + 1):
        t = i * step_s
        yaw, pitch, roll = angles(t)
        state = VehicleState(
            t_ns=round(t * S),
            source="test",
            yaw_rad=math.remainder(yaw + yaw_off(t), math.tau),
            pitch_rad=pitch,
            roll_rad=roll + off(t),
        )
        telemetry.add(state)
        before, after = rot_w_b(*angles(t - step_s)), rot_w_b(*angles(t + step_s))
        rates = log_so3(before.T @ after) / (2 * step_s)
        if t >= imu_from_s:
            sample = (0, 0.0, 0.0, -9.81, *(float(rate) for rate in rates))
            telemetry.add_imu(Imu(t_ns=round(t * S), source="test", samples=[sample]))
    return telemetry


def test_a_turn_measured_by_the_gyroscopes_is_no_correction() -> None:
    telemetry = simulate(10.0, lambda t: 0.0)
    turned = [telemetry.turn_without_gyro(round(t * S), round((t + 0.5) * S)) for t in np.arange(0.0, 9.5, 0.37)]
    assert max(float(np.linalg.norm(way[0])) for way in turned if way is not None) < math.radians(0.05)
    assert all(way is not None for way in turned)


def test_a_turn_not_measured_by_the_gyroscopes_is_a_correction() -> None:
    telemetry = simulate(6.0, lambda t: math.radians(2.0) * max(0.0, t - 3.0))
    before, after = telemetry.turn_without_gyro(S, 3 * S), telemetry.turn_without_gyro(3 * S, 4 * S)
    assert before is not None and np.linalg.norm(before[0]) < math.radians(0.05)
    assert after is not None
    way, turned_rad = after
    assert math.degrees(np.linalg.norm(way)) == pytest.approx(2.0, abs=0.1)
    rates = (np.subtract(angles(t + 0.01), angles(t)) / 0.01 for t in np.arange(3.0, 4.0, 0.01))
    assert turned_rad == pytest.approx(np.mean([np.linalg.norm(rate) for rate in rates]), rel=0.05)
    ahead = 1.0 + 0.4 * 3.5  # it rolls about its heading; the error turns with it
    assert math.sin(ahead) * way[0] + math.cos(ahead) * way[1] > 0.95 * np.hypot(*way[:2])


def test_without_complete_gyroscope_data_the_correction_is_unknown() -> None:
    telemetry = simulate(6.0, lambda t: 0.0, imu_from_s=3.0)
    assert telemetry.turn_without_gyro(2 * S, 4 * S) is None
    assert telemetry.turn_without_gyro(4 * S, 9 * S) is None
    assert telemetry.turn_without_gyro(4 * S, 4 * S) is None
    assert telemetry.turn_without_gyro(4 * S, 5 * S) is not None


def corrected(telemetry: Telemetry, until_s: float = 7.9) -> tuple[AhrsCorrectionMonitor, list[tuple[float, Attitude]]]:
    """Attitudes at 2 Hz, with their times [s]."""
    monitor = AhrsCorrectionMonitor(telemetry)
    times = np.arange(0.0, until_s, 0.5)
    return monitor, [(float(t), monitor.attitude_at(round(t * S), SIGMA_RAD, YAW_SIGMA_RAD)) for t in times]


def farthest_deg(seconds: float, off: Callable[[float], float]) -> list[float]:
    return [math.degrees(attitude.righted_rad) for _, attitude in corrected(simulate(seconds, off))[1]]


def test_a_correction_counts_beyond_the_stated_sigma_and_gyroscope_noise() -> None:
    assert max(farthest_deg(8.0, lambda t: 0.9 * ORDINARY_RADPS * t)) == 0.0
    assert max(farthest_deg(8.0, lambda t: 0.9 * 2.0 * SIGMA_RAD * math.sin(min(t, 1.5)))) == 0.0
    moved = farthest_deg(8.0, lambda t: math.radians(6.0) * min(max(t - 3.0, 0.0), 1.0))
    assert max(moved[:7]) == 0.0 and moved[8] == pytest.approx(4.3, abs=0.4)  # of 6: it banks at the same time
    there_and_back = farthest_deg(8.0, lambda t: math.radians(6.0) * math.sin(min(max(t - 3.0, 0.0), math.pi)))
    assert there_and_back[-1] == pytest.approx(max(there_and_back), rel=0.2), "it was wrong a moment ago"


def test_a_correction_is_forgotten_after_the_tilt_correlation_time() -> None:
    monitor, seen = corrected(simulate(7.9, lambda t: math.radians(6.0) * math.sin(min(max(t - 1.0, 0.0), math.pi))))
    assert seen[-1][1].righted_rad > math.radians(3.0)
    assert monitor.attitude_at(round((4.6 + TILT_CORRELATION_S) * S), SIGMA_RAD, YAW_SIGMA_RAD).righted_rad == 0.0


def away_deg(seen: list[tuple[float, Attitude]]) -> tuple[list[float], list[float]]:
    """Errors of tilt and heading."""
    tilts, yaws = [], []
    for t, attitude in seen:
        reported = rot_w_b(attitude.yaw_rad or 0.0, attitude.pitch_rad or 0.0, attitude.roll_rad or 0.0)
        off = np.degrees(log_so3(reported @ rot_w_b(*angles(t)).T))
        tilts.append(float(np.hypot(*off[:2])))
        yaws.append(abs(float(off[2])))
    return tilts, yaws


def test_a_wrong_correction_is_replaced_by_the_gyroscope_attitude() -> None:
    """As of a plane's filter that changes its attitude by 16 degrees in three seconds, and its heading by 60."""
    swing = simulate(
        7.9,
        lambda t: math.radians(8.0) * math.sin(max(t - 3.0, 0.0)),
        yaw_off=lambda t: math.radians(30.0) * math.sin(max(t - 3.0, 0.0)),
    )
    tilts, yaws = away_deg(corrected(swing)[1])
    assert max(tilts[:6]) < 0.1 and max(yaws[:6]) < 0.1
    assert max(tilts) < 3.0 and max(yaws) < 9.0  # 8 and 30 as reported


def test_corrections_within_the_stated_sigma_leave_attitude_and_acceleration_unchanged() -> None:
    telemetry = simulate(
        7.9, lambda t: 0.9 * SIGMA_RAD * math.sin(t), yaw_off=lambda t: 0.9 * YAW_SIGMA_RAD * math.sin(t)
    )
    monitor, seen = corrected(telemetry)
    assert all(attitude == telemetry.at(round(t * S)) for t, attitude in seen)
    once, again = monitor.world_acceleration(3 * S, 4 * S), telemetry.world_acceleration(3 * S, 4 * S)
    assert once is not None and again is not None and np.array_equal(once.accel_w_mps2, again.accel_w_mps2)


def test_an_attitude_jump_without_gyroscope_motion_is_accepted_slowly() -> None:
    """It may have been wrong before: after a few correlation times it is accepted."""
    telemetry = Telemetry()
    monitor = AhrsCorrectionMonitor(telemetry)
    tilts, sigmas_deg = [], []
    for i in range(60 * HZ):
        t = i / HZ
        off_rad = 0.0 if t < 3.0 else math.radians(10.0)
        sample = (0, 0.0, 0.0, -9.81, 0.0, 0.0, 0.0)
        telemetry.add(VehicleState(t_ns=round(t * S), source="test", yaw_rad=1.0, pitch_rad=0.0, roll_rad=off_rad))
        telemetry.add_imu(Imu(t_ns=round(t * S), source="test", samples=[sample]))
        if i % (HZ // 2) == 0:
            attitude = monitor.attitude_at(round(t * S), SIGMA_RAD, YAW_SIGMA_RAD)
            tilts.append(math.degrees(attitude.roll_rad or 0.0))
            sigmas_deg.append(math.degrees(attitude.righted_rad))
    assert tilts[7] < 1.0 and sigmas_deg[7] > 8.0
    assert tilts[round(2 * (3.0 + TILT_CORRELATION_S))] == pytest.approx(10.0 * (1.0 - math.exp(-1.0)), abs=0.5)
    assert tilts[-1] == pytest.approx(10.0, abs=0.1) and sigmas_deg[-1] == 0.0


def test_a_misaligned_imu_causes_no_correction() -> None:
    """An IMU with a misalignment of 1.5 degrees that the attitude is corrected for; the plane circles."""
    board = exp_so3(np.radians([1.2, 0.9, 0.0]))
    telemetry = Telemetry()
    monitor = AhrsCorrectionMonitor(telemetry)
    for i in range(40 * HZ):
        t = i / HZ
        telemetry.add(
            VehicleState(
                t_ns=round(t * S), source="test", yaw_rad=math.remainder(0.3 * t, math.tau), pitch_rad=0.0, roll_rad=0.6
            )
        )
        rates = board @ rot_w_b(0.0, 0.0, 0.6).T @ np.array([0.0, 0.0, -0.3])
        sample = (0, 0.0, 0.0, -9.81, *(float(rate) for rate in rates))
        telemetry.add_imu(Imu(t_ns=round(t * S), source="test", samples=[sample]))
        if i % (HZ // 2) == 0:
            assert monitor.attitude_at(round(t * S), SIGMA_RAD, YAW_SIGMA_RAD) == telemetry.at(round(t * S))


def test_specific_force_is_rotated_with_the_corrected_attitude() -> None:
    """Specific force of a plane, with an attitude error of 8 degrees: gravity would be rotated wrongly."""

    def put_wrong(by_deg: float) -> Callable[[float], float]:
        return lambda t: math.radians(by_deg) * min(max(t - 3.0, 0.0), 1.0)

    true, swung = simulate(8.0, lambda t: 0.0), simulate(8.0, put_wrong(8.0), yaw_off=put_wrong(30.0))
    monitor, _ = corrected(swung)
    used, expected, as_reported = (
        monitor.world_acceleration(5 * S, 6 * S),
        true.world_acceleration(5 * S, 6 * S),
        swung.world_acceleration(5 * S, 6 * S),
    )
    assert used is not None and expected is not None and as_reported is not None
    off_mps2 = [float(np.abs(f.accel_w_mps2 - expected.accel_w_mps2).max()) for f in (used, as_reported)]
    assert off_mps2[0] < 0.4 * off_mps2[1] and off_mps2[1] > 1.0
    off_rad = [np.angle(np.exp(1j * (f.yaw_rad - expected.yaw_rad))) for f in (used, as_reported)]
    off_deg = [float(np.degrees(np.abs(off)).max()) for off in off_rad]
    assert off_deg[0] < 8.0 and off_deg[1] == pytest.approx(30.0, abs=0.1)


def test_after_an_imu_gap_the_reported_attitude_is_used_with_the_correction_sigma() -> None:
    telemetry = simulate(7.9, lambda t: math.radians(8.0) * min(max(t - 1.0, 0.0), 1.0))
    monitor, _ = corrected(telemetry, 4.0)
    assert monitor.attitude_at(4 * S, SIGMA_RAD, YAW_SIGMA_RAD).roll_rad != telemetry.at(4 * S).roll_rad
    late = monitor.attitude_at(9 * S, SIGMA_RAD, YAW_SIGMA_RAD)  # readings ended at 7.9 s
    assert late.roll_rad is None or late.roll_rad == telemetry.at(9 * S).roll_rad
    assert late.righted_rad > math.radians(4.0)  # earlier corrections still count


def test_without_gyroscopes_the_reported_attitude_is_used() -> None:
    telemetry = simulate(8.0, lambda t: math.radians(8.0) * min(max(t - 3.0, 0.0), 1.0), imu_from_s=100.0)
    assert all(attitude == telemetry.at(round(t * S)) for t, attitude in corrected(telemetry)[1])


def test_an_autopilot_without_position_aiding_has_a_larger_tilt_sigma() -> None:
    monitor = AhrsCorrectionMonitor(Telemetry())

    def off_rad(t_s: float, sigma_mps: float) -> float:
        attitude = monitor.attitude_at(round(t_s * S), SIGMA_RAD, YAW_SIGMA_RAD)
        monitor.position_published(round(t_s * S), sigma_mps)
        return attitude.righted_rad

    assert max(off_rad(t, 9.0) for t in range(20)) == 0.0, (
        "before a first fix of ours, it has another source of position"
    )
    assert max(off_rad(t, 0.4) for t in range(20, 30)) == 0.0
    assert off_rad(30.0, 9.0) == off_rad(29.0 + COAST_S, 9.0) == 0.0, "dead reckoning of the autopilot"
    assert off_rad(30.0 + COAST_S, 9.0) == pytest.approx(UNAIDED_RAD)
    assert off_rad(90.0, 0.4) == pytest.approx(UNAIDED_RAD)
    assert min(off_rad(90.0 + t, 0.4) for t in range(round(UNAIDED_S))) < 0.4 * UNAIDED_RAD


def test_a_restart_counts_as_time_without_position_aiding() -> None:
    back_s = 7.0
    for checkpoint_s, off_rad in ((back_s - 5.0, UNAIDED_RAD), (back_s - 1.0, 0.0)):
        monitor = AhrsCorrectionMonitor(simulate(1.0, lambda t: 0.0), round(checkpoint_s * S))
        assert monitor.attitude_at(round(back_s * S), SIGMA_RAD, YAW_SIGMA_RAD).righted_rad == pytest.approx(off_rad)


def swaying(flight: InertialFlight, sway_deg: float) -> InertialFlight:
    """From 20 s on the reported roll oscillates with a period of 8 s; the true one does not."""
    for messages in flight.messages_by_frame:
        for i, message in enumerate(messages):
            since_s = message.t_ns / S - 20.0
            if isinstance(message, VehicleState) and message.roll_rad is not None and since_s > 0.0:
                off_rad = math.radians(sway_deg) * math.sin(math.tau * since_s / 8.0)
                messages[i] = msgspec.structs.replace(message, roll_rad=message.roll_rad + off_rad)
    return flight


@pytest.mark.slow
@pytest.mark.parametrize("sway_deg", [5.0, 10.0])
def test_velocity_is_consistent_with_a_swaying_attitude(sway_deg: float) -> None:
    seen = flown(swaying(InertialFlight(1), sway_deg), imu=True)
    error_mps, sigma_mps = np.hypot(*seen.velocity_error_mps[22:, :2].T), seen.velocity_sigma_mps[22:]
    assert np.mean(error_mps > 3.0 * sigma_mps) < 0.05  # 30 to 50 % with the uncorrected attitude
    assert np.mean(np.square(error_mps / sigma_mps)) < 2.0 * 1.5


@pytest.mark.slow
def test_without_corrections_the_velocity_sigma_is_unchanged() -> None:
    seen = flown(InertialFlight(1), imu=True)
    assert float(np.median(seen.velocity_sigma_mps[22:])) < 0.4


@pytest.mark.slow
def test_velocity_is_consistent_after_time_without_position_aiding() -> None:
    """As of a plane with a tilt error of 2.7 degrees for 15 s after Terrafix was back."""
    blind, nees = (22, 29), []
    for seed in (4, 5, 6):
        flight = InertialFlight(seed)
        for messages in flight.messages_by_frame[blind[1] - 3 :]:
            for i, message in enumerate(messages):
                if isinstance(message, VehicleState) and message.roll_rad is not None:
                    messages[i] = msgspec.structs.replace(message, roll_rad=message.roll_rad + math.radians(2.7))
        seen = flown(flight, imu=True, blind=blind, no_imu=(22.0, 29.0))
        after = slice(blind[1] + 2, blind[1] + 20)
        error_mps, sigma_mps = np.hypot(*seen.velocity_error_mps[after, :2].T), seen.velocity_sigma_mps[after]
        nees.append(float(np.mean(np.square(error_mps / sigma_mps))))
        assert float(np.median(sigma_mps)) < 0.6
    assert np.mean(nees) < 1.4  # 2.1 with the usual sigma
