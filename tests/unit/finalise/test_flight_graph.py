"""Batch smoother after landing: accuracy, consistency, and rejection of outlier map matches."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import gtsam
import msgspec
import numpy as np
import pytest
from gtsam.symbol_shorthand import C, M

from map_matches import with_search
from recorded_flight import blind_between, errors, replayed_graph, shifted, unmatched
from simulated_flight import ORIGIN, EstimatorRun, Flight, error_m
from terrafix.core.geodesy import local_rotation_up
from terrafix.core.map_error import shared_variance_m2
from terrafix.core.pose import tangent_to_world
from terrafix.estimator.measurements.principal_point import PrincipalPointFilter
from terrafix.estimator.models.lens_prior import principal_point_sigma
from terrafix.estimator.models.plane_motion import MatchedRays
from terrafix.estimator.state import NodeState
from terrafix.messages import MapMatch, Message, SearchResult, Verdict
from terrafix.smoother.gnc import solve
from terrafix_tools.finalise import batch_smoother
from terrafix_tools.finalise.batch_smoother import smooth
from terrafix_tools.finalise.fix_consistency import ambiguous_segments, information_shares, lost_sigma
from terrafix_tools.finalise.flight_graph import Fix, FlightGraph, FlightReplayer, RecordedNode
from terrafix_tools.finalise.run import refined_track
from terrafix_tools.finalise.submaps import _moved, _submap
from terrafix_tools.score import nees_of

FAR_M = (350.0, -200.0)


def median_m(errors_m: np.ndarray) -> float:
    return float(np.median(np.hypot(errors_m[:, 0], errors_m[:, 1])))


@pytest.mark.slow
def test_the_smoothed_track_is_more_accurate_than_in_flight_and_consistent() -> None:
    squares, ratios = [], []
    for seed in range(6):
        flight = Flight(54, seed=seed, dem=True)  # without a DEM the covariance includes hills
        graph = replayed_graph(flight)
        errors_m, covs = errors(flight, graph, smooth(graph))
        squares.append(nees_of(errors_m, covs))
        run = EstimatorRun().fly(flight, 0, flight.frames)
        immediate = np.array([error_m(run.estimate(i), flight)[:2] for i in range(flight.frames)])
        ratios.append(median_m(errors_m) / median_m(immediate))
    assert np.median(ratios) < 0.9
    assert 1.2 < float(np.mean(squares)) < 3.0  # expected 2; the errors of one flight are correlated
    assert np.mean(np.concatenate(squares) < 5.991) > 0.88


@pytest.mark.slow
def test_outlier_map_matches_are_rejected_even_three_consistent_ones() -> None:
    flight = Flight(90, seed=3, fix_every=5)
    wrong = {20: FAR_M, 45: (40.0, 30.0), 50: (40.0, 30.0), 55: (40.0, 30.0), 80: (-90.0, 200.0)}

    def alter(message: Message) -> Message | None:
        moved = wrong.get(message.frame_id) if isinstance(message, MapMatch) else None
        return shifted(message, moved) if moved and isinstance(message, MapMatch) else message

    graph, clean = replayed_graph(flight, alter), replayed_graph(flight)
    smoothed = smooth(graph)
    frames = {node: frame for frame, node in graph.node_of.items()}
    rejected = {frames.get(f.node) for f, b in zip(graph.fixes, smoothed.inliers, strict=True) if not b}
    assert rejected >= set(wrong) and len(rejected) <= len(wrong) + 1
    errors_m, _ = errors(flight, graph, smoothed)
    undisturbed, _ = errors(flight, clean, smooth(clean))
    assert median_m(errors_m) < 1.25 * median_m(undisturbed) + 0.3


def test_an_unknown_principal_point_widens_the_solution_by_its_lever_and_a_map_is_compared_less_its_offset() -> None:
    graph = replayed_graph(Flight(6, seed=4, fix_every=3))
    camera = msgspec.structs.replace(graph.origin.camera, focal_sigma=0.1)
    graph.principal_point = None
    known, graph.principal_point = smooth(graph), PrincipalPointFilter(camera)
    graph.principal_point.offset[:] = 0.02, 0.01
    unknown = smooth(graph)
    for pose, seen in zip(unknown.poses, unknown.camera, strict=True):
        aside_m = pose.rotation().matrix()[:2, :2] @ (2.0, 1.0)  # of 100 m, from the camera that map matches see
        assert (pose.translation() - seen.translation())[:2] == pytest.approx(aside_m, abs=0.2)
    variance_m2 = [
        np.array([tangent_to_world(c, p.rotation().matrix())[0, 0] for c, p in zip(one.covs, one.poses, strict=True)])
        for one in (known, unknown)
    ]
    lever_m2 = (100.0 * principal_point_sigma(camera)) ** 2
    assert variance_m2[1] - variance_m2[0] == pytest.approx(lever_m2, rel=0.15)
    fix = graph.fixes[0]
    moved = replace(known, map_offset_m={fix.map_sigma_m: (np.array([3.0, 4.0, 0.0]), np.zeros(3))})
    off_m = moved.on_map(fix).translation() - known.camera[fix.node].translation()
    assert off_m == pytest.approx([-3.0, -4.0, 0.0])


def test_only_a_map_match_that_nothing_contradicted_ends_the_doubt_of_the_nodes_before_it() -> None:
    def fix(node: int) -> Fix:
        return Fix(node, gtsam.Pose3(), np.eye(6), 1.0, False, np.zeros((6, 2)), 0.0, True, None)

    flight = FlightGraph(ORIGIN, fixes=[fix(2), fix(5)], lost_sigma_m={2: 0.0, 5: 800.0})
    inliers, begins = np.ones(2, bool), np.zeros(8, int)
    assert lost_sigma(flight, inliers, begins).tolist() == [0.0] * 3 + [800.0] * 5
    assert lost_sigma(flight, np.array([False, True]), begins).tolist() == [800.0] * 8


@pytest.mark.parametrize("position_only", [False, True])
def test_matches_without_a_pose_lead_to_no_second_position(position_only: bool) -> None:
    at = [gtsam.Pose3(gtsam.Rot3(), np.array([80.0 * (i > 3), 0.0, 100.0])) for i in range(8)]
    given: Any = {"cov": np.eye(6), "map_sigma_m": 1.0, "by_lens": None, "k1": 0.0, "tried": True, "points": None}
    fixes = [Fix(i, pose, position_only=position_only and i > 3, **given) for i, pose in enumerate(at)]
    inliers, begins = np.arange(8) < 4, np.zeros(8, int)
    found = list(ambiguous_segments(fixes, inliers, begins, [at[0]] * 8))
    assert [nodes.tolist() for nodes, _ in found] == ([] if position_only else [[4, 5, 6, 7]])


def test_how_much_ground_two_map_matches_share_depends_on_the_height_above_it() -> None:
    shares = []
    for ground_m in (0.0, 500.0):
        flight = FlightGraph(msgspec.structs.replace(ORIGIN, ground_amsl_m=ground_m))
        for i in range(4):
            pose = gtsam.Pose3(gtsam.Rot3(), np.array([40.0 * i, 0.0, ground_m + 100.0]))
            flight.recorder.nodes.append(RecordedNode(float(i), NodeState(pose, np.zeros(6), np.zeros(8)), []))
            flight.fixes.append(Fix(i, pose, np.eye(6), 1.0, False, np.zeros((6, 2)), 0.0, True, None))
        shares.append(information_shares(flight))
    assert shares[0] == shares[1] and shares[0][0] == 1.0 > shares[0][1]


def test_map_matches_over_the_same_ground_count_with_their_share(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = replayed_graph(Flight(6, seed=4, fix_every=3))
    alone = smooth(graph)
    monkeypatch.setattr(batch_smoother, "information_shares", lambda flight: [0.2] * len(flight.fixes))
    shared = smooth(graph)
    assert np.trace(shared.covs[-1]) > 1.2 * np.trace(alone.covs[-1])


def test_a_map_match_that_agrees_with_the_solution_is_readmitted(monkeypatch: pytest.MonkeyPatch) -> None:
    def without_the_first(*given: Any) -> tuple[gtsam.Values, np.ndarray]:
        values, inliers = solve(*given)
        return values, inliers & (np.arange(len(inliers)) > 0)

    monkeypatch.setattr(batch_smoother, "solve", without_the_first)
    assert smooth(replayed_graph(Flight(12, seed=4, fix_every=3))).inliers.all()


@pytest.mark.parametrize(("learnt", "factors"), [(1.0, 1), (0.5, 2)])
def test_a_learnt_height_scale_is_the_sum_of_barometer_and_focal_length(learnt: float, factors: int) -> None:
    graph = replayed_graph(Flight(2, seed=4))
    first, smoothing = graph.recorder.nodes[0], batch_smoother._Smoothing(graph, lambda _done, _of: None)
    assert first.calibration is not None
    first.calibration = first.calibration[0], learnt * first.calibration[1]
    smoothing._sees_lens = True
    assert len(list(smoothing._calibration_factors(0, first))) == factors


def test_a_start_has_the_offset_of_the_map_that_most_matches_use() -> None:
    graph = replayed_graph(Flight(12, seed=4, fix_every=3))
    graph.fixes[0] = replace(graph.fixes[0], map_sigma_m=99.0)
    assert batch_smoother._Smoothing(graph, lambda _done, _of: None)._start_factor(0).factor.keys()[0] == M(0)


def test_an_error_of_the_height_is_the_scale_of_a_segment_and_not_of_its_steps() -> None:
    first, node = replayed_graph(Flight(2, seed=4)).recorder.nodes
    assert node.motion is not None and node.motion.rays is not None
    ground, step_m = node.motion.rays.ground, node.motion.r.T @ node.motion.p_m
    left = node.motion.cov - _submap([first, node], 0, 0.1).step_cov[1]
    assert np.trace(left) == pytest.approx(step_m @ step_m * (ground.height_sigma_m / ground.height_m) ** 2)


def test_a_segment_that_is_moved_turns_its_velocity_and_not_what_is_in_the_axes_of_the_camera() -> None:
    state = NodeState(gtsam.Pose3(), np.zeros(6), np.array([10.0, 0.0, 1.0, 2.0, 0.0, 0.0, 0.1, 0.2]))
    moved = _moved(state, gtsam.Pose3(gtsam.Rot3.Rz(np.pi / 2.0), np.ones(3)))
    assert moved.motion == pytest.approx([0.0, 10.0, 1.0, 2.0, 0.0, 0.0, 0.1, 0.2])


def test_positions_that_the_estimator_refines_have_the_error_of_the_map_on_earth() -> None:
    graph, turned = replayed_graph(Flight(3, seed=4)), gtsam.Rot3.Rz(0.5).matrix()
    past = SimpleNamespace(r_w_c=turned, p_m=np.zeros(3), cov=np.diag([4.0, 4.0, 9.0, 0.01, 0.01, 0.01]))
    estimator: Any = SimpleNamespace(map_sigma_m=5.0, refine=lambda: {0: past, 99: past})
    ((frame_id, placed),) = refined_track(graph, estimator).items()
    variances = np.diag(tangent_to_world(placed.cov, turned))
    assert frame_id == 0 and variances[:3] == pytest.approx([4.0 + shared_variance_m2(5.0)] * 2 + [9.0])


def test_the_height_over_sloping_ground_follows_its_keyframe(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, seen = replayed_graph(Flight(6, seed=4, fix_every=3)), list[MatchedRays]()
    smoothing = batch_smoother._Smoothing(graph, lambda *_: None)
    i, node = next((i, n) for i, n in enumerate(graph.recorder.nodes) if n.motion is not None and n.motion.rays)
    assert node.motion is not None and node.motion.rays is not None
    ground = replace(node.motion.rays.ground, slope_e=0.5, slope_n=-0.2)
    then_m = smoothing._values.atPose3(C(node.parent)).translation() - (10.0, 5.0, 3.0)
    monkeypatch.setattr(batch_smoother, "plane_two_view_factor", lambda *given: seen.append(given[5]))
    smoothing._plane_factor(node.parent, i, replace(node.motion, rays=replace(node.motion.rays, ground=ground)), then_m)
    assert seen[0].ground.height_m == pytest.approx(ground.height_m + 3.0 - (0.5 * 10.0 - 0.2 * 5.0))


def test_a_blackout_is_interpolated_from_both_sides() -> None:
    flight = Flight(90, seed=4)
    graph = replayed_graph(flight, blind_between(30, 50))
    errors_m, covs = errors(flight, graph, smooth(graph))
    sigma = np.sqrt(covs[:, 0, 0] + covs[:, 1, 1])
    assert sigma[40] > 1.5 * max(sigma[25], sigma[60])
    assert np.mean(nees_of(errors_m, covs) < 9.21) > 0.95
    assert np.hypot(*errors_m[60:].T).max() < 8.0


def test_further_rounds_of_linearisation_do_not_move_the_track(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = replayed_graph(Flight(24, seed=4), blind_between(8, 16))
    tracks = []
    for more in (0, 2):
        monkeypatch.setattr(batch_smoother, "ROUNDS", batch_smoother.ROUNDS + more)
        tracks.append(np.array([pose.translation() for pose in smooth(graph).poses]))
    assert np.abs(tracks[1] - tracks[0]).max() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(
    "telemetry",
    [{"yaw", "attitude", "height"}, {"attitude", "height"}, {"attitude"}],
    ids=["all", "no yaw", "no height"],
)
def test_the_track_before_a_reset_by_a_map_match_is_corrected(telemetry: set[str]) -> None:
    """The start coordinate is 900 m off, and without a compass the whole track is rotated by 150 degrees, too far for a
    local optimiser."""
    flight = Flight(150, seed=3, telemetry=frozenset(telemetry), dem=True)
    turn = local_rotation_up(0.0 if "yaw" in telemetry else np.radians(150.0))
    moved, first = (800.0, 400.0), 108

    def alter(message: Message) -> Message | None:
        if not isinstance(message, MapMatch):
            return message
        if message.frame_id < first:
            return unmatched(message)
        return with_search(shifted(message, moved, turn), relocalized=message.frame_id == first)

    graph = replayed_graph(flight, alter)
    smoothed = smooth(graph)
    assert sum(node.again for node in graph.recorder.nodes) == 1 and smoothed.start_inliers == {0: False}
    errors_m = [
        (smoothed.poses[graph.node_of[i]].translation() - turn @ flight.p_m[i] - (*moved, 0.0))[:2]
        for i in range(flight.frames)
    ]
    assert np.hypot(*np.array(errors_m).T).max() < 20.0
    assert smoothed.placed.all() and smoothed.inliers.all()


def test_a_start_with_unknown_heading_is_an_inlier() -> None:
    """In flight the heading was fixed as a gauge; here it is free, and the coordinate agrees with the map."""
    flight = Flight(60, seed=4, telemetry=frozenset({"attitude", "height"}), dem=True)
    graph = replayed_graph(flight, lambda m: unmatched(m) if isinstance(m, MapMatch) and m.frame_id < 27 else m)
    smoothed = smooth(graph)
    assert smoothed.start_inliers == {0: True}
    poses = [smoothed.poses[graph.node_of[i]].translation() for i in range(flight.frames)]
    assert np.hypot(*(np.array(poses) - flight.p_m)[:, :2].T).max() < 15.0


def test_a_lost_position_that_is_not_found_again_keeps_its_sigma() -> None:
    """A map match contradicted the estimated position, and the position was not found again."""
    flight = Flight(60, seed=9)

    def alter(message: Message) -> Message | None:
        if isinstance(message, MapMatch) and message.frame_id > 36:
            return msgspec.structs.replace(unmatched(message), verdict=Verdict.LOST, search=SearchResult(sigma_m=300.0))
        return message

    graph = replayed_graph(flight, alter)
    _, covs = errors(flight, graph, smooth(graph))
    assert covs[30, 0, 0] < 10.0**2 and covs[50, 0, 0] > 300.0**2


@pytest.mark.slow
def test_map_matches_that_arrived_after_the_window_are_used() -> None:
    """Map matches of the middle of the flight arrive at its end."""
    flight = Flight(80, seed=5)
    held = [m for i in range(18, 55, 9) for m in flight.messages(i) if isinstance(m, MapMatch)]
    at = {m.frame_id for m in held}

    def alter(message: Message) -> Message | None:
        return None if isinstance(message, MapMatch) and message.frame_id in at else message

    without, late = replayed_graph(flight, alter), replayed_graph(flight, alter, held)
    assert len(late.fixes) == len(without.fixes) + len(held) == len(without.fixes) + 5
    smoothed = smooth(late)
    assert smoothed.inliers.sum() >= len(late.fixes) - 1
    errors_m, covs = errors(flight, late, smoothed)
    _, covs_without = errors(flight, without, smooth(without))
    assert covs[36].trace() < 0.5 * covs_without[36].trace()
    assert np.hypot(*errors_m[36]) < 8.0


@pytest.mark.slow
def test_without_map_matches_the_track_follows_from_start_and_odometry() -> None:
    flight = Flight(60, seed=6)
    graph = replayed_graph(flight, lambda m: None if isinstance(m, MapMatch) else m)
    smoothed = smooth(graph)
    errors_m, covs = errors(flight, graph, smoothed)
    assert smoothed.placed.all() and not graph.fixes
    assert covs[-1].trace() > covs[0].trace() > 2.0 * 14.0**2
    assert nees_of(errors_m, covs).max() < 13.8


@pytest.mark.slow
def test_consistent_outliers_at_the_end_widen_the_covariance_over_both_positions() -> None:
    """One odometry error could explain them, and no later map match contradicts that."""
    flight = Flight(90, seed=7, fix_every=6)

    def alter(message: Message) -> Message | None:
        late = isinstance(message, MapMatch) and message.frame_id >= 72
        return shifted(message, (60.0, 0.0)) if late and isinstance(message, MapMatch) else message

    graph = replayed_graph(flight, alter)
    smoothed = smooth(graph)
    errors_m, covs = errors(flight, graph, smoothed)
    assert np.all(nees_of(errors_m, covs)[75:] < 9.21) and covs[80, 0, 0] > 30.0**2 > 10.0**2 > covs[40, 0, 0]


def test_a_record_with_two_origins_gives_two_flights() -> None:
    replayer, flight = FlightReplayer(), Flight(12, seed=8)
    for message in (ORIGIN, *flight.messages(0), *flight.messages(1)):
        replayer.on(message)
    replayer.on(ORIGIN)  # a new file of the record repeats it
    replayer.on(msgspec.structs.replace(ORIGIN, t_ns=5))
    for message in flight.messages(0):
        replayer.on(message)
    assert [len(f.node_of) for f in replayer.flights] == [2, 1]
    assert replayer.flights[0].refused.get(str(Verdict.STALE), 0) == 0
