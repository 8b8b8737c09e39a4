"""Pinhole camera with Brown-Conrady distortion and rolling shutter, and its orientation in the body."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from msgspec import UnsetType

from terrafix.core.geodesy import rot_from_quat
from terrafix.messages import Camera, NavEstimate, ReadoutMotion

# Lower bound of the denominator of the division model: a point moves outwards by a factor of 4 at most.
MIN_UNDISTORTION_DENOMINATOR = 0.25


# OpenCV's default of five iterations is 1e-3 off at 45 degrees of a lens with k1 = -0.28: a pixel
# [measured: tests/unit/vision/test_fisheye.py].
UNDISTORTION = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-9)


# From the row that a point would have without motion to the one in which it is exposed: each step leaves the share of
# the image that it moves during the readout, a twentieth. [measured: tests/unit/core/test_camera_readout.py]
READOUT_STEPS = 2


def _undistort_points(points: np.ndarray, matrix: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Pixels (N, 1, 2) -> normalised coordinates (N, 1, 2), by cv2.undistortPoints to convergence."""
    if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4
        return np.asarray(cv2.undistortPointsIter(points, matrix, distortion, None, None, UNDISTORTION))
    return np.asarray(cv2.undistortPoints(points, matrix, distortion, criteria=UNDISTORTION))


def undistort_division(xy: np.ndarray, radial_k1: float) -> np.ndarray:
    """Distorted normalised coordinates (N, 2) -> undistorted normalised coordinates (N, 2).

    Division model with one coefficient (Fitzgibbon 2001). Near the principal point ``radial_k1`` equals OpenCV's k1.
    The model follows an action camera (k1 -0.28, k2 0.09, k3 -0.012) to 0.2 % of its focal length out to 47 degrees
    off the optical axis; OpenCV's polynomial with k1 alone follows it to 1.3 %."""
    denominator = 1.0 + radial_k1 * np.sum(np.square(xy), axis=1, keepdims=True)
    return np.asarray(xy / np.maximum(denominator, MIN_UNDISTORTION_DENOMINATOR))


def distort_division(xy: np.ndarray, radial_k1: float) -> np.ndarray:
    """Inverse of ``undistort_division``: undistorted -> distorted normalised coordinates (N, 2)."""
    discriminant = np.maximum(1.0 - 4.0 * radial_k1 * np.sum(np.square(xy), axis=1, keepdims=True), 0.0)
    return np.asarray(xy * 2.0 / (1.0 + np.sqrt(discriminant)))


@dataclass(frozen=True)
class Readout:
    """Rolling shutter of one frame over level ground: every row is exposed at its own time.

    ``row_s``: time from one row to the next; ``middle_row``: that of the time stamp. ``rate_radps``, ``speed_per_s``
    (velocity over the height above ground), ``down``: (3,), axes of the camera."""

    row_s: float
    middle_row: float
    rate_radps: np.ndarray
    speed_per_s: np.ndarray
    down: np.ndarray

    @classmethod
    def of(cls, camera: Camera, motion: ReadoutMotion | UnsetType, r_w_c: np.ndarray) -> "Readout | None":
        """None: the camera has no rolling shutter, or it is not known how it moved. ``r_w_c`` (3, 3): its attitude."""
        if isinstance(motion, UnsetType) or not camera.readout_s:
            return None
        moved = np.array(motion.rate_radps), np.array(motion.speed_per_s)
        return cls(camera.readout_s / (camera.height - 1), 0.5 * (camera.height - 1), *moved, -r_w_c[2])

    def shift(self, xy: np.ndarray, row: np.ndarray) -> np.ndarray:
        """(N, 2): by how much normalised coordinates ``xy`` (N, 2) of points in image rows ``row`` (N,) would differ
        if they had been exposed with the middle row, to the first order."""
        rays = np.column_stack([xy, np.ones(len(xy))])
        away = np.maximum(rays @ self.down, 0.0)  # 0: above the horizon, where translation moves nothing
        flow = away[:, None] * self.speed_per_s + np.cross(self.rate_radps, rays)
        after_s = (row - self.middle_row) * self.row_s
        return np.asarray(after_s[:, None] * (flow[:, :2] - xy * flow[:, 2:]))


