"""Monitors of the flight's description: alarms on wrong ones, silence on right ones, and the claim that follows."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from simulated_flight import ORIGIN, Flight, Listener, sigma_m, t_ns
from terrafix.core.camera import Mount
from terrafix.core.geodesy import rot_w_b
from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.estimator.monitors.calibration_monitors import UNKNOWN_M, Monitors
from terrafix.estimator.monitors.cusum import LARGEST_STEP, MARGIN, Cusum, threshold
from terrafix.estimator.monitors.inertial import LEAST_CHANGE_MPS, MOUNT_YAWS_DEG, WINDOW_S, InertialMonitor
from terrafix.estimator.monitors.map_offsets import OffsetMonitor, told_over_seen
from terrafix.estimator.monitors.registration import NEW_GROUND, PRIOR, REACH, Registration
from terrafix.estimator.monitors.sighting import sighting
from terrafix.estimator.monitors.turns import TurnMonitor
from terrafix.messages import CalibrationFault, MapMatch, Message, Odometry, VehicleState, Verdict

HEIGHT_M = 100.0


def test_a_threshold_is_the_logarithm_of_the_steps_between_two_false_alarms() -> None:
    assert threshold(100.0, hours=10.0) == pytest.approx(math.log(1000.0))
    assert threshold(100.0, 5, hours=10.0) == pytest.approx(math.log(5000.0))


def test_noise_alone_raises_no_alarm_as_often_as_is_stated() -> None:
    rng, hours = np.random.default_rng(5), 20.0
    steps = rng.normal(0.0, 1.0, 200_000)
    test, alarms = Cusum(threshold(50.0, hours=hours)), 0  # one in 1000 steps at most
    for x in steps:
        test.add(x - 0.5)  # of N(1, 1) over N(0, 1)
        if test.active:
            alarms, test = alarms + 1, Cusum(test.limit)
    assert 0 < alarms <= len(steps) / (50.0 * hours)


def test_an_alarm_begins_at_the_limit_and_ends_at_zero() -> None:
    test = Cusum(5.0)
    test.add(100.0)
    assert test.sum == LARGEST_STEP and not test.active
    test.add(2.0)
    assert test.active
    for _ in range(9):
        test.add(3.0)
    assert test.sum == 5.0 + MARGIN
    test.add(-3.0)
    test.add(-3.0)
    assert test.active
    test.add(-3.0)
    assert test.sum == 0.0 and not test.active


def _flown(
    moved: tuple[float, float], turned_rad: float, mount_yaw_deg: float = 0.0
) -> tuple[np.ndarray, Attitude, Attitude]:
    """Rays of ground points from two cameras, east and north in heights, with the attitudes that are told."""
    points = np.random.default_rng(2).uniform(-0.4, 0.4, (30, 2))
    r_b_c = Mount(yaw_deg=mount_yaw_deg).r_b_c()
    yaws = (0.3, 0.3 + turned_rad)
    seen = []
    for yaw, at in zip(yaws, (np.zeros(2), np.array(moved)), strict=True):
        rays = np.column_stack([points - at, -np.ones(len(points))]) @ (rot_w_b(yaw, 0.05, -0.04) @ r_b_c)
        seen.append(rays[:, :2] / rays[:, 2:])
    told = [Attitude(yaw, 0.05, -0.04, HEIGHT_M) for yaw in yaws]
    return np.hstack(seen), told[0], told[1]


def test_a_sighting_is_the_way_in_heights_and_a_turn_that_is_as_told() -> None:
    pairs, before, now = _flown((0.1, -0.2), 0.5)
    seen = sighting(pairs, before, now, Mount().r_b_c())
    assert seen is not None
    assert seen.moved == pytest.approx([0.1, -0.2], abs=1e-9)
    assert seen.said_rad == pytest.approx(0.5) and seen.turned_rad == pytest.approx(0.5, abs=0.01)


def test_a_mirrored_picture_turns_the_other_way() -> None:
    pairs, before, now = _flown((0.0, 0.0), 0.2)
    seen = sighting(pairs * (-1.0, 1.0, -1.0, 1.0), before, now, Mount().r_b_c())
    assert seen is not None
    assert seen.turned_rad == pytest.approx(-0.2, abs=0.02)


def test_a_camera_that_is_mounted_backwards_turns_as_the_attitude_does() -> None:
    pairs, before, now = _flown((0.0, 0.0), 0.2, mount_yaw_deg=180.0)
    seen = sighting(pairs, before, now, Mount().r_b_c())
    assert seen is not None and seen.turned_rad == pytest.approx(0.2, abs=0.02)


def test_without_a_heading_or_with_few_rays_there_is_no_sighting() -> None:
    pairs, before, now = _flown((0.1, 0.0), 0.0)
    assert sighting(pairs, replace(before, yaw_rad=None), now, Mount().r_b_c()) is None
    assert sighting(pairs[:7], before, now, Mount().r_b_c()) is None
    assert sighting(pairs, replace(before, roll_rad=2.5), now, Mount().r_b_c()) is None  # the horizon and above


def _manoeuvres(gain: float, *, mount: int = 0, windows: int = 60) -> InertialMonitor:
    """Changes of 8 m/s in all directions, as pictures of a wrong description show them, to 1 m/s."""
    rng, monitor = np.random.default_rng(8), InertialMonitor()
    turned = np.exp(1j * np.radians(MOUNT_YAWS_DEG[mount] - np.array(MOUNT_YAWS_DEG)))
    for i in range(windows):
        began_s = i * (WINDOW_S + 1.0)
        monitor.add(began_s, 5.0 * turned)
        assert monitor.window(began_s + WINDOW_S - 0.1) is None
        assert monitor.window(began_s + WINDOW_S) == began_s
        felt = 8.0 * np.exp(2j * math.pi * rng.uniform())
        noise = complex(*rng.normal(0.0, 1.0, 2))
        monitor.compare(began_s + WINDOW_S, (5.0 + gain * felt + noise) * turned, felt)
    return monitor


@pytest.mark.parametrize("factor", [0.5, 2.0, 3.28, 1 / 3.28])
def test_velocity_changes_name_the_scale(factor: float) -> None:
    fault = _manoeuvres(factor).fault
    assert fault is not None and fault.quantity == "scale" and fault.factor == pytest.approx(factor)


@pytest.mark.parametrize("mount", [1, 2, 3])
def test_velocity_changes_name_a_mount_that_is_turned(mount: int) -> None:
    fault = _manoeuvres(1.0, mount=mount).fault
    assert fault is not None and fault.quantity == "mount yaw" and fault.factor == MOUNT_YAWS_DEG[mount]


def test_velocity_changes_of_a_right_description_raise_no_alarm() -> None:
    assert _manoeuvres(1.0, windows=5000).fault is None
    assert _manoeuvres(1.1, windows=500).fault is None  # a focal length within its usual sigma


def test_flight_without_manoeuvres_tells_nothing() -> None:
    monitor, little = InertialMonitor(), np.full(4, 0.9j * LEAST_CHANGE_MPS)
    for i in range(500):
        monitor.add(i * 5.0, 0.0 * little)
        monitor.window(i * 5.0 + 4.0)
        monitor.compare(i * 5.0 + 4.0, little, -0.9j * LEAST_CHANGE_MPS)
    assert monitor.fault is None


@pytest.mark.parametrize("mirrored", [True, False])
def test_turns_tell_a_mirrored_picture(mirrored: bool) -> None:
    rng, sigma = np.random.default_rng(3), math.radians(2.0)
    monitor = TurnMonitor(sigma)
    for said in rng.normal(0.0, math.radians(6.0), 200):
        monitor.add(said, (-said if mirrored else said) + rng.normal(0.0, sigma))
    assert monitor.mirrored is mirrored


def test_constant_errors_within_three_sigmas_are_allowed_and_larger_ones_are_found_with_their_size() -> None:
    for off, alarm in ((0.29, False), (0.5, True), (-0.5, True)):
        monitor, rng = OffsetMonitor(0.1, 0.05), np.random.default_rng(1)
        for _ in range(300):
            monitor.add(off + rng.normal(0.0, 0.03))
        assert monitor.active is alarm
        assert monitor.mean == pytest.approx(off, abs=0.05)


def test_feet_told_for_metres_are_the_logarithm_of_3_28() -> None:
    assert told_over_seen(328.0, 100.0) == pytest.approx(math.log(3.28))


def _looks(monitor: Registration, count: int, *, found: bool) -> None:
    for _ in range(count):
        monitor.flew(NEW_GROUND * HEIGHT_M, HEIGHT_M)
        monitor.looked(found=found)


def test_looks_that_find_nothing_widen_the_claim_before_they_raise_the_alarm() -> None:
    monitor = Registration()
    monitor.flew(40.0, HEIGHT_M)
    assert monitor.sigma_m == pytest.approx(0.0, abs=1e-3)  # nothing has been looked at
    _looks(monitor, 1, found=False)
    assert monitor.sigma_m == pytest.approx(REACH * 65.0 * math.sqrt(0.2067 - PRIOR), rel=0.02)
    _looks(monitor, 3, found=False)
    assert not monitor.active and monitor.probability > 0.9
    _looks(monitor, 10, found=False)
    assert monitor.active and not monitor.confirmed


def test_looks_at_the_same_ground_count_once() -> None:
    monitor = Registration()
    _looks(monitor, 1, found=False)
    once = monitor.probability
    for _ in range(50):
        monitor.looked(found=False)
    assert monitor.probability == once


def test_what_the_map_has_confirmed_is_no_more_in_question() -> None:
    monitor = Registration()
    _looks(monitor, 1, found=True)
    assert not monitor.confirmed
    _looks(monitor, 1, found=True)
    assert monitor.confirmed and monitor.sigma_m == 0.0
    _looks(monitor, 50, found=False)
    assert monitor.probability == 0.0 and not monitor.active


def test_one_match_does_not_end_the_alarm_and_several_do() -> None:
    monitor = Registration()
    _looks(monitor, 30, found=False)
    _looks(monitor, 1, found=True)
    assert monitor.active
    _looks(monitor, 8, found=True)
    assert not monitor.active and monitor.confirmed and monitor.sigma_m == 0.0


def _fly(edit: object = None, frames: int = 120, **flight: object) -> tuple[Listener, list[CalibrationFault]]:
    listener, flown = Listener(), Flight(frames, **({"fix_every": 3, "dem": True} | flight))  # type: ignore[arg-type]
    listener.hear([ORIGIN])
    for i in range(frames):
        listener.hear([edit(message) if callable(edit) else message for message in flown.messages(i)])
    return listener, [message for message in listener.said if isinstance(message, CalibrationFault)]


def test_a_flight_that_is_described_rightly_has_no_fault() -> None:
    for seed in range(3):
        assert _fly(seed=seed)[1] == []


def test_heights_told_in_feet_are_named_and_the_position_is_withdrawn() -> None:
    def feet(message: Message) -> Message:
        if isinstance(message, VehicleState) and message.agl_m is not None:
            return msgspec.structs.replace(message, agl_m=3.28 * message.agl_m)
        return message

    listener, faults = _fly(feet)
    assert faults and faults[0].quantity == "scale" and faults[0].active
    assert faults[0].factor == pytest.approx(3.28, rel=0.1)
    assert sigma_m(listener.estimate(119)) >= UNKNOWN_M


def test_looks_that_find_nothing_withdraw_the_position() -> None:
    def nothing(message: Message) -> Message:
        if not isinstance(message, MapMatch):
            return message
        return MapMatch(t_ns=message.t_ns, frame_id=message.frame_id, verdict=Verdict.AMBIGUOUS, matcher="gradient")

    listener, faults = _fly(nothing, fix_every=1)
    assert [(fault.quantity, fault.active) for fault in faults] == [("registration", True)]
    assert sigma_m(listener.estimate(119)) >= UNKNOWN_M
    assert sigma_m(listener.estimate(12)) > 50.0  # of 72 m


def _coarsely(message: Message) -> Message:
    """A match without a pose: the belief's mode."""
    if not isinstance(message, MapMatch):
        return message
    return msgspec.structs.replace(message, coarse=True, inliers=0)


