"""The factor of a map match after landing: what it observes, and its derivatives."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, C, F, M

from terrafix.estimator.state import CALIBRATION_SIZE
from terrafix_tools.finalise.batch_smoother import map_match_factor
from terrafix_tools.finalise.lens import Lens
from terrafix_tools.finalise.map_points import PoseRows

KEYS = [M(0), C(0), B(0), F(0)]


def seen() -> PoseRows:
    rng = np.random.default_rng(7)
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(3.1, 0.05, 1.2), np.array([40.0, -25.0, 120.0]))
    return PoseRows(pose, Lens(0.01, 0.02), rng.normal(size=(6, 9)))


def values(offset_m: np.ndarray, moved: np.ndarray) -> gtsam.Values:
    """The camera lies ``moved`` (6,) from the pose of the match, in tangent order, on a map that is off by
    ``offset_m``."""
    at = seen().pose.retract(moved)
    found = gtsam.Values()
    found.insert(KEYS[0], gtsam.Pose3(gtsam.Rot3(), offset_m))
    found.insert(KEYS[1], gtsam.Pose3(at.rotation(), at.translation() + offset_m))
    found.insert(KEYS[2], 0.01 * np.arange(CALIBRATION_SIZE))
    found.insert(KEYS[3], np.array([0.03]))
    return found


MOVED = np.array([0.05, -0.03, 0.04, 3.0, -2.0, 5.0])  # rad, m: as between a match and a track that rejects it


@pytest.mark.parametrize("shift_m", [[10.0, 0.0, 0.0], [0.0, -10.0, 0.0], [-300.0, 200.0, 5.0]])
def test_moving_map_and_camera_alike_changes_no_residual(shift_m: list[float]) -> None:
    """No measurement of a flight observes the offset of its only map."""
    factor = map_match_factor(KEYS, seen(), 0.5)
    at, shifted = values(np.zeros(3), MOVED), values(np.array(shift_m), MOVED)
    assert factor.error(at) > 1.0
    assert factor.error(shifted) == pytest.approx(factor.error(at), rel=1e-9)


def test_the_derivative_along_a_common_shift_of_map_and_camera_is_zero() -> None:
    at = values(np.array([2.0, -1.0, 0.5]), MOVED)
    blocks = map_match_factor(KEYS, seen(), 1.0).linearize(at).jacobian()[0]
    by_offset, by_pose = blocks[:, 3:6], blocks[:, 9:12]
    r_w_c = at.atPose3(KEYS[1]).rotation().matrix()
    assert np.abs(by_offset + by_pose @ r_w_c.T).max() < 1e-9 * np.abs(by_pose).max()


def test_derivatives_of_the_map_match_factor_agree_with_differences() -> None:
    factor, at, step = map_match_factor(KEYS, seen(), 0.5), values(np.array([2.0, -1.0, 0.5]), MOVED), 1e-5
    exact = factor.linearize(at).jacobian()[0]
    sizes = dict(zip(KEYS, (6, 6, CALIBRATION_SIZE, 1), strict=True))

    def residual(changed: int, change: np.ndarray) -> np.ndarray:
        delta = gtsam.VectorValues()
        for key, size in sizes.items():
            delta.insert(key, change if key == changed else np.zeros(size))
        return -factor.linearize(at.retract(delta)).jacobian()[1]

    by_differences = np.column_stack(
        [
            (residual(key, step * axis) - residual(key, -step * axis)) / (2.0 * step)
            for key, size in sizes.items()
            for axis in np.eye(size)
        ]
    )
    rotation_of_map = slice(0, 3)  # held fixed by its prior
    by_differences[:, rotation_of_map] = exact[:, rotation_of_map] = 0.0
    assert np.allclose(exact, by_differences, atol=1e-5 * np.abs(exact).max())
