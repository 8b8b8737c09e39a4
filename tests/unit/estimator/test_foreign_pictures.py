"""Pictures of another flight, and a frozen camera: the estimate during and after them."""

import math
from typing import Any

import msgspec
import numpy as np
import pytest

from map_matches import plane, position_of, with_pose, with_search
from simulated_flight import FRAME_S, ORIGIN, EstimatorRun, Flight, blind, cov_of, error_m, sigma_m, t_ns
from terrafix.estimator.filter_state import FilterState
from terrafix.estimator.integrity.motion_gate import MotionInnovation
from terrafix.estimator.integrity.static_picture import MAX_STATIC_S
from terrafix.estimator.integrity.velocity_doubt import MOTION_TIMEOUT_S
from terrafix.estimator.measurements.height import is_below_map_matching
from terrafix.estimator.measurements.odometry import KeyframeMotion, OdometryMeasurement
from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.estimator.models.motion_model import MAX_SPEED_SIGMA_MPS
from terrafix.messages import MapMatch, Message, Odometry, Prediction, VehicleState, Verdict

FIRST, END, FRAMES = 30, 42, 70  # frames of the false pictures, of the flight
LATER = 9  # frames, after which the other flight has turned


def odometry_of(messages: list[Message]) -> Odometry:
    return next(m for m in messages if isinstance(m, Odometry))


def without(messages: list[Message], *kinds: type[Message]) -> list[Message]:
    return [m for m in messages if not isinstance(m, kinds)]


def foreign(other: Flight, i: int) -> Odometry:
    """Frame i shows ``other`` LATER frames on. Its frames match each other and form a new fragment."""
    odometry = odometry_of(other.messages(i + LATER))
    if i == FIRST:
        odometry = blind(odometry)
    keyframe_id = max(odometry.keyframe_id - LATER, FIRST)
    return msgspec.structs.replace(odometry, t_ns=t_ns(i), frame_id=i, keyframe_id=keyframe_id)


def flown(lie: dict[int, Odometry], flight: Flight, *, fixes: bool = True) -> EstimatorRun:
    """``lie``: odometry instead of the flight's own, in frames without a map match."""
    listener = EstimatorRun().fly(flight, 0, FIRST)
    for i in range(FIRST, FRAMES):
        messages = flight.messages(i)
        if i in lie:
            messages = [*without(messages, Odometry, MapMatch), lie[i]]
        elif i == END:  # its keyframe showed another flight: it begins a fragment
            messages = [blind(m) if isinstance(m, Odometry) else m for m in messages]
        listener.feed(messages if fixes else without(messages, MapMatch))
    return listener


def mahalanobis(listener: EstimatorRun, flight: Flight, i: int) -> float:
    estimate = listener.estimate(i)
    off = error_m(estimate, flight)[:2]
    return math.sqrt(float(off @ np.linalg.solve(cov_of(estimate)[:2, :2], off)))


def is_false(listener: EstimatorRun, flight: Flight, i: int) -> bool:
    """An error of more than 50 m and more than three sigmas."""
    off_m = float(np.linalg.norm(error_m(listener.estimate(i), flight)[:2]))
    return off_m > 50.0 and mahalanobis(listener, flight, i) > 3.0


def lied_to(speed_mps: float = 45.0, turn_rad: float = 2.0, **other: Any) -> tuple[Flight, Flight, EstimatorRun]:
    """-> a flight, another one whose pictures it shows from FIRST to END, and the run over it."""
    flight = Flight(FRAMES, seed=5)
    shown = Flight(FRAMES + LATER, seed=11, speed_mps=speed_mps, turn_rad=turn_rad, **other)
    return flight, shown, flown({i: foreign(shown, i) for i in range(FIRST, END)}, flight)


STARTED, FOUND = "first frame", "map match: found"  # reasons of a reset


def resets(run: EstimatorRun) -> dict[int, str]:
    """Frame and reason of each reset of the graph."""
    return {frame: verdict.detail for frame, verdict in run.verdicts("reset").items()}


