"""The pose of a map match, as the graph takes it: whether it is one, and how sure."""

import gtsam
import numpy as np

from terrafix.core.geodesy import rot_from_quat
from terrafix.core.pose import MAX_CONDITION, project_with_jacobian, world_to_tangent
from terrafix.estimator.models.terrain import Terrain
from terrafix.messages import MapMatch

LOCAL_WARP = 0.33  # of the map's own error: by so much orthophotos are stretched over one footprint
ROOFS = 0.03  # of the height, 1-sigma: roofs and crowns lift the ground that is seen, and with it the height


def measured_pose(match: MapMatch, terrain: Terrain) -> tuple[gtsam.Pose3, np.ndarray]:
    """Of a match that is ``determined``: pose and covariance (6x6, tangent order).

    A slope that the map does not tell looks like a tilt of the camera about the ground below it: it turns the pose and
    moves it by the height times as much."""
    assert match.p_c_in_w_m is not None and match.q_w_c is not None
    r_w_c = rot_from_quat(match.q_w_c)
    local_m, height_m = LOCAL_WARP * match.map_sigma_m, max(match.p_c_in_w_m[2] - terrain.ground_m, 1.0)
    about_north, about_east = np.zeros(6), np.zeros(6)
    about_north[[0, 4]], about_east[[1, 3]] = (height_m, 1.0), (-height_m, 1.0)
    slope = terrain.slope_sigma(height_m) ** 2 * (np.outer(about_north, about_north) + np.outer(about_east, about_east))
    cov = world_to_tangent(np.array(match.cov).reshape(6, 6) + slope, r_w_c)
    cov[3:, 3:] += r_w_c.T @ np.diag([local_m, local_m, ROOFS * height_m]) ** 2 @ r_w_c
    return gtsam.Pose3(gtsam.Rot3.ClosestTo(r_w_c), np.array(match.p_c_in_w_m)), cov


def moved_by_lens(match: MapMatch) -> np.ndarray | None:
    """(6,) tangent order: what the pose of a match that is ``determined`` would have moved by, had the lens one more of
    bend than it was seen through. Around the middle of the picture that is the height; where the ground that counted
    lies aside, it is tilt and place. None: a coarse fix, which has no points."""
    if not match.matches:
        return None
    assert match.p_c_in_w_m is not None and match.q_w_c is not None
    points = np.array(match.matches)
    xy = points[:, :2]
    _, jacobian, _ = project_with_jacobian(rot_from_quat(match.q_w_c), np.array(match.p_c_in_w_m), points[:, 2:5])
    by_pose = jacobian.reshape(-1, 6)
    by_lens = -(np.sum(np.square(xy), axis=1, keepdims=True) * xy).ravel()  # a ray is straightened by as much
    weighted = by_pose.T * np.repeat(points[:, 5], 2)
    return np.asarray(np.linalg.solve(weighted @ by_pose, weighted @ by_lens))


def straightened_pose(
    seen: gtsam.Pose3, cov: np.ndarray, by_lens: np.ndarray | None, more: float, sigma: float
) -> tuple[gtsam.Pose3, np.ndarray]:
    """The pose of a match and its covariance, had the lens ``more`` of bend than it was seen through, known to
    ``sigma``. ``by_lens``: ``moved_by_lens`` of the match."""
    if by_lens is None:
        return seen, cov
    return seen.retract(by_lens * more), cov + sigma**2 * np.outer(by_lens, by_lens)


def determined(match: MapMatch) -> bool:
    """Whether pose and covariance are numbers, and the 2D-3D matches (when it has any) fix six degrees of freedom.

    The anchor has looked already; a graph that was given such a pose would be sure of it for ever."""
    if match.p_c_in_w_m is None or match.q_w_c is None or match.cov is None:
        return False
    p_m, q = np.array(match.p_c_in_w_m), np.array(match.q_w_c)
    cov = np.array(match.cov, dtype=float)
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
