"""Time offset between frames and telemetry, from the attitude that both observe."""

import itertools

import msgspec
import numpy as np
import pytest

import inertial_flight
from inertial_flight import ORIGIN as INERTIAL_ORIGIN
from inertial_flight import InertialFlight
from seeds import seeds
from simulated_flight import CAMERA, ORIGIN, PLACE, EstimatorRun, Flight, cov_of, t_ns
from terrafix.core.camera import Mount
from terrafix.core.gate import GATE
from terrafix.core.geodesy import LocalFrame
from terrafix.core.pose import exp_so3
from terrafix.estimator.integrity.innovation import Innovation
from terrafix.estimator.integrity.offset_drift import DRIFT_GRID_S, RATES, Hazards, predicted
from terrafix.estimator.integrity.time_offset import MAX_SLEW, Contradiction, TimeOffset
from terrafix.estimator.measurements.telemetry_buffer import Telemetry
from terrafix.estimator.pose_estimator import EstimatedFlight
from terrafix.messages import (
    STAMP_SIGMA_S,
    CalibrationFault,
    Frame,
    Imu,
    NavEstimate,
    Odometry,
    Prediction,
    VehicleState,
    Verdict,
)
from terrafix_tools.mission.items import AltitudeFrame, Do, Item, Mission

R_B_C = Mount.of(CAMERA).r_b_c()


def grown(t_s: float) -> float:
    """A buffer that fills from 20 s on: a second in 20."""
    return float(np.clip((t_s - 20.0) / 20.0, 0.0, 1.2))


def straight_course(seed: int, length_m: float, box: object, frame: LocalFrame, *, agl_m: float) -> Mission:
    """In place of ``course``: to the north-east, without a turn."""
    ends = [frame.to_wgs84(1.0 * along_m, 0.5 * along_m) for along_m in (-1500.0, 1500.0)]
    items = [Item(Do.WAYPOINT, i, *end, agl_m, AltitudeFrame.GROUND) for i, end in enumerate(ends, start=1)]
    return Mission("straight", *ends[0], tuple(items))


@pytest.fixture(scope="module")
def plane() -> InertialFlight:
    return InertialFlight(2, 75, 25, delay=grown)


def offset_of(flight: InertialFlight, until_s: float = 1e9) -> TimeOffset:
    telemetry, offset = Telemetry(), TimeOffset(R_B_C)
    offset.buffered = True
    for messages in flight.messages_by_frame:
        for message in messages:
            if message.t_ns > until_s * 1e9:
                return offset
            if isinstance(message, VehicleState):
                telemetry.add(message)
            elif isinstance(message, Imu):
                telemetry.add_imu(message)
            elif isinstance(message, Odometry):
                offset.add(message, telemetry, 120.0)
                offset.step(0.5)
    return offset


@pytest.mark.parametrize("seed", seeds(1, 2))
def test_a_camera_in_time_is_not_corrected_and_not_claimed_wider(seed: int) -> None:
    offset = offset_of(InertialFlight(seed, 60, 25))
    assert offset.applied_s == 0.0 and offset.sigma_s <= STAMP_SIGMA_S


def over_relief(odometry: Odometry, rng: np.random.Generator) -> Odometry:
    """Images that turn about level axes as no gyroscope does, by six degrees a second."""
    if not odometry.two_view:
        return odometry
    pairs, span_s = np.array(odometry.two_view), 0.2 * (odometry.frame_id - odometry.keyframe_id)
    turned_deg = np.array([2.0, 6.0, 0.0]) * span_s + rng.normal(0.0, 0.5, 3)
    rays = np.column_stack([pairs[:, 2:], np.ones(len(pairs))]) @ exp_so3(np.radians(turned_deg)).T
    moved = np.column_stack([pairs[:, :2], rays[:, :2] / rays[:, 2:]])
    return msgspec.structs.replace(odometry, two_view=moved.tolist())


@pytest.mark.parametrize("seed", [2, 3, 7])
def test_turns_of_images_that_the_gyroscopes_have_at_no_offset_say_nothing_of_it(seed: int) -> None:
    flight, rng = InertialFlight(seed, 30, 25), np.random.default_rng([seed, 3])
    telemetry, offset, sigmas_s = Telemetry(), TimeOffset(R_B_C), list[float]()
    for message in itertools.chain.from_iterable(flight.messages_by_frame):
        if isinstance(message, VehicleState):
            telemetry.add(message)
        elif isinstance(message, Imu):
            telemetry.add_imu(message)
        elif isinstance(message, Odometry):
            offset.add(over_relief(message, rng), telemetry, 120.0)
            offset.step(0.5)
            sigmas_s.append(offset.sigma_s)
    assert offset.applied_s == 0.0 and max(sigmas_s) < 0.2


