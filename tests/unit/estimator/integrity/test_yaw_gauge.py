"""A flight without a heading: the yaw stays unobservable until the first map match."""

import math

import msgspec
import numpy as np
import pytest

from map_matches import position_of, with_pose
from seeds import seeds
from simulated_flight import (
    ORIGIN,
    EstimatorRun,
    Flight,
    altered,
    cov_of,
    error_m,
    unaltered,
    without_fix,
    without_sight,
)
from terrafix.core.camera import Mount
from terrafix.core.geodesy import rot_from_quat, yaw_of
from terrafix.messages import MapMatch, Message, Prediction, VehicleState, Verdict

FIRST_MATCH = 27
TURN = 30  # frame at which it turns


def flown(knows: set[str], *, seed: int, coarse: bool = False) -> tuple[Flight, EstimatorRun]:
    """Until 15 s after the first match; with ``coarse`` that match has no pose."""
    flight, listener = Flight(FIRST_MATCH + 30, seed=seed, telemetry=frozenset(knows)), EstimatorRun()
    listener.fly(flight, 0, FIRST_MATCH, without_fix)
    listener.fly(
        flight,
        FIRST_MATCH,
        FIRST_MATCH + 1,
        lambda m: with_pose(m, position_only=True) if coarse and isinstance(m, MapMatch) else m,
    )
    return flight, listener.fly(flight, FIRST_MATCH + 1, flight.frames)


def headings_rad(listener: EstimatorRun) -> dict[int, float]:
    predicted = (m for m in listener.published if isinstance(m, Prediction))
    return {m.frame_id: yaw_of(rot_from_quat(m.q_w_c) @ Mount().r_b_c().T) for m in predicted}


@pytest.mark.parametrize("seed", seeds(2, 4))
@pytest.mark.parametrize("knows", [{"height", "attitude"}, {"height"}, set()], ids=["attitude", "height", "nothing"])
def test_the_yaw_stays_unobservable_until_the_first_map_match(knows: set[str], seed: int) -> None:
    flight, listener = flown(knows, seed=seed)
    yaw_rad = headings_rad(listener)
    truth_rad, first = [yaw_of(r) for r in flight.r_w_b], min(yaw_rad)
    for published in (m for m in listener.published if isinstance(m, Prediction) and first < m.frame_id <= FIRST_MATCH):
        i = published.frame_id
        assert published.cov[35] > 2.5**2
        # The gauge is constant: relative to the first frame the yaw is that of the vehicle.
        turned = math.remainder(yaw_rad[i] - yaw_rad[first] - truth_rad[i] + truth_rad[first], math.tau)
        assert abs(turned) < math.radians(5.0)
        off_m = np.array(published.p_c_in_w_m[:2]) - flight.p_m[i, :2]
        assert float(off_m @ np.linalg.solve(np.array(published.cov).reshape(6, 6)[:2, :2], off_m)) < 9.0
    assert listener.verdicts("map")[FIRST_MATCH].verdict is Verdict.ACCEPTED
    last = listener.estimate(flight.frames - 1)
    assert abs(math.remainder(yaw_rad[flight.frames - 1] - truth_rad[-1], math.tau)) < math.radians(4.0)
    off_m = error_m(last, flight)[:2]
    assert float(off_m @ np.linalg.solve(cov_of(last)[:2, :2], off_m)) < 13.8 and np.hypot(*off_m) < 15.0
    assert last.velocity_sigma_mps < 3.0


def test_without_a_heading_the_velocity_sigma_covers_all_directions() -> None:
    flight, listener = flown({"height"}, seed=2)
    published = listener.estimate(FIRST_MATCH - 1)
    assert published.velocity_sigma_mps >= np.hypot(*published.velocity_enu_mps[:2]) > 0.5 * flight.speed_mps


def test_a_coarse_match_does_not_observe_the_yaw() -> None:
    _, listener = flown({"height"}, seed=2, coarse=True)
    verdicts = listener.verdicts("map")
    assert verdicts[FIRST_MATCH].verdict is Verdict.AMBIGUOUS
    assert verdicts[FIRST_MATCH + 9].verdict is Verdict.ACCEPTED


def broken(seed: int, frames: int, turns_deg: float = 90.0, reported_from: int = 1000) -> tuple[Flight, EstimatorRun]:
    """No heading is reported before frame ``reported_from``. From the turn on ``frames`` have no odometry; map matches
    return 15 s after the turn."""
    flight = Flight(TURN + 42, seed=seed, turn_rad=math.radians(turns_deg))
    listener = EstimatorRun()
    listener.feed([ORIGIN])
    for i in range(flight.frames):
        alter = without_sight if TURN <= i < TURN + frames else without_fix if TURN <= i < TURN + 30 else unaltered
        messages = altered(flight.messages(i), alter)
        listener.feed(messages if i >= reported_from else map(without_heading, messages))
    return flight, listener


