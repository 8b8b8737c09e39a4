"""A camera on a gimbal: the vehicle rolls by 25 degrees, and the estimate is that of a fixed camera in a level one."""

import math
from collections.abc import Callable, Iterator
from functools import cache, partial

import msgspec
import numpy as np
import pytest

from inertial_flight import InertialFlight
from simulated_flight import ORIGIN, EstimatorRun, Flight, blind, cov_of, error_m
from terrafix.core.camera import camera_rotation
from terrafix.core.geodesy import euler_from_rot, rot_from_quat, rot_w_b, yaw_of
from terrafix.core.mavlink.gimbal import quat_from_euler
from terrafix.estimator.measurements.gimbal import GimbalReports
from terrafix.link.pilot_text.statustext import fault_text
from terrafix.messages import (
    CalibrationFault,
    Gimbal,
    GimbalAttitude,
    MapMatch,
    Message,
    Odometry,
    Origin,
    Prediction,
    VehicleState,
    Verdict,
)

FRAMES, AWAY = 44, range(24, 30)
ROLL_RAD = math.radians(25.0)
FLIGHT = Flight(FRAMES, seed=4)
Reports = Callable[[int, VehicleState], list[GimbalAttitude]]  # of a frame


def origin(gimbal: Gimbal | None = None) -> Origin:
    camera = msgspec.structs.replace(ORIGIN.camera, gimbal=gimbal or Gimbal())
    return msgspec.structs.replace(ORIGIN, camera=camera)


def leaning(state: VehicleState, i: int) -> VehicleState:
    """As ``rolling``, and the vehicle pitches as much."""
    leans_rad = ROLL_RAD * math.sin(0.7 * i)
    return msgspec.structs.replace(rolling(state, i), pitch_rad=leans_rad)


def rolling(state: VehicleState, i: int) -> VehicleState:
    """The vehicle's attitude; that of the camera's platform is the one of ``state``."""
    return msgspec.structs.replace(state, pitch_rad=0.1, roll_rad=ROLL_RAD * math.sin(1.3 * i))


def held(state: VehicleState, *, from_north: bool = True, up_deg: float = 0.0, late_s: float = 0.0) -> GimbalAttitude:
    """The report of a gimbal whose platform is that of ``state``, which points the camera ``up_deg`` above nadir."""
    assert state.yaw_rad is not None and state.pitch_rad is not None and state.roll_rad is not None
    r_w_p = rot_w_b(0.0 if not from_north else state.yaw_rad, state.pitch_rad + math.radians(up_deg), state.roll_rad)
    along_view = r_w_p @ np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # gimbal at pitch -90
    q = quat_from_euler(*euler_from_rot(along_view))
    return GimbalAttitude(t_ns=state.t_ns + round(late_s * 1e9), q=q, from_north=from_north)


def by_gimbal(reports: Reports, leans: Callable[[VehicleState, int], VehicleState] = rolling) -> Iterator[Message]:
    for i in range(FRAMES):
        for message in FLIGHT.messages(i):
            if isinstance(message, VehicleState):
                yield leans(message, i)
                yield from reports(i, message)
            else:
                yield message


@cache
def fixed() -> EstimatorRun:
    return EstimatorRun().fly(FLIGHT, 0, FRAMES)


def flown(reports: Reports, gimbal: Gimbal | None = None) -> EstimatorRun:
    run = EstimatorRun()
    run.feed([origin(gimbal), *by_gimbal(reports, leaning if reports is of_servos else rolling)])
    return run


def errors_m(run: EstimatorRun) -> np.ndarray:
    return np.array([float(np.hypot(*error_m(estimate, FLIGHT)[:2])) for estimate in run.estimates()])


def sigmas(run: EstimatorRun) -> np.ndarray:
    """Error of each frame over its claim, as a Mahalanobis distance."""
    found = []
    for estimate in run.estimates():
        off_m = error_m(estimate, FLIGHT)[:2]
        found.append(math.sqrt(float(off_m @ np.linalg.solve(cov_of(estimate)[:2, :2], off_m))))
    return np.array(found)


@cache
def by_north() -> EstimatorRun:
    return flown(lambda _i, state: [held(state)])