@pytest.mark.parametrize("speed_mps", [3.0, 6.0, 12.0, 25.0, 45.0])
def test_pictures_of_another_flight_cause_no_false_fix(speed_mps: float) -> None:
    flight, _, listener = lied_to(speed_mps)
    assert not any(is_false(listener, flight, i) for i in range(FIRST, FRAMES))
    assert listener.verdicts("odometry")[FRAMES - 1].verdict is Verdict.ACCEPTED
    assert np.linalg.norm(error_m(listener.estimate(FRAMES - 1), flight)[:2]) < 12.0


def test_an_implausible_foreign_motion_is_not_fused() -> None:
    flight, _, listener = lied_to()
    verdicts = listener.verdicts("odometry")
    assert {verdicts[i].verdict for i in range(FIRST + 1, END)} <= {Verdict.UNCONFIRMED, Verdict.IMPLAUSIBLE}
    assert max(mahalanobis(listener, flight, i) for i in range(FIRST, FRAMES)) < 3.5


def test_a_fragment_that_turns_against_the_reported_heading_does_not_join() -> None:
    """Same speed and course for two frames; then they turn, and the reported heading does not."""
    flight = Flight(FRAMES, seed=5)
    other = Flight(FRAMES, seed=11, turn_rad=-2.5)
    odometry = {i: odometry_of(other.messages(i)) for i in range(FIRST, END)}
    lie = {i: msgspec.structs.replace(m, keyframe_id=max(m.keyframe_id, FIRST)) for i, m in odometry.items()}
    listener = flown(lie | {FIRST: blind(odometry[FIRST])}, flight)
    assert max(mahalanobis(listener, flight, i) for i in range(FIRST, FRAMES)) < 3.5


def test_unconfirmed_motion_does_not_update_height_and_calibration() -> None:
    flight, _, lied = lied_to(turn_rad=0.0, climb_amplitude_m=60.0)
    dark = flown({i: blind(odometry_of(flight.messages(i))) for i in range(FIRST, END)}, flight)
    for i in range(FIRST, END):
        heights = [
            np.array([m.agl_m for m in run.published if isinstance(m, Prediction) and m.frame_id == i])
            for run in (lied, dark)
        ]
        assert heights[0] == pytest.approx(heights[1], abs=1.0)


def test_a_fragment_that_moves_as_predicted_joins_without_a_map() -> None:
    """Tracking is lost for three frames; the next ones agree with the known velocity."""
    flight = Flight(FRAMES, seed=6)
    begins = FIRST + 3
    lie = {i: blind(odometry_of(flight.messages(i))) for i in range(FIRST, begins + 1)}
    for i in range(begins + 1, FRAMES):
        odometry = odometry_of(flight.messages(i))
        lie[i] = msgspec.structs.replace(odometry, keyframe_id=max(odometry.keyframe_id, begins))
    # Pairs belong to the keyframe from which they were tracked: those of an older one do not belong to the fragment.
    lie = {i: m for i, m in lie.items() if m.verdict is not Verdict.ACCEPTED or m.keyframe_id >= begins}
    listener = flown({i: m for i, m in lie.items() if i < begins + 4}, flight, fixes=False)
    verdicts = listener.verdicts("odometry")
    assert verdicts[FRAMES - 1].verdict is Verdict.ACCEPTED
    assert mahalanobis(listener, flight, FRAMES - 1) < 3.5


@pytest.mark.parametrize("outcome", [Verdict.AMBIGUOUS, Verdict.FEW_INLIERS, Verdict.DEGENERATE, "coarse"])
def test_correlations_without_a_pose_delay_joining_where_the_hit_rate_is_high(
    outcome: Verdict | str,
) -> None:
    """It moves as predicted, which would join it elsewhere; one pose joins it."""
    flight = Flight(FRAMES, seed=6, fix_every=1)
    listener = EstimatorRun().fly(flight, 0, FIRST)
    for i in range(FIRST, END):
        odometry, match = odometry_of(flight.messages(i)), flight.fix(i)
        if i == FIRST:
            odometry = blind(odometry)
        if outcome == "coarse":
            match = with_pose(match, position_only=True)
        elif isinstance(outcome, Verdict):
            match = msgspec.structs.replace(match, verdict=outcome)
        listener.feed([*without(flight.messages(i), Odometry, MapMatch), odometry, match])
    verdicts = listener.verdicts("odometry")
    assert all(verdicts[i].verdict is Verdict.UNCONFIRMED for i in range(FIRST + 1, END))
    listener.feed([flight.fix(END - 1), *flight.messages(END)])
    assert listener.verdicts("odometry")[END].verdict is Verdict.ACCEPTED


