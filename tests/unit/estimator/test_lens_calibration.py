"""A lens that bends what its description does not say: an unknown of the graph, learnt in flight, without a map."""

import gtsam
import msgspec
import numpy as np
import pytest

from simulated_flight import ORIGIN, Flight, Listener
from terrafix.estimator.factors.custom_factors import BIAS_SIZE, LENS, plane_two_view_factor
from terrafix.estimator.models.lens_prior import LENS_SIGMA
from terrafix.estimator.models.plane_motion import Ground
from terrafix.messages import MapMatch, Message, Odometry

MAPPED = 30  # frames, before the map ends


def bent(xy: np.ndarray, k1: float) -> np.ndarray:
    """(N, 2) normalised: as such a lens shows them."""
    return np.asarray(xy * (1.0 + k1 * (xy**2).sum(axis=1, keepdims=True)))


@pytest.mark.parametrize("turned_rad", [0.0, 1.0])
def test_a_lens_that_bends_explains_what_no_motion_does(turned_rad: float) -> None:
    looks_down = gtsam.Rot3(np.diag([1.0, -1.0, -1.0]))
    keyframe = gtsam.Pose3(looks_down, np.array([0.0, 0.0, 100.0]))
    pose = gtsam.Pose3(gtsam.Rot3.Rz(turned_rad).compose(looks_down), np.array([10.0, 5.0, 101.0]))
    seen = np.random.default_rng(1).uniform(-0.4, 0.4, (40, 2))
    points = 100.0 * np.column_stack([seen * (1.0, -1.0), np.zeros(40)])
    in_pose = (points - pose.translation()) @ pose.rotation().matrix()
    k1 = 0.01
    pairs = np.hstack([bent(seen, k1), bent(in_pose[:, :2] / in_pose[:, 2:], k1)])
    factor = plane_two_view_factor(0, 1, 2, keyframe, pose, pairs, 1e-4, Ground(100.0, 2.0, slope_sigma=0.01))

    def error(believed: float) -> float:
        values, bias = gtsam.Values(), np.zeros(BIAS_SIZE)
        bias[LENS] = believed
        values.insert(0, keyframe)
        values.insert(1, pose)
        values.insert(2, bias)
        return float(factor.error(values))

    assert error(k1) < 0.05 * error(0.0)
    assert error(0.0) > 1.0


@pytest.mark.slow
@pytest.mark.parametrize("k1", [-0.01, 0.0])
def test_a_lens_is_learnt_in_flight_and_noise_is_not_taken_for_one(k1: float) -> None:
    flight, run = Flight(200, seed=2), Listener()

    def through_the_lens(message: Message) -> Message:
        if not isinstance(message, Odometry) or not message.pairs:
            return message
        pairs = np.array(message.pairs)
        pairs = np.hstack([bent(pairs[:, :2], k1), bent(pairs[:, 2:], k1)])
        return msgspec.structs.replace(
            message, pairs=[(float(a), float(b), float(c), float(d)) for a, b, c, d in pairs]
        )

    run.hear([ORIGIN])
    for i in range(flight.frames):
        said = [m for m in flight.messages(i) if i < MAPPED or not isinstance(m, MapMatch)]
        run.hear(map(through_the_lens, said))
    assert run.node._estimator is not None
    graph = run.node._estimator.graph
    believed = float(graph.state(graph.newest).bias[LENS])
    sigma = float(np.sqrt(graph.bias_covariance(graph.newest)[LENS, LENS]))
    assert sigma < 0.5 * LENS_SIGMA
    assert abs(believed - k1) < 2.5 * sigma
