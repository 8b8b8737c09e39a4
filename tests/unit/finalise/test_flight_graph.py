"""The whole flight smoothed after landing: better than in flight, sure of what it is sure of, deaf to wrong matches."""

import msgspec
import numpy as np
import pytest

from simulated_flight import ORIGIN, Flight, Listener, error_m
from terrafix.core.geodesy import local_rotation_up
from terrafix.messages import MapMatch, Message, Verdict
from terrafix_tools.finalise.batch_smoother import smooth
from terrafix_tools.finalise.flight_graph import FlightReplayer
from told_flight import blind_between, errors, nees, shifted, told, unmatched

FAR_M = (350.0, -200.0)


def median_m(off: np.ndarray) -> float:
    return float(np.median(np.hypot(off[:, 0], off[:, 1])))


@pytest.mark.slow
def test_it_is_better_than_in_flight_and_claims_what_it_is() -> None:
    squares, better = [], []
    for seed in range(6):
        flight = Flight(54, seed=seed, dem=True)  # without elevation claims leave room for hills
        retold = told(flight)
        off, covs = errors(flight, retold, smooth(retold))
        squares.append(nees(off, covs))
        heard = Listener().fly(flight, 0, flight.frames)
        immediate = np.array([error_m(heard.estimate(i), flight)[:2] for i in range(flight.frames)])
        better.append(median_m(off) / median_m(immediate))
    assert np.median(better) < 0.9
    assert 1.2 < float(np.mean(squares)) < 3.0  # 2 is honest; the errors of one flight hang together
    assert np.mean(np.concatenate(squares) < 5.991) > 0.88


@pytest.mark.slow
def test_wrong_matches_are_refused_even_three_that_agree() -> None:
    flight = Flight(90, seed=3, fix_every=5)
    wrong = {20: FAR_M, 45: (40.0, 30.0), 50: (40.0, 30.0), 55: (40.0, 30.0), 80: (-90.0, 200.0)}

    def alter(message: Message) -> Message | None:
        moved = wrong.get(message.frame_id) if isinstance(message, MapMatch) else None
        return shifted(message, moved) if moved and isinstance(message, MapMatch) else message

    retold, clean = told(flight, alter), told(flight)
    found = smooth(retold)
    frames = {node: frame for frame, node in retold.node_of.items()}
    refused = {frames.get(f.node) for f, b in zip(retold.fixes, found.believed, strict=True) if not b}
    assert refused >= set(wrong) and len(refused) <= len(wrong) + 1
    off, _ = errors(flight, retold, found)
    undisturbed, _ = errors(flight, clean, smooth(clean))
    assert median_m(off) < 1.25 * median_m(undisturbed) + 0.3


def test_a_blackout_is_bridged_from_both_sides() -> None:
    flight = Flight(90, seed=4)
    retold = told(flight, blind_between(30, 50))
    off, covs = errors(flight, retold, smooth(retold))
    sigma = np.sqrt(covs[:, 0, 0] + covs[:, 1, 1])
    assert sigma[40] > 1.5 * max(sigma[25], sigma[60])
    assert np.mean(nees(off, covs) < 9.21) > 0.95
    assert np.hypot(*off[60:].T).max() < 8.0


@pytest.mark.slow
@pytest.mark.parametrize(
    "knows", [{"yaw", "attitude", "height"}, {"attitude", "height"}, {"attitude"}], ids=["all", "no yaw", "no height"]
)
def test_what_was_flown_before_the_place_was_found_is_put_right(knows: set[str]) -> None:
    """The start coordinate is 900 m off, and without a compass the whole track is turned by 150 degrees, for so long
    that downhill from there is no way."""
    flight = Flight(150, seed=3, knows=frozenset(knows), dem=True)
    turn = local_rotation_up(0.0 if "yaw" in knows else np.radians(150.0))
    moved, first = (800.0, 400.0), 108

    def alter(message: Message) -> Message | None:
        if not isinstance(message, MapMatch):
            return message
        if message.frame_id < first:
            return unmatched(message)
        return msgspec.structs.replace(shifted(message, moved, turn), found=message.frame_id == first)

    retold = told(flight, alter)
    found = smooth(retold)
    assert sum(node.again for node in retold.graph.nodes) == 1 and found.start_believed == {0: False}
    off = [
        (found.poses[retold.node_of[i]].translation() - turn @ flight.p_m[i] - (*moved, 0.0))[:2]
        for i in range(flight.frames)
    ]
    assert np.hypot(*np.array(off).T).max() < 20.0
    assert found.placed.all() and found.believed.all()