def test_the_prediction_of_an_unjoined_fragment_covers_the_time_since_its_keyframe(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The keyframe itself was placed by velocity, so that the velocity error counts over all of the time since."""
    predicted = OdometryMeasurement._innovation
    beyond: list[float] = []

    def spy(
        odometry: OdometryMeasurement, t_s: float, p_m: np.ndarray, seen: KeyframeMotion, *rest: Any
    ) -> MotionInnovation:
        innovation = predicted(odometry, t_s, p_m, seen, *rest)
        state = odometry._state
        if not state.fragments.of(seen.parent).confirmed:
            since_s = t_s - state.graph.time_of(seen.parent)
            velocity_m2 = state.motion_cov[:2, :2] * since_s**2
            beyond.append(float(np.linalg.eigvalsh(innovation.cov_m2[:2, :2] - velocity_m2)[0]))
        return innovation

    monkeypatch.setattr(OdometryMeasurement, "_innovation", spy)
    lied_to(3.0)
    assert len(beyond) > 5 and min(beyond) > 0.0


def test_prediction_steps_follow_a_foreign_fragment_and_return_after_it() -> None:
    flight, other, listener = lied_to(25.0)
    steps = {m.frame_id: np.array(m.step_m) for m in listener.published if isinstance(m, Prediction)}
    theirs_m = np.linalg.norm(np.diff(other.p_m[FIRST + LATER : END + LATER, :2], axis=0), axis=1).sum()
    assert sum(np.linalg.norm(steps[i]) for i in range(FIRST + 1, END)) == pytest.approx(theirs_m, rel=0.1)
    ours = (flight.p_m[END + 3] - flight.p_m[FIRST - 1])[:2]
    assert np.linalg.norm(sum(steps[i] for i in range(FIRST, END + 4)) - ours) < 40.0  # dead reckoning of six seconds


def frozen(flight: Flight, i: int) -> Odometry:
    """The picture of frame FIRST - 1 again: all image points are unchanged."""
    odometry = odometry_of(flight.messages(FIRST - 1))
    pairs = [(x, y, x, y) for x, y, _, _ in odometry.two_view]
    return msgspec.structs.replace(
        odometry, t_ns=t_ns(i), frame_id=i, keyframe_id=FIRST - 1, two_view=pairs, becomes_keyframe=False, static=True
    )


@pytest.fixture(scope="module")
def frozen_run() -> tuple[Flight, EstimatorRun]:
    """The last true picture is a keyframe."""
    flight = Flight(FRAMES, seed=7)
    return flight, flown({i: frozen(flight, i) for i in range(FIRST, END)}, flight)


def test_a_frozen_camera_is_not_taken_for_a_stationary_vehicle(frozen_run: tuple[Flight, EstimatorRun]) -> None:
    flight, listener = frozen_run
    verdicts = listener.verdicts("odometry")
    assert all(verdicts[i].verdict is Verdict.STALLED for i in range(FIRST, END))
    assert max(mahalanobis(listener, flight, i) for i in range(FIRST, FRAMES)) < 3.5
    way_m = np.linalg.norm((flight.p_m[END - 1] - flight.p_m[FIRST - 1])[:2])
    assert np.linalg.norm(error_m(listener.estimate(END - 1), flight)[:2]) < 0.5 * way_m


def test_no_prediction_is_published_for_a_frozen_picture(frozen_run: tuple[Flight, EstimatorRun]) -> None:
    _, listener = frozen_run
    predicted = {m.frame_id for m in listener.published if isinstance(m, Prediction)}
    assert not predicted & set(range(FIRST, END))
    assert predicted >= {FIRST - 1, *range(END, FRAMES)}


def test_the_standstill_that_the_first_repeated_pictures_have_shown_is_discarded() -> None:
    """A slow vehicle without inertial readings could have stopped: the first of them is fused."""
    flight = Flight(FRAMES, seed=8, speed_mps=8.0)
    listener = flown({i: frozen(flight, i) for i in range(FIRST, END)}, flight)
    assert listener.verdicts("odometry")[FIRST].verdict is Verdict.ACCEPTED
    assert resets(listener) == {0: STARTED, FIRST + 1: "repeated images have shown a standstill for up to 7 m"}
    assert max(mahalanobis(listener, flight, i) for i in range(FIRST, FRAMES)) < 3.0
    velocity_mps = np.array(listener.estimate(END - 1).velocity_enu_mps)[:2]
    assert float(np.hypot(*velocity_mps)) > 4.0


@pytest.mark.parametrize("found", [True, False])
def test_a_frozen_camera_is_detected_without_a_heading(found: bool) -> None:
    """``found``: a map match has given the heading. Else no motion is predicted, and the duration decides."""
    flight, listener = Flight(FRAMES, seed=7, telemetry=frozenset({"attitude", "height"})), EstimatorRun()
    listener.feed([ORIGIN])
    for i in range(FRAMES):
        messages = flight.messages(i) if found and i < FIRST else without(flight.messages(i), MapMatch)
        if FIRST <= i < END:
            messages = [*without(messages, Odometry), frozen(flight, i)]
        elif i == END:  # its keyframe showed another picture
            messages = [blind(m) if isinstance(m, Odometry) else m for m in messages]
        listener.feed(messages)
    verdicts = listener.verdicts("odometry")
    lasts = FIRST + round(MAX_STATIC_S / FRAME_S)
    assert all(verdicts[i].verdict is Verdict.STALLED for i in range(lasts, END))
    assert verdicts[FRAMES - 1].verdict is Verdict.ACCEPTED


def test_a_frozen_picture_stays_stalled_after_a_reset_of_the_graph() -> None:
    """Its keyframe is older than the new graph; no prediction is published nevertheless."""
    flight = Flight(FRAMES, seed=7)
    listener = EstimatorRun().fly(flight, 0, FIRST)
    for i in range(FIRST, END):
        listener.feed([*without(flight.messages(i), Odometry, MapMatch), frozen(flight, i)])
        if i == FIRST + 2:
            listener.feed([with_search(flight.fix(FIRST - 1), relocalized=True)])
    verdicts = listener.verdicts("odometry")
    assert all(verdicts[i].verdict is Verdict.STALLED for i in range(FIRST, END))


def test_a_view_that_changed_while_nothing_was_tracked_ends_a_frozen_picture() -> None:
    flight = Flight(FRAMES, seed=7)
    hover = msgspec.structs.replace(frozen(flight, FIRST), two_view=[])  # static, and nothing is tracked in it
    lie = {FIRST: frozen(flight, FIRST), FIRST + 1: blind(frozen(flight, FIRST + 1))}
    lie[FIRST + 2] = msgspec.structs.replace(hover, t_ns=t_ns(FIRST + 2), frame_id=FIRST + 2)
    verdicts = flown(lie, flight).verdicts("odometry")
    assert verdicts[FIRST].verdict is Verdict.STALLED
    assert verdicts[FIRST + 2].verdict is Verdict.FEW_INLIERS


def test_skipped_pictures_do_not_end_a_frozen_picture() -> None:
    flight = Flight(FRAMES, seed=7)
    lie = {i: frozen(flight, i) for i in range(FIRST, END)}
    for i, verdict in ((FIRST + 1, Verdict.STALLED), (FIRST + 3, Verdict.BAD_IMAGE)):
        lie[i] = blind(lie[i], verdict)
        lie[i + 1] = msgspec.structs.replace(lie[i + 1], two_view=[])
    verdicts = flown(lie, flight).verdicts("odometry")
    assert [verdicts[i].verdict for i in (FIRST + 1, FIRST + 2)] == [Verdict.STALLED] * 2
    assert [verdicts[i].verdict for i in (FIRST + 3, FIRST + 4)] == [Verdict.BAD_IMAGE, Verdict.STALLED]


def test_the_step_covariance_after_stalled_frames_spans_all_of_them(frozen_run: tuple[Flight, EstimatorRun]) -> None:
    flight, listener = frozen_run
    odometry = {m.frame_id: m for m in listener.published if isinstance(m, Prediction)}
    truth_m = (flight.p_m[END] - flight.p_m[FIRST - 1])[:2]
    sigma = math.sqrt(odometry[END].step_cov_m2[0])
    assert np.linalg.norm(odometry[END].step_m - truth_m) < 3.5 * sigma
    grown_m2 = cov_of(listener.estimate(END))[:2, :2] - cov_of(listener.estimate(FIRST - 1))[:2, :2]
    assert sigma > 0.7 * math.sqrt(np.linalg.eigvalsh(grown_m2)[-1])
    assert math.sqrt(odometry[END + 1].step_cov_m2[0]) < 0.5 * sigma


def test_two_frames_with_one_time_stamp_are_no_evidence_of_motion() -> None:
    flight = Flight(FRAMES, seed=5)
    still = msgspec.structs.replace(frozen(flight, FIRST + 1), t_ns=t_ns(FIRST), keyframe_id=FIRST, static=False)
    listener = EstimatorRun().fly(flight, 0, FIRST)
    listener.feed([*without(flight.messages(FIRST), Odometry, MapMatch), blind(odometry_of(flight.messages(FIRST)))])
    listener.feed([still])
    assert listener.verdicts("odometry")[FIRST + 1].verdict is Verdict.UNCONFIRMED


@pytest.mark.parametrize(("speed_mps", "then"), [(110.0, Verdict.ACCEPTED), (150.0, Verdict.IMPLAUSIBLE)])
def test_contradicted_velocity_is_reset_once_after_the_timeout(speed_mps: float, then: Verdict) -> None:
    """Nothing tells which of the two is wrong, so the claim must hold for both."""
    flight, impossible = Flight(FRAMES, seed=8), Flight(FRAMES, seed=8, speed_mps=speed_mps)
    listener = EstimatorRun().fly(flight, 0, FIRST)
    timeout = FIRST + 2 + round(MOTION_TIMEOUT_S / FRAME_S)  # the first frame that is surely later than it
    for i in range(FIRST, timeout + 4):
        odometry = odometry_of(impossible.messages(i))
        if i == FIRST:  # one motion that is possible: the five seconds begin after it
            odometry = odometry_of(flight.messages(i))
        listener.feed([*without(flight.messages(i), Odometry, MapMatch), odometry])
    verdicts = listener.verdicts("odometry")
    assert all(verdicts[i].verdict is Verdict.IMPLAUSIBLE for i in range(FIRST + 1, timeout + 1))
    assert resets(listener) == {0: STARTED, timeout: "odometry contradicts velocity for 5 s"}
    assert sigma_m(listener.estimate(timeout)) > 15.0
    assert listener.estimate(timeout).velocity_sigma_mps >= MAX_SPEED_SIGMA_MPS[0]
    assert verdicts[timeout + 1].verdict is then


def test_a_velocity_that_one_motion_has_shown_is_reset_as_soon_as_as_many_contradict_it() -> None:
    """The first motion of a flight is fused: nothing predicts it."""
    flight, fast = Flight(FRAMES, seed=8), Flight(FRAMES, seed=8, speed_mps=55.0)
    listener = EstimatorRun().fly(flight, 0, 1)
    for i in range(1, 6):
        odometry = odometry_of((fast if i == 1 else flight).messages(i))
        listener.feed([*without(flight.messages(i), Odometry, MapMatch), odometry])
    assert resets(listener) == {0: STARTED, 4: "odometry contradicts velocity for 1 s"}


def test_a_coarse_match_does_not_join_a_fragment_to_the_flight() -> None:
    """It says what the belief remembers; pictures of another flight have no part in it."""
    flight = Flight(FRAMES, seed=5)
    other = Flight(FRAMES + LATER, seed=11, speed_mps=45.0, turn_rad=2.0)
    listener = EstimatorRun().fly(flight, 0, FIRST)
    for i in range(FIRST, FIRST + 3):
        coarse = with_pose(flight.fix(i), position_only=True)
        listener.feed([*without(flight.messages(i), Odometry, MapMatch), foreign(other, i), coarse])
    verdicts = listener.verdicts("map")
    assert [verdicts[i].verdict for i in range(FIRST, FIRST + 3)] == [Verdict.UNCONFIRMED] * 3
    assert listener.estimate(FIRST + 2).last_anchor_age_ms > 0


def found_at_15_m(fix: MapMatch) -> MapMatch:
    """``fix`` as the result of a search, at a height too low for matching."""
    return with_search(with_pose(fix, p_c_in_w_m=(*position_of(fix)[:2], 15.0)), relocalized=True)


def run_at_15_m(flight: Flight) -> EstimatorRun:
    """After 20 frames, the last of which a search has found too low."""
    listener = EstimatorRun().fly(flight, 0, 20)
    listener.feed([found_at_15_m(flight.fix(19))])
    return listener


@pytest.mark.parametrize(("reported_m", "resets_it"), [(44.0, False), (46.0, True)])
def test_an_estimate_too_low_is_reset_from_one_and_a_half_times_the_matching_limit(
    reported_m: float, resets_it: bool
) -> None:
    state = FilterState(msgspec.structs.replace(ORIGIN, ground_amsl_m=0.0))
    state.terrain.update(plane(0.0), np.zeros(3))
    here = np.array([0.0, 0.0, 15.0])
    assert is_below_map_matching(state, Attitude(0.0, 0.0, 0.0, reported_m), here) == resets_it


@pytest.mark.parametrize("reported_m", [None, 3.0])
def test_an_estimate_below_the_ground_is_reset_whatever_height_is_reported(reported_m: float | None) -> None:
    """Images seen from below the ground turn the sign of every motion."""
    state = FilterState(msgspec.structs.replace(ORIGIN, ground_amsl_m=0.0))
    state.terrain.update(plane(0.0), np.zeros(3))
    attitude = Attitude(0.0, 0.0, 0.0, reported_m)
    assert is_below_map_matching(state, attitude, np.array([0.0, 0.0, -1.0]))
    assert not is_below_map_matching(state, attitude, np.array([0.0, 0.0, 2.0]))


def test_a_height_too_low_for_matching_is_reset_to_the_reported_one() -> None:
    flight = Flight(30, seed=3, dem=True)
    listener = run_at_15_m(flight)
    assert listener.estimate(19).agl_m < 20.0
    listener.feed(without(flight.messages(20), MapMatch))
    assert list(resets(listener).items())[:2] == [(0, STARTED), (19, FOUND)]
    assert list(resets(listener)) == [0, 19, 20] and "are reported" in resets(listener)[20]
    assert listener.estimate(20).agl_m == pytest.approx(flight.p_m[20, 2], abs=15.0)
    listener.fly(flight, 21, 30)
    assert list(resets(listener)) == [0, 19, 20]


@pytest.mark.parametrize(
    ("dem", "reported_m"),
    [
        pytest.param(True, 20.0, id="reported below the matching limit"),
        pytest.param(True, 44.0, id="reported a little above the matching limit"),
        pytest.param(False, None, id="without an elevation map, whatever is reported"),
    ],
)
def test_a_low_height_causes_no_reset(dem: bool, reported_m: float | None) -> None:
    flight = Flight(25, seed=3, dem=dem)
    listener = run_at_15_m(flight)
    state = next(m for m in flight.messages(20) if isinstance(m, VehicleState))
    state = state if reported_m is None else msgspec.structs.replace(state, agl_m=reported_m)
    listener.feed([state, odometry_of(flight.messages(20))])
    assert listener.estimate(20).agl_m < 25.0 and resets(listener) == {0: STARTED, 19: FOUND}


def test_the_height_after_a_reset_is_the_reported_one_above_the_take_off() -> None:
    """The take-off was 60 m higher than the ground here."""
    flight, above_m = Flight(25, seed=3, dem=True), 60.0
    listener = EstimatorRun()
    listener.feed([msgspec.structs.replace(ORIGIN, ground_amsl_m=above_m)])
    for i in range(21):
        for m in flight.messages(i):
            if isinstance(m, VehicleState) and m.agl_m is not None:
                m = msgspec.structs.replace(m, agl_m=m.agl_m - above_m)
            if i < 20 or not isinstance(m, MapMatch):
                listener.feed([m])
        if i == 19:
            listener.feed([found_at_15_m(flight.fix(19))])
    assert list(resets(listener)) == [0, 19, 20]
    assert listener.estimate(20).agl_m == pytest.approx(flight.p_m[20, 2], abs=15.0)


def test_a_flight_at_its_reported_height_is_never_reset() -> None:
    flight = Flight(30, seed=3, dem=True, climb_amplitude_m=0.0)
    assert resets(EstimatorRun().fly(flight, 0, 30)) == {0: STARTED}
