"""Self-calibration of the principal point from points in three views, with radial distortion."""

import gtsam
import msgspec
import numpy as np
import pytest

from simulated_flight import CAMERA
from terrafix.core.pose import exp_so3
from terrafix.estimator.factors.three_view import ThreeViewPose
from terrafix.estimator.measurements.principal_point import PrincipalPointFilter, graph_shift
from terrafix.messages import CalibrationEstimate, Camera
from terrafix_lab.sim.true_messages import estimate as true_estimate
from terrafix_tools.lens_report import lens_words

UNCALIBRATED = msgspec.structs.replace(CAMERA, focal_sigma=0.1)
HEIGHT_M = 80.0
NOISE = 0.25 / 560.0
# Distortion of a wide lens (k1, k2), and its principal point: 20 and 13 px of `CAMERA`.
BENDS, MIDDLE = (-0.06, 0.04), np.array([0.036, 0.023])


def shown(ray: np.ndarray, bends: tuple[float, float], middle: np.ndarray) -> np.ndarray:
    r2 = np.sum(ray**2, axis=1, keepdims=True)
    return np.asarray(ray * (1.0 + bends[0] * r2 + bends[1] * r2**2) + middle)


def triple(
    rng: np.random.Generator, bends: tuple[float, float], middle: np.ndarray, lean: float = 0.05
) -> tuple[np.ndarray, ThreeViewPose]:
    """60 points of ground with houses, and camera poses of a graph without a model of the lens."""
    poses = []
    for way_m in (-25.0, 25.0):
        turn = gtsam.Rot3(exp_so3(rng.normal(0.0, lean, 3)))
        poses.append(gtsam.Pose3(turn, np.array([0.0, way_m, 0.0]) + rng.normal(0.0, 3.0, 3)))
    ray = rng.uniform((-0.85, -0.5), (0.85, 0.5), (60, 2))
    points = np.column_stack([ray, np.ones(60)]) * HEIGHT_M * (1.0 - 0.05 * rng.uniform(0.0, 1.0, (60, 1)))
    seen = []
    for pose in (poses[0], gtsam.Pose3(), poses[1]):
        in_c = (points - pose.translation()) @ pose.rotation().matrix()
        seen.append(shown(in_c[:, :2] / in_c[:, 2:], bends, middle) + rng.normal(0.0, NOISE, (60, 2)))
    first, last = (pose.retract(rng.normal(0.0, [0.01] * 3 + [0.5] * 3)) for pose in poses)
    return np.hstack(seen), ThreeViewPose(first, last, HEIGHT_M, 0.0, 0.0)


def learnt(
    seed: int, camera: Camera = UNCALIBRATED, bends: tuple[float, float] = BENDS, lean: float = 0.05
) -> PrincipalPointFilter:
    rng, found = np.random.default_rng(seed), PrincipalPointFilter(camera)
    for _ in range(40):
        triples, at = triple(rng, bends, MIDDLE, lean)
        found.update(triples, NOISE, at)
    return found


@pytest.mark.slow
def test_radial_distortion_makes_the_principal_point_observable() -> None:
    found = [learnt(seed) for seed in range(8)]
    for one in found:
        assert np.sqrt(np.diag(one.cov)).max() < 0.5 * np.sqrt(np.diag(PrincipalPointFilter(UNCALIBRATED).cov)).min()
    errors = [one.offset - MIDDLE for one in found]
    assert np.linalg.norm(np.mean(errors, axis=0)) < 0.3 * np.linalg.norm(MIDDLE)
    nees = np.mean([e @ np.linalg.solve(one.cov, e) for e, one in zip(errors, found, strict=True)])
    assert nees < 2.0  # 40 independent sets carry more information than those of a flight, which share points


def test_without_distortion_the_principal_point_is_observable_only_with_tilt() -> None:
    before = np.sqrt(PrincipalPointFilter(UNCALIBRATED).cov[0, 0])
    leans = learnt(1, bends=(0.0, 0.0))
    assert np.linalg.norm(leans.offset - MIDDLE) < 0.2 * np.linalg.norm(MIDDLE)
    level = learnt(1, bends=(0.0, 0.0), lean=0.0)
    assert np.linalg.norm(level.offset) < 0.3 * before
    assert np.sqrt(np.diag(level.cov)).min() > 0.9 * before


@pytest.mark.parametrize(
    "camera",
    [CAMERA, msgspec.structs.replace(UNCALIBRATED, distortion=(-0.1, 0.02, 0.0, 0.0))],
    ids=["calibrated", "stated"],
)
def test_a_calibrated_principal_point_is_not_estimated(camera: Camera) -> None:
    found = learnt(1, camera)
    assert found.learnt is None and np.array_equal(found.offset, np.zeros(2))
    assert np.array_equal(found.cov, PrincipalPointFilter(camera).cov)


def test_inconsistent_and_non_finite_points_have_no_effect() -> None:
    found, before = PrincipalPointFilter(UNCALIBRATED), PrincipalPointFilter(UNCALIBRATED)
    triples, at = triple(np.random.default_rng(2), BENDS, MIDDLE)
    mixed = np.random.default_rng(3).permuted(triples, axis=0)
    for wrong in (mixed, np.full_like(triples, np.nan), 1e200 * triples):
        with np.errstate(all="ignore"):
            found.update(wrong, NOISE, at)
        assert np.array_equal(found.cov, before.cov) and np.array_equal(found.offset, before.offset)


def test_the_estimate_is_restored_from_its_message() -> None:
    found = learnt(1)
    again = PrincipalPointFilter(UNCALIBRATED, found.learnt)
    assert np.allclose(again.offset, found.offset) and np.allclose(again.cov, found.cov)


def test_the_estimated_principal_point_is_reported() -> None:
    slow = CalibrationEstimate(
        t_ns=0, frame_id=0, state=(0.0,) * 6, cov=tuple((np.eye(6) * 1e-4).ravel()), lens=learnt(1).learnt
    )
    words = lens_words(UNCALIBRATED, slow)
    assert words is not None and "cx = 500 and cy = 28" in words
    assert lens_words(UNCALIBRATED, msgspec.structs.replace(slow, lens=None)) is None


def test_a_principal_point_offset_moves_the_camera_horizontally() -> None:
    """For a principal point right of the stated one, the nadir appears on the right, so that the graph has the camera
    too far to the left. With right being west, the true camera is farther west."""
    found = learnt(1)
    r_w_c = np.array([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])  # image right is west, image down is north
    aside_m, cov = found.shift(HEIGHT_M * r_w_c[:2, :2])
    assert np.allclose(aside_m, HEIGHT_M * found.offset * (-1.0, 1.0))
    assert np.allclose(np.diag(cov), HEIGHT_M**2 * np.diag(found.cov))


def test_a_restart_uses_the_position_of_the_graph_without_the_principal_point_offset() -> None:
    found = learnt(1)
    assert found.learnt is not None
    level_to_north = (0.0, 0.7071067811865476, 0.7071067811865476, 0.0)
    estimate = true_estimate(0, 48.0, 11.0, sigmas=(1.0, 1.0, 1.0), agl_m=HEIGHT_M, q_w_b=level_to_north)
    # Image right is east, image down is south.
    shift_m = graph_shift(estimate, UNCALIBRATED, found.learnt)
    assert np.allclose(shift_m, HEIGHT_M * found.offset * (1.0, -1.0), atol=1e-6)
