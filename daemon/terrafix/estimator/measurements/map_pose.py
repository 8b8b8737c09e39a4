"""The pose of a map match as a measurement: whether it is determined, and its covariance."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C

from terrafix.core.gate import GATE
from terrafix.core.geodesy import rot_from_quat
from terrafix.core.pose import MAX_CONDITION, project_with_jacobian, tangent_to_world, world_to_tangent
from terrafix.estimator.factors.map_pose import map_pose_factor
from terrafix.estimator.factors.noise import robust_noise
from terrafix.estimator.filter_state import FilterState
from terrafix.estimator.integrity.innovation import Innovation
from terrafix.estimator.models.terrain import Terrain
from terrafix.estimator.state import HORIZONTAL, ROTATION, TRANSLATION
from terrafix.messages import MapMatch, MapPose

LOCAL_WARP = 0.33  # of the map's error: how orthophotos are stretched within one footprint [tuned]
ROOFS = 0.03  # of the height, 1-sigma: roofs and trees raise the ground that is seen, and the height with it [tuned]


@dataclass(frozen=True)
class MapPoseMeasurement:
    """The pose of one map match: as it was seen, and with the lens as it is estimated now; each with its covariance
    (6, 6), tangent order. ``by_k1`` (6,): change of the pose by the radial coefficient, which was ``radial_k1`` when
    it was seen; None without 2D-3D matches. ``information_share``: of the match that no other match has given."""

    seen: gtsam.Pose3
    seen_cov: np.ndarray
    pose: gtsam.Pose3
    cov: np.ndarray
    by_k1: np.ndarray | None
    radial_k1: float
    information_share: float = 1.0
    name: str = "map"

    @classmethod
    def of(cls, match: MapMatch, terrain: Terrain, radial_k1_estimate: tuple[float, float]) -> "MapPoseMeasurement":
        """Measurement from a match that is ``determined``. ``radial_k1_estimate``: radial coefficient and its
        1-sigma."""
        assert match.pose is not None
        seen, seen_cov = measured_pose(match.pose, match.map_sigma_m, terrain)
        by_k1, (radial_k1, sigma) = moved_by_k1(match), radial_k1_estimate
        pose, cov = undistorted_pose(seen, seen_cov, by_k1, radial_k1 - match.radial_k1, sigma)
        return cls(seen, seen_cov, pose, cov, by_k1, match.radial_k1)

    @property
    def position_m(self) -> np.ndarray:
        """Position (2,) [m], east and north."""
        return np.asarray(self.pose.translation()[:2])

    def innovation(self, state: FilterState, node: int) -> Innovation:
        """Innovation of the pose, 6 degrees of freedom, tangent order."""
        residual = state.graph.state(node).pose.logmap(self.pose)
        return Innovation(residual, state.covariance(node) + self.cov, GATE[6])

    def position_innovation(self, pose: gtsam.Pose3, pose_cov: np.ndarray) -> Innovation:
        """Innovation of the position against a predicted ``pose`` with ``pose_cov`` (6, 6), tangent order: 2 degrees
        of freedom, east and north, whatever the heading is."""
        both = [tangent_to_world(c, p.rotation().matrix()) for p, c in ((pose, pose_cov), (self.pose, self.cov))]
        residual = (self.pose.translation() - pose.translation())[:2]
        return Innovation(residual, (both[0] + both[1])[:2, :2], GATE[2])

    def add_to(self, state: FilterState, node: int) -> None:
        cov = self.seen_cov / self.information_share
        if self.by_k1 is None:
            state.add_factors(node, gtsam.PriorFactorPose3(C(node), self.seen, robust_noise(cov)))
        else:
            factor = map_pose_factor(C(node), B(node), self.seen, cov, self.by_k1, self.radial_k1)
            state.add_factors(node, factor)


@dataclass(frozen=True)
class FixedPose:
    """Camera pose by an accepted map match, with covariance ``cov`` (6, 6), tangent order, that part included which it
    shares with other matches over the same ground."""

    pose: gtsam.Pose3
    cov: np.ndarray


def levelled(measurement: MapPoseMeasurement, predicted: gtsam.Pose3, predicted_cov: np.ndarray) -> FixedPose:
    """Pose of a match with the tilt that was ``predicted`` for its frame, with ``predicted_cov`` (6, 6), tangent order:
    a tilt that the matches do not determine well moves the camera by the height times as much. Of the prediction only
    the tilt counts, which attitude and mount give; its position has other matches in it."""
    pose, cov = measurement.pose, measurement.cov / measurement.information_share
    r_w_c, r_predicted = pose.rotation().matrix(), predicted.rotation().matrix()
    by_pose = np.zeros((2, 6))
    by_pose[:, ROTATION] = r_w_c[HORIZONTAL]
    residual = r_w_c[HORIZONTAL] @ pose.logmap(predicted)[ROTATION]
    tilt_cov = r_predicted[HORIZONTAL] @ predicted_cov[ROTATION, ROTATION] @ r_predicted[HORIZONTAL].T
    gain = np.linalg.solve(by_pose @ cov @ by_pose.T + tilt_cov, by_pose @ cov).T
    cov = cov - gain @ by_pose @ cov
    return FixedPose(pose.retract(gain @ residual), (cov + cov.T) / 2)


def levelled_innovation(
    measurement: MapPoseMeasurement, predicted: gtsam.Pose3, predicted_cov: np.ndarray
) -> Innovation:
    """``position_innovation`` of the match once it is ``levelled``, whatever other matches over the same ground have
    given."""
    alone = levelled(replace(measurement, information_share=1.0), predicted, predicted_cov)
    return replace(measurement, pose=alone.pose, cov=alone.cov).position_innovation(predicted, predicted_cov)


def measured_pose(pose: MapPose, map_sigma_m: float, terrain: Terrain) -> tuple[gtsam.Pose3, np.ndarray]:
    """Pose and covariance (6, 6), tangent order, of a match that is ``determined``.

    A slope that the map does not have looks like a tilt of the camera about the ground below it: it rotates the pose
    and moves it by the height times as much."""
    r_w_c = rot_from_quat(pose.q_w_c)
    local_m, height_m = LOCAL_WARP * map_sigma_m, max(pose.p_c_in_w_m[2] - terrain.ground_m, 1.0)
    about_north, about_east = np.zeros(6), np.zeros(6)
    about_north[[0, 4]], about_east[[1, 3]] = (height_m, 1.0), (-height_m, 1.0)
    slope = terrain.slope_sigma(height_m) ** 2 * (np.outer(about_north, about_north) + np.outer(about_east, about_east))
    cov = world_to_tangent(np.array(pose.cov).reshape(6, 6) + slope, r_w_c)
    cov[TRANSLATION, TRANSLATION] += r_w_c.T @ np.diag([local_m, local_m, ROOFS * height_m]) ** 2 @ r_w_c
    return gtsam.Pose3(gtsam.Rot3.ClosestTo(r_w_c), np.array(pose.p_c_in_w_m)), cov


def moved_by_k1(match: MapMatch) -> np.ndarray | None:
    """(6,) tangent order: change of the pose of a match that is ``determined`` by one unit of the radial coefficient of
    the lens. For points around the principal point that is height; for points to one side it is tilt and position.
    None: there are no points."""
    return _moved_by(match, lambda xy: np.sum(np.square(xy), axis=1, keepdims=True) * xy)


def moved_by_focal(match: MapMatch) -> np.ndarray | None:
    """(6,) as ``moved_by_k1``, by the logarithm of the focal length."""
    return _moved_by(match, lambda xy: xy)


def _moved_by(match: MapMatch, inward: Callable[[np.ndarray], np.ndarray]) -> np.ndarray | None:
    """``inward``: rays (N, 2) -> how far each of them moves towards the centre."""
    if not match.matches:
        return None
    assert match.pose is not None
    points = np.array(match.matches)
    xy = points[:, :2]
    r_w_c, p_m = rot_from_quat(match.pose.q_w_c), np.array(match.pose.p_c_in_w_m)
    _, jacobian, _ = project_with_jacobian(r_w_c, p_m, points[:, 2:5])
    by_pose = jacobian.reshape(-1, 6)
    by_lens = -inward(xy).ravel()
    weighted = by_pose.T * np.repeat(points[:, 5], 2)
    return np.asarray(np.linalg.solve(weighted @ by_pose, weighted @ by_lens))


def undistorted_pose(
    seen: gtsam.Pose3, cov: np.ndarray, by_k1: np.ndarray | None, more: float, sigma: float
) -> tuple[gtsam.Pose3, np.ndarray]:
    """Pose and covariance of a match, had the radial coefficient been larger by ``more``, known to ``sigma``.
    ``by_k1``: ``moved_by_k1`` of the match."""
    if by_k1 is None:
        return seen, cov
    return seen.retract(by_k1 * more), cov + sigma**2 * np.outer(by_k1, by_k1)


def determined(match: MapMatch) -> bool:
    """Whether pose and covariance are finite, and the 2D-3D matches (when there are any) determine six degrees of
    freedom.

    The anchor checks this too; a graph that fused such a pose would be overconfident for good."""
    if match.pose is None:
        return False
    p_m, q = np.array(match.pose.p_c_in_w_m), np.array(match.pose.q_w_c)
    cov = np.array(match.pose.cov, dtype=float)
    if not (cov.shape == (36,) and np.isfinite(p_m).all() and np.isfinite(q).all() and np.isfinite(cov).all()):
        return False
    if abs(float(np.linalg.norm(q)) - 1.0) > 1e-3 or float(np.linalg.eigvalsh(cov.reshape(6, 6))[0]) <= 0.0:
        return False
    if not match.matches:
        return True
    r_w_c = rot_from_quat((float(q[0]), float(q[1]), float(q[2]), float(q[3])))
    points = np.array(match.matches)[:, 2:5]
    _, jacobian, depth = project_with_jacobian(r_w_c, p_m, points)
    scaled = jacobian.reshape(-1, 6) * ([1.0] * 3 + [float(np.median(np.abs(depth)))] * 3)
    spread = np.linalg.eigvalsh(scaled.T @ scaled)
    return bool(depth.min() > 0.0 and spread[0] * MAX_CONDITION > spread[-1])