def test_an_offset_that_grows_is_followed(plane: InertialFlight) -> None:
    offset = offset_of(plane)
    mean_s, sigma_s = offset.estimate
    assert mean_s == pytest.approx(1.2, abs=max(3.0 * sigma_s, 0.06))
    assert offset.applied_s > 0.3 and abs(1.2 - offset.applied_s) < 3.0 * offset.sigma_s


@pytest.mark.parametrize("seed", seeds(3, 8))
def test_gusts_in_straight_flight_show_a_camera_that_is_late(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    monkeypatch.setattr(inertial_flight, "course", straight_course)
    offset = offset_of(InertialFlight(seed, 70, 25, delay=lambda t_s: 1.4 * (t_s > 20.0)))
    assert offset.estimate[0] == pytest.approx(1.4, abs=3.0 * offset.estimate[1])
    assert offset.applied_s == pytest.approx(1.4, abs=0.3)


def test_without_attitudes_nothing_is_compared_and_views_do_not_pile_up() -> None:
    telemetry, offset = Telemetry(), TimeOffset(R_B_C)
    view = {"keyframe_id": 0, "verdict": "accepted", "two_view": [(0.1, 0.1, 0.1, 0.1)] * 8}
    for i in range(100):
        offset.add(
            msgspec.convert({"t_ns": i * 10**9, "frame_id": i, **view, "type": "Odometry"}, Odometry), telemetry, 100.0
        )
    assert offset.applied_s == 0.0 and len(offset._pending) < 6


def straight(seen: float) -> TimeOffset:
    """A vehicle flies level with 20 m/s at 100 m for 25 s. From 15 s on images show the share ``seen`` of it."""
    telemetry, offset = Telemetry(), TimeOffset(R_B_C)
    rng = np.random.default_rng(5)
    offset.buffered = True
    for i in range(50):
        for part_ns in range(0, 500_000_000, 100_000_000):
            at_ns = i * 500_000_000 + part_ns
            samples = [(0, 0.0, 0.0, -9.81, 0.0, 0.0, 0.0)]
            telemetry.add(
                VehicleState(t_ns=at_ns, source="test", yaw_rad=0.0, pitch_rad=0.0, roll_rad=0.0, agl_m=100.0)
            )
            telemetry.add_imu(Imu(t_ns=at_ns, source="test", samples=samples))
        way = 0.1 * (seen if i >= 30 else 1.0)
        pairs = [
            (x, y, x - way + rng.normal(0.0, 1e-3), y)
            for x in np.linspace(-0.7, 0.7, 8)
            for y in (-0.3, -0.1, 0.0, 0.1, 0.3)
        ]
        view = Odometry(
            t_ns=i * 500_000_000, frame_id=i, keyframe_id=max(i - 1, 0), verdict=Verdict.ACCEPTED, two_view=pairs
        )
        offset.add(view, telemetry, 100.0)
    return offset


@pytest.mark.parametrize(("seen", "far"), [(1.0, False), (0.85, True), (1.4, False)])
def test_in_straight_flight_a_drift_shows_as_a_velocity_that_changes_without_acceleration(
    seen: float, far: bool
) -> None:
    offset = straight(seen)
    assert (offset.sigma_s > 0.3) == far
    assert offset.estimate[0] > 0.1 if far else offset.sigma_s <= STAMP_SIGMA_S


def test_an_offset_that_nothing_observes_is_claimed_once_its_buffer_may_have_filled() -> None:
    """Of an hour in which a buffer begins to fill once, 5 % are three minutes."""
    mass = np.zeros((len(RATES), len(DRIFT_GRID_S)))
    mass[0, 40] = 1.0
    hourly = Hazards(1.0 / 3600.0, 0.0)
    away = [1.0 - predicted(mass, 1.0, hourly)[:, 40].sum()]
    for _ in range(299):
        mass = predicted(mass, 1.0, hourly)
        away.append(1.0 - mass[:, 39:42].sum())
    assert mass.sum() == pytest.approx(1.0) and away[60] < 0.05 < away[299]


def test_a_buffer_that_fills_is_reported_claimed_and_corrected(plane: InertialFlight) -> None:
    """A delay that grows from 0 to 2 s over 40 s of the flight."""
    run, beyond = EstimatorRun(), 0
    run.feed([INERTIAL_ORIGIN, Frame(t_ns=0, frame_id=0, file="", width=1, height=1, buffered=True)])
    for i, messages in enumerate(plane.messages_by_frame):
        estimates = [m for m in run.feed(messages) if isinstance(m, NavEstimate)]
        if not estimates:
            continue
        estimate, stamp_s = estimates[-1], 0.5 * i
        at_m = np.array(PLACE.to_local(estimate.lat_deg, estimate.lon_deg))
        at_m = at_m + np.array(estimate.velocity_enu_mps[:2]) * (stamp_s - estimate.t_ns * 1e-9)
        error_m = float(np.hypot(*(at_m - plane.true_m[i][:2])))
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(cov_of(estimate)[:2, :2])[-1]))
        beyond += i > 10 and error_m > max(20.0, 3.0 * sigma_m)
    faults = [m for m in run.published if isinstance(m, CalibrationFault) and m.quantity == "camera time"]
    assert beyond == 0
    assert faults and faults[0].active and faults[0].factor is not None and faults[0].factor > 0.0