def test_coarse_matches_that_enter_the_graph_are_no_looks_that_find_nothing() -> None:
    listener, faults = _fly(_coarsely, fix_every=1)
    verdicts = listener.verdicts("map").values()
    assert sum(v.verdict is Verdict.ACCEPTED for v in verdicts) > 100
    assert faults == []
    assert max(sigma_m(listener.estimate(i)) for i in range(120)) < 20.0


def test_coarse_matches_that_the_graph_refuses_find_nothing() -> None:
    def aside(message: Message) -> Message:
        said = _coarsely(message)
        if not isinstance(said, MapMatch) or said.p_c_in_w_m is None:
            return said
        e_m, n_m, up_m = said.p_c_in_w_m
        return msgspec.structs.replace(said, p_c_in_w_m=(e_m + 400.0 * (said.frame_id % 3), n_m - 500.0, up_m))

    listener, faults = _fly(aside, fix_every=1)
    assert not any(v.verdict is Verdict.ACCEPTED for v in listener.verdicts("map").values())
    assert [(fault.quantity, fault.active) for fault in faults] == [("registration", True)]


def test_looks_at_ground_without_texture_say_nothing() -> None:
    def nothing(message: Message) -> Message:
        if isinstance(message, Odometry):
            return msgspec.structs.replace(message, verdict=Verdict.NO_FEATURES, pairs=[])
        if isinstance(message, MapMatch):
            return MapMatch(t_ns=message.t_ns, frame_id=message.frame_id, verdict=Verdict.AMBIGUOUS, matcher="gradient")
        return message

    assert _fly(nothing, fix_every=1)[1] == []