def without_heading(message: Message) -> Message:
    return msgspec.structs.replace(message, yaw_rad=None) if isinstance(message, VehicleState) else message


def distances2(flight: Flight, listener: EstimatorRun) -> list[float]:
    """Squared Mahalanobis distances of the horizontal position, from the turn on."""
    published = [listener.estimate(i) for i in range(TURN, flight.frames)]
    errors_m = [error_m(m, flight)[:2] for m in published]
    return [float(e @ np.linalg.solve(cov_of(m)[:2, :2], e)) for e, m in zip(errors_m, published, strict=True)]


@pytest.mark.parametrize("seed", seeds(1, 2))
@pytest.mark.parametrize("frames", [2, 4])
def test_a_turn_without_odometry_frees_the_yaw_gauge_again(frames: int, seed: int) -> None:
    flight, listener = broken(seed, frames)
    assert max(distances2(flight, listener)) < 9.2
    assert listener.verdicts("map")[TURN + 33].verdict is Verdict.ACCEPTED
    assert np.hypot(*error_m(listener.estimate(flight.frames - 1), flight)[:2]) < 15.0


@pytest.mark.slow
def test_the_yaw_sigma_grows_with_the_time_without_odometry() -> None:
    sigmas_rad = []
    for frames in (0, 1, 4, 16):
        _, listener = broken(1, frames, turns_deg=0.0)
        published = [m for m in listener.published if isinstance(m, Prediction) and m.frame_id == TURN + frames + 4]
        sigmas_rad.append(math.sqrt(published[-1].cov[35]))
    assert sigmas_rad[0] < math.radians(5.0)
    assert sigmas_rad[1:] == pytest.approx([math.radians(22.5), math.radians(90.0), 3.0], rel=0.1)


def test_a_pose_during_a_blackout_fixes_the_yaw_until_the_next_frame_without_odometry() -> None:
    flight, listener = Flight(TURN + 4, seed=1, telemetry=frozenset({"height"})), EstimatorRun()
    listener.fly(flight, 0, TURN).fly(flight, TURN, TURN + 1, without_fix)
    listener.fly(flight, TURN + 1, TURN + 3, without_sight)
    listener.feed([flight.fix(TURN + 2)])
    listener.fly(flight, TURN + 3, flight.frames, without_sight)
    sigmas_rad = {m.frame_id: math.sqrt(m.cov[35]) for m in listener.published if isinstance(m, Prediction)}
    assert sigmas_rad[TURN + 2] == pytest.approx(math.radians(45.0), rel=0.2)
    assert sigmas_rad[TURN + 3] == pytest.approx(math.radians(22.5), rel=0.2)


def test_a_reported_heading_fixes_a_free_yaw_gauge() -> None:
    flight, listener = broken(1, 4, reported_from=TURN + 12)
    assert max(distances2(flight, listener)) < 9.2
    published = [m for m in listener.published if isinstance(m, Prediction) and TURN + 13 <= m.frame_id < TURN + 33]
    truth_rad = [yaw_of(r) for r in flight.r_w_b]
    yaw_rad = headings_rad(listener)
    for m in published:
        assert m.cov[35] < math.radians(20.0) ** 2
        assert abs(math.remainder(yaw_rad[m.frame_id] - truth_rad[m.frame_id], math.tau)) < math.radians(15.0)


def test_a_match_far_outside_the_gate_does_not_fix_a_free_yaw_gauge() -> None:
    """A wrong match would move the whole graph. Three consistent ones over new ground do, as in other states."""
    far, listener = Flight(TURN + 42, seed=1, turn_rad=math.radians(90.0)), EstimatorRun()
    listener.feed([ORIGIN])
    for i in range(TURN + 4):
        listener.feed(map(without_heading, altered(far.messages(i), unaltered if i < TURN else without_sight)))
    listener.feed([moved(far.fix(TURN + 3), 600.0)])
    assert listener.verdicts("map")[TURN + 3].verdict is Verdict.INNOVATION


def moved(match: MapMatch, east_m: float) -> MapMatch:
    e_m, n_m, up_m = position_of(match)
    return with_pose(match, p_c_in_w_m=(e_m + east_m, n_m, up_m))
