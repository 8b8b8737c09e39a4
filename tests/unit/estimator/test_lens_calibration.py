"""Radial coefficient of the lens beyond its description: a state of the graph, estimated in flight without a map."""

import gtsam
import numpy as np
import pytest

from simulated_flight import ORIGIN, EstimatorRun, Flight, with_distortion
from terrafix.estimator.factors.plane_two_view import LensNoise, plane_two_view_factor
from terrafix.estimator.models.lens_prior import RADIAL_K1_SIGMA
from terrafix.estimator.models.plane_motion import Ground, MatchedRays
from terrafix.estimator.state import CALIBRATION_SIZE, RADIAL_K1
from terrafix.messages import MapMatch

MAPPED = 30  # frames with map matches


def distorted(xy: np.ndarray, k1: float) -> np.ndarray:
    """(N, 2) normalised, distorted."""
    return np.asarray(xy * (1.0 + k1 * (xy**2).sum(axis=1, keepdims=True)))


@pytest.mark.parametrize("turned_rad", [0.0, 1.0])
def test_the_radial_coefficient_explains_residuals_that_no_motion_explains(turned_rad: float) -> None:
    looks_down = gtsam.Rot3(np.diag([1.0, -1.0, -1.0]))
    keyframe = gtsam.Pose3(looks_down, np.array([0.0, 0.0, 100.0]))
    pose = gtsam.Pose3(gtsam.Rot3.Rz(turned_rad).compose(looks_down), np.array([10.0, 5.0, 101.0]))
    seen = np.random.default_rng(1).uniform(-0.4, 0.4, (40, 2))
    points = 100.0 * np.column_stack([seen * (1.0, -1.0), np.zeros(40)])
    in_pose = (points - pose.translation()) @ pose.rotation().matrix()
    k1 = 0.01
    pairs = np.hstack([distorted(seen, k1), distorted(in_pose[:, :2] / in_pose[:, 2:], k1)])
    rays = MatchedRays(pairs, 1e-4, Ground(100.0, 2.0, slope_sigma=0.01))
    factor = plane_two_view_factor(0, 1, 2, keyframe, pose, rays)

    def error(estimate: float) -> float:
        values, bias = gtsam.Values(), np.zeros(CALIBRATION_SIZE)
        bias[RADIAL_K1] = estimate
        values.insert(0, keyframe)
        values.insert(1, pose)
        values.insert(2, bias)
        return float(factor.error(values))

    assert error(k1) < 0.05 * error(0.0)
    assert error(0.0) > 1.0


def test_pairs_with_a_lens_in_their_noise_say_nothing_of_focal_length_and_radial_coefficient() -> None:
    """Pairs through a lens with another radial coefficient, and another focal length, both within that noise."""
    looks_down = gtsam.Rot3(np.diag([1.0, -1.0, -1.0]))
    keyframe, pose = (gtsam.Pose3(looks_down, np.array(at)) for at in ((0.0, 0.0, 100.0), (10.0, 5.0, 130.0)))
    seen = np.random.default_rng(1).uniform(-0.4, 0.4, (40, 2))
    points = 100.0 * np.column_stack([seen * (1.0, -1.0), np.zeros(40)])
    in_pose = (points - pose.translation()) @ pose.rotation().matrix()
    values = gtsam.Values()
    for key, value in ((0, keyframe), (1, pose), (2, np.zeros(CALIBRATION_SIZE))):
        values.insert(key, value)
    ground = Ground(100.0, 2.0, slope_sigma=0.01)

    def error(k1: float, longer: float, lens: LensNoise | None) -> float:
        views = (distorted(xy, k1) * (1.0 + longer) for xy in (seen, in_pose[:, :2] / in_pose[:, 2:]))
        rays = MatchedRays(np.hstack([*views]), 1e-4, ground)
        factor = plane_two_view_factor(0, 1, 2, keyframe, pose, rays, lens=lens)
        return float(factor.error(values))

    noise = LensNoise(0.1, 0.1)
    assert error(0.02, 0.0, noise) < 0.2 < 5.0 < error(0.02, 0.0, None)
    assert error(0.0, 0.02, noise) < 0.5 * error(0.0, 0.02, None)


@pytest.mark.slow
@pytest.mark.parametrize("k1", [-0.01, 0.0])
def test_the_radial_coefficient_is_estimated_in_flight_and_stays_zero_without_distortion(k1: float) -> None:
    flight, run = Flight(200, seed=2), EstimatorRun()
    run.feed([ORIGIN])
    for i in range(flight.frames):
        messages = [m for m in flight.messages(i) if i < MAPPED or not isinstance(m, MapMatch)]
        run.feed(with_distortion(message, k1) for message in messages)
    assert run.node.estimator is not None
    graph = run.node.estimator.graph
    estimate = float(graph.state(graph.newest).calibration[RADIAL_K1])
    sigma = float(np.sqrt(graph.calibration_covariance(graph.newest)[RADIAL_K1, RADIAL_K1]))
    assert sigma < 0.5 * RADIAL_K1_SIGMA
    assert abs(estimate - k1) < 2.5 * sigma