def test_a_compass_that_is_90_degrees_off_is_named_by_poses_on_the_map() -> None:
    from terrafix.estimator.measurements.telemetry_buffer import Telemetry

    monitors, telemetry, flight = Monitors(ORIGIN), Telemetry(), Flight(60, dem=True)
    for i in range(60):
        state, _, *_ = flight.messages(i)
        assert isinstance(state, VehicleState) and state.yaw_rad is not None
        telemetry.add(msgspec.structs.replace(state, yaw_rad=state.yaw_rad + math.pi / 2))
        monitors.matched(flight.fix(i), telemetry, accepted=True)
    faults = monitors.changes(t_ns(60))
    assert [(fault.quantity, fault.active) for fault in faults] == [("heading", True)]
    assert faults[0].factor == pytest.approx(90.0, abs=15.0)
    assert monitors.changes(t_ns(61)) == []


def test_a_finding_is_said_again_when_it_becomes_another_one() -> None:
    from terrafix.estimator.measurements.telemetry_buffer import Telemetry

    monitors, telemetry, flight = Monitors(ORIGIN), Telemetry(), Flight(200, dem=True)
    said = []
    for i in range(200):
        state, _, *_ = flight.messages(i)
        assert isinstance(state, VehicleState) and state.yaw_rad is not None
        telemetry.add(msgspec.structs.replace(state, yaw_rad=state.yaw_rad + (1.5 if i < 100 else 3.0)))
        monitors.matched(flight.fix(i), telemetry, accepted=True)
        said += monitors.changes(t_ns(i))
    assert all(fault.quantity == "heading" and fault.active for fault in said)
    assert 2 <= len(said) <= 5
    assert said[0].factor == pytest.approx(86.0, abs=10.0) and said[-1].factor == pytest.approx(172.0, abs=35.0)
