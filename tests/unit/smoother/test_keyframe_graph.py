"""Trees of frames: what hangs on which keyframe, and what is kept."""

import gc
import tracemalloc
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from terrafix.smoother import keyframe_graph
from terrafix.smoother.keyframe_graph import LONE_FRAMES, Anchor, FrameNode, Join, KeyframeGraph, with_scale
from terrafix.smoother.solution import _submap, followers, predict, solve

COV = np.diag([0.002, 0.002, 0.002, 0.1, 0.1, 0.1]) ** 2
ANCHOR_COV = np.diag([0.01, 0.01, 0.01, 1.0, 1.0, 1.0]) ** 2
STEP = gtsam.Pose3(gtsam.Rot3.Rz(0.1), np.array([5.0, 1.0, 0.0]))


def node(i: int, parent: int | None = None, between: gtsam.Pose3 = STEP) -> FrameNode:
    cov = COV if parent is not None else 100.0 * np.eye(6)
    return FrameNode(
        i, i * 10**9, 0, 100.0, gtsam.Pose3() if parent is None else between, cov, parent, 0.02 - i % 2 / 100, 1e-6
    )


def chain(frames: int, max_keyframes: int = 256) -> KeyframeGraph:
    graph = KeyframeGraph(max_keyframes)
    graph.add_start(node(0))
    for i in range(1, frames):
        graph.add_start(node(i))
        assert graph.add_link(node(i, i - 1))
    return graph


def world(i: int) -> gtsam.Pose3:
    pose = gtsam.Pose3()
    for _ in range(i):
        pose = pose.compose(STEP)
    return pose


def test_keyframes_are_bounded_and_what_hung_on_one_that_goes_keeps_its_pose_and_gains_its_covariance() -> None:
    graph = chain(40, max_keyframes=10)  # every second frame has a length that is known half as well
    assert len(graph.keyframes) == 10 and graph.keyframes[0] == 0 and graph.keyframes[-1] == 38
    for i, frame in graph.frames.items():
        if frame.parent is not None:
            expected = world(frame.parent).between(world(i))
            assert np.allclose(frame.between.matrix(), expected.matrix(), atol=1e-9)
            assert frame.walk2 == pytest.approx(1e-6 * (i - frame.parent))
            assert _submap(graph, [frame.parent, i]).scale_walk[1] ** 2 == pytest.approx(frame.walk2)
            assert frame.cov[5, 5] == pytest.approx(COV[5, 5] * (i - frame.parent), rel=0.1)
            assert frame.scale_sigma == (0.01 if i - frame.parent == 1 and i % 2 else 0.02)


def test_the_error_of_a_length_is_along_the_way_in_the_axes_of_the_frame() -> None:
    turned = gtsam.Pose3(gtsam.Rot3.Rz(0.5), np.array([10.0, 2.0, 0.0]))
    way_m = turned.rotation().matrix().T @ turned.translation()
    along_m2 = (with_scale(replace(node(1, 0, turned), scale_sigma=0.1)) - COV)[3:, 3:]
    assert np.allclose(along_m2, 0.1**2 * np.outer(way_m, way_m))


def test_the_keyframes_that_go_are_spread_over_the_flight() -> None:
    graph = chain(200, max_keyframes=20)
    assert np.diff(graph.keyframes[:-2]).max() <= 20


def test_a_map_match_of_a_frame_that_is_no_keyframe_places_its_keyframe() -> None:
    graph = chain(3)
    graph.add_start(node(3))
    graph.add_link(node(3, 1))
    assert graph.add_anchor(3, Anchor(world(2), ANCHOR_COV))
    (anchor,) = graph.anchors[1]
    assert np.allclose(anchor.pose.matrix(), world(1).matrix(), atol=1e-9)
    assert np.trace(anchor.cov[3:, 3:]) > np.trace(ANCHOR_COV[3:, 3:])


def test_map_matches_of_one_keyframe_that_agree_count_as_one_with_their_information() -> None:
    graph = chain(3)
    for aside_m in (0.6, -0.6, 0.6, -0.6):
        aside = gtsam.Pose3(gtsam.Rot3(), np.array([aside_m, 0.0, 0.0]))
        graph.add_anchor(1, Anchor(world(1).compose(aside), ANCHOR_COV))
    (anchor,) = graph.anchors[1]
    assert np.allclose(anchor.cov, ANCHOR_COV / 4.0)
    assert np.allclose(anchor.pose.translation(), world(1).translation(), atol=1e-3)


def test_map_matches_of_one_keyframe_that_contradict_each_other_are_kept_apart_up_to_three() -> None:
    graph = chain(3)
    for k in range(6):
        aside = gtsam.Pose3(gtsam.Rot3(), np.array([30.0 * k, 0.0, 0.0]))
        graph.add_anchor(1, Anchor(world(1).compose(aside), (1.0 + k) * ANCHOR_COV))
    assert len(graph.anchors[1]) == 3
    assert max(anchor.cov[3, 3] for anchor in graph.anchors[1]) == pytest.approx(3.0)


def test_map_matches_of_a_keyframe_that_goes_move_to_the_one_before_it() -> None:
    graph = KeyframeGraph(4)
    graph.add_start(node(0))
    for i in range(1, 12):
        graph.add_link(node(i, i - 1))
        graph.add_anchor(i, Anchor(world(i), ANCHOR_COV))
    for keyframe, anchors in graph.anchors.items():
        assert keyframe in graph.keyframes
        assert all(np.allclose(a.pose.matrix(), world(keyframe).matrix(), atol=1e-6) for a in anchors)