class LateCamera(TimeOffset):
    """Estimates an offset of a second with certainty, and stores the stamps of the added frames."""

    def __init__(self) -> None:
        super().__init__(R_B_C)
        self.stamps_ns: list[int] = []

    @property
    def density(self) -> np.ndarray:
        return np.where(np.abs(DRIFT_GRID_S - 1.0) < 0.01, 1.0, 0.0)

    def add(self, odometry: Odometry, telemetry: Telemetry, agl_m: float) -> None:
        self.stamps_ns.append(odometry.t_ns)


def flight_of(run: EstimatorRun) -> EstimatedFlight:
    flight = run.node._flight
    assert flight is not None
    return flight


def test_the_node_shifts_frame_times_by_the_slew_limited_offset_and_compares_at_the_stamps() -> None:
    flight, late = Flight(30, seed=3), LateCamera()
    listener = EstimatorRun().fly(flight, 0, 10)
    flight_of(listener).time_offset = late
    listener.fly(flight, 10, 30)
    shifted_s = [(t_ns(i) - listener.estimate(i).t_ns) * 1e-9 for i in range(10, 30)]
    assert shifted_s == pytest.approx([min(MAX_SLEW * 0.5 * (i + 1), 1.0) for i in range(20)])
    assert late.stamps_ns == [t_ns(i) for i in range(10, 30)]


class KnownTo(TimeOffset):
    """An offset of zero with ``one_sigma_s``, of a share of all cameras; the others have none."""

    def __init__(self, one_sigma_s: float, share: float) -> None:
        super().__init__(R_B_C)
        self._known = one_sigma_s, share

    @property
    def density(self) -> np.ndarray:
        one_sigma_s, share = self._known
        wide = np.exp(-0.5 * (DRIFT_GRID_S / one_sigma_s) ** 2)
        return share * wide / wide.sum() + (1.0 - share) * (np.abs(DRIFT_GRID_S) < 0.01)


@pytest.mark.parametrize(("share", "sigma_s"), [(0.01, STAMP_SIGMA_S), (1.0, 0.3)])
def test_the_uncertainty_of_the_time_offset_inflates_the_covariance_along_the_velocity(
    share: float, sigma_s: float
) -> None:
    flight, covs_m2 = Flight(12, seed=3), []
    for offset in (KnownTo(0.3, share), KnownTo(0.03, 0.0)):
        listener = EstimatorRun().fly(flight, 0, 11)
        flight_of(listener).time_offset = offset
        covs_m2.append(cov_of(listener.fly(flight, 11, 12).estimate(11))[:2, :2])
        left_s2 = offset.sigma_s**2
    way_m = (flight.p_m[11] - flight.p_m[10])[:2]
    along = way_m / np.linalg.norm(way_m)
    across = np.array([along[1], -along[0]])
    grown_m2 = covs_m2[0] - covs_m2[1]
    assert along @ grown_m2 @ along == pytest.approx((sigma_s**2 - left_s2) * 12.0**2, rel=0.1, abs=0.01)
    assert across @ grown_m2 @ across == pytest.approx(0.0, abs=0.05)


def test_a_new_origin_resets_the_time_offset() -> None:
    flight, late = Flight(12, seed=3), LateCamera()
    listener = EstimatorRun().fly(flight, 0, 2)
    flight_of(listener).time_offset = late
    listener.fly(flight, 2, 12)
    assert late.applied_s > 0.5
    listener.feed([msgspec.structs.replace(ORIGIN, start_sigma_m=20.0)])
    listener.fly(flight, 10, 12)
    assert listener.estimate(11).t_ns == t_ns(11)
    first = [m for m in listener.published if isinstance(m, Prediction) and m.frame_id == 10][-1]
    assert np.hypot(*first.step_m) < 1e-9


@pytest.mark.parametrize("sigma_s", [0.005, 0.2])
def test_the_prior_of_the_offset_is_what_the_source_knows_of_its_stamps(sigma_s: float) -> None:
    offset = TimeOffset(R_B_C)
    offset.stamped(Frame(t_ns=0, frame_id=0, file="", width=1, height=1, buffered=True, stamp_sigma_s=sigma_s))
    assert offset.buffered and offset.applied_s == 0.0
    assert sigma_s <= offset.sigma_s <= 1.5 * sigma_s  # 1 % of the cameras may be off by anything


