"""Geometry of the pictures of a moment: where a frame lies on the ground, and what its matches say.

World coordinates are those of the record: east and north in metres about the origin of the flight, up AMSL."""

import math
from dataclasses import dataclass, replace

import numpy as np

from terrafix.core.camera import CameraCalibration, camera_rotation
from terrafix.core.geodesy import LocalFrame, rot_from_quat
from terrafix.messages import MapMatch, MapPose, Origin
from terrafix_tools.report.moment_record import FrameRecord

EDGE_POINTS = 6  # of the footprint on each edge of the image; distortion bends the edges
FARTHEST = 4.0  # heights: a ray that meets the ground farther away, or not at all, ends there


@dataclass(frozen=True)
class Pose:
    """Camera pose with the height of the ground below it."""

    p_m: np.ndarray  # (3,) world
    r_w_c: np.ndarray  # (3, 3)
    ground_m: float  # AMSL

    @property
    def agl_m(self) -> float:
        return max(1.0, float(self.p_m[2]) - self.ground_m)

    @property
    def heading_rad(self) -> float:
        """Direction of the image's upper edge on the ground, clockwise from north."""
        up = self.r_w_c @ np.array([0.0, -1.0, 0.0])
        return math.atan2(float(up[0]), float(up[1]))

    def ground(self, xy: np.ndarray) -> np.ndarray:
        """Rays (N, 2), normalised image coordinates -> where they meet the ground (N, 2)."""
        rays = np.column_stack([xy, np.ones(len(xy))]) @ self.r_w_c.T
        down = np.maximum(-rays[:, 2], 1e-9)
        level = np.maximum(np.linalg.norm(rays[:, :2], axis=1), 1e-9)
        length = np.minimum(self.agl_m / down, FARTHEST * self.agl_m / level)
        return np.asarray(self.p_m[:2] + rays[:, :2] * length[:, None])

    def seen(self, points_m: np.ndarray) -> np.ndarray:
        """World points (N, 3) -> normalised image coordinates (N, 2); NaN behind the camera."""
        q = (points_m - self.p_m) @ self.r_w_c
        depth = np.where(q[:, 2:] > 1e-6, q[:, 2:], np.nan)
        return np.asarray(q[:, :2] / depth)


@dataclass(frozen=True)
class Matches:
    """2D-3D matches of a frame. ``inlier``: whether they agree with the pose that was computed; None: unknown."""

    xy: np.ndarray  # (N, 2) normalised image coordinates
    points_m: np.ndarray  # (N, 3) world
    inlier: np.ndarray | None  # (N,) bool


def calibration_of(origin: Origin, match: MapMatch | None) -> CameraCalibration:
    return replace(CameraCalibration.of(origin.camera), radial_k1=match.radial_k1 if match is not None else 0.0)


def estimated_pose(record: FrameRecord, origin: Origin) -> Pose | None:
    """The camera pose as published, else as predicted; None without both."""
    if (estimate := record.estimate) is not None:
        e_m, n_m = LocalFrame(origin.lat_deg, origin.lon_deg).to_local(estimate.lat_deg, estimate.lon_deg)
        r_w_c = camera_rotation(estimate, origin.camera)
        up_m = estimate.alt_amsl_m
        return Pose(np.array([e_m, n_m, up_m]), r_w_c, up_m - estimate.agl_m)
    if (predicted := record.prediction) is not None:
        p_m = np.array(predicted.p_c_in_w_m)
        return Pose(p_m, rot_from_quat(predicted.q_w_c), float(p_m[2]) - predicted.agl_m)
    return None


def matched_pose(record: FrameRecord, ground_m: float) -> Pose | None:
    """The camera pose that the map match gives, also if it was rejected; None: it gives no full pose."""
    found = _solved(record)
    if found is None or found.position_only:
        return None
    return Pose(np.array(found.p_c_in_w_m), rot_from_quat(found.q_w_c), ground_m)


def matches_of(record: FrameRecord) -> Matches | None:
    match = record.match
    if match is None or not match.matches:
        return None
    rows = np.array(match.matches, dtype=float).reshape(-1, 6)
    rows = rows[np.isfinite(rows).all(axis=1)]
    xy, points_m = rows[:, :2], rows[:, 2:5]
    found = _solved(record)
    if match.pnp is None:
        return Matches(xy, points_m, np.ones(len(xy), bool))  # those that agree with the matcher's own pose
    if found is None:
        return Matches(xy, points_m, None)
    pose = Pose(np.array(found.p_c_in_w_m), rot_from_quat(found.q_w_c), 0.0)
    error = np.linalg.norm(pose.seen(points_m) - xy, axis=1)
    return Matches(xy, points_m, np.nan_to_num(error, nan=np.inf) < match.pnp.threshold)


def _solved(record: FrameRecord) -> MapPose | None:
    if record.solution is not None and record.solution.pose is not None:
        return record.solution.pose
    return record.match.pose if record.match is not None else None


def footprint(pose: Pose, camera: CameraCalibration) -> np.ndarray:
    """(4 EDGE_POINTS, 2) ground points of the image border, around it."""
    share = np.linspace(0.0, 1.0, EDGE_POINTS, endpoint=False)
    right, bottom = camera.width - 0.5, camera.height - 0.5
    top = np.column_stack([-0.5 + share * camera.width, np.full(EDGE_POINTS, -0.5)])
    side = np.column_stack([np.full(EDGE_POINTS, right), -0.5 + share * camera.height])
    low = np.column_stack([right - share * camera.width, np.full(EDGE_POINTS, bottom)])
    left = np.column_stack([np.full(EDGE_POINTS, -0.5), bottom - share * camera.height])
    return pose.ground(camera.normalise(np.vstack([top, side, low, left])))
