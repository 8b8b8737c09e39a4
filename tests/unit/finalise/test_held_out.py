"""The choice of the finalised solution by map matches that were held out, and loop closures in the batch solution."""

import csv
import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

from recorded_flight import blind_between, errors, messages, record, replayed_graph, seen_again
from simulated_flight import ORIGIN, Flight, t_ns
from terrafix.messages import Frame, MapMatch, Message, Refinement, SourceEnded
from terrafix_tools.before_after import kept_line
from terrafix_tools.finalise import held_out
from terrafix_tools.finalise.batch_smoother import smooth
from terrafix_tools.finalise.flight_graph import HELD_OUT_RUN, FlightGraph, FlightReplayer
from terrafix_tools.finalise.held_out import EVERY, MIN_RUNS, Comparison, choose
from terrafix_tools.finalise.run import finalise, last_lines

MATCHES = 160
KEYFRAME, AGAIN = 57, (100, 101, 102)  # frames: of a keyframe, and those that see its ground again


def compared(difference_m: float, matches: int = MATCHES) -> Comparison:
    """Distances of 3 m with a scatter of 1 m, and the same of another solution, changed by ``difference_m``."""
    rng = np.random.default_rng(3)
    before = 3.0 + rng.normal(0.0, 1.0, matches)
    return Comparison.of(before, before + difference_m + rng.normal(0.0, 0.5, matches), "m")


@pytest.mark.parametrize(
    ("difference_m", "better", "worse"), [(-0.5, True, False), (0.5, False, True), (0.0, False, False)]
)
def test_a_difference_counts_when_it_is_large_against_the_scatter_of_the_flight(
    difference_m: float, better: bool, worse: bool
) -> None:
    found = compared(difference_m)
    assert (found.better, found.worse, found.matches) == (better, worse, MATCHES)


def test_a_difference_between_few_matches_decides_nothing() -> None:
    for matches in (0, HELD_OUT_RUN, 3 * HELD_OUT_RUN):
        found = compared(-2.0, matches)
        assert not found.better and not found.worse and found.matches == matches


def test_four_runs_of_matches_need_a_larger_difference_than_forty() -> None:
    """Student's t: 95 % of 3 and of 39 degrees of freedom, from the tables."""
    assert compared(0.0, 4 * HELD_OUT_RUN)._limit == pytest.approx(2.353, rel=0.03)
    assert compared(0.0, 40 * HELD_OUT_RUN)._limit == pytest.approx(1.685, rel=0.01)


def test_a_wrong_match_does_not_decide_which_solution_is_better() -> None:
    rng = np.random.default_rng(5)
    before = 3.0 + rng.normal(0.0, 1.0, MATCHES)
    after = before - 0.5 + rng.normal(0.0, 0.3, MATCHES)
    before[20], after[20] = 300.0, 340.0
    assert Comparison.of(before, after, "m").better


