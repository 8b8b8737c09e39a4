"""Pictures of another flight, and a camera that is frozen: what the estimate says while they last and afterwards."""

import math
from typing import Any

import msgspec
import numpy as np
import pytest

from simulated_flight import FRAME_S, ORIGIN, Flight, Listener, blind, cov_of, error_m, sigma_m, t_ns
from terrafix.estimator.integrity.motion_gate import MotionInnovation
from terrafix.estimator.integrity.static_picture import AT_REST_S
from terrafix.estimator.models.motion_model import MAX_SPEED_SIGMA_MPS
from terrafix.estimator.propagation import MOTION_TIMEOUT_S, Propagation
from terrafix.messages import MapMatch, Message, Odometry, Prediction, VehicleState, Verdict

FIRST, END, FRAMES = 30, 42, 70  # frames of the lie, of the flight
LATER = 9  # frames: the other flight has turned by then


def odometry_of(messages: list[Message]) -> Odometry:
    return next(m for m in messages if isinstance(m, Odometry))


def without(messages: list[Message], *kinds: type[Message]) -> list[Message]:
    return [m for m in messages if not isinstance(m, kinds)]


def foreign(other: Flight, i: int) -> Odometry:
    """Frame i shows ``other`` as it is LATER frames on. Two that match each other are a new fragment."""
    said = odometry_of(other.messages(i + LATER))
    if i == FIRST:
        said = blind(said)
    keyframe_id = max(said.keyframe_id - LATER, FIRST)
    return msgspec.structs.replace(said, t_ns=t_ns(i), frame_id=i, keyframe_id=keyframe_id)


def flown(lie: dict[int, Odometry], flight: Flight, *, fixes: bool = True) -> Listener:
    """``lie``: odometry instead of the flight's own, in frames that find nothing on the map."""
    listener = Listener().fly(flight, 0, FIRST)
    for i in range(FIRST, FRAMES):
        messages = flight.messages(i)
        if i in lie:
            messages = [*without(messages, Odometry, MapMatch), lie[i]]
        elif i == END:  # its keyframe showed something else: it begins a fragment, to which later frames refer
            messages = [blind(m) if isinstance(m, Odometry) else m for m in messages]
        listener.hear(messages if fixes else without(messages, MapMatch))
    return listener


def mahalanobis(listener: Listener, flight: Flight, i: int) -> float:
    said = listener.estimate(i)
    off = error_m(said, flight)[:2]
    return math.sqrt(float(off @ np.linalg.solve(cov_of(said)[:2, :2], off)))


def is_false(listener: Listener, flight: Flight, i: int) -> bool:
    """More than 50 m and more than three sigmas off."""
    off_m = float(np.linalg.norm(error_m(listener.estimate(i), flight)[:2]))
    return off_m > 50.0 and mahalanobis(listener, flight, i) > 3.0


@pytest.mark.parametrize("speed_mps", [3.0, 6.0, 12.0, 25.0, 45.0])
def test_pictures_of_another_flight_move_nothing(speed_mps: float) -> None:
    flight = Flight(FRAMES, seed=5)
    other = Flight(FRAMES + LATER, seed=11, speed_mps=speed_mps, turns_rad=2.0)
    listener = flown({i: foreign(other, i) for i in range(FIRST, END)}, flight)
    assert not any(is_false(listener, flight, i) for i in range(FIRST, FRAMES))
    assert listener.verdicts("odometry")[FRAMES - 1].verdict is Verdict.ACCEPTED
    assert np.linalg.norm(error_m(listener.estimate(FRAMES - 1), flight)[:2]) < 12.0


def test_a_foreign_motion_that_cannot_be_ours_is_not_fused() -> None:
    flight = Flight(FRAMES, seed=5)
    other = Flight(FRAMES + LATER, seed=11, speed_mps=45.0, turns_rad=2.0)
    listener = flown({i: foreign(other, i) for i in range(FIRST, END)}, flight)
    verdicts = listener.verdicts("odometry")
    assert {verdicts[i].verdict for i in range(FIRST + 1, END)} <= {Verdict.UNCONFIRMED, Verdict.IMPLAUSIBLE}
    assert max(mahalanobis(listener, flight, i) for i in range(FIRST, FRAMES)) < 3.5


