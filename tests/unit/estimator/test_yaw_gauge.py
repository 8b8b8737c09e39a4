"""A flight whose heading nobody says: the estimator does not make one up, and the first map match tells it."""

import math

import msgspec
import numpy as np
import pytest

from simulated_flight import ORIGIN, Flight, Listener, blind, cov_of, error_m
from terrafix.core.camera import Mount
from terrafix.core.geodesy import rot_from_quat, yaw_of
from terrafix.messages import MapMatch, Odometry, Prediction, VehicleState, Verdict

FIRST_MATCH = 27
TURN = 30  # frame at which it turns


def flown(knows: set[str], *, seed: int, coarse: bool = False) -> tuple[Flight, Listener]:
    """To a quarter of a minute after the first match; with ``coarse`` that one has no pose of its own."""
    flight, listener = Flight(FIRST_MATCH + 30, seed=seed, knows=frozenset(knows)), Listener()
    listener.hear([ORIGIN])
    for i in range(flight.frames):
        messages = [m for m in flight.messages(i) if not (isinstance(m, MapMatch) and i < FIRST_MATCH)]
        if coarse and i == FIRST_MATCH:
            messages = [msgspec.structs.replace(m, coarse=True) if isinstance(m, MapMatch) else m for m in messages]
        listener.hear(messages)
    return flight, listener


def headings_rad(listener: Listener) -> dict[int, float]:
    predicted = (m for m in listener.said if isinstance(m, Prediction))
    return {m.frame_id: yaw_of(rot_from_quat(m.q_w_c) @ Mount().r_b_c().T) for m in predicted}


@pytest.mark.parametrize("seed", [2, 4])
@pytest.mark.parametrize("knows", [{"height", "attitude"}, {"height"}, set()], ids=["attitude", "height", "nothing"])
def test_the_heading_stays_open_until_a_match_says_it(knows: set[str], seed: int) -> None:
    flight, listener = flown(knows, seed=seed)
    yaw_rad = headings_rad(listener)
    truth_rad, first = [yaw_of(r) for r in flight.r_w_b], min(yaw_rad)
    for said in (m for m in listener.said if isinstance(m, Prediction) and first < m.frame_id <= FIRST_MATCH):
        i = said.frame_id
        assert said.cov[35] > 2.5**2
        # It is a choice of axes: what is seen turns the vehicle in them, and nothing turns the axes.
        turned = math.remainder(yaw_rad[i] - yaw_rad[first] - truth_rad[i] + truth_rad[first], math.tau)
        assert abs(turned) < math.radians(5.0)
        off_m = np.array(said.p_c_in_w_m[:2]) - flight.p_m[i, :2]
        assert float(off_m @ np.linalg.solve(np.array(said.cov).reshape(6, 6)[:2, :2], off_m)) < 9.0
    assert listener.verdicts("map")[FIRST_MATCH].verdict is Verdict.ACCEPTED
    last = listener.estimate(flight.frames - 1)
    assert abs(math.remainder(yaw_rad[flight.frames - 1] - truth_rad[-1], math.tau)) < math.radians(4.0)
    off_m = error_m(last, flight)[:2]
    assert float(off_m @ np.linalg.solve(cov_of(last)[:2, :2], off_m)) < 13.8 and np.hypot(*off_m) < 15.0
    assert last.velocity_sigma_mps < 3.0


def test_the_velocity_has_no_direction_without_a_heading() -> None:
    flight, listener = flown({"height"}, seed=2)
    said = listener.estimate(FIRST_MATCH - 1)
    assert said.velocity_sigma_mps >= np.hypot(*said.velocity_enu_mps[:2]) > 0.5 * flight.speed_mps


def test_a_match_without_a_pose_of_its_own_does_not_tell_the_heading() -> None:
    _, listener = flown({"height"}, seed=2, coarse=True)
    verdicts = listener.verdicts("map")
    assert verdicts[FIRST_MATCH].verdict is Verdict.AMBIGUOUS
    assert verdicts[FIRST_MATCH + 9].verdict is Verdict.ACCEPTED


def broken(seed: int, frames: int, turns_deg: float = 90.0, told_from: int = 1000) -> tuple[Flight, Listener]:
    """No heading is told before frame ``told_from``. From the turn on ``frames`` show nothing; the map is met again a
    quarter of a minute after it began."""
    flight = Flight(TURN + 42, seed=seed, turns_rad=math.radians(turns_deg))
    listener = Listener()
    listener.hear([ORIGIN])
    for i in range(flight.frames):
        messages = [m for m in flight.messages(i) if not (isinstance(m, MapMatch) and TURN <= i < TURN + 30)]
        if TURN <= i < TURN + frames:
            messages = [blind(m) if isinstance(m, Odometry) else m for m in messages]
        untold = [m if i >= told_from or not isinstance(m, VehicleState) else without_heading(m) for m in messages]
        listener.hear(untold)
    return flight, listener


