"""An autopilot that puts its attitude right: seen by its gyroscopes, and believed only as far as these felt it."""

import math
from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from inertial_flight import InertialFlight, flown
from terrafix.core.geodesy import rot_w_b
from terrafix.core.pose import exp_so3, log_so3
from terrafix.estimator.measurements.ahrs_correction import (
    AIDS_MPS,
    COASTS_S,
    ORDINARY_RADPS,
    UNAIDED_RAD,
    UNAIDED_S,
    AhrsCorrectionMonitor,
)
from terrafix.estimator.measurements.telemetry_buffer import Attitude, Telemetry
from terrafix.estimator.models.motion_model import TILT_S
from terrafix.link.integrity.fix_type import MAX_SPEED_SIGMA_MPS
from terrafix.messages import Imu, VehicleState

S = 1_000_000_000
HZ = 50
SIGMA_RAD = math.radians(0.7)
YAW_SIGMA_RAD = math.radians(3.0)


def angles(t: float) -> tuple[float, float, float]:
    """Yaw, pitch, roll of a plane that rolls into turns."""
    return 1.0 + 0.4 * t, 0.05 * math.sin(t), 0.6 * math.sin(0.8 * t)


def flew(
    seconds: float,
    off: Callable[[float], float],
    imu_from_s: float = 0.0,
    yaw_off: Callable[[float], float] = lambda t: 0.0,
) -> Telemetry:
    """That plane with true gyroscopes, and an attitude that is ``off`` in roll, and in yaw by ``yaw_off`` [rad]."""
    telemetry, step_s = Telemetry(), 1.0 / HZ
    for i in range(round(seconds * HZ) + 1):
        t = i * step_s
        yaw, pitch, roll = angles(t)
        heard = VehicleState(
            t_ns=round(t * S),
            source="test",
            yaw_rad=math.remainder(yaw + yaw_off(t), math.tau),
            pitch_rad=pitch,
            roll_rad=roll + off(t),
        )
        telemetry.add(heard)
        before, after = rot_w_b(*angles(t - step_s)), rot_w_b(*angles(t + step_s))
        rates = log_so3(before.T @ after) / (2 * step_s)
        if t >= imu_from_s:
            sample = (0, 0.0, 0.0, -9.81, *(float(rate) for rate in rates))
            telemetry.add_imu(Imu(t_ns=round(t * S), source="test", samples=[sample]))
    return telemetry


def test_what_gyroscopes_felt_is_no_correction() -> None:
    telemetry = flew(10.0, lambda t: 0.0)
    turned = [telemetry.turned_otherwise(round(t * S), round((t + 0.5) * S)) for t in np.arange(0.0, 9.5, 0.37)]
    assert max(float(np.linalg.norm(way[0])) for way in turned if way is not None) < math.radians(0.05)
    assert all(way is not None for way in turned)


def test_what_they_did_not_is_one() -> None:
    telemetry = flew(6.0, lambda t: math.radians(2.0) * max(0.0, t - 3.0))
    before, after = telemetry.turned_otherwise(S, 3 * S), telemetry.turned_otherwise(3 * S, 4 * S)
    assert before is not None and np.linalg.norm(before[0]) < math.radians(0.05)
    assert after is not None
    way, turned_rad = after
    assert math.degrees(np.linalg.norm(way)) == pytest.approx(2.0, abs=0.1)
    rates = (np.subtract(angles(t + 0.01), angles(t)) / 0.01 for t in np.arange(3.0, 4.0, 0.01))
    assert turned_rad == pytest.approx(np.mean([np.linalg.norm(rate) for rate in rates]), rel=0.05)
    ahead = 1.0 + 0.4 * 3.5  # it rolls about where it heads; what it is off by then turns with it
    assert math.sin(ahead) * way[0] + math.cos(ahead) * way[1] > 0.95 * np.hypot(*way[:2])


def test_who_did_not_hear_all_of_it_does_not_know() -> None:
    telemetry = flew(6.0, lambda t: 0.0, imu_from_s=3.0)
    assert telemetry.turned_otherwise(2 * S, 4 * S) is None
    assert telemetry.turned_otherwise(4 * S, 9 * S) is None
    assert telemetry.turned_otherwise(4 * S, 4 * S) is None
    assert telemetry.turned_otherwise(4 * S, 5 * S) is not None


