"""Map matches that come late and out of order: each belongs to its own frame, and none is lost or counted twice."""

from itertools import pairwise

import msgspec
import numpy as np
import pytest

from map_matches import plane, with_search
from seeds import seeds
from simulated_flight import (
    ORIGIN,
    EstimatorRun,
    Flight,
    cov_of,
    error_m,
    sigma_m,
    t_ns,
    without_fix,
    without_sight,
)
from terrafix.messages import MapMatch, Message, NavEstimate, SourceEnded, SourceLabel, Verdict

LATEST = 4  # frames: two seconds


def late(flight: Flight, frames: int, seed: int, latest: int = LATEST) -> list[Message]:
    """All messages of a flight, each match 0 to ``latest`` frames late, so that they also overtake each other."""
    rng = np.random.default_rng([seed, 6])
    published: list[Message] = [ORIGIN]
    due: list[tuple[int, float, MapMatch]] = []
    for i in range(frames):
        for message in flight.messages(i):
            if isinstance(message, MapMatch):
                due.append((i + int(rng.integers(latest + 1)), float(rng.uniform()), message))
            else:
                published.append(message)
        published += [m for at, _, m in sorted(due, key=lambda d: d[1]) if at <= i]
        due = [d for d in due if d[0] > i]
    published += [m for _, _, m in due]
    return [*published, SourceEnded(t_ns=t_ns(frames - 1), frames=frames)]


def test_the_order_is_an_odd_one() -> None:
    """Or the tests below show nothing."""
    at = [m.frame_id for m in late(Flight(60, seed=5, fix_every=2), 60, seed=1) if isinstance(m, MapMatch)]
    assert sorted(at) == list(range(0, 60, 2)) and sum(b < a for a, b in pairwise(at)) >= 5


@pytest.mark.slow
def test_the_same_odd_order_gives_the_same_bytes() -> None:
    messages = late(Flight(60, seed=5, fix_every=2), 60, seed=1)
    runs = [EstimatorRun(), EstimatorRun()]
    for run in runs:
        run.feed(messages)
    assert msgspec.json.encode(runs[0].published) == msgspec.json.encode(runs[1].published)


@pytest.mark.slow
@pytest.mark.parametrize("seed", seeds(1, 2, 3))
def test_late_matches_are_worth_as_much_as_those_in_time(seed: int) -> None:
    """Once they have arrived: within a fifth of what both claim, and the claims within a tenth."""
    flight, frames = Flight(90, seed=seed, fix_every=3), 90
    timely, tardy = EstimatorRun().fly(flight, 0, frames), EstimatorRun()
    tardy.feed(late(flight, frames, seed))
    assert {v.verdict for v in tardy.verdicts("map").values()} == {Verdict.ACCEPTED}
    assert sorted(tardy.verdicts("map")) == list(range(0, frames, 3))
    a, b = timely.estimate(frames - 1), tardy.estimate(frames - 1)
    apart_m = error_m(a, flight)[:2] - error_m(b, flight)[:2]
    assert np.linalg.norm(apart_m) < 0.2 * sigma_m(a)
    assert sigma_m(b) == pytest.approx(sigma_m(a), rel=0.1)


@pytest.mark.slow
def test_covariance_is_consistent_while_matches_are_late() -> None:
    nees = []
    for seed in range(3):
        flight = Flight(80, seed=seed, fix_every=3)
        run = EstimatorRun()
        run.feed(late(flight, 80, seed))
        for i in range(20, 80):
            e = error_m(run.estimate(i), flight)[:2]
            nees.append(float(e @ np.linalg.solve(cov_of(run.estimate(i))[:2, :2], e)))
    assert 0.4 < np.mean(nees) < 3.0  # 2 would be exact; neighbours share their errors


