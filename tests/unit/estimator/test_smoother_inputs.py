"""What the estimator publishes for the smoother: relative poses without map matches, and poses of map matches."""

import gtsam
import numpy as np
import pytest

from simulated_flight import EstimatorRun, Flight, blind
from terrafix.core.geodesy import rot_from_quat
from terrafix.estimator.measurements.map_pose import MapPoseMeasurement, levelled
from terrafix.messages import NavEstimate, Odometry, PoseAnchor, PoseLink

FRAMES = 60


@pytest.fixture(scope="module")
def flight() -> Flight:
    return Flight(FRAMES, seed=3, dem=True)


@pytest.fixture(scope="module")
def run(flight: Flight) -> EstimatorRun:
    return EstimatorRun().fly(flight, 0, FRAMES)


def links(run: EstimatorRun) -> list[PoseLink]:
    return [m for m in run.published if isinstance(m, PoseLink)]


def pose(q: tuple[float, float, float, float], p: tuple[float, float, float]) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.ClosestTo(rot_from_quat(q)), np.array(p))


def true_pose(flight: Flight, i: int) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.ClosestTo(flight.r_w_c[i]), flight.p_m[i])


def test_every_frame_but_the_first_is_linked_to_its_keyframe_after_its_estimate(run: EstimatorRun) -> None:
    assert [link.frame_id for link in links(run)] == list(range(1, FRAMES))
    assert all(link.parent_id == (link.frame_id - 1) // 3 * 3 for link in links(run))
    for before, message in zip(run.published, run.published[1:], strict=False):
        if isinstance(message, PoseLink):
            assert isinstance(before, NavEstimate) and before.frame_id == message.frame_id


def test_links_are_true_to_their_covariance_and_scale(run: EstimatorRun, flight: Flight) -> None:
    nees = []
    for link in links(run)[10:]:
        expected = true_pose(flight, link.parent_id).between(true_pose(flight, link.frame_id))
        seen, cov = pose(link.q_parent_c, link.p_in_parent_m), np.array(link.cov).reshape(6, 6)
        t = expected.rotation().unrotate(expected.translation())
        cov[3:, 3:] += link.scale_sigma**2 * np.outer(t, t)
        residual = expected.logmap(seen)
        assert np.linalg.norm(residual[3:]) < 0.1 * np.linalg.norm(t) + 0.5
        nees.append(residual @ np.linalg.solve(cov, residual))
    assert float(np.mean(nees)) < 6.0


def test_a_frame_without_odometry_has_no_link_and_a_frame_after_it_has_one(flight: Flight) -> None:
    run = EstimatorRun().fly(flight, 0, 20)
    dark = [blind(m) if isinstance(m, Odometry) else m for m in flight.messages(20)]
    assert not [m for m in run.feed(dark) if isinstance(m, PoseLink)]
    assert [m.parent_id for m in run.feed(flight.messages(21)) if isinstance(m, PoseLink)] == [18]


def test_accepted_map_matches_alone_are_anchors_near_the_truth(run: EstimatorRun, flight: Flight) -> None:
    anchors = [m for m in run.published if isinstance(m, PoseAnchor)]
    accepted = {i for i, verdict in run.verdicts("map").items() if verdict.verdict == "accepted"}
    assert {a.frame_id for a in anchors} == accepted and len(anchors) >= 5
    for anchor in anchors:
        error_m = np.array(anchor.p_c_in_w_m) - flight.p_m[anchor.frame_id]
        assert np.hypot(*error_m[:2]) < 10.0
    wrong = EstimatorRun().fly(flight, 0, 30)
    assert not [m for m in wrong.feed([flight.fix(29, (300.0, 0.0))]) if isinstance(m, PoseAnchor)]


def test_a_match_over_ground_that_was_just_seen_is_a_weaker_anchor(flight: Flight) -> None:
    run = EstimatorRun().fly(flight, 0, 27)  # the newest match is of frame 18, 48 m behind
    found = [m for i in (26, 25) for m in run.feed([flight.fix(i)]) if isinstance(m, PoseAnchor)]
    new, seen_before = found
    assert seen_before.cov[35] > 3.0 * new.cov[35]


def measurement(cov: np.ndarray, share: float = 1.0) -> MapPoseMeasurement:
    down = gtsam.Pose3(gtsam.Rot3(np.diag([1.0, -1.0, -1.0])), np.array([0.0, 0.0, 100.0]))
    return MapPoseMeasurement(down, cov, down, cov, None, 0.0, share)


def test_a_known_tilt_moves_a_match_by_what_its_own_tilt_is_correlated_with() -> None:
    tilt, lever_m = 0.05, 100.0
    by_tilt = np.zeros((6, 2))
    by_tilt[0, 0], by_tilt[4, 0] = 1.0, lever_m  # a tilt about x moves the camera along y
    by_tilt[1, 1], by_tilt[3, 1] = 1.0, -lever_m
    cov = tilt**2 * by_tilt @ by_tilt.T + np.diag([1e-4, 1e-4, 1e-4, 1.0, 1.0, 1.0])
    seen = measurement(cov)
    predicted = seen.pose.compose(gtsam.Pose3(gtsam.Rot3.Expmap(np.array([0.02, 0.0, 0.3])), np.zeros(3)))
    predicted_cov = np.diag([1e-5, 1e-5, 1.0, 1e4, 1e4, 1e4])
    fixed = levelled(seen, predicted, predicted_cov)
    moved = seen.pose.logmap(fixed.pose)
    assert moved[0] == pytest.approx(0.02, rel=0.1) and moved[4] == pytest.approx(2.0, rel=0.15)
    assert np.sqrt(fixed.cov[4, 4]) < 0.35 * np.sqrt(cov[4, 4])
    assert abs(moved[2]) < 0.005 and fixed.cov[2, 2] == pytest.approx(cov[2, 2]), "the heading is left alone"


def test_an_unknown_tilt_changes_nothing_and_the_share_of_information_widens_all() -> None:
    cov = np.diag([0.01, 0.01, 0.02, 2.0, 2.0, 3.0]) ** 2
    seen = measurement(cov, share=0.25)
    fixed = levelled(seen, seen.pose, 1e4 * np.eye(6))
    assert np.allclose(fixed.cov, cov / 0.25, rtol=1e-3)
    assert np.allclose(fixed.pose.matrix(), seen.pose.matrix(), atol=1e-6)


def test_late_matches_are_anchors_of_their_own_frame(flight: Flight) -> None:
    run = EstimatorRun().fly(flight, 0, 30)
    (anchor,) = [m for m in run.feed([flight.fix(26)]) if isinstance(m, PoseAnchor)]
    assert anchor.frame_id == 26 and anchor.t_ns == round(26 * 0.5e9)