def looked(telemetry: Telemetry, until_s: float = 7.9) -> tuple[AhrsCorrectionMonitor, list[tuple[float, Attitude]]]:
    """Twice a second: seconds, attitude."""
    righted = AhrsCorrectionMonitor(telemetry)
    times = np.arange(0.0, until_s, 0.5)
    return righted, [(float(t), righted.look(round(t * S), SIGMA_RAD, YAW_SIGMA_RAD)) for t in times]


def farthest_deg(seconds: float, off: Callable[[float], float]) -> list[float]:
    return [math.degrees(attitude.righted_rad) for _, attitude in looked(flew(seconds, off))[1]]


def test_a_correction_counts_when_it_is_more_than_the_claim_and_the_gyroscopes_explain() -> None:
    assert max(farthest_deg(8.0, lambda t: 0.9 * ORDINARY_RADPS * t)) == 0.0
    assert max(farthest_deg(8.0, lambda t: 0.9 * 2.0 * SIGMA_RAD * math.sin(min(t, 1.5)))) == 0.0
    moved = farthest_deg(8.0, lambda t: math.radians(6.0) * min(max(t - 3.0, 0.0), 1.0))
    assert max(moved[:7]) == 0.0 and moved[8] == pytest.approx(4.3, abs=0.4)  # of 6: it banks meanwhile
    there_and_back = farthest_deg(8.0, lambda t: math.radians(6.0) * math.sin(min(max(t - 3.0, 0.0), math.pi)))
    assert there_and_back[-1] == pytest.approx(max(there_and_back), rel=0.2), "it was wrong a moment ago"


def test_it_is_forgotten() -> None:
    righted, seen = looked(flew(7.9, lambda t: math.radians(6.0) * math.sin(min(max(t - 1.0, 0.0), math.pi))))
    assert seen[-1][1].righted_rad > math.radians(3.0)
    assert righted.look(round((4.6 + TILT_S) * S), SIGMA_RAD, YAW_SIGMA_RAD).righted_rad == 0.0


def away_deg(seen: list[tuple[float, Attitude]]) -> tuple[list[float], list[float]]:
    """By how much tilt and heading are off."""
    tilts, yaws = [], []
    for t, attitude in seen:
        said = rot_w_b(attitude.yaw_rad or 0.0, attitude.pitch_rad or 0.0, attitude.roll_rad or 0.0)
        off = np.degrees(log_so3(said @ rot_w_b(*angles(t)).T))
        tilts.append(float(np.hypot(*off[:2])))
        yaws.append(abs(float(off[2])))
    return tilts, yaws


def test_an_attitude_that_is_put_wrong_stays_as_it_was_felt() -> None:
    """As a plane's filter that swings its attitude by 16 degrees in three seconds, and its heading by 60."""
    swing = flew(
        7.9,
        lambda t: math.radians(8.0) * math.sin(max(t - 3.0, 0.0)),
        yaw_off=lambda t: math.radians(30.0) * math.sin(max(t - 3.0, 0.0)),
    )
    tilts, yaws = away_deg(looked(swing)[1])
    assert max(tilts[:6]) < 0.1 and max(yaws[:6]) < 0.1
    assert max(tilts) < 3.0 and max(yaws) < 9.0  # 8 and 30, as it is said


def test_what_claims_explain_is_believed_as_it_is_said() -> None:
    telemetry = flew(7.9, lambda t: 0.9 * SIGMA_RAD * math.sin(t), yaw_off=lambda t: 0.9 * YAW_SIGMA_RAD * math.sin(t))
    righted, seen = looked(telemetry)
    assert all(attitude == telemetry.at(round(t * S)) for t, attitude in seen)
    once, again = righted.felt(3 * S, 4 * S), telemetry.felt(3 * S, 4 * S)
    assert once is not None and again is not None and np.array_equal(once.accel_w_mps2, again.accel_w_mps2)


