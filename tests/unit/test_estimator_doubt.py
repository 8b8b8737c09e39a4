"""A position that proved wrong: withdrawn, and replaced by the one that a search has found."""

import msgspec
import numpy as np
from simulated_flight import FRAME_S, ORIGIN, SPEED_MPS, Flight, Listener, cov_of, error_m, sigma_m

from terrafix.estimator.doubt import Doubt
from terrafix.messages import MapMatch, Message, Refinement, SearchStep, SourceEnded, Verdict

WRONG_M = (700.0, -500.0)
LOST_SIGMA_M = 900.0


def lost(match: MapMatch, step: SearchStep = SearchStep.WIDEN) -> MapMatch:
    return msgspec.structs.replace(
        match, verdict=Verdict.LOST, step=step, lost_sigma_m=LOST_SIGMA_M, p_c_in_w_m=None, q_w_c=None, cov=None
    )


def silent(match: MapMatch) -> MapMatch:
    return msgspec.structs.replace(match, verdict=Verdict.BAD_IMAGE, p_c_in_w_m=None, q_w_c=None, cov=None)


def with_map(flight: Flight, i: int, match: MapMatch) -> list[Message]:
    return [m for m in flight.messages(i) if not isinstance(m, MapMatch)] + [match]


def flown_wrong(flight: Flight) -> Listener:
    """30 frames at a place that is 860 m off and sure of it, then ten on which the anchor says LOST."""
    run = Listener().fly(flight, 0, 1)
    for i in range(1, 30):
        run.hear(with_map(flight, i, flight.fix(i)))
    for i in range(30, 40):
        run.hear(with_map(flight, i, lost(flight.fix(i))))
    return run


def test_lost_means_that_the_position_claims_nothing() -> None:
    flight = Flight(60, seed=3)
    run = flown_wrong(flight)
    assert sigma_m(run.estimate(29)) < 10.0
    for i in range(30, 40):
        assert sigma_m(run.estimate(i)) > 0.99 * LOST_SIGMA_M
        assert run.verdicts("map")[i].verdict is Verdict.LOST
        assert run.verdicts("map")[i].detail == "lost; search: widen"
        assert run.verdicts("odometry")[i].verdict is Verdict.ACCEPTED  # which goes on meanwhile
        assert np.linalg.eigvalsh(cov_of(run.estimate(i))).min() > 0.0
    step = error_m(run.estimate(39), flight)[:2] - error_m(run.estimate(30), flight)[:2]
    assert np.linalg.norm(step) < 0.1 * 9 * FRAME_S * SPEED_MPS


def test_what_a_search_found_replaces_it_at_once() -> None:
    flight = Flight(60, seed=3, dem=True)
    run = flown_wrong(flight)
    found = msgspec.structs.replace(flight.fix(40, WRONG_M), found=True)
    run.hear(with_map(flight, 40, found))
    verdict = run.verdicts("map")[40]
    assert verdict.verdict is Verdict.ACCEPTED and "found 8" in verdict.detail
    assert np.linalg.norm(error_m(run.estimate(40), flight, WRONG_M)[:2]) < 20.0
    assert sigma_m(run.estimate(40)) < 15.0
    for i in range(41, 60):
        run.hear(with_map(flight, i, flight.fix(i, WRONG_M)))
        assert np.linalg.norm(error_m(run.estimate(i), flight, WRONG_M)[:2]) < 4 * sigma_m(run.estimate(i)) + 5.0
    assert sigma_m(run.estimate(59)) < 8.0


def test_a_place_that_is_found_and_still_tested_claims_the_doubt_of_it_until_the_map_takes_it_back() -> None:
    flight = Flight(60, seed=3, dem=True)
    run = flown_wrong(flight)
    found = msgspec.structs.replace(flight.fix(40, WRONG_M), found=True, lost_sigma_m=700.0)
    run.hear(with_map(flight, 40, found))
    assert run.verdicts("map")[40].verdict is Verdict.ACCEPTED
    assert 700.0 <= sigma_m(run.estimate(40)) < 720.0
    run.hear(with_map(flight, 41, msgspec.structs.replace(flight.fix(41, WRONG_M), lost_sigma_m=200.0)))
    assert 200.0 <= sigma_m(run.estimate(41)) < 220.0
    run.hear(with_map(flight, 42, flight.fix(42, WRONG_M)))
    assert sigma_m(run.estimate(42)) < 15.0


def test_the_same_fix_without_a_search_behind_it_is_refused() -> None:
    flight = Flight(60, seed=3)
    run = flown_wrong(flight)
    doubted = msgspec.structs.replace(flight.fix(40, WRONG_M), lost_sigma_m=LOST_SIGMA_M)
    run.hear(with_map(flight, 40, doubted))
    assert run.verdicts("map")[40].verdict is Verdict.INNOVATION
    assert sigma_m(run.estimate(40)) > 0.99 * LOST_SIGMA_M


def test_doubt_is_what_the_anchor_says_and_lies_in_the_plane() -> None:
    doubt = Doubt()
    flight = Flight(2)
    assert doubt.hear(lost(flight.fix(0), SearchStep.ASK)) == "lost; search: ask"
    assert doubt.added(np.eye(6))[0, 0] == 1.0 + LOST_SIGMA_M**2 and doubt.added(np.eye(6))[2, 2] == 1.0
    assert doubt.hear(msgspec.structs.replace(flight.fix(1), lost_sigma_m=5.0)) == ""
    assert doubt.added(np.eye(6))[1, 1] == 26.0
    doubt.hear(flight.fix(1))
    assert (doubt.added(np.eye(6)) == np.eye(6)).all()


def test_a_place_that_the_frames_speak_against_claims_less_before_it_is_given_up() -> None:
    flight = Flight(30, seed=3)
    run = Listener().fly(flight, 0, 20)
    said = msgspec.structs.replace(flight.fix(20), verdict=Verdict.AMBIGUOUS, lost_sigma_m=134.0)
    run.hear(with_map(flight, 20, said))
    run.hear(with_map(flight, 21, said))
    assert sigma_m(run.estimate(21)) > 134.0


def test_a_start_that_is_not_known_claims_nothing_from_the_first_frame_and_is_refined_all_the_same() -> None:
    flight = Flight(30, seed=3)
    run = Listener()
    run.hear([msgspec.structs.replace(ORIGIN, start_sigma_m=5000.0)])
    run.hear(flight.messages(0)[:2])
    for i in range(1, 10):
        run.hear(with_map(flight, i, lost(flight.fix(i)) if i % 2 else silent(flight.fix(i))))
    assert min(sigma_m(run.estimate(i)) for i in range(10)) > 5000.0
    run.hear(with_map(flight, 10, msgspec.structs.replace(flight.fix(10, WRONG_M), found=True)))
    for i in range(11, 30):
        run.hear(with_map(flight, i, flight.fix(i, WRONG_M)))
    assert np.linalg.norm(error_m(run.estimate(29), flight, WRONG_M)[:2]) < 10.0
    run.hear([SourceEnded(t_ns=0, frames=30)])
    (refined,) = [m for m in run.said if isinstance(m, Refinement)]
    assert len(refined.poses) == 30