@pytest.mark.parametrize("from_north", [True, False])
def test_a_stabilised_camera_is_as_good_as_a_fixed_one_in_a_level_vehicle(from_north: bool) -> None:
    run = by_north() if from_north else flown(lambda _i, state: [held(state, from_north=False)])
    assert errors_m(run).mean() <= 1.1 * errors_m(fixed()).mean()
    assert sigmas(run).max() < 3.5
    last = run.estimates()[-1]
    r_w_c = camera_rotation(last, ORIGIN.camera)
    assert np.degrees(np.arccos((np.trace(r_w_c.T @ FLIGHT.r_w_c[-1]) - 1.0) / 2.0)) < 2.0


def test_the_published_attitude_is_that_of_the_vehicle() -> None:
    run = by_north()
    for estimate in run.estimates()[12:]:
        yaw, _, roll = euler_from_rot(rot_from_quat(estimate.q_w_b))
        assert roll == pytest.approx(ROLL_RAD * math.sin(1.3 * estimate.frame_id), abs=math.radians(5.0))
        assert math.remainder(yaw - yaw_of(FLIGHT.r_w_b[estimate.frame_id]), math.tau) == pytest.approx(0.0, abs=0.15)


def of_servos(i: int, state: VehicleState) -> list[GimbalAttitude]:
    """As ArduPilot reports a mount with servos that point down: the vehicle's roll and pitch with the other sign."""
    leans = leaning(state, i)
    assert leans.pitch_rad is not None and leans.roll_rad is not None
    q = quat_from_euler(0.0, -math.pi / 2 - leans.pitch_rad, -leans.roll_rad)
    return [GimbalAttitude(t_ns=state.t_ns, q=q, from_north=False)]


# arducopter 4.7-dev (SITL), mount sent straight down by MAVLink, attitude targets: pitch of the vehicle [degrees] and
# quaternion of GIMBAL_DEVICE_ATTITUDE_STATUS (flags 44: roll lock, pitch lock, yaw in the vehicle's frame) 2 s later.
OF_TYPE_1 = (
    (-1.9, (0.708, -0.007, -0.706, -0.007)),
    (15.1, (0.707, 0.009, -0.707, 0.009)),  # the servo is at its limit, -90
    (0.2, (0.707, 0.015, -0.707, 0.015)),
    (-16.2, (0.789, -0.014, -0.614, -0.011)),
    (0.5, (0.712, 0.009, -0.702, 0.009)),
)
OF_TYPE_7 = tuple((pitch_deg, (0.707, 0.0, -0.707, 0.0)) for pitch_deg in (-1.3, 16.2, -15.3, 0.7))  # what it is sent


@pytest.mark.parametrize(("reported", "opposes"), [(OF_TYPE_1, True), (OF_TYPE_7, False)])
def test_fact_ardupilot_reports_the_angles_of_servos_and_what_a_brushless_gimbal_is_sent(
    reported: tuple[tuple[float, tuple[float, float, float, float]], ...], opposes: bool
) -> None:
    reports = GimbalReports()
    for i, (pitch_deg, q) in enumerate(reported):
        w, x, y, z = np.array(q) / np.linalg.norm(q)
        report = GimbalAttitude(t_ns=round(2e9 * i), q=(w, x, y, z), from_north=False)
        reports.add(report, math.radians(pitch_deg))
    assert reports.opposes is opposes and reports.is_level is not opposes


def test_a_gimbal_that_was_level_for_long_is_no_longer_when_its_reports_begin_to_oppose_the_lean() -> None:
    reports = GimbalReports()
    for i in range(40):
        pitch_rad = math.radians(5.0 * (i % 2))
        q = quat_from_euler(0.0, -math.pi / 2 - (pitch_rad if i >= 30 else 0.0), 0.0)
        reports.add(GimbalAttitude(t_ns=round(2e9 * i), q=q, from_north=False), pitch_rad)
        assert i != 29 or reports.is_level
    assert reports.opposes and not reports.is_level


def lost(i: int, state: VehicleState, from_frame: int = 20) -> list[GimbalAttitude]:
    return [held(state)] if i < from_frame else []


def frozen(i: int, state: VehicleState) -> list[GimbalAttitude]:
    """From frame 20 on the report of a camera that looks 20 degrees ahead is repeated."""
    if i < 20:
        return [held(state)]
    tilted = held(FLIGHT.messages(20)[0], up_deg=20.0)  # type: ignore[arg-type]
    return [msgspec.structs.replace(tilted, t_ns=state.t_ns)]


def late(i: int, state: VehicleState) -> list[GimbalAttitude]:
    """Of the frame before, at the time of its arrival."""
    before = FLIGHT.messages(max(i - 1, 0))[0]
    assert isinstance(before, VehicleState)
    return [msgspec.structs.replace(held(before), t_ns=state.t_ns)]