def test_a_jump_that_nobody_felt_is_let_in_slowly() -> None:
    """It may have been wrong before: after a few TILT_S it is believed."""
    telemetry = Telemetry()
    righted = AhrsCorrectionMonitor(telemetry)
    tilts, sigmas_deg = [], []
    for i in range(60 * HZ):
        t = i / HZ
        off_rad = 0.0 if t < 3.0 else math.radians(10.0)
        sample = (0, 0.0, 0.0, -9.81, 0.0, 0.0, 0.0)
        telemetry.add(VehicleState(t_ns=round(t * S), source="test", yaw_rad=1.0, pitch_rad=0.0, roll_rad=off_rad))
        telemetry.add_imu(Imu(t_ns=round(t * S), source="test", samples=[sample]))
        if i % (HZ // 2) == 0:
            attitude = righted.look(round(t * S), SIGMA_RAD, YAW_SIGMA_RAD)
            tilts.append(math.degrees(attitude.roll_rad or 0.0))
            sigmas_deg.append(math.degrees(attitude.righted_rad))
    assert tilts[7] < 1.0 and sigmas_deg[7] > 8.0
    assert tilts[round(2 * (3.0 + TILT_S))] == pytest.approx(10.0 * (1.0 - math.exp(-1.0)), abs=0.5)
    assert tilts[-1] == pytest.approx(10.0, abs=0.1) and sigmas_deg[-1] == 0.0


def test_gyroscopes_that_are_not_level_with_the_vehicle_put_nothing_right() -> None:
    """A board that is screwed on at 1.5 degrees, and an attitude that has it taken out; the plane circles."""
    board = exp_so3(np.radians([1.2, 0.9, 0.0]))
    telemetry = Telemetry()
    righted = AhrsCorrectionMonitor(telemetry)
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
            assert righted.look(round(t * S), SIGMA_RAD, YAW_SIGMA_RAD) == telemetry.at(round(t * S))


def test_what_was_felt_is_turned_by_the_same_attitude() -> None:
    """The specific force of a plane in flight, by an attitude that is 8 degrees off: gravity would go astray."""

    def put_wrong(by_deg: float) -> Callable[[float], float]:
        return lambda t: math.radians(by_deg) * min(max(t - 3.0, 0.0), 1.0)

    true, swung = flew(8.0, lambda t: 0.0), flew(8.0, put_wrong(8.0), yaw_off=put_wrong(30.0))
    righted, _ = looked(swung)
    felt, as_felt, as_said = righted.felt(5 * S, 6 * S), true.felt(5 * S, 6 * S), swung.felt(5 * S, 6 * S)
    assert felt is not None and as_felt is not None and as_said is not None
    off_mps2 = [float(np.abs(f.accel_w_mps2 - as_felt.accel_w_mps2).max()) for f in (felt, as_said)]
    assert off_mps2[0] < 0.4 * off_mps2[1] and off_mps2[1] > 1.0
    off_rad = [np.angle(np.exp(1j * (f.yaw_rad - as_felt.yaw_rad))) for f in (felt, as_said)]
    off_deg = [float(np.degrees(np.abs(off)).max()) for off in off_rad]
    assert off_deg[0] < 8.0 and off_deg[1] == pytest.approx(30.0, abs=0.1)


def test_after_a_gap_nobody_knows_what_it_was_turned_by() -> None:
    telemetry = flew(7.9, lambda t: math.radians(8.0) * min(max(t - 1.0, 0.0), 1.0))
    righted, _ = looked(telemetry, 4.0)
    assert righted.look(4 * S, SIGMA_RAD, YAW_SIGMA_RAD).roll_rad != telemetry.at(4 * S).roll_rad
    late = righted.look(9 * S, SIGMA_RAD, YAW_SIGMA_RAD)  # readings ended at 7.9 s
    assert late.roll_rad is None or late.roll_rad == telemetry.at(9 * S).roll_rad
    assert late.righted_rad > math.radians(4.0)  # what it was put right before counts on


def test_who_did_not_hear_the_gyroscopes_believes_what_is_said() -> None:
    telemetry = flew(8.0, lambda t: math.radians(8.0) * min(max(t - 3.0, 0.0), 1.0), imu_from_s=100.0)
    assert all(attitude == telemetry.at(round(t * S)) for t, attitude in looked(telemetry)[1])


def test_an_autopilot_that_was_told_nothing_may_be_off_for_long() -> None:
    righted = AhrsCorrectionMonitor(flew(1.0, lambda t: 0.0))

    def off_rad(t_s: float, sigma_mps: float) -> float:
        attitude = righted.look(round(t_s * S), SIGMA_RAD, YAW_SIGMA_RAD)
        righted.told(round(t_s * S), sigma_mps)
        return attitude.righted_rad

    assert AIDS_MPS == MAX_SPEED_SIGMA_MPS, "of the link, which lets it have no other velocity"
    assert max(off_rad(t, 9.0) for t in range(20)) == 0.0, "it flies by something else, as long as we know nothing"
    assert max(off_rad(t, 0.4) for t in range(20, 30)) == 0.0
    assert off_rad(30.0, 9.0) == off_rad(29.0 + COASTS_S, 9.0) == 0.0, "it coasts"
    assert off_rad(30.0 + COASTS_S, 9.0) == pytest.approx(UNAIDED_RAD)
    assert off_rad(90.0, 0.4) == pytest.approx(UNAIDED_RAD)
    assert min(off_rad(90.0 + t, 0.4) for t in range(round(UNAIDED_S))) < 0.4 * UNAIDED_RAD


def test_who_was_killed_told_it_nothing() -> None:
    back_s = 7.0
    for told_s, off_rad in ((back_s - 5.0, UNAIDED_RAD), (back_s - 1.0, 0.0)):
        righted = AhrsCorrectionMonitor(flew(1.0, lambda t: 0.0), round(told_s * S))
        assert righted.look(round(back_s * S), SIGMA_RAD, YAW_SIGMA_RAD).righted_rad == pytest.approx(off_rad)


def swaying(flight: InertialFlight, sway_deg: float) -> InertialFlight:
    """From 20 s on its attitude rolls to and fro every 8 s, and it does not."""
    for said in flight.said:
        for i, message in enumerate(said):
            since_s = message.t_ns / S - 20.0
            if isinstance(message, VehicleState) and message.roll_rad is not None and since_s > 0.0:
                off_rad = math.radians(sway_deg) * math.sin(math.tau * since_s / 8.0)
                said[i] = msgspec.structs.replace(message, roll_rad=message.roll_rad + off_rad)
    return flight


@pytest.mark.slow
@pytest.mark.parametrize("sway_deg", [5.0, 10.0])
def test_velocity_from_an_attitude_that_sways_claims_no_more_than_it_knows(sway_deg: float) -> None:
    seen = flown(swaying(InertialFlight(1), sway_deg), imu=True)
    error_mps, sigma_mps = np.hypot(*seen.velocity_error_mps[22:, :2].T), seen.velocity_sigma_mps[22:]
    assert np.mean(error_mps > 3.0 * sigma_mps) < 0.05  # 30 to 50 % for who believes the attitude
    assert np.mean(np.square(error_mps / sigma_mps)) < 2.0 * 1.5


@pytest.mark.slow
def test_who_is_not_put_right_is_believed_as_before() -> None:
    seen = flown(InertialFlight(1), imu=True)
    assert float(np.median(seen.velocity_sigma_mps[22:])) < 0.4


@pytest.mark.slow
def test_velocity_claims_no_more_than_it_knows_by_an_attitude_that_was_without_a_position() -> None:
    """As a plane's that was off by 2.7 degrees for 15 s after Terrafix was back."""
    blind, nees = (22, 29), []
    for seed in (4, 5, 6):
        flight = InertialFlight(seed)
        for said in flight.said[blind[1] - 3 :]:
            for i, message in enumerate(said):
                if isinstance(message, VehicleState) and message.roll_rad is not None:
                    said[i] = msgspec.structs.replace(message, roll_rad=message.roll_rad + math.radians(2.7))
        seen = flown(flight, imu=True, blind=blind, no_imu=(22.0, 29.0))
        after = slice(blind[1] + 2, blind[1] + 20)
        error_mps, sigma_mps = np.hypot(*seen.velocity_error_mps[after, :2].T), seen.velocity_sigma_mps[after]
        nees.append(float(np.mean(np.square(error_mps / sigma_mps))))
        assert float(np.median(sigma_mps)) < 0.6
    assert np.mean(nees) < 1.4  # 2.1 by the usual claim
