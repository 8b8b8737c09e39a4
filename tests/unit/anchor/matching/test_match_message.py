"""Conversion of match results into MapMatch."""

import numpy as np

from terrafix.anchor.matching.frame_matcher import View
from terrafix.anchor.matching.match_message import mode_match
from terrafix.anchor.matching.point_mass_filter import Mode
from terrafix.messages import MapMatch, Verdict

DOWN = np.diag([1.0, -1.0, -1.0])
VIEW = View(0.0, 0.0, DOWN, 100.0, 50.0, 0.0, 0.0, 0.0)


def test_the_position_of_a_mode_carries_nothing_of_a_pose_that_was_rejected_there() -> None:
    rejected = MapMatch(
        t_ns=0, frame_id=3, verdict=Verdict.DEGENERATE, matcher="gradient", inliers=9, reprojection_px=2.0,
        matches=[(0.1, 0.2, 40.0, 30.0, 50.0, 1.0)] * 9)  # fmt: skip
    match = mode_match(rejected, Mode(20.0, -10.0, 0.95, 0.01, 4.0), 2.0, VIEW, None)
    assert match.verdict is Verdict.ACCEPTED and match.position_only
    assert (match.matches, match.inliers, match.reprojection_px) == ([], 0, 0.0)
    assert match.pose is not None and match.pose.p_c_in_w_m == (20.0, -10.0, 150.0)