def test_a_frame_that_nothing_hangs_on_is_dropped_after_some_time() -> None:
    graph = chain(3)
    for i in range(10, 10 + LONE_FRAMES + 5):
        graph.add_start(node(i))
    assert 10 not in graph.frames and 10 + LONE_FRAMES in graph.frames and {0, 1, 2} <= set(graph.frames)


def test_frames_are_bounded_and_the_oldest_that_are_no_keyframes_go_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keyframe_graph, "MAX_SMOOTHED_FRAMES", 40)
    graph = KeyframeGraph()
    graph.add_start(node(0))
    for i in range(1, 100):
        graph.add_start(node(i))
        assert graph.add_link(node(i, (i - 1) // 10 * 10)), "each tenth frame is a keyframe"
    keyframes = list(range(0, 100, 10))
    assert list(graph.frames) == sorted({*keyframes, *range(67, 100)})
    assert graph.keyframes == keyframes and graph.children(10) == [20]


def test_a_frame_takes_less_than_a_kilobyte() -> None:
    """In Python and in arrays; GTSAM's pose takes 0.2 kB more."""
    graph, frames = KeyframeGraph(), 500
    graph.add_start(node(300))
    gc.collect()
    tracemalloc.start()
    try:
        for i in range(frames):
            of_frame = node(301 + i, 300)
            of_frame.cov = COV.copy()
            assert graph.add_link(of_frame)
        held = tracemalloc.get_traced_memory()[0] / frames
    finally:
        tracemalloc.stop()
    assert 300 < held < 800


def test_a_relocalisation_between_frames_is_one_between_their_keyframes() -> None:
    graph = chain(10)
    graph.add_link(node(20, 3))
    graph.add_link(node(21, 7))
    between = world(3).compose(STEP).between(world(7).compose(STEP))
    join = graph.on_keyframes(Join(20, 21, between, COV, 0.01))
    assert join is not None and (join.first, join.second) == (3, 7)
    assert np.allclose(join.between.matrix(), world(3).between(world(7)).matrix(), atol=1e-9)
    assert graph.on_keyframes(Join(3, 20, STEP, COV, 0.01)) is None, "of one keyframe"
    uncertain = [graph.on_keyframes(Join(20, 21, between, 100.0 * COV, 0.01))]
    for frame_id in (20, 21):
        graph.frames[frame_id].cov = 100.0 * COV
        uncertain.append(graph.on_keyframes(Join(20, 21, between, COV, 0.01)))
        graph.frames[frame_id].cov = COV
    assert all(np.trace(one.cov) > 10.0 * np.trace(join.cov) for one in uncertain if one is not None), "of all three"


def test_trees_whose_only_relocalisation_is_wrong_are_not_placed_by_their_starts() -> None:
    graph = KeyframeGraph()
    for start in (0, 10):
        graph.add_start(replace(node(start, between=world(start)), cov=1e-4 * np.eye(6)))
        graph.add_link(node(start + 1, start))
    graph.add_join(Join(0, 10, gtsam.Pose3(gtsam.Rot3(), np.array([300.0, 0.0, 0.0])), COV, 0.01))
    assert solve(graph) == {}


def test_a_tree_that_cannot_be_solved_does_not_keep_others_from_it() -> None:
    graph = chain(4)
    graph.add_anchor(0, Anchor(world(0), ANCHOR_COV))
    graph.add_start(node(10))
    graph.add_link(FrameNode(11, 11 * 10**9, 1, 100.0, STEP, np.full((6, 6), np.nan), 10))
    graph.add_anchor(10, Anchor(world(1), ANCHOR_COV))
    placed = solve(graph)
    assert {0, 1, 2} <= set(placed)
    assert all(np.isfinite(placed[i].cov).all() for i in (0, 1, 2))


def test_a_frame_between_keyframes_takes_its_share_of_the_correction_at_both() -> None:
    graph = chain(2)
    graph.add_link(node(10, 1, gtsam.Pose3(gtsam.Rot3(), np.array([90.0, 0.0, 0.0]))))
    graph.add_link(node(11, 10))
    half = FrameNode(5, round(5.5e9), 0, 100.0, gtsam.Pose3(gtsam.Rot3(), np.array([45.0, 0.0, 0.0])), COV, 1, 0.01)
    assert graph.add_link(half)
    for keyframe, aside in ((1, 0.0), (10, 0.4)):
        at = world(1) if keyframe == 1 else world(1).compose(graph.frames[10].between)
        moved = gtsam.Pose3(at.rotation(), at.translation() + np.array([0.0, 0.0, aside]))
        graph.add_anchor(keyframe, Anchor(moved, 1e-4 * np.eye(6)))
    placed = solve(graph)
    (followed,) = followers(graph, 1, placed)
    assert followed[0] == 5
    between = followed[1]
    assert placed[10].pose.z() - placed[1].pose.z() == pytest.approx(0.4, abs=0.05)
    assert between.pose.z() - placed[1].pose.z() == pytest.approx(0.2, abs=0.03)
    assert between.cov[2, 2] > max(placed[1].cov[2, 2], placed[10].cov[2, 2])


def test_a_frame_far_from_its_keyframe_has_the_error_of_the_keyframes_attitude_as_a_position() -> None:
    graph = chain(2)
    graph.add_link(node(2, 1, gtsam.Pose3(gtsam.Rot3(), np.array([90.0, 0.0, 0.0]))))
    graph.add_anchor(0, Anchor(world(0), 1e-4 * np.eye(6)))
    placed = solve(graph)
    ((_, far),) = followers(graph, 1, placed)
    alone = with_scale(graph.frames[2])[5, 5] + placed[1].cov[2, 2]
    assert far.cov[2, 2] > 20.0 * alone
    predicted = predict(graph, 2, placed)
    assert predicted is not None and np.allclose(predicted.cov, far.cov), "before the keyframe is solved again as well"
