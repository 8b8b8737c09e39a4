"""Height scale of a camera with a wrong focal length: estimated from climbs, and consistent without a map."""

from functools import cache

import gtsam
import msgspec
import numpy as np
import pytest

from map_matches import position_of, with_pose
from simulated_flight import CAMERA, ORIGIN, EstimatorRun, Flight, cov_of, error_m
from terrafix.core.camera import Mount
from terrafix.core.geodesy import rot_w_b
from terrafix.estimator.factors.attitude_height import attitude_height_residual
from terrafix.estimator.models.bias_walk import BAROMETER_SCALE_SIGMA
from terrafix.estimator.state import CALIBRATION_SIZE, HEIGHT, LOG_HEIGHT_SCALE
from terrafix.messages import MapMatch, Message, NavEstimate, Odometry

MAPPED, FRAMES = 90, 170  # climb, descent, and a second climb without map matches
UNCALIBRATED = msgspec.structs.replace(ORIGIN, camera=msgspec.structs.replace(CAMERA, focal_sigma=0.1))


def seen_through(message: Message, focal: float) -> Message:
    """The message of a camera with ``focal`` times the described focal length: rays nearer to the optical axis, and map
    poses higher up."""
    if isinstance(message, Odometry) and message.two_view:
        pairs = focal * np.array(message.two_view)
        return msgspec.structs.replace(message, two_view=[tuple(map(float, row)) for row in pairs])
    if isinstance(message, MapMatch):
        e_m, n_m, up_m = position_of(message)
        return with_pose(message, p_c_in_w_m=(e_m, n_m, up_m / focal))
    return message


@cache
def flown(focal: float, *, dem: bool, seed: int) -> tuple[Flight, EstimatorRun]:
    flight, run = Flight(FRAMES, seed=seed, dem=dem, climb_amplitude_m=40.0), EstimatorRun()
    run.feed([UNCALIBRATED])
    for i in range(FRAMES):
        messages = [m for m in flight.messages(i) if i < MAPPED or not isinstance(m, MapMatch)]
        run.feed(seen_through(m, focal) for m in messages)
    return flight, run


def estimated(run: EstimatorRun) -> tuple[float, float]:
    assert run.node.estimator is not None
    graph = run.node.estimator.graph
    cov = graph.calibration_covariance(graph.newest)
    return float(graph.state(graph.newest).calibration[LOG_HEIGHT_SCALE]), float(
        np.sqrt(cov[LOG_HEIGHT_SCALE, LOG_HEIGHT_SCALE])
    )


@pytest.mark.slow
@pytest.mark.parametrize("dem", [False, True])
@pytest.mark.parametrize("focal", [0.8, 1.0])
def test_the_height_scale_is_estimated_from_climbs(focal: float, dem: bool) -> None:
    _, run = flown(focal, dem=dem, seed=3)
    scale, sigma = estimated(run)
    assert sigma < 0.05
    assert abs(scale - np.log(focal)) < 3.0 * sigma


@pytest.mark.slow
def test_a_climb_without_map_matches_ends_within_the_covariance() -> None:
    nees, heights = [], []
    for focal, dem, seed in ((0.8, False, 2), (0.8, False, 3), (1.25, True, 0), (1.25, True, 1)):
        flight, run = flown(focal, dem=dem, seed=seed)
        last: NavEstimate = run.estimate(FRAMES - 1)
        error, cov = error_m(last, flight), cov_of(last)
        nees.append(float(error[:2] @ np.linalg.solve(cov[:2, :2], error[:2])))
        heights.append(float(error[2] / np.sqrt(cov[2, 2])))
    assert np.mean(nees) < 4.7  # chi-square of 8 degrees of freedom over 4, 98 %
    assert np.max(np.abs(heights)) < 3.0


def test_the_height_scale_is_divided_between_focal_length_and_barometer_by_variance() -> None:
    for focal_sigma, share in ((0.1, 0.8), (0.01, 0.0385)):
        run = EstimatorRun()
        camera = msgspec.structs.replace(CAMERA, focal_sigma=focal_sigma)
        run.feed([msgspec.structs.replace(ORIGIN, camera=camera), *Flight(1).messages(0)[:2]])
        estimator = run.node.estimator
        assert estimator is not None
        state = estimator.graph.state(0)
        state.calibration[LOG_HEIGHT_SCALE] = np.log(0.8)
        stretch, sigma = estimator.state.height_scale(0)
        assert stretch == pytest.approx(0.8**share, rel=1e-3)
        assert sigma == pytest.approx((focal_sigma**-2 + BAROMETER_SCALE_SIGMA**-2) ** -0.5)


def test_the_jacobians_match_numerical_differences() -> None:
    r_w_b, r_b_c = rot_w_b(0.3, 0.02, -0.03), Mount.of(CAMERA).r_b_c()
    pose = gtsam.Pose3(gtsam.Rot3(r_w_b @ r_b_c), np.array([3.0, 4.0, 150.0]))
    bias = np.zeros(CALIBRATION_SIZE)
    bias[[HEIGHT, LOG_HEIGHT_SCALE]] = 7.0, -0.2

    def residual(pose: gtsam.Pose3, bias: np.ndarray) -> np.ndarray:
        return attitude_height_residual(pose, bias, r_w_b, r_b_c, 140.0, 20.0)[0]

    _, by_pose, by_bias = attitude_height_residual(pose, bias, r_w_b, r_b_c, 140.0, 20.0)
    step = 1e-5
    moved = [(residual(pose.retract(step * d), bias) - residual(pose, bias)) / step for d in np.eye(6)]
    biased = [(residual(pose, bias + step * d) - residual(pose, bias)) / step for d in np.eye(CALIBRATION_SIZE)]
    assert np.allclose(np.column_stack(moved), by_pose, atol=1e-3)
    assert np.allclose(np.column_stack(biased), by_bias, atol=1e-3)