def ambiguous(i: int, state: VehicleState) -> list[GimbalAttitude]:
    """Straight down, yaw and roll turn about one axis: a report by Euler angles splits the heading at random."""
    assert state.yaw_rad is not None and state.roll_rad is not None
    part = float(np.random.default_rng(i).uniform(-3.0, 3.0))
    q = quat_from_euler(state.yaw_rad + part, -math.pi / 2, -part)
    return [GimbalAttitude(t_ns=state.t_ns, q=q, from_north=True)]


NAMED = {
    **dict.fromkeys((partial(lost, from_frame=0), lost), "gimbal not reported"),
    frozen: "gimbal repeats a report",
    of_servos: "gimbal reports its servos",
    **dict.fromkeys((late, ambiguous), ""),
}


@pytest.mark.parametrize(("reports", "named"), NAMED.items())
def test_the_claim_holds_when_reports_are_missing_late_frozen_or_ambiguous(reports: Reports, named: str) -> None:
    run = flown(reports)
    faults = [fault_text(message) for message in run.published if isinstance(message, CalibrationFault)]
    assert f"{named}: level assumed" in faults if named else not faults
    assert sigmas(run).max() < 3.5
    assert errors_m(run)[20:].mean() < 2.0 * errors_m(fixed())[20:].mean() + (8.0 if reports is frozen else 1.0)


def test_a_gimbal_that_looks_away_gives_no_match_and_its_own_verdict() -> None:
    run = EstimatorRun()
    run.feed([origin()])
    for message in by_gimbal(lambda i, state: [held(state, up_deg=85.0 if i in AWAY else 0.0)]):
        if isinstance(message, MapMatch) and message.frame_id in AWAY:
            continue  # there is no Prediction to match
        run.feed([message])
    verdicts = run.verdicts("odometry")
    assert {i for i, verdict in verdicts.items() if verdict.verdict is Verdict.NO_GROUND} == set(AWAY)
    predicted = {message.frame_id for message in run.published if isinstance(message, Prediction)}
    assert not predicted & set(AWAY) and FRAMES - 1 in predicted
    assert sigmas(run).max() < 3.5
    assert errors_m(run)[-1] < 10.0


def test_without_images_the_velocity_is_as_sure_as_by_a_fixed_camera_whatever_the_gimbal_reports() -> None:
    flight, sigmas_mps = InertialFlight(seed=4, seconds=45), []
    for on_gimbal in (False, True):
        run = EstimatorRun()
        run.feed([origin() if on_gimbal else ORIGIN])
        for i, messages in enumerate(flight.messages_by_frame):
            for message in [m for m in messages if i < 35 or not isinstance(m, MapMatch)]:
                run.feed([blind(message)] if i >= 35 and isinstance(message, Odometry) else [message])
                if on_gimbal and i < 35 and isinstance(message, VehicleState):
                    run.feed([held(message)])
        sigmas_mps.append(run.estimates()[-1].velocity_sigma_mps)
    seen = run.node._telemetry.at(run.estimates()[-1].t_ns)  # the gimbal may have turned with the vehicle
    assert seen.yaw_rad == pytest.approx(seen.of_vehicle.yaw_rad, abs=0.01) and sigmas_mps[1] < 1.2 * sigmas_mps[0]


def test_a_gimbal_counts_from_its_first_report_on_unless_it_is_required() -> None:
    auto = Gimbal(required=False)
    silent = EstimatorRun()
    silent.feed([origin(auto), *(message for i in range(12) for message in FLIGHT.messages(i))])
    alone = EstimatorRun().fly(FLIGHT, 0, 12)
    assert [m.lat_deg for m in silent.estimates()] == [m.lat_deg for m in alone.estimates()]
    run = flown(lambda _i, state: [held(state)], auto)
    assert errors_m(run).mean() <= 1.1 * errors_m(fixed()).mean()


def test_reports_of_another_device_do_not_count() -> None:
    def two(_i: int, state: VehicleState) -> list[GimbalAttitude]:
        right = msgspec.structs.replace(held(state), device=2)
        return [msgspec.structs.replace(held(state, up_deg=85.0), device=1), right]

    run = flown(two, Gimbal(device=2))
    assert not [v for v in run.verdicts("odometry").values() if v.verdict is Verdict.NO_GROUND]
    assert errors_m(run).mean() <= 1.1 * errors_m(fixed()).mean()
