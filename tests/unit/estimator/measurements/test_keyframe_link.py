"""Further keyframes of a frame: what they add, wrong ones, and frames whose own keyframe gives no motion."""

import msgspec
import numpy as np
import pytest

from simulated_flight import (
    ORIGIN,
    EstimatorRun,
    Flight,
    cov_of,
    error_m,
    same_features,
    sigma_m,
    some_features,
    t_ns,
)
from terrafix.core.gate import GATE
from terrafix.estimator.graph.pose_graph import NewNode, PoseGraph
from terrafix.messages import Health, KeyframeLink, MapMatch, Message, Odometry, ThermalBand, Verdict

FRAMES, MAP_UNTIL = 30, 4


def link(flight: Flight, keyframe: int, i: int, *, shown: int | None = None) -> KeyframeLink:
    """Frame i sees the ground of ``keyframe``; or, by mistake, that of the frame ``shown``."""
    seen = same_features(flight, keyframe if shown is None else shown, i, some_features())
    return KeyframeLink(
        keyframe_id=keyframe, two_view=seen.two_view, sigma_norm=seen.sigma_norm, inliers=40, tracked=50
    )


def photos(flight: Flight, i: int, links: list[KeyframeLink]) -> list[Message]:
    """Messages of frame i without a map match: every frame is a keyframe, and registered to the one before."""
    kept = [m for m in flight.messages(i) if not isinstance(m, MapMatch | Odometry)]
    odometry = msgspec.structs.replace(
        same_features(flight, i - 1, i, some_features()), becomes_keyframe=True, fragment_id=0, links=links
    )
    return [*kept, odometry]


def flown(flight: Flight, linked: tuple[int, ...] = (), end: int = FRAMES) -> EstimatorRun:
    """``linked``: how many frames before a frame its further keyframes are."""
    run = EstimatorRun().fly(flight, 0, MAP_UNTIL)
    for i in range(MAP_UNTIL, end):
        run.feed(photos(flight, i, [link(flight, i - back, i) for back in linked if i - back >= 0]))
    return run


def flight_of(seed: int) -> Flight:
    return Flight(FRAMES, seed=seed, fix_every=1)


@pytest.mark.slow
def test_links_narrow_the_claim_and_it_holds() -> None:
    """Over several flights without a map, with links to the fourth and the eighth frame before."""
    errors_m, sigmas_m, d2 = [], list[tuple[float, float]](), []
    for seed in range(5):
        flight = flight_of(seed)
        alone, linked = flown(flight, end=24), flown(flight, (4, 8), end=24)
        assert {v.verdict for v in linked.verdicts("link").values()} == {Verdict.ACCEPTED}
        sigmas_m.append((sigma_m(alone.estimate(23)), sigma_m(linked.estimate(23))))
        off_m = error_m(linked.estimate(23), flight)[:2]
        errors_m.append(float(np.hypot(*off_m)))
        d2.append(float(off_m @ np.linalg.solve(cov_of(linked.estimate(23))[:2, :2], off_m)))
    assert all(b < 0.85 * a for a, b in sigmas_m)
    assert max(d2) < GATE[2] and np.mean(d2) < 4.1  # chi-square of the mean of five: 97.5 %


def test_the_information_of_a_frame_is_shared_by_its_keyframes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of three keyframes each has a third: their noise, and that of the ground below them, is larger by root three."""
    flight, added = flight_of(2), list[NewNode]()
    extend = PoseGraph.extend

    def recorded(graph: PoseGraph, t_s: float, new: NewNode) -> int:
        added.append(new)
        return extend(graph, t_s, new)

    monkeypatch.setattr(PoseGraph, "extend", recorded)
    for linked in ((), (2, 3)):
        run = flown(flight, end=12)
        run.feed(photos(flight, 12, [link(flight, 12 - back, 12) for back in linked]))
    alone, shared = added[len(added) // 2 - 1], added[-1]
    assert (len(alone.links), len(shared.links)) == (0, 2)
    one, third = alone.motion.rays, shared.motion.rays
    assert one is not None and third is not None
    assert third.sigma == pytest.approx(np.sqrt(3.0) * one.sigma)
    assert third.ground.level_sigma_m == pytest.approx(np.sqrt(3.0) * one.ground.level_sigma_m)
    assert all(rays.sigma > 1.5 * one.sigma for _, rays in shared.links)


def test_a_wrong_link_is_rejected_and_changes_nothing() -> None:
    flight = flight_of(3)
    without, wrong = flown(flight, end=20), flown(flight, end=20)
    without.feed(photos(flight, 20, []))
    wrong.feed(photos(flight, 20, [link(flight, 17, 20, shown=12)]))
    assert wrong.verdicts("link")[20].verdict is Verdict.INNOVATION
    assert "keyframe 17" in wrong.verdicts("link")[20].detail
    assert np.array_equal(error_m(wrong.estimate(20), flight), error_m(without.estimate(20), flight))
    assert wrong.estimate(20).cov == without.estimate(20).cov


@pytest.mark.parametrize("reason", ["left the window", "too few matches"])
def test_without_a_motion_since_its_keyframe_a_frame_is_placed_by_its_first_link(reason: str) -> None:
    flight = flight_of(4)
    run = flown(flight, end=24)
    messages = photos(flight, 24, [link(flight, 22, 24), link(flight, 21, 24)])
    odometry = messages[-1]
    assert isinstance(odometry, Odometry)
    changed = {"keyframe_id": 1} if reason == "left the window" else {"two_view": odometry.two_view[:5]}
    run.feed([*messages[:-1], msgspec.structs.replace(odometry, **changed)])
    assert run.verdicts("odometry")[24].verdict is Verdict.ACCEPTED
    assert run.verdicts("link")[24].verdict is Verdict.ACCEPTED
    assert "keyframe 21" in run.verdicts("link")[24].detail
    placed = flown(flight, end=24)
    placed.feed(photos(flight, 24, []))
    assert sigma_m(run.estimate(24)) < 1.1 * sigma_m(placed.estimate(24))


def test_a_hot_computer_uses_no_links() -> None:
    """Their gate needs marginals, of which none is computed then."""
    flight = flight_of(5)
    run = flown(flight, end=20)
    hot = Health(
        t_ns=t_ns(19), band=ThermalBand.HOT, temperature_c=90.0, throttled=True, disk_free_mb=None, cause="test"
    )
    run.feed([hot])
    run.feed(photos(flight, 20, [link(flight, 18, 20)]))
    assert run.verdicts("link")[20].verdict is Verdict.THROTTLED
    assert run.verdicts("odometry")[20].verdict is Verdict.ACCEPTED


def test_a_link_to_a_keyframe_outside_the_window_is_stale() -> None:
    flight = flight_of(6)
    run = flown(flight, end=28)
    run.feed(photos(flight, 28, [link(flight, 2, 28)]))
    assert run.verdicts("link")[28].verdict is Verdict.STALE
    assert ORIGIN.start_sigma_m > sigma_m(run.estimate(28))