def test_pictures_that_begin_like_this_flight_and_then_turn_are_not_it() -> None:
    """Same speed, same course, for two frames; the reported heading does not turn with them."""
    flight = Flight(FRAMES, seed=5)
    other = Flight(FRAMES, seed=11, turns_rad=-2.5)
    said = {i: odometry_of(other.messages(i)) for i in range(FIRST, END)}
    lie = {i: msgspec.structs.replace(m, keyframe_id=max(m.keyframe_id, FIRST)) for i, m in said.items()}
    listener = flown(lie | {FIRST: blind(said[FIRST])}, flight)
    assert max(mahalanobis(listener, flight, i) for i in range(FIRST, FRAMES)) < 3.5


def test_foreign_motion_teaches_neither_height_nor_calibration() -> None:
    flight = Flight(FRAMES, seed=5)
    other = Flight(FRAMES + LATER, seed=11, speed_mps=45.0, climbs_m=60.0)
    lied = flown({i: foreign(other, i) for i in range(FIRST, END)}, flight)
    dark = flown({i: blind(odometry_of(flight.messages(i))) for i in range(FIRST, END)}, flight)
    for i in range(FIRST, END):
        heights = [
            np.array([m.agl_m for m in run.said if isinstance(m, Prediction) and m.frame_id == i])
            for run in (lied, dark)
        ]
        assert heights[0] == pytest.approx(heights[1], abs=1.0)


def test_a_new_fragment_that_moves_as_predicted_is_the_flight_without_any_map() -> None:
    """Tracking was lost for three frames; what follows agrees with the velocity that was known."""
    flight = Flight(FRAMES, seed=6)
    begins = FIRST + 3
    lie = {i: blind(odometry_of(flight.messages(i))) for i in range(FIRST, begins + 1)}
    for i in range(begins + 1, FRAMES):
        said = odometry_of(flight.messages(i))
        lie[i] = msgspec.structs.replace(said, keyframe_id=max(said.keyframe_id, begins))
    # Pairs refer to the keyframe that they were seen from: those of an older one are not the new fragment's.
    lie = {i: m for i, m in lie.items() if m.verdict is not Verdict.ACCEPTED or m.keyframe_id >= begins}
    listener = flown({i: m for i, m in lie.items() if i < begins + 4}, flight, fixes=False)
    verdicts = listener.verdicts("odometry")
    assert verdicts[FRAMES - 1].verdict is Verdict.ACCEPTED
    assert mahalanobis(listener, flight, FRAMES - 1) < 3.5


@pytest.mark.parametrize("said", [Verdict.AMBIGUOUS, Verdict.FEW_INLIERS, Verdict.DEGENERATE, "coarse"])
def test_looks_that_find_nothing_where_every_look_found_a_pose_speak_against_a_new_fragment(
    said: Verdict | str,
) -> None:
    """It moves as predicted, which would join it; one pose joins it."""
    flight = Flight(FRAMES, seed=6, fix_every=1)
    listener = Listener().fly(flight, 0, FIRST)
    for i in range(FIRST, END):
        odometry, match = odometry_of(flight.messages(i)), flight.fix(i)
        if i == FIRST:
            odometry = blind(odometry)
        if said == "coarse":
            match = msgspec.structs.replace(match, coarse=True)
        elif isinstance(said, Verdict):
            match = msgspec.structs.replace(match, verdict=said)
        listener.hear([*without(flight.messages(i), Odometry, MapMatch), odometry, match])
    verdicts = listener.verdicts("odometry")
    assert all(verdicts[i].verdict is Verdict.UNCONFIRMED for i in range(FIRST + 1, END))
    listener.hear([flight.fix(END - 1), *flight.messages(END)])
    assert listener.verdicts("odometry")[END].verdict is Verdict.ACCEPTED