def test_every_third_run_of_map_matches_is_held_out_and_never_reaches_the_estimator() -> None:
    flight = Flight(60, seed=2, fix_every=2)
    replayer = FlightReplayer(EVERY)
    for message in messages(flight):
        replayer.on(message)
    (graph,) = replayer.flights
    whole = replayed_graph(flight)
    runs, rest = divmod(len(whole.fixes), HELD_OUT_RUN)
    assert len(graph.held_out) == (runs // EVERY) * HELD_OUT_RUN + (rest if runs % EVERY == EVERY - 1 else 0)
    assert graph.held_out and not whole.held_out
    assert len(graph.fixes) + len(graph.held_out) == len(whole.fixes)
    assert not {fix.node for fix in graph.held_out} & {fix.node for fix in graph.fixes}


def test_a_flight_with_few_matches_is_finalised_with_its_refined_positions(tmp_path: Path) -> None:
    def stated(message: Message) -> Message:
        return msgspec.structs.replace(message, map_sigma_m=4.0) if isinstance(message, MapMatch) else message

    flight = Flight(36, seed=2)
    record(tmp_path, flight, stated)
    summary = finalise(tmp_path)
    (of_flight,) = summary["flights"]
    assert of_flight["solution"] == "refined" and of_flight["held_out"]["track"]["matches"] == 0
    assert any("no map match could be held out" in line for line in last_lines(summary, tmp_path))
    assert json.loads((tmp_path / "finalised.json").read_text(encoding="utf-8"))["flights"] == summary["flights"]
    replayer = FlightReplayer()
    refined: list[Refinement] = []
    for message in (*messages(flight, stated), SourceEnded(t_ns=t_ns(36), frames=36)):
        refined += [m for m in replayer.on(message) if isinstance(m, Refinement)]
    rows = list(csv.DictReader((tmp_path / "finalised.csv").read_text(encoding="utf-8").splitlines()))
    for pose, row in zip(refined[-1].poses, rows, strict=True):
        assert float(row["lat_deg"]) == pytest.approx(pose.lat_deg, abs=2e-8)
        assert float(row["sigma_e_m"]) == pytest.approx(pose.sigma_e_m, abs=1e-3)
        # The lens stays as described, 1 % of the focal length, 100 m above the ground.
        assert float(row["sigma_u_m"]) > 0.9
    assert kept_line({"before_after": []}) == "", "of a summary of an older version"


def test_after_a_reset_the_batch_solution_is_kept_unless_it_is_worse() -> None:
    """The start is 600 m off. The refined positions before the reset stay there, those of the batch smoother do not."""
    flight = Flight(60, seed=2, fix_every=3)

    def elsewhere(message: Message) -> Message | None:
        return None if isinstance(message, MapMatch) and message.frame_id < 20 else message

    replayer = FlightReplayer(EVERY)
    for message in messages(flight, elsewhere):
        replayer.on(message)
    (graph,) = replayer.flights
    graph.recorder.store_estimates()
    without = choose(graph)
    assert not without.kept and without.track is not None and not without.track.worse
    graph.recorder.nodes[30].again = True
    assert choose(graph).kept


def drifted(flight: Flight, again: tuple[int, ...]) -> FlightGraph:
    """A flight without a map after its first frames, and without odometry for 18 frames. The frames ``again`` see the
    ground of KEYFRAME, which is before these."""
    replayer, before = FlightReplayer(), -1
    for message in messages(flight, blind_between(62, 80)):
        if isinstance(message, Frame):
            if before in again:
                replayer.on(seen_again(flight, KEYFRAME, before))
            before = message.frame_id
        if not isinstance(message, MapMatch) or message.frame_id < 10:
            replayer.on(message)
    (graph,) = replayer.flights
    graph.recorder.store_estimates()
    return graph


@pytest.mark.slow
def test_loop_closures_bring_a_drifted_track_back_to_the_old_keyframe() -> None:
    ratios, last = [], AGAIN[-1]
    for seed in range(4):
        flight = Flight(last + 2, seed=seed, fix_every=3, speed_mps=3.0)
        graphs = drifted(flight, ()), drifted(flight, AGAIN)
        assert [len(graph.loops) for graph in graphs] == [0, 2]  # the first one is not confirmed yet
        steps_m = []
        for graph in graphs:
            errors_m, _ = errors(flight, graph, smooth(graph))
            steps_m.append(float(np.hypot(*(errors_m[last] - errors_m[KEYFRAME])[:2])))
        ratios.append(steps_m[1] / steps_m[0])
    assert float(np.median(ratios)) < 0.7


@pytest.mark.parametrize(("more_px", "kept"), [(0.0, True), (1.0, False)])
def test_a_lens_that_the_flight_determines_is_kept_unless_held_out_matches_are_worse_by_it(
    monkeypatch: pytest.MonkeyPatch, more_px: float, kept: bool
) -> None:
    matches = np.ones(4 * MIN_RUNS * HELD_OUT_RUN)
    monkeypatch.setattr(held_out, "smooth", lambda *_, **__: "described")
    monkeypatch.setattr(held_out, "_estimated", lambda *_: "estimated")
    monkeypatch.setattr(held_out, "_smoothed_px", lambda _, lens: matches + more_px * (lens == "estimated"))
    monkeypatch.setattr(held_out, "_in_flight_px", lambda _: matches)
    assert choose(FlightGraph(ORIGIN)).estimates_lens is kept