@pytest.mark.parametrize(("off_m", "late_s"), [((-28.0, 0.5), 1.4), ((28.0, 0.5), -1.4), ((-0.5, 28.0), 0.0)])
def test_an_image_that_jumps_along_the_track_is_one_of_another_time_and_one_beside_it_is_not(
    off_m: tuple[float, float], late_s: float
) -> None:
    """A plane with 20 m/s to the east; the map repeats what the images show."""
    offset = TimeOffset(R_B_C)
    offset.buffered = True
    off = Innovation(np.array(off_m), np.eye(2), GATE[2])
    for by_map in (False, True):
        offset.contradict(Contradiction(0, off, np.array([20.0, 0.0]), 120.0), Telemetry(), by_map=by_map)
    assert offset.estimate[0] == pytest.approx(late_s, abs=0.1)
    (fault,) = offset.take_changes(0) or (None,)
    assert (fault is not None and fault.active) == (late_s != 0.0)
    assert offset.step(0.5) == (late_s != 0.0), "an offset that has jumped is subtracted at once"
    assert offset.applied_s == pytest.approx(late_s, abs=0.1) and offset.sigma_s < 0.2 and not offset.step(0.5)


@pytest.mark.parametrize(("repeats", "off_m", "late_s"), [(1, -10.0, 0.5), (3, -30.0, 1.5), (1, 0.0, 0.0)])
def test_pictures_that_a_stream_repeats_are_late_by_as_much_from_then_on_or_not_at_all(
    repeats: int, off_m: float, late_s: float
) -> None:
    """At 2 Hz and 20 m/s; the first new image decides."""
    offset = TimeOffset(R_B_C)
    offset.buffered = True
    for i in range(5 + repeats + 1):
        offset.view(i * 500_000_000, repeated=5 <= i < 5 + repeats)
    held_sigma_s = offset.sigma_s
    off = Innovation(np.array([off_m, 0.5]), 2.0 * np.eye(2), GATE[2])
    offset.contradict(Contradiction(0, off, np.array([20.0, 0.0]), 120.0), Telemetry(), by_map=False)
    offset.agree()  # a match of the same frame, at its old time
    assert offset.estimate[0] == pytest.approx(late_s, abs=0.1) and offset.step(0.5) == (late_s > 0.0)
    assert offset.applied_s == pytest.approx(late_s, abs=0.1) and offset.sigma_s < 0.1 < held_sigma_s


def test_a_stream_that_catches_up_has_an_empty_buffer() -> None:
    """Its images have jumped back by 1.3 s more or less, of 1.4 s."""
    offset, speed_mps = TimeOffset(R_B_C), np.array([20.0, 0.0])
    offset.buffered = True
    for t_s, off_m in ((0, -28.0), (20, 26.0)):
        off = Innovation(np.array([off_m, 0.0]), (4.0 if t_s else 1.0) * np.eye(2), GATE[2])
        for by_map in (False, True):
            offset.contradict(Contradiction(t_s * 10**9, off, speed_mps, 120.0), Telemetry(), by_map=by_map)
        assert offset.step(0.5)
        offset.agree()
    assert offset.applied_s == pytest.approx(0.0, abs=0.03)


def test_a_vehicle_that_hovers_learns_nothing_of_the_time_from_an_image_that_jumps() -> None:
    offset, before = TimeOffset(R_B_C), TimeOffset(R_B_C)
    off = Innovation(np.array([-20.0, 0.0]), np.eye(2), GATE[2])
    offset.contradict(Contradiction(0, off, np.zeros(2), 120.0), Telemetry(), by_map=False)
    assert offset.density == pytest.approx(before.density)


@pytest.mark.parametrize(
    ("keyframe_ns", "north_m", "by_map", "late_s"),
    [(0, 30.0, False, 1.4), (10**9, 30.0, False, 0.0), (10**9, 0.5, False, 1.4), (10**9, 30.0, True, 1.4)],
)
def test_images_that_jump_and_go_on_with_impossible_motions_tell_nothing_of_the_time(
    keyframe_ns: int, north_m: float, late_s: float, *, by_map: bool
) -> None:
    """The next motion, since a keyframe before or after the jump, beside the track or along it; the map may have
    confirmed the jump."""
    offset = TimeOffset(R_B_C)
    offset.buffered, offset._stamps_ns = True, {7: keyframe_ns}
    for at_ns, off_m in ((10**9, (-28.0, 0.5)), (2 * 10**9, (-5.0, north_m))):
        seen = Contradiction(at_ns, Innovation(np.array(off_m), np.eye(2), GATE[2]), np.array([20.0, 0.0]), 120.0, 7)
        offset.contradict(seen, Telemetry(), by_map=False)
        if by_map:
            offset.contradict(seen, Telemetry(), by_map=True)
    assert offset.estimate[0] == pytest.approx(late_s, abs=0.2)
