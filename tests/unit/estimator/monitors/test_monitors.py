"""Calibration monitors: alarms for wrong descriptions, none for correct ones, and the covariance inflation."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import msgspec
import numpy as np
import pytest

from map_matches import with_pose
from simulated_flight import ORIGIN, Alter, EstimatorRun, Flight, sigma_m, t_ns, without_fix
from terrafix.core.agreement import Agreement, Cause
from terrafix.core.camera import Mount
from terrafix.core.geodesy import rot_w_b
from terrafix.estimator.measurements.telemetry_buffer import Attitude, Telemetry
from terrafix.estimator.monitors.calibration_monitors import FAULT_SIGMA_M, Monitors
from terrafix.estimator.monitors.cusum import MARGIN, MAX_STEP, Cusum, threshold
from terrafix.estimator.monitors.image_shape import ASPECT_RATIOS, ShapeMonitor
from terrafix.estimator.monitors.inertial import MIN_CHANGE_MPS, MIN_WINDOW_S, MOUNT_YAWS_DEG, InertialMonitor
from terrafix.estimator.monitors.map_offsets import (
    HEIGHT_CHANGE_NOISE,
    HEIGHT_CHANGE_SIGMA,
    ChangeMonitor,
    OffsetMonitor,
    log_height_ratio,
)
from terrafix.estimator.monitors.registration import ERROR_PER_PATH, REGISTRATION_SPACING_HEIGHTS, Registration
from terrafix.estimator.monitors.turns import TurnMonitor
from terrafix.estimator.monitors.visual_motion import visual_motion
from terrafix.messages import ON_DRAWN, CalibrationFault, MapMatch, Message, Odometry, VehicleState, Verdict

HEIGHT_M = 100.0


def test_a_threshold_is_the_logarithm_of_the_steps_between_two_false_alarms() -> None:
    assert threshold(100.0, hours=10.0) == pytest.approx(math.log(1000.0))
    assert threshold(100.0, 5, hours=10.0) == pytest.approx(math.log(5000.0))


def test_the_false_alarm_rate_of_noise_is_below_the_stated_one() -> None:
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
    assert test.sum == MAX_STEP and not test.active
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
    """Image points of ground points from two cameras, ``moved`` in heights, with the reported attitudes."""
    points = np.random.default_rng(2).uniform(-0.4, 0.4, (30, 2))
    r_b_c = Mount(yaw_deg=mount_yaw_deg).r_b_c()
    yaws = (0.3, 0.3 + turned_rad)
    seen = []
    for yaw, at in zip(yaws, (np.zeros(2), np.array(moved)), strict=True):
        rays = np.column_stack([points - at, -np.ones(len(points))]) @ (rot_w_b(yaw, 0.05, -0.04) @ r_b_c)
        seen.append(rays[:, :2] / rays[:, 2:])
    reported = [Attitude(yaw, 0.05, -0.04, HEIGHT_M) for yaw in yaws]
    return np.hstack(seen), reported[0], reported[1]


def test_visual_motion_has_the_displacement_in_heights_and_the_turn() -> None:
    pairs, before, now = _flown((0.1, -0.2), 0.5)
    seen = visual_motion(pairs, before, now, Mount().r_b_c())
    assert seen is not None
    assert seen.displacement == pytest.approx([0.1, -0.2], abs=1e-9)
    assert seen.reported_rad == pytest.approx(0.5) and seen.turned_rad == pytest.approx(0.5, abs=0.01)


def test_a_mirrored_picture_shows_the_opposite_turn() -> None:
    pairs, before, now = _flown((0.0, 0.0), 0.2)
    seen = visual_motion(pairs * (-1.0, 1.0, -1.0, 1.0), before, now, Mount().r_b_c())
    assert seen is not None
    assert seen.turned_rad == pytest.approx(-0.2, abs=0.02)


def test_the_visual_turn_does_not_depend_on_the_mount() -> None:
    pairs, before, now = _flown((0.0, 0.0), 0.2, mount_yaw_deg=180.0)
    seen = visual_motion(pairs, before, now, Mount().r_b_c())
    assert seen is not None and seen.turned_rad == pytest.approx(0.2, abs=0.02)


@pytest.mark.parametrize("ratio", [*ASPECT_RATIOS, 1.0])
def test_turns_identify_an_image_whose_axes_have_two_scales(ratio: float) -> None:
    """Turns of 15 degrees and 0.3 degrees of noise of the reported tilt."""
    rng, monitor, r_b_c = np.random.default_rng(4), ShapeMonitor(), Mount().r_b_c()
    for _ in range(40):
        pairs, *attitudes = _flown((0.1, -0.2), math.radians(15.0))
        before, now = (
            replace(
                one, roll_rad=one.roll_rad + rng.normal(0.0, 0.005), pitch_rad=one.pitch_rad + rng.normal(0.0, 0.005)
            )
            for one in attitudes
        )
        monitor.add(pairs * (ratio, 1.0, ratio, 1.0), before, now, r_b_c)
    assert monitor.ratio == (None if ratio == 1.0 else ratio)


def test_a_straight_flight_tells_nothing_of_the_two_scales_of_its_images() -> None:
    monitor = ShapeMonitor()
    for _ in range(1000):
        pairs, before, now = _flown((0.1, -0.2), 0.0)
        monitor.add(pairs * (0.75, 1.0, 0.75, 1.0), before, now, Mount().r_b_c())
    assert monitor.ratio is None


def test_a_flight_whose_images_are_squeezed_names_it_and_withdraws_the_position() -> None:
    """A copter at 12 m/s that turns by 115 degrees between 15 and 17 s."""
    run = EstimatorRun().fly(
        Flight(50, seed=3, turn_rad=2.0),
        0,
        50,
        lambda m: _scaled_x(m, 0.75) if isinstance(m, Odometry) else without_fix(m),
    )
    faults = [(m.quantity, m.factor) for m in run.published if isinstance(m, CalibrationFault)]
    assert ("aspect ratio", 0.75) in faults
    assert sigma_m(run.estimate(49)) >= FAULT_SIGMA_M


def test_a_ratio_of_the_axes_that_the_map_shows_is_a_fault_until_it_shows_none() -> None:
    flight, monitors, telemetry, changes = (
        Flight(20, fix_every=1),
        Monitors(ORIGIN),
        Telemetry(),
        list[CalibrationFault](),
    )
    for i in range(3):
        match = msgspec.structs.replace(flight.fix(i), aspect_ratio=0.8 if i == 1 else None)
        monitors.on_map_match(match, telemetry, accepted=True)
        changes += monitors.take_changes(t_ns(i))
        assert (monitors.sigma_m > 0.0) is (i == 1)
    assert [(c.quantity, c.factor, c.active) for c in changes] == [
        ("aspect ratio", 0.8, True),
        ("aspect ratio", 0.8, False),
    ]


@pytest.mark.parametrize(("by_map", "accepted", "ends"), [(1.0, True, True), (1.0, False, False), (None, True, False)])
def test_a_ratio_of_the_axes_by_odometry_ends_where_an_accepted_match_shows_the_described_one(
    by_map: float | None, *, accepted: bool, ends: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight, monitors, telemetry = Flight(2, fix_every=1), Monitors(ORIGIN), Telemetry()
    monkeypatch.setattr(monitors._shape._tests[0.75], "active", True)
    assert [change.quantity for change in monitors.take_changes(t_ns(0))] == ["aspect ratio"]
    match = msgspec.structs.replace(flight.fix(1), aspect_ratio=by_map)
    monitors.on_map_match(match, telemetry, accepted=accepted)
    assert [change.active for change in monitors.take_changes(t_ns(1))] == ([False] if ends else [])


def _scaled_x(odometry: Odometry, factor: float) -> Odometry:
    pairs = [(factor * a, b, factor * c, d) for a, b, c, d in odometry.two_view]
    return msgspec.structs.replace(odometry, two_view=pairs)


def test_without_a_heading_or_with_few_rays_there_is_no_visual_motion() -> None:
    pairs, before, now = _flown((0.1, 0.0), 0.0)
    assert visual_motion(pairs, replace(before, yaw_rad=None), now, Mount().r_b_c()) is None
    assert visual_motion(pairs[:7], before, now, Mount().r_b_c()) is None
    assert visual_motion(pairs, replace(before, roll_rad=2.5), now, Mount().r_b_c()) is None  # the horizon and above


def _manoeuvres(gain: float, *, mount: int = 0, windows: int = 60) -> InertialMonitor:
    """Changes of 8 m/s in all directions, as observed with a wrong description, with 1 m/s of noise."""
    rng, monitor = np.random.default_rng(8), InertialMonitor()
    turned = np.exp(1j * np.radians(MOUNT_YAWS_DEG[mount] - np.array(MOUNT_YAWS_DEG)))
    for i in range(windows):
        start_s = i * (MIN_WINDOW_S + 1.0)
        monitor.add(start_s, 5.0 * turned)
        assert monitor.window_start_s(start_s + MIN_WINDOW_S - 0.1) is None
        assert monitor.window_start_s(start_s + MIN_WINDOW_S) == start_s
        inertial = 8.0 * np.exp(2j * math.pi * rng.uniform())
        noise = complex(*rng.normal(0.0, 1.0, 2))
        monitor.compare(start_s + MIN_WINDOW_S, (5.0 + gain * inertial + noise) * turned, inertial)
    return monitor


@pytest.mark.parametrize("factor", [0.5, 2.0, 3.28, 1 / 3.28])
def test_velocity_changes_identify_a_scale_fault(factor: float) -> None:
    fault = _manoeuvres(factor).fault
    assert fault is not None and fault.quantity == "scale" and fault.factor == pytest.approx(factor)


@pytest.mark.parametrize("mount", [1, 2, 3])
def test_velocity_changes_identify_a_mount_yaw_fault(mount: int) -> None:
    fault = _manoeuvres(1.0, mount=mount).fault
    assert fault is not None and fault.quantity == "mount yaw" and fault.factor == MOUNT_YAWS_DEG[mount]


def test_velocity_changes_of_a_correct_description_raise_no_alarm() -> None:
    assert _manoeuvres(1.0, windows=5000).fault is None
    assert _manoeuvres(1.1, windows=500).fault is None  # a focal length within its usual sigma


def test_small_velocity_changes_raise_no_alarm() -> None:
    monitor, little = InertialMonitor(), np.full(4, 0.9j * MIN_CHANGE_MPS)
    for i in range(500):
        monitor.add(i * 5.0, 0.0 * little)
        monitor.window_start_s(i * 5.0 + 4.0)
        monitor.compare(i * 5.0 + 4.0, little, -0.9j * MIN_CHANGE_MPS)
    assert monitor.fault is None


@pytest.mark.parametrize("mirrored", [True, False])
def test_turns_identify_a_mirrored_picture(mirrored: bool) -> None:
    rng, sigma = np.random.default_rng(3), math.radians(2.0)
    monitor = TurnMonitor(sigma)
    for turn_rad in rng.normal(0.0, math.radians(6.0), 200):
        monitor.add(turn_rad, (-turn_rad if mirrored else turn_rad) + rng.normal(0.0, sigma))
    assert monitor.mirrored is mirrored


def test_constant_errors_beyond_three_sigmas_raise_an_alarm_with_their_size() -> None:
    for off, alarm in ((0.29, False), (0.5, True), (-0.5, True)):
        monitor, rng = OffsetMonitor(0.1, 0.05), np.random.default_rng(1)
        for _ in range(300):
            monitor.add(off + rng.normal(0.0, 0.03))
        assert monitor.active is alarm
        assert monitor.mean == pytest.approx(off, abs=0.05)


@pytest.mark.parametrize("usual", [0.0, 0.2])
def test_a_lens_that_zooms_is_an_alarm_and_a_constant_error_of_height_is_none(usual: float) -> None:
    monitor, rng, alarms = ChangeMonitor(HEIGHT_CHANGE_SIGMA, HEIGHT_CHANGE_NOISE), np.random.default_rng(1), []
    for zoom in [1.0] * 300 + np.linspace(1.0, 1.3, 20).tolist() + [1.0] * 20:
        monitor.add(usual + math.log(zoom) + rng.normal(0.0, 0.02))
        alarms.append(monitor.active)
    assert not any(alarms[:300]) and any(alarms[300:320]) and not alarms[-1]


def test_the_log_height_ratio_of_feet_for_metres_is_log_3_28() -> None:
    assert log_height_ratio(328.0, 100.0) == pytest.approx(math.log(3.28))


def _attempts(monitor: Registration, count: int, *, found: bool) -> None:
    for _ in range(count):
        monitor.add_path(REGISTRATION_SPACING_HEIGHTS * HEIGHT_M, HEIGHT_M)
        monitor.add_attempt(found=found)


@pytest.fixture
def agreement() -> Agreement:
    """Of a flight whose start is not in question."""
    found = Agreement()
    found.begin(Cause.START, -math.inf)
    return found


@pytest.fixture
def monitor(agreement: Agreement) -> Registration:
    return Registration(agreement)


def test_correlations_without_a_match_raise_the_probability_before_the_alarm(
    monitor: Registration, agreement: Agreement
) -> None:
    assert agreement.weight(Cause.DESCRIPTION) == 0.0  # no correlation yet
    _attempts(monitor, 1, found=False)
    assert agreement.weight(Cause.DESCRIPTION) == pytest.approx(0.2067, abs=1e-3)
    _attempts(monitor, 3, found=False)
    assert not monitor.active and agreement.weight(Cause.DESCRIPTION) > 0.9
    _attempts(monitor, 7, found=False)
    assert not monitor.active
    _attempts(monitor, 1, found=False)
    assert monitor.active


def test_correlations_over_the_same_ground_count_once(monitor: Registration, agreement: Agreement) -> None:
    _attempts(monitor, 1, found=False)
    once = agreement.probability(Cause.DESCRIPTION)
    for _ in range(50):
        monitor.add_attempt(found=False)
    assert agreement.probability(Cause.DESCRIPTION) == once


def test_a_confirmed_description_stays_confirmed(monitor: Registration, agreement: Agreement) -> None:
    _attempts(monitor, 1, found=True)
    assert agreement.probability(Cause.DESCRIPTION) > 0.0
    _attempts(monitor, 1, found=True)
    assert agreement.probability(Cause.DESCRIPTION) == 0.0
    _attempts(monitor, 50, found=False)
    assert agreement.probability(Cause.DESCRIPTION) == 0.0 and not monitor.active


def test_several_matches_end_the_registration_alarm(monitor: Registration, agreement: Agreement) -> None:
    _attempts(monitor, 30, found=False)
    _attempts(monitor, 1, found=True)
    assert monitor.active
    _attempts(monitor, 8, found=True)
    assert not monitor.active and agreement.probability(Cause.DESCRIPTION) == 0.0


def test_the_path_since_the_last_match_bounds_the_error_of_a_wrong_description(
    monitor: Registration, agreement: Agreement
) -> None:
    _attempts(monitor, 1, found=True)
    assert monitor.path_error_m == 0.0
    _attempts(monitor, 1, found=False)
    once_m = monitor.path_error_m
    _attempts(monitor, 3, found=False)
    assert once_m == ERROR_PER_PATH * REGISTRATION_SPACING_HEIGHTS * HEIGHT_M
    assert monitor.path_error_m == pytest.approx(4.0 * once_m)
    _attempts(monitor, 6, found=True)
    assert agreement.probability(Cause.DESCRIPTION) == 0.0
    _attempts(monitor, 2, found=False)
    assert monitor.path_error_m == pytest.approx(2.0 * once_m)
    _attempts(monitor, 1, found=True)  # also of a confirmed description
    assert monitor.path_error_m == 0.0


def _fly(edit: Alter | None = None, frames: int = 120, **flight: object) -> tuple[EstimatorRun, list[CalibrationFault]]:
    listener, flown = EstimatorRun(), Flight(frames, **({"fix_every": 3, "dem": True} | flight))  # type: ignore[arg-type]
    listener.fly(flown, 0, frames, edit)
    return listener, [message for message in listener.published if isinstance(message, CalibrationFault)]


@pytest.mark.slow
def test_a_correctly_described_flight_has_no_fault() -> None:
    for seed in range(3):
        assert _fly(seed=seed)[1] == []


@pytest.mark.slow
def test_heights_in_feet_raise_a_scale_fault_and_withdraw_the_position() -> None:
    def feet(message: Message) -> Message:
        if isinstance(message, VehicleState) and message.agl_m is not None:
            return msgspec.structs.replace(message, agl_m=3.28 * message.agl_m)
        return message

    listener, faults = _fly(feet)
    assert faults and faults[0].quantity == "scale" and faults[0].active
    assert faults[0].factor == pytest.approx(3.28, rel=0.1)
    assert sigma_m(listener.estimate(119)) >= FAULT_SIGMA_M


def _unmatched(message: Message, matcher: str = "gradient") -> Message:
    if not isinstance(message, MapMatch):
        return message
    return MapMatch(t_ns=message.t_ns, frame_id=message.frame_id, verdict=Verdict.AMBIGUOUS, matcher=matcher)


@pytest.mark.slow
def test_correlations_without_a_match_withdraw_the_position() -> None:
    listener, faults = _fly(_unmatched, fix_every=1, frames=350)
    assert [(fault.quantity, fault.active) for fault in faults] == [("registration", True)]
    assert sigma_m(listener.estimate(119)) >= FAULT_SIGMA_M
    assert sigma_m(listener.estimate(12)) > 50.0  # of 72 m
    assert sigma_m(listener.estimate(349)) > 1.5 * FAULT_SIGMA_M  # it may have flown 2 km the other way


def _coarsely(message: Message) -> Message:
    """A coarse match: the mode of the belief without a pose."""
    if not isinstance(message, MapMatch):
        return message
    return with_pose(msgspec.structs.replace(message, inliers=0), position_only=True)


@pytest.mark.slow
def test_accepted_coarse_matches_do_not_count_against_registration() -> None:
    listener, faults = _fly(_coarsely, fix_every=1)
    verdicts = listener.verdicts("map").values()
    assert sum(v.verdict is Verdict.ACCEPTED for v in verdicts) > 100
    assert faults == []
    assert max(sigma_m(listener.estimate(i)) for i in range(120)) < 20.0


@pytest.mark.slow
def test_rejected_coarse_matches_count_against_registration() -> None:
    def aside(message: Message) -> Message:
        match = _coarsely(message)
        if not isinstance(match, MapMatch) or match.pose is None:
            return match
        e_m, n_m, up_m = match.pose.p_c_in_w_m
        return with_pose(match, p_c_in_w_m=(e_m + 400.0 * (match.frame_id % 3), n_m - 500.0, up_m))

    listener, faults = _fly(aside, fix_every=1)
    assert not any(v.verdict is Verdict.ACCEPTED for v in listener.verdicts("map").values())
    assert [(fault.quantity, fault.active) for fault in faults] == [("registration", True)]


@pytest.mark.parametrize(("verdict", "counts"), [(Verdict.ACCEPTED, True), (Verdict.NO_FEATURES, False)])
def test_correlations_count_over_ground_with_texture_alone(verdict: Verdict, counts: bool) -> None:
    monitors, telemetry, flight = Monitors(ORIGIN), Telemetry(), Flight(30, fix_every=1, dem=True)
    for i in range(30):
        state, odometry, match = flight.messages(i)
        assert isinstance(odometry, Odometry) and isinstance(match, MapMatch)
        telemetry.add(state)
        monitors.on_odometry(msgspec.structs.replace(odometry, verdict=verdict), telemetry, 1.0 * HEIGHT_M, HEIGHT_M)
        monitors.on_map_match(_unmatched(match), telemetry, accepted=False)
    assert [fault.quantity for fault in monitors.take_changes(t_ns(30))] == (["registration"] if counts else [])


def test_velocities_by_the_images_are_by_the_height_above_the_ground_below(monkeypatch: pytest.MonkeyPatch) -> None:
    """Above ground that lies 80 m over that at the start, the reported height is 80 m more."""
    seen: dict[float, list[np.ndarray]] = {0.0: [], 80.0: []}
    for rise_m, velocities in seen.items():
        monkeypatch.setattr(InertialMonitor, "add", lambda *of, to=velocities: to.append(of[-1]))
        origin = msgspec.structs.replace(ORIGIN, ground_amsl_m=(ORIGIN.ground_amsl_m or 0.0) - rise_m)
        monitors, telemetry, flight = Monitors(origin), Telemetry(), Flight(20, fix_every=1, dem=True)
        for i in range(20):
            state, odometry, match = flight.messages(i)
            assert isinstance(state, VehicleState) and state.agl_m is not None
            assert isinstance(odometry, Odometry) and isinstance(match, MapMatch)
            telemetry.add(msgspec.structs.replace(state, agl_m=state.agl_m + rise_m))
            monitors.on_odometry(odometry, telemetry, 10.0, HEIGHT_M)
            monitors.on_map_match(match, telemetry, accepted=True)
    assert len(seen[0.0]) > 5 and np.array(seen[80.0]) == pytest.approx(np.array(seen[0.0]))


@pytest.mark.slow
def test_correlations_with_a_drawn_map_do_not_count_against_registration() -> None:
    assert _fly(partial(_unmatched, matcher=f"gradient{ON_DRAWN}"), fix_every=1)[1] == []


def _heading_faults(frames: int, off_rad: Callable[[int], float], inliers: int = 30) -> list[CalibrationFault]:
    """Changes of the faults in a flight whose reported heading is off by ``off_rad`` (frame), matched in each frame by
    ``inliers`` patches; 0: a place that the frame alone has selected, without a pose."""
    monitors, telemetry, flight = Monitors(ORIGIN), Telemetry(), Flight(frames, dem=True)
    faults = []
    for i in range(frames):
        state, _, *_ = flight.messages(i)
        assert isinstance(state, VehicleState) and state.yaw_rad is not None
        telemetry.add(msgspec.structs.replace(state, yaw_rad=state.yaw_rad + off_rad(i)))
        match = msgspec.structs.replace(flight.fix(i), inliers=inliers)
        monitors.on_map_match(match, telemetry, accepted=True)
        faults += monitors.take_changes(t_ns(i))
    return faults


def test_map_poses_identify_a_compass_error_of_90_degrees_once() -> None:
    (fault,) = _heading_faults(60, lambda _: math.pi / 2)
    assert (fault.quantity, fault.active) == ("heading", True)
    assert fault.factor == pytest.approx(90.0, abs=15.0)
    assert _heading_faults(60, lambda _: math.pi / 2, inliers=0) == []


def test_a_fault_is_reported_again_when_its_factor_changes() -> None:
    faults = _heading_faults(200, lambda i: 1.5 if i < 100 else 3.0)
    assert all(fault.quantity == "heading" and fault.active for fault in faults)
    assert 2 <= len(faults) <= 5
    assert faults[0].factor == pytest.approx(86.0, abs=10.0) and faults[-1].factor == pytest.approx(172.0, abs=35.0)