def test_the_motion_of_an_unjoined_fragment_is_predicted_from_its_keyframe_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Velocity led the keyframe there, too, so that its error counts over all of the time since."""
    predicted = Propagation._motion_innovation
    beyond: list[float] = []

    def spy(tracker: Propagation, t_s: float, p_m: np.ndarray, parent: int, *rest: Any) -> MotionInnovation:
        innovation = predicted(tracker, t_s, p_m, parent, *rest)
        if not tracker._fragments.of(parent).joined:
            since_s = t_s - tracker.graph.time_of(parent)
            velocity_m2 = tracker._velocity_cov[:2, :2] * since_s**2
            beyond.append(float(np.linalg.eigvalsh(innovation.cov_m2[:2, :2] - velocity_m2)[0]))
        return innovation

    monkeypatch.setattr(Propagation, "_motion_innovation", spy)
    flight = Flight(FRAMES, seed=5)
    other = Flight(FRAMES + LATER, seed=11, speed_mps=3.0, turns_rad=2.0)
    flown({i: foreign(other, i) for i in range(FIRST, END)}, flight)
    assert len(beyond) > 5 and min(beyond) > 0.0


def test_the_anchor_follows_what_pictures_show_and_returns_to_the_flight_afterwards() -> None:
    flight = Flight(FRAMES, seed=5)
    other = Flight(FRAMES + LATER, seed=11, speed_mps=25.0, turns_rad=2.0)
    listener = flown({i: foreign(other, i) for i in range(FIRST, END)}, flight)
    steps = {m.frame_id: np.array(m.step_m) for m in listener.said if isinstance(m, Prediction)}
    theirs_m = np.linalg.norm(np.diff(other.p_m[FIRST + LATER : END + LATER, :2], axis=0), axis=1).sum()
    assert sum(np.linalg.norm(steps[i]) for i in range(FIRST + 1, END)) == pytest.approx(theirs_m, rel=0.1)
    ours = (flight.p_m[END + 3] - flight.p_m[FIRST - 1])[:2]
    assert np.linalg.norm(sum(steps[i] for i in range(FIRST, END + 4)) - ours) < 40.0  # dead reckoning of six seconds


def frozen(flight: Flight, i: int) -> Odometry:
    """The picture of frame FIRST - 1 again: every ray is where it was."""
    said = odometry_of(flight.messages(FIRST - 1))
    pairs = [(x, y, x, y) for x, y, _, _ in said.pairs]
    return msgspec.structs.replace(
        said, t_ns=t_ns(i), frame_id=i, keyframe_id=FIRST - 1, pairs=pairs, becomes_keyframe=False, static=True
    )


def test_a_frozen_camera_is_not_a_vehicle_that_stands() -> None:
    flight = Flight(FRAMES, seed=7)
    # The picture before the lie is a keyframe of its own.
    listener = flown({i: frozen(flight, i) for i in range(FIRST, END)}, flight)
    verdicts = listener.verdicts("odometry")
    assert all(verdicts[i].verdict is Verdict.STALLED for i in range(FIRST, END))
    assert max(mahalanobis(listener, flight, i) for i in range(FIRST, FRAMES)) < 3.5
    way_m = np.linalg.norm((flight.p_m[END - 1] - flight.p_m[FIRST - 1])[:2])
    assert np.linalg.norm(error_m(listener.estimate(END - 1), flight)[:2]) < 0.5 * way_m


def test_a_frozen_picture_is_not_shown_to_the_anchor() -> None:
    flight = Flight(FRAMES, seed=7)
    listener = flown({i: frozen(flight, i) for i in range(FIRST, END)}, flight)
    predicted = {m.frame_id for m in listener.said if isinstance(m, Prediction)}
    assert not predicted & set(range(FIRST, END))
    assert predicted >= {FIRST - 1, *range(END, FRAMES)}


@pytest.mark.parametrize("found", [True, False])
def test_a_frozen_camera_is_recognised_where_no_heading_is_reported(found: bool) -> None:
    """``found``: the map has told the heading by then. Else nothing predicts the motion, but the time tells."""
    flight, listener = Flight(FRAMES, seed=7, knows=frozenset({"attitude", "height"})), Listener()
    listener.hear([ORIGIN])
    for i in range(FRAMES):
        messages = flight.messages(i) if found and i < FIRST else without(flight.messages(i), MapMatch)
        if FIRST <= i < END:
            messages = [*without(messages, Odometry), frozen(flight, i)]
        elif i == END:  # its keyframe showed something else
            messages = [blind(m) if isinstance(m, Odometry) else m for m in messages]
        listener.hear(messages)
    verdicts = listener.verdicts("odometry")
    lasts = FIRST + round(AT_REST_S / FRAME_S)
    assert all(verdicts[i].verdict is Verdict.STALLED for i in range(lasts, END))
    assert verdicts[FRAMES - 1].verdict is Verdict.ACCEPTED


def test_a_frozen_picture_stays_one_when_the_graph_begins_anew() -> None:
    """Its keyframe is older than the new graph; that does not make it a picture for the anchor."""
    flight = Flight(FRAMES, seed=7)
    listener = Listener().fly(flight, 0, FIRST)
    for i in range(FIRST, END):
        listener.hear([*without(flight.messages(i), Odometry, MapMatch), frozen(flight, i)])
        if i == FIRST + 2:
            listener.hear([msgspec.structs.replace(flight.fix(FIRST - 1), found=True)])
    verdicts = listener.verdicts("odometry")
    assert all(verdicts[i].verdict is Verdict.STALLED for i in range(FIRST, END))


def test_a_view_that_changed_while_nothing_was_tracked_ends_a_frozen_picture() -> None:
    flight = Flight(FRAMES, seed=7)
    hover = msgspec.structs.replace(frozen(flight, FIRST), pairs=[])  # static, and nothing is tracked in it
    lie = {FIRST: frozen(flight, FIRST), FIRST + 1: blind(frozen(flight, FIRST + 1))}
    lie[FIRST + 2] = msgspec.structs.replace(hover, t_ns=t_ns(FIRST + 2), frame_id=FIRST + 2)
    verdicts = flown(lie, flight).verdicts("odometry")
    assert verdicts[FIRST].verdict is Verdict.STALLED
    assert verdicts[FIRST + 2].verdict is Verdict.FEW_INLIERS


def test_pictures_that_vision_skips_do_not_end_a_frozen_one() -> None:
    flight = Flight(FRAMES, seed=7)
    lie = {i: frozen(flight, i) for i in range(FIRST, END)}
    for i, verdict in ((FIRST + 1, Verdict.STALLED), (FIRST + 3, Verdict.BAD_IMAGE)):
        lie[i] = blind(lie[i], verdict)
        lie[i + 1] = msgspec.structs.replace(lie[i + 1], pairs=[])
    verdicts = flown(lie, flight).verdicts("odometry")
    assert [verdicts[i].verdict for i in (FIRST + 1, FIRST + 2)] == [Verdict.STALLED] * 2
    assert [verdicts[i].verdict for i in (FIRST + 3, FIRST + 4)] == [Verdict.BAD_IMAGE, Verdict.STALLED]


def test_the_step_after_frames_that_the_anchor_did_not_see_is_known_as_the_way_over_all_of_them() -> None:
    flight = Flight(FRAMES, seed=7)
    listener = flown({i: frozen(flight, i) for i in range(FIRST, END)}, flight)
    said = {m.frame_id: m for m in listener.said if isinstance(m, Prediction)}
    truth_m = (flight.p_m[END] - flight.p_m[FIRST - 1])[:2]
    sigma = math.sqrt(said[END].step_cov_m2[0])
    assert np.linalg.norm(said[END].step_m - truth_m) < 3.5 * sigma
    grown_m2 = cov_of(listener.estimate(END))[:2, :2] - cov_of(listener.estimate(FIRST - 1))[:2, :2]
    assert sigma > 0.7 * math.sqrt(np.linalg.eigvalsh(grown_m2)[-1])
    assert math.sqrt(said[END + 1].step_cov_m2[0]) < 0.5 * sigma


def test_two_frames_with_one_time_stamp_are_no_evidence_of_motion() -> None:
    flight = Flight(FRAMES, seed=5)
    still = msgspec.structs.replace(frozen(flight, FIRST + 1), t_ns=t_ns(FIRST), keyframe_id=FIRST, static=False)
    listener = Listener().fly(flight, 0, FIRST)
    listener.hear([*without(flight.messages(FIRST), Odometry, MapMatch), blind(odometry_of(flight.messages(FIRST)))])
    listener.hear([still])
    assert listener.verdicts("odometry")[FIRST + 1].verdict is Verdict.UNCONFIRMED


@pytest.mark.parametrize(("speed_mps", "then"), [(110.0, Verdict.ACCEPTED), (150.0, Verdict.IMPLAUSIBLE)])
def test_velocity_that_odometry_contradicts_for_seconds_is_given_up_once(speed_mps: float, then: Verdict) -> None:
    """Nothing tells which of the two is wrong, so the claim must hold for both."""
    flight, impossible = Flight(FRAMES, seed=8), Flight(FRAMES, seed=8, speed_mps=speed_mps)
    listener = Listener().fly(flight, 0, FIRST)
    timeout = FIRST + 2 + round(MOTION_TIMEOUT_S / FRAME_S)  # the first frame that is surely later than it
    for i in range(FIRST, timeout + 4):
        said = odometry_of(impossible.messages(i))
        if i == FIRST:  # one motion that is possible: the five seconds begin after it
            said = odometry_of(flight.messages(i))
        listener.hear([*without(flight.messages(i), Odometry, MapMatch), said])
    verdicts = listener.verdicts("odometry")
    assert all(verdicts[i].verdict is Verdict.IMPLAUSIBLE for i in range(FIRST + 1, timeout + 1))
    assert list(listener.verdicts("reset")) == [timeout]
    assert "contradicts velocity for 5 s" in listener.verdicts("reset")[timeout].detail
    assert sigma_m(listener.estimate(timeout)) > 15.0
    assert listener.estimate(timeout).velocity_sigma_mps >= MAX_SPEED_SIGMA_MPS[0]
    assert verdicts[timeout + 1].verdict is then


def test_a_coarse_match_does_not_join_a_fragment_to_the_flight() -> None:
    """It says what the belief remembers; pictures of another flight have no part in it."""
    flight = Flight(FRAMES, seed=5)
    other = Flight(FRAMES + LATER, seed=11, speed_mps=45.0, turns_rad=2.0)
    listener = Listener().fly(flight, 0, FIRST)
    for i in range(FIRST, FIRST + 3):
        coarse = msgspec.structs.replace(flight.fix(i), coarse=True)
        listener.hear([*without(flight.messages(i), Odometry, MapMatch), foreign(other, i), coarse])
    verdicts = listener.verdicts("map")
    assert [verdicts[i].verdict for i in range(FIRST, FIRST + 3)] == [Verdict.UNCONFIRMED] * 3
    assert listener.estimate(FIRST + 2).last_anchor_age_ms > 0


def test_a_height_that_keeps_the_anchor_from_looking_is_given_up_for_the_reported_one() -> None:
    flight = Flight(30, seed=3, dem=True)
    listener = Listener().fly(flight, 0, 20)
    fix = flight.fix(19)
    assert fix.p_c_in_w_m is not None
    low = msgspec.structs.replace(fix, found=True, p_c_in_w_m=(*fix.p_c_in_w_m[:2], 15.0))
    listener.hear([low])
    assert listener.estimate(19).agl_m < 20.0
    listener.hear(without(flight.messages(20), MapMatch))
    resets = listener.verdicts("reset")
    assert list(resets) == [20] and "are reported" in resets[20].detail
    assert listener.estimate(20).agl_m == pytest.approx(flight.p_m[20, 2], abs=15.0)
    for i in range(21, 30):
        listener.hear(flight.messages(i))
    assert list(listener.verdicts("reset")) == [20]


@pytest.mark.parametrize("reported_m", [20.0, 40.0])
def test_a_reported_height_that_would_hardly_be_looked_from_resets_nothing(reported_m: float) -> None:
    flight = Flight(25, seed=3, dem=True)
    listener = Listener().fly(flight, 0, 20)
    fix = flight.fix(19)
    assert fix.p_c_in_w_m is not None
    listener.hear([msgspec.structs.replace(fix, found=True, p_c_in_w_m=(*fix.p_c_in_w_m[:2], 15.0))])
    state = next(m for m in flight.messages(20) if isinstance(m, VehicleState))
    listener.hear([msgspec.structs.replace(state, agl_m=reported_m), odometry_of(flight.messages(20))])
    assert listener.estimate(20).agl_m < 25.0 and listener.verdicts("reset") == {}


def test_without_a_map_of_the_ground_a_low_height_resets_nothing() -> None:
    flight = Flight(25, seed=3)
    listener = Listener().fly(flight, 0, 20)
    fix = flight.fix(19)
    assert fix.p_c_in_w_m is not None
    listener.hear([msgspec.structs.replace(fix, found=True, p_c_in_w_m=(*fix.p_c_in_w_m[:2], 15.0))])
    listener.hear(without(flight.messages(20), MapMatch))
    assert listener.estimate(20).agl_m < 25.0 and listener.verdicts("reset") == {}


def test_the_height_after_a_reset_is_the_reported_one_above_the_take_off() -> None:
    """The take-off was 60 m higher than the ground here."""
    flight, above_m = Flight(25, seed=3, dem=True), 60.0
    listener = Listener()
    listener.hear([msgspec.structs.replace(ORIGIN, ground_amsl_m=above_m)])
    for i in range(21):
        for m in flight.messages(i):
            if isinstance(m, VehicleState) and m.agl_m is not None:
                m = msgspec.structs.replace(m, agl_m=m.agl_m - above_m)
            if i < 20 or not isinstance(m, MapMatch):
                listener.hear([m])
        if i == 19:
            fix = flight.fix(19)
            assert fix.p_c_in_w_m is not None
            listener.hear([msgspec.structs.replace(fix, found=True, p_c_in_w_m=(*fix.p_c_in_w_m[:2], 15.0))])
    assert list(listener.verdicts("reset")) == [20]
    assert listener.estimate(20).agl_m == pytest.approx(flight.p_m[20, 2], abs=15.0)


def test_a_flight_at_its_reported_height_is_never_reset() -> None:
    flight = Flight(30, seed=3, dem=True, climbs_m=0.0)
    assert Listener().fly(flight, 0, 30).verdicts("reset") == {}