def without_heading(state: VehicleState) -> VehicleState:
    return msgspec.structs.replace(state, yaw_rad=None)


def distances2(flight: Flight, listener: Listener) -> list[float]:
    """Squared Mahalanobis distances of the horizontal position, from the turn on."""
    said = [listener.estimate(i) for i in range(TURN, flight.frames)]
    return [float(error_m(m, flight)[:2] @ np.linalg.solve(cov_of(m)[:2, :2], error_m(m, flight)[:2])) for m in said]


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("frames", [2, 4])
def test_a_turn_that_nobody_saw_opens_the_heading_again(frames: int, seed: int) -> None:
    flight, listener = broken(seed, frames)
    assert max(distances2(flight, listener)) < 9.2
    assert listener.verdicts("map")[TURN + 33].verdict is Verdict.ACCEPTED
    assert np.hypot(*error_m(listener.estimate(flight.frames - 1), flight)[:2]) < 15.0


def test_the_longer_it_was_unseen_the_more_it_may_have_turned() -> None:
    sigmas_rad = []
    for frames in (0, 1, 4, 16):
        _, listener = broken(1, frames, turns_deg=0.0)
        said = [m for m in listener.said if isinstance(m, Prediction) and m.frame_id == TURN + frames + 4]
        sigmas_rad.append(math.sqrt(said[-1].cov[35]))
    assert sigmas_rad[0] < math.radians(5.0)
    assert sigmas_rad[1:] == pytest.approx([math.radians(22.5), math.radians(90.0), 3.0], rel=0.1)


def test_a_pose_in_the_dark_closes_it_until_the_next_break() -> None:
    flight, listener = Flight(TURN + 4, seed=1, knows=frozenset({"height"})), Listener()
    listener.hear([ORIGIN])
    for i in range(flight.frames):
        messages = [m for m in flight.messages(i) if not isinstance(m, MapMatch) or i < TURN]
        if i > TURN:
            messages = [blind(m) if isinstance(m, Odometry) else m for m in messages]
        listener.hear([*messages, flight.fix(i)] if i == TURN + 2 else messages)
    sigmas_rad = {m.frame_id: math.sqrt(m.cov[35]) for m in listener.said if isinstance(m, Prediction)}
    assert sigmas_rad[TURN + 2] == pytest.approx(math.radians(45.0), rel=0.2)
    assert sigmas_rad[TURN + 3] == pytest.approx(math.radians(22.5), rel=0.2)


def test_a_heading_that_is_told_at_last_closes_it() -> None:
    flight, listener = broken(1, 4, told_from=TURN + 12)
    assert max(distances2(flight, listener)) < 9.2
    said = [m for m in listener.said if isinstance(m, Prediction) and TURN + 13 <= m.frame_id < TURN + 33]
    truth_rad = [yaw_of(r) for r in flight.r_w_b]
    yaw_rad = headings_rad(listener)
    for m in said:
        assert m.cov[35] < math.radians(20.0) ** 2
        assert abs(math.remainder(yaw_rad[m.frame_id] - truth_rad[m.frame_id], math.tau)) < math.radians(15.0)


def test_one_match_far_from_where_it_can_be_does_not_tell_the_heading() -> None:
    """A wrong one would take the whole graph along; three that agree over new ground do, as ever."""
    far, listener = Flight(TURN + 42, seed=1, turns_rad=math.radians(90.0)), Listener()
    listener.hear([ORIGIN])
    for i in range(TURN + 4):
        messages = [m for m in far.messages(i) if not (isinstance(m, MapMatch) and i >= TURN)]
        if i >= TURN:
            messages = [blind(m) if isinstance(m, Odometry) else m for m in messages]
        if i == TURN + 3:
            messages.append(moved(far.fix(i), 600.0))
        listener.hear([without_heading(m) if isinstance(m, VehicleState) else m for m in messages])
    assert listener.verdicts("map")[TURN + 3].verdict is Verdict.INNOVATION


def moved(match: MapMatch, east_m: float) -> MapMatch:
    assert match.p_c_in_w_m is not None
    e_m, n_m, up_m = match.p_c_in_w_m
    return msgspec.structs.replace(match, p_c_in_w_m=(e_m + east_m, n_m, up_m))
