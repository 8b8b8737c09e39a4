"""The smoother: refined poses of all fragments, bounded in rate and size."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from refined_track import ANCHOR_COV, Track
from simulated_flight import ORIGIN, PLACE
from terrafix.core.config import Config, SmootherSection
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.geodesy import rot_from_quat
from terrafix.core.node import NodeContext
from terrafix.core.pose import log_so3
from terrafix.messages import RefinementSource
from terrafix.smoother.keyframe_graph import KeyframeGraph
from terrafix.smoother.node import KNOWN_HEIGHT_WALK, MAX_POSES, SmootherNode, make_node

LAP = 80  # frames


def turned_rad(track: Track, i: int) -> float:
    """Angle between the refined and the true orientation of a frame."""
    q = track.refined[i].q_w_c
    assert q is not None
    return float(np.linalg.norm(log_so3(track.pose(i)[0].T @ rot_from_quat(q))))


def test_map_matches_at_both_ends_correct_position_and_orientation_of_all_between() -> None:
    track = Track(drift_rad=0.002)
    track.fly(0, LAP)
    track.feed([track.anchor(0)])
    assert track.error_m(LAP - 1) > 8.0 and turned_rad(track, LAP - 1) > 0.1  # what there is to correct
    track.feed([track.anchor(LAP - 1)])
    track.fly(LAP, LAP + 3)
    assert max(track.error_m(i) for i in range(LAP)) < 4.5
    assert max(turned_rad(track, i) for i in range(LAP)) < 0.035
    for pose in track.refined.values():
        cov = np.reshape(pose.cov, (6, 6))
        assert np.linalg.eigvalsh(cov)[0] > 0.0 and cov[:2, :2] == pytest.approx(
            np.array([[pose.sigma_e_m**2, pose.cov_en_m2], [pose.cov_en_m2, pose.sigma_n_m**2]])
        )
    assert {m.source for m in track.published} == {RefinementSource.SMOOTHER}


def test_the_smoother_of_the_default_configuration_refines_and_a_switched_off_one_does_not(tmp_path: Path) -> None:
    refined = {}
    for enabled in (True, False):
        config = Config() if enabled else Config(smoother=SmootherSection(enabled=False))
        track = Track(smoother=make_node(NodeContext(config, MemoryFrameStore(1), None, tmp_path)))
        track.fly(0, 20)
        track.feed([track.anchor(0), track.anchor(19), track.prediction(20)])
        refined[enabled] = len(track.refined)
    assert refined[True] >= 19 and refined[False] == 0


def test_the_scale_of_a_submap_is_that_by_which_its_relative_poses_are_too_short() -> None:
    track = Track(drift_share=-0.05)
    track.fly(0, 40)
    track.feed([*(track.anchor(i) for i in range(0, 40, 3)), track.prediction(46)])
    assert min(pose.m_per_unit or 0.0 for pose in track.refined.values()) > 1.02
    assert track.refined[20].m_per_unit == pytest.approx(1.0 / 0.95, abs=0.02)


def test_a_relocalisation_closes_a_loop_without_any_map() -> None:
    track = Track(drift_rad=0.002)
    track.fly(0, LAP)
    assert track.published == []  # nothing places it
    track.feed([track.prediction(LAP), track.link(LAP, LAP - 1), track.link(LAP, 0, relocalization=True)])
    track.fly(LAP + 1, LAP + 3)
    offset = [track.error_m(i) for i in range(LAP)]
    assert max(offset) < 8.0  # 12 m without the loop; the start, known to 30 m, is right here


def test_a_disconnected_fragment_is_merged_within_a_second_of_its_first_map_match() -> None:
    track = Track()
    track.fly(0, 20, 0)
    track.feed([track.anchor(5), track.anchor(15)])
    track.fly(25, 45, 1, offset_m=(25.0, -20.0))  # by dead reckoning
    track.fly(50, 70, 2, offset_m=(-20.0, 25.0))
    assert {pose.fragment_id for pose in track.refined.values()} == {0}
    track.feed([track.anchor(68)])
    track.fly(71, 72, 3)
    assert {pose.fragment_id for pose in track.refined.values()} == {0, 2}
    assert max(track.error_m(i) for i in range(50, 69)) < 3.0
    merged = track.feed([track.anchor(40), track.prediction(73)])
    assert [m.t_ns for m in merged] and max(m.t_ns for m in merged) <= 73 * 10**9
    assert {pose.fragment_id for pose in track.refined.values()} == {0, 1, 2}
    assert max(track.error_m(i) for i in (*range(20), *range(25, 44), *range(50, 69))) < 3.0


def test_the_start_of_a_fragment_that_was_kilometres_off_does_not_hold_it_back() -> None:
    track = Track()
    track.fly(0, 30, offset_m=(3000.0, 1000.0))
    track.feed([track.anchor(5), track.anchor(15), track.anchor(29), track.prediction(31)])
    assert max(track.error_m(i) for i in range(29)) < 3.0


def test_a_relocalisation_places_a_fragment_that_has_only_one_frame_yet() -> None:
    track = Track()
    track.fly(0, 20, 0)
    track.feed([track.anchor(5), track.anchor(15)])
    track.feed([track.prediction(25, (25.0, -20.0), 1), track.link(25, 10, 1, relocalization=True)])
    track.feed([track.prediction(27, fragment_id=2)])
    assert track.refined[25].fragment_id == 1 and track.error_m(25) < 3.0


def test_a_wrong_map_match_is_rejected_when_others_contradict_it() -> None:
    track = Track()
    track.fly(0, 40)
    track.feed([track.anchor(i, (60.0, 40.0) if i == 20 else (0.0, 0.0)) for i in range(0, 40, 5)])
    track.feed([track.prediction(41), track.prediction(47)])
    assert max(track.error_m(i) for i in range(39)) < 1.0


def test_the_error_that_all_map_matches_share_is_not_averaged() -> None:
    sigmas = {}
    for map_sigma_m in (0.0, 4.0):
        track = Track()
        track.fly(0, 40)
        track.feed([*(track.anchor(i, map_sigma_m=map_sigma_m) for i in range(39)), track.prediction(46)])
        sigmas[map_sigma_m] = track.refined[20].sigma_e_m
        assert np.reshape(track.refined[20].cov, (6, 6))[0, 0] == pytest.approx(sigmas[map_sigma_m] ** 2)
    assert sigmas[0.0] < 0.5 * np.sqrt(ANCHOR_COV[3, 3])
    assert sigmas[4.0] == pytest.approx(np.hypot(sigmas[0.0], 4.0), rel=0.1)


def test_a_frame_with_two_possible_positions_reaches_both() -> None:
    track = Track()
    track.fly(0, 39)
    doubtful = msgspec.structs.replace(track.link(39, 38), ambiguity_m2=(900.0, 0.0, 0.0, 0.0))
    track.feed([track.prediction(39), doubtful, *(track.anchor(i) for i in range(40)), track.prediction(46)])
    assert track.refined[39].sigma_e_m == pytest.approx(30.0, rel=0.01) and track.refined[39].sigma_n_m < 1.0


def test_the_estimated_principal_point_moves_all_frames_by_its_lever_and_widens_them() -> None:
    refined = []
    for axis, variance in (((0.0, 0.0), 0.0), ((0.02, -0.01), 1e-4)):
        track = Track(side_m=2000.0)
        track.fly(0, 20)
        seen = {"axis": axis, "axis_cov": (variance, 0.0, 0.0, variance)}
        anchors = [msgspec.structs.replace(track.anchor(i), **seen) for i in (0, 10, 19)]
        track.feed([*anchors, track.prediction(26)])
        refined.append(track.refined[5])
    described, estimated = refined
    before_m, after_m = (np.array(PLACE.to_local(p.lat_deg, p.lon_deg)) for p in refined)
    moved_m = after_m - before_m
    assert moved_m == pytest.approx([1.0, -2.0], abs=0.05), "image top east, 100 m above ground"
    assert estimated.sigma_e_m**2 - described.sigma_e_m**2 == pytest.approx(1.0, abs=0.05)


def test_the_covariance_grows_with_the_distance_from_the_map_matches() -> None:
    track = Track(side_m=2000.0)
    track.fly(0, 101)
    track.feed([track.anchor(0), track.anchor(100), track.prediction(107)])
    sigma = [track.refined[i].sigma_n_m for i in (0, 25, 50, 75, 99)]
    assert sigma[0] < sigma[1] < sigma[2] > sigma[3] > sigma[4] and sigma[2] > 2.0


def test_at_most_one_refinement_a_second_of_bounded_size_and_the_rest_follows() -> None:
    track = Track(smoother=SmootherNode(graph=KeyframeGraph(max_keyframes=2 * MAX_POSES)))
    track.fly(0, MAX_POSES + 100)
    first = track.feed([track.anchor(0), track.anchor(MAX_POSES + 99)])
    assert [len(m.poses) for m in first] == [MAX_POSES]
    assert track.feed([track.prediction(0)]) == []  # in the same second
    track.fly(MAX_POSES + 100, MAX_POSES + 106)
    assert set(range(MAX_POSES + 99)) <= set(track.refined)
    times = np.array([m.t_ns for m in track.published])
    assert (np.diff(times) >= 10**9).all()


def test_poses_that_have_not_moved_are_not_published_again() -> None:
    track = Track()
    track.fly(0, 30)
    track.feed([track.anchor(i) for i in range(0, 30, 3)])
    track.fly(30, 45, goes_on=True)
    count = len(track.published)
    track.feed([track.anchor(30), track.prediction(51)])
    again = [pose.frame_id for m in track.published[count:] for pose in m.poses]
    assert again and min(again) >= 25


def test_a_map_match_that_moves_nothing_waits_and_one_that_moves_the_past_does_not() -> None:
    track = Track(drift_share=0.05)
    track.fly(0, 10)
    track.feed([track.anchor(0, map_sigma_m=3.0), track.anchor(9, map_sigma_m=3.0), track.prediction(10)])
    solved = len(track.published)
    track.fly(10, 12, goes_on=True)
    track.feed([track.anchor(10, map_sigma_m=3.0), track.prediction(13)])
    assert len(track.published) == solved
    track.fly(12, 41, goes_on=True)
    count = len(track.published)
    found = track.feed([track.anchor(40, map_sigma_m=3.0), track.prediction(41)])
    assert len(track.published) == count + 1 and found[0].t_ns <= 41 * 10**9
    assert track.error_m(30) < 2.5


@pytest.mark.parametrize(("matches", "solves"), [(1, False), (2, True)])
def test_map_matches_that_move_the_past_a_little_each_move_it_together(matches: int, solves: bool) -> None:
    track = Track()
    track.fly(0, 10)
    track.feed([track.anchor(0), track.anchor(9), track.prediction(10)])
    count = len(track.published)
    track.fly(10, 12, goes_on=True)
    track.feed([*(track.anchor(i, (0.52, 0.0)) for i in range(10, 10 + matches)), track.prediction(12)])
    assert (len(track.published) > count) is solves


def test_the_scale_walks_from_frame_to_frame_to_a_keyframe() -> None:
    track = Track(smoother=SmootherNode(graph=(graph := KeyframeGraph())))
    track.feed([track.prediction(0), track.prediction(7), track.link(7, 0)])
    assert graph.frames[7].walk2 == pytest.approx(7 * KNOWN_HEIGHT_WALK**2)


def test_a_restarted_smoother_goes_on_with_the_frames_after_its_start() -> None:
    track = Track()
    track.fly(0, 20)
    track.feed([track.anchor(0), track.anchor(19)])
    track.smoother = SmootherNode()
    track.feed([ORIGIN, track.link(20, 19), track.anchor(19)])  # of frames that it does not know
    track.fly(21, 40, goes_on=True)
    track.feed([track.anchor(25), track.anchor(38), track.prediction(41)])
    assert set(range(21, 39)) <= set(track.refined) and max(track.error_m(i) for i in range(21, 39)) < 1.5


def test_inputs_before_the_origin_are_used_when_it_comes() -> None:
    track, early = Track(), Track()
    early.smoother = SmootherNode()
    early.fly(0, 10)
    early.feed([early.anchor(0), early.anchor(9), early.prediction(10), ORIGIN])
    track.fly(0, 10)
    track.feed([track.anchor(0), track.anchor(9), track.prediction(10)])
    assert early.published == track.published != []


def test_missing_links_and_frames_out_of_order_break_a_fragment_and_nothing_else() -> None:
    track = Track()
    track.fly(0, 10)
    track.feed([track.link(12, 11), track.link(5, 6), track.link(3, 3), track.prediction(4)])
    track.feed([track.anchor(77), track.link(50, 49, relocalization=True)])
    track.feed([track.anchor(0), track.anchor(9), track.prediction(10)])
    assert set(track.refined) == set(range(10)) and max(track.error_m(i) for i in range(10)) < 1.0


def test_nothing_is_solved_while_the_computer_is_hot_and_all_is_afterwards() -> None:
    track = Track()
    track.fly(0, 10)
    track.feed([track.anchor(0), track.anchor(9, hot=True)])
    before = len(track.published)
    track.feed([track.prediction(20), track.prediction(30)])
    assert len(track.published) == before
    track.feed([track.anchor(9), track.prediction(31)])
    assert set(track.refined) >= set(range(9))


def test_the_same_messages_give_the_same_refinements() -> None:
    def flown() -> Track:
        track = Track(drift_rad=0.001)
        for i in range(0, 60, 10):
            track.fly(i, i + 10, i // 10)
            track.feed([track.anchor(i + 4), track.anchor(i + 8)])
        return track

    assert flown().published == flown().published != []
