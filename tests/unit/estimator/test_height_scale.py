"""A focal length that is not what its description says: learnt from climbs, and without a map true to its claim."""

import gtsam
import msgspec
import numpy as np
import pytest

from simulated_flight import CAMERA, ORIGIN, Flight, Listener, cov_of, error_m
from terrafix.core.camera import Mount
from terrafix.core.geodesy import rot_w_b
from terrafix.estimator.factors.custom_factors import (
    BAROMETER_SCALE,
    BIAS_SIZE,
    HEIGHT,
    SCALE,
    attitude_and_height_residual,
)
from terrafix.messages import MapMatch, Message, NavEstimate, Odometry

MAPPED, FRAMES = 90, 170  # it climbs, sinks, and climbs again in the dark
UNCALIBRATED = msgspec.structs.replace(ORIGIN, camera=msgspec.structs.replace(CAMERA, focal_sigma=0.1))


def seen_through(message: Message, focal: float) -> Message:
    """As a camera shows it whose focal length is ``focal`` of the described one: nearer to its middle, and so from
    higher up."""
    if isinstance(message, Odometry) and message.pairs:
        pairs = focal * np.array(message.pairs)
        return msgspec.structs.replace(message, pairs=[tuple(map(float, row)) for row in pairs])
    if isinstance(message, MapMatch):
        assert message.p_c_in_w_m is not None
        e_m, n_m, up_m = message.p_c_in_w_m
        return msgspec.structs.replace(message, p_c_in_w_m=(e_m, n_m, up_m / focal))
    return message


def flown(focal: float, *, dem: bool, seed: int) -> tuple[Flight, Listener]:
    flight, run = Flight(FRAMES, seed=seed, dem=dem, climbs_m=40.0), Listener()
    run.hear([UNCALIBRATED])
    for i in range(FRAMES):
        said = [m for m in flight.messages(i) if i < MAPPED or not isinstance(m, MapMatch)]
        run.hear(seen_through(m, focal) for m in said)
    return flight, run


def learnt(run: Listener) -> tuple[float, float]:
    assert run.node._estimator is not None
    graph = run.node._estimator.graph
    cov = graph.bias_covariance(graph.newest)
    return float(graph.state(graph.newest).bias[SCALE]), float(np.sqrt(cov[SCALE, SCALE]))


@pytest.mark.slow
@pytest.mark.parametrize("dem", [False, True])
@pytest.mark.parametrize("focal", [0.8, 1.0])
def test_it_is_learnt_from_climbs(focal: float, dem: bool) -> None:
    _, run = flown(focal, dem=dem, seed=3)
    scale, sigma = learnt(run)
    assert sigma < 0.05
    assert abs(scale - np.log(focal)) < 3.0 * sigma


@pytest.mark.slow
@pytest.mark.parametrize("dem", [False, True])
@pytest.mark.parametrize("focal", [0.8, 1.25])
def test_a_climb_in_the_dark_ends_where_the_claim_says(focal: float, dem: bool) -> None:
    nees, heights = [], []
    for seed in range(4):
        flight, run = flown(focal, dem=dem, seed=seed)
        last: NavEstimate = run.estimate(FRAMES - 1)
        error, cov = error_m(last, flight), cov_of(last)
        nees.append(float(error[:2] @ np.linalg.solve(cov[:2, :2], error[:2])))
        heights.append(float(error[2] / np.sqrt(cov[2, 2])))
    assert np.mean(nees) < 4.7  # chi-square of 8 degrees of freedom over 4, 98 %
    assert np.max(np.abs(heights)) < 3.0


def test_an_altitude_is_the_barometers_where_the_lens_is_to_blame_and_the_pictures_where_the_air_is() -> None:
    for focal_sigma, share in ((0.1, 0.8), (0.01, 0.0385)):
        run = Listener()
        camera = msgspec.structs.replace(CAMERA, focal_sigma=focal_sigma)
        run.hear([msgspec.structs.replace(ORIGIN, camera=camera), *Flight(1).messages(0)[:2]])
        estimator = run.node._estimator
        assert estimator is not None
        state = estimator.graph.state(0)
        state.bias[SCALE] = np.log(0.8)
        stretch, sigma = estimator.stretch(0)
        assert stretch == pytest.approx(0.8**share, rel=1e-3)
        assert sigma == pytest.approx((focal_sigma**-2 + BAROMETER_SCALE**-2) ** -0.5)


def test_the_jacobians_are_the_differences() -> None:
    r_w_b, r_b_c = rot_w_b(0.3, 0.02, -0.03), Mount.of(CAMERA).r_b_c()
    pose = gtsam.Pose3(gtsam.Rot3(r_w_b @ r_b_c), np.array([3.0, 4.0, 150.0]))
    bias = np.zeros(BIAS_SIZE)
    bias[[HEIGHT, SCALE]] = 7.0, -0.2

    def residual(pose: gtsam.Pose3, bias: np.ndarray) -> np.ndarray:
        return attitude_and_height_residual(pose, bias, r_w_b, r_b_c, 140.0, 20.0)[0]

    _, by_pose, by_bias = attitude_and_height_residual(pose, bias, r_w_b, r_b_c, 140.0, 20.0)
    step = 1e-5
    moved = [(residual(pose.retract(step * d), bias) - residual(pose, bias)) / step for d in np.eye(6)]
    biased = [(residual(pose, bias + step * d) - residual(pose, bias)) / step for d in np.eye(BIAS_SIZE)]
    assert np.allclose(np.column_stack(moved), by_pose, atol=1e-3)
    assert np.allclose(np.column_stack(biased), by_bias, atol=1e-3)