def test_a_start_whose_heading_nobody_knows_is_a_start_all_the_same() -> None:
    """In flight its heading was chosen; here it is open, and the coordinate agrees with the map."""
    flight = Flight(60, seed=4, knows=frozenset({"attitude", "height"}), dem=True)
    retold = told(flight, lambda m: unmatched(m) if isinstance(m, MapMatch) and m.frame_id < 27 else m)
    found = smooth(retold)
    assert found.start_believed == {0: True}
    poses = [found.poses[retold.node_of[i]].translation() for i in range(flight.frames)]
    assert np.hypot(*(np.array(poses) - flight.p_m)[:, :2].T).max() < 15.0


def test_a_doubt_that_nothing_ended_is_kept() -> None:
    """The map said that the vehicle is not where it is believed to be, and its place was not found again."""
    flight = Flight(60, seed=9)

    def alter(message: Message) -> Message | None:
        if isinstance(message, MapMatch) and message.frame_id > 36:
            return msgspec.structs.replace(unmatched(message), verdict=Verdict.LOST, lost_sigma_m=300.0)
        return message

    retold = told(flight, alter)
    _, covs = errors(flight, retold, smooth(retold))
    assert covs[30, 0, 0] < 10.0**2 and covs[50, 0, 0] > 300.0**2


def test_matches_that_came_too_late_for_the_flight_are_used() -> None:
    """All of the middle of the flight come at its end."""
    flight = Flight(80, seed=5)
    held = [m for i in range(18, 55, 9) for m in flight.messages(i) if isinstance(m, MapMatch)]
    at = {m.frame_id for m in held}

    def alter(message: Message) -> Message | None:
        return None if isinstance(message, MapMatch) and message.frame_id in at else message

    without, late = told(flight, alter), told(flight, alter, held)
    assert len(late.fixes) == len(without.fixes) + len(held) == len(without.fixes) + 5
    found = smooth(late)
    assert found.believed.sum() >= len(late.fixes) - 1
    off, covs = errors(flight, late, found)
    _, covs_without = errors(flight, without, smooth(without))
    assert covs[36].trace() < 0.5 * covs_without[36].trace()
    assert np.hypot(*off[36]) < 8.0


def test_without_a_match_the_start_and_odometry_remain() -> None:
    flight = Flight(60, seed=6)
    retold = told(flight, lambda m: None if isinstance(m, MapMatch) else m)
    found = smooth(retold)
    off, covs = errors(flight, retold, found)
    assert found.placed.all() and not retold.fixes
    assert covs[-1].trace() > covs[0].trace() > 2.0 * 14.0**2
    assert nees(off, covs).max() < 13.8


def test_matches_at_the_end_that_contradict_the_rest_leave_both_places_open() -> None:
    """One mistake of odometry could explain them: nothing comes after that speaks against it."""
    flight = Flight(90, seed=7, fix_every=6)

    def alter(message: Message) -> Message | None:
        late = isinstance(message, MapMatch) and message.frame_id >= 72
        return shifted(message, (60.0, 0.0)) if late and isinstance(message, MapMatch) else message

    retold = told(flight, alter)
    found = smooth(retold)
    off, covs = errors(flight, retold, found)
    assert np.all(nees(off, covs)[75:] < 9.21) and covs[80, 0, 0] > 30.0**2


def test_a_record_of_two_flights_is_two_flights() -> None:
    storyteller, flight = FlightReplayer(), Flight(12, seed=8)
    for said in (ORIGIN, *flight.messages(0), *flight.messages(1)):
        storyteller.on(said)
    storyteller.on(ORIGIN)  # a new file of the record repeats it
    storyteller.on(msgspec.structs.replace(ORIGIN, t_ns=5))
    for said in flight.messages(0):
        storyteller.on(said)
    assert [len(f.node_of) for f in storyteller.flights] == [2, 1]
    assert storyteller.flights[0].refused.get(str(Verdict.STALE), 0) == 0
