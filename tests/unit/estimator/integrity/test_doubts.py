"""What stands against past positions: which frames inherit a doubt after landing, and how much of it."""

import gtsam
import numpy as np
import pytest

from terrafix.estimator.filter_state import FrameState
from terrafix.estimator.integrity.doubts import MIN_DOUBT_M2, Doubts

NONE_M2, WIDE_M2, SIDE_M2 = np.zeros((2, 2)), 100.0**2 * np.eye(2), np.diag([30.0**2, 0.0])


def frame(i: int) -> FrameState:
    return FrameState(i, float(i), gtsam.Pose3(), np.eye(6), np.zeros(3), np.eye(3), i)


def flown(
    frames: range, doubt_m2: np.ndarray, fix_s: float | None, doubts: Doubts | None = None, graph: int = 0
) -> Doubts:
    doubts = Doubts() if doubts is None else doubts
    for i in frames:
        doubts.record(frame(i), graph, fix_s, NONE_M2, doubt_m2)
    return doubts


def test_without_a_doubt_nothing_is_added() -> None:
    doubts = flown(range(10), 0.4 * MIN_DOUBT_M2 * np.eye(2), None)
    assert doubts.of_frames() == {} and doubts.sigma_m == 0.0


def test_a_doubt_at_the_end_holds_for_all_frames_that_no_match_has_confirmed() -> None:
    doubts = flown(range(8, 10), WIDE_M2, None, flown(range(8), NONE_M2, None))
    added = doubts.of_frames()
    assert list(added) == list(range(10)) and all((m2 == WIDE_M2).all() for m2 in added.values())
    assert doubts.sigma_m == pytest.approx(100.0)


def test_a_doubt_that_a_later_match_has_ended_is_not_inherited() -> None:
    doubts = flown(range(5, 8), WIDE_M2, None, flown(range(5), NONE_M2, None))
    assert flown(range(8, 10), NONE_M2, 8.0, doubts).of_frames() == {}


def test_after_the_last_confirmation_a_doubt_has_grown_with_the_time_since() -> None:
    doubts = flown(range(5), NONE_M2, 4.0)
    added = flown(range(5, 9), WIDE_M2, 4.0, doubts).of_frames()
    assert {i: m2[0, 0] for i, m2 in added.items()} == pytest.approx({5: 625.0, 6: 2500.0, 7: 5625.0, 8: 1e4})


def test_a_match_under_doubt_confirms_nothing() -> None:
    doubts = flown(range(5), WIDE_M2, 4.0)
    assert list(doubts.of_frames()) == list(range(5))


def test_a_late_match_confirms_the_frames_up_to_its_own() -> None:
    doubts = flown(range(6), NONE_M2, 3.0)
    assert list(flown(range(6, 8), WIDE_M2, 3.0, doubts).of_frames()) == [4, 5, 6, 7]


def test_another_graph_confirms_nothing_of_the_one_before() -> None:
    doubts = flown(range(5), WIDE_M2, None)
    added = flown(range(5, 9), NONE_M2, 8.0, doubts, graph=5).of_frames()
    assert list(added) == list(range(5))


def test_a_reset_by_the_match_of_the_newest_frame_moves_that_frame_to_the_new_graph() -> None:
    doubts = flown(range(5), WIDE_M2, None)
    doubts.record(frame(4), 4, 4.0, NONE_M2, NONE_M2)
    assert list(doubts.of_frames()) == list(range(4))


def test_what_depends_on_the_frame_alone_stays_with_it_and_only_its_newest_value() -> None:
    doubts = flown(range(3), NONE_M2, None)
    doubts.record(frame(3), 0, None, WIDE_M2, NONE_M2)
    doubts.record(frame(3), 0, None, SIDE_M2, NONE_M2)
    doubts.record(frame(4), 0, None, WIDE_M2, NONE_M2)
    doubts.record(frame(4), 0, None, NONE_M2, NONE_M2)
    assert {i: m2.tolist() for i, m2 in doubts.of_frames().items()} == {3: SIDE_M2.tolist()}
    added = flown(range(5, 7), WIDE_M2, None, doubts).of_frames()
    assert added[3].tolist() == (SIDE_M2 + WIDE_M2).tolist()