def test_a_match_of_an_old_frame_publishes_the_newest_position_and_improves_it() -> None:
    flight = Flight(40, seed=2)
    run = EstimatorRun().fly(flight, 0, 28).fly(flight, 28, 40, without_fix)
    before = sigma_m(run.estimate(39))
    estimates = [m for m in run.feed([flight.fix(37)]) if isinstance(m, NavEstimate)]
    assert [(m.frame_id, m.t_ns, m.emitted_at_ns) for m in estimates] == [(39, t_ns(39), t_ns(39))]
    assert run.verdicts("map")[37].verdict is Verdict.ACCEPTED and sigma_m(estimates[0]) < 0.8 * before
    assert estimates[0].last_anchor_age_ms == 1000
    older = [m for m in run.feed([flight.fix(35)]) if isinstance(m, NavEstimate)]
    assert [m.last_anchor_age_ms for m in older] == [1000]  # the newest fix is still that of frame 37


def test_a_late_match_does_not_make_a_blind_frame_a_seen_one() -> None:
    flight = Flight(40, seed=2)
    run = EstimatorRun().fly(flight, 0, 37).fly(flight, 37, 40, without_sight)
    run.feed([flight.fix(36)])
    assert run.verdicts("map")[36].verdict is Verdict.ACCEPTED
    assert run.estimate(39).source_label is SourceLabel.DEAD_RECKONED
    run.feed([flight.fix(39)])
    assert run.estimate(39).source_label is SourceLabel.SATELLITE_ANCHORED


def test_of_two_matches_the_newer_one_knows_the_ground_below() -> None:
    flight = Flight(40, seed=2)
    run = EstimatorRun().fly(flight, 0, 40)
    high, low = (msgspec.structs.replace(flight.fix(i), ground=plane(up)) for i, up in ((39, 12.0), (36, 4.0)))
    run.feed([high])
    above_m = run.estimate(39).agl_m
    run.feed([low])
    assert run.estimate(39).agl_m == pytest.approx(above_m, abs=2.0)  # a fix moves it, too; the ground would by 8 m
    assert {run.verdicts("map")[i].verdict for i in (36, 39)} == {Verdict.ACCEPTED}


def test_what_a_search_found_knows_its_ground_however_late_it_is() -> None:
    flight = Flight(43, seed=9)
    run = EstimatorRun().fly(flight, 0, 30).fly(flight, 30, 42, without_fix)
    newer = msgspec.structs.replace(flight.fix(41), verdict=Verdict.AMBIGUOUS, ground=plane(0.0))
    found = with_search(msgspec.structs.replace(flight.fix(36, (300.0, 200.0)), ground=plane(20.0)), relocalized=True)
    run.feed([newer, found])
    estimate = run.estimate(41)
    assert estimate.alt_amsl_m - estimate.agl_m == pytest.approx(20.0, abs=0.5)
    # Frame 41 stays the newest one by whose match the ground was updated: that of frame 38 is older.
    run.feed([msgspec.structs.replace(flight.fix(38), verdict=Verdict.AMBIGUOUS, ground=plane(4.0))])
    run.feed([m for m in flight.messages(42) if not isinstance(m, MapMatch)])
    estimate = run.estimate(42)
    assert estimate.alt_amsl_m - estimate.agl_m == pytest.approx(20.0, abs=0.5)


def test_a_match_that_has_left_the_window_is_stale_and_changes_nothing() -> None:
    flight = Flight(60, seed=3)
    run = EstimatorRun().fly(flight, 0, 60)
    before = run.estimate(59)
    answers = run.feed([flight.fix(20)])
    assert run.verdicts("map")[20].verdict is Verdict.STALE
    assert not any(isinstance(m, NavEstimate) for m in answers) and run.estimate(59) == before
    run.feed([msgspec.structs.replace(flight.fix(59), frame_id=4711)])  # of a frame that never was
    assert run.verdicts("map")[4711].verdict is Verdict.STALE


def test_a_match_after_the_end_of_the_flight_is_stale() -> None:
    """The anchor is still at its last picture when the source has ended."""
    flight = Flight(60, seed=3)
    run = EstimatorRun().fly(flight, 0, 59)
    run.feed([m for m in flight.messages(59) if not isinstance(m, MapMatch)])
    run.feed([SourceEnded(t_ns=t_ns(59), frames=60)])
    answers = run.feed([flight.fix(59)])
    assert run.verdicts("map")[59].verdict is Verdict.STALE
    assert not any(isinstance(m, NavEstimate) for m in answers)