@dataclass(frozen=True)
class CameraCalibration:
    """Intrinsics in pixels of the stored frames. ``distortion``: OpenCV order (k1 k2 p1 p2 k3 ...), empty = none.

    ``radial_k1``: residual radial distortion that the calibration does not describe, as estimated in flight
    (``undistort_division``). ``readout``: of the frame; normalised coordinates are those of the middle row's camera."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    radial_k1: float = 0.0
    readout: Readout | None = None

    @classmethod
    def of(cls, camera: Camera) -> "CameraCalibration":
        distortion = camera.distortion if any(camera.distortion) else ()
        return cls(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, distortion)

    def matrix(self) -> np.ndarray:
        """Camera matrix K (3x3), pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def normalise(self, px: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) -> undistorted normalised coordinates (N, 2)."""
        if self.distortion:
            points = np.ascontiguousarray(px, dtype=np.float64).reshape(-1, 1, 2)
            xy = _undistort_points(points, self.matrix(), np.array(self.distortion)).reshape(-1, 2)
        else:
            xy = (px - (self.cx, self.cy)) / (self.fx, self.fy)
        xy = undistort_division(xy, self.radial_k1) if self.radial_k1 else xy
        return xy if self.readout is None else xy + self.readout.shift(xy, px[:, 1])

    def project(self, p_in_c: np.ndarray) -> np.ndarray:
        """Points in the camera frame (N, 3), z > 0, any length unit -> distorted pixels (N, 2)."""
        if self.readout is not None:
            return self._project_by_rows(p_in_c[:, :2] / p_in_c[:, 2:], self.readout)
        if self.radial_k1:
            distorted_xy = distort_division(p_in_c[:, :2] / p_in_c[:, 2:], self.radial_k1)
            p_in_c = np.column_stack([distorted_xy, np.ones(len(p_in_c))])
        if not self.distortion:
            return p_in_c[:, :2] / p_in_c[:, 2:] * (self.fx, self.fy) + (self.cx, self.cy)
        zero = np.zeros(3)
        px, _ = cv2.projectPoints(np.ascontiguousarray(p_in_c), zero, zero, self.matrix(), np.array(self.distortion))
        return np.asarray(px).reshape(-1, 2)

    def _project_by_rows(self, xy: np.ndarray, readout: Readout) -> np.ndarray:
        still, seen = replace(self, readout=None), xy
        for _ in range(READOUT_STEPS):
            px = still.project(np.column_stack([seen, np.ones(len(seen))]))
            seen = xy - readout.shift(seen, px[:, 1])
        return still.project(np.column_stack([seen, np.ones(len(seen))]))

    def scaled(self, factor: float) -> "CameraCalibration":
        """Intrinsics for frames resized by ``factor``. Pixel indices denote centres: pixel 0 spans -0.5 to 0.5."""
        return CameraCalibration(
            round(self.width * factor),
            round(self.height * factor),
            self.fx * factor,
            self.fy * factor,
            (self.cx + 0.5) * factor - 0.5,
            (self.cy + 0.5) * factor - 0.5,
            self.distortion,
            self.radial_k1,
        )


@dataclass(frozen=True)
class Mount:
    """Orientation of the camera in the body: yaw, then pitch (-90 = straight down, image top forward), then roll."""

    yaw_deg: float = 0.0
    pitch_deg: float = -90.0
    roll_deg: float = 0.0
    tolerance_deg: float = 5.0  # 1-sigma of the true tilt about the nominal tilt

    @classmethod
    def of(cls, camera: Camera) -> "Mount":
        return cls(camera.mount_yaw_deg, camera.mount_pitch_deg, camera.mount_roll_deg, camera.mount_tolerance_deg)

    def r_b_c(self) -> np.ndarray:
        """R_b_c (3x3): rotates camera coordinates (OpenCV axes) into the body frame FRD."""
        y, p, r = (math.radians(v) for v in (self.yaw_deg, self.pitch_deg, self.roll_deg))
        rz = np.array([[math.cos(y), -math.sin(y), 0], [math.sin(y), math.cos(y), 0], [0, 0, 1.0]])
        ry = np.array([[math.cos(p), 0, math.sin(p)], [0, 1.0, 0], [-math.sin(p), 0, math.cos(p)]])
        rx = np.array([[1.0, 0, 0], [0, math.cos(r), -math.sin(r)], [0, math.sin(r), math.cos(r)]])
        forward_looking = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # camera z = body x, camera x = body y
        return rz @ ry @ rx @ forward_looking


def camera_rotation(estimate: NavEstimate, camera: Camera) -> np.ndarray:
    """R_w_c (3x3) of an estimate: of a camera on a gimbal as estimated, of a fixed one with the mount as described."""
    if isinstance(estimate.q_w_c, UnsetType):
        return np.asarray(rot_from_quat(estimate.q_w_b) @ Mount.of(camera).r_b_c())
    return rot_from_quat(estimate.q_w_c)
