"""Pinhole camera model with Brown-Conrady distortion, and the orientation of the camera in the body."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from msgspec import UnsetType

from terrafix.core.geodesy import rot_from_quat
from terrafix.messages import Camera, NavEstimate

# Lower bound of the denominator of the division model: a point moves outwards by a factor of 4 at most.
MIN_UNDISTORTION_DENOMINATOR = 0.25


# OpenCV's default of five iterations is 1e-3 off at 45 degrees of a lens with k1 = -0.28: a pixel
# [measured: tests/unit/vision/test_fisheye.py].
UNDISTORTION = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-9)


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
class CameraCalibration:
    """Intrinsics in pixels of the stored frames. ``distortion``: OpenCV order (k1 k2 p1 p2 k3 ...), empty = none.

    ``radial_k1``: residual radial distortion that the calibration does not describe, as estimated in flight
    (``undistort_division``)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    radial_k1: float = 0.0

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
        return undistort_division(xy, self.radial_k1) if self.radial_k1 else xy

    def project(self, p_in_c: np.ndarray) -> np.ndarray:
        """Points in the camera frame (N, 3), z > 0, any length unit -> distorted pixels (N, 2)."""
        if self.radial_k1:
            distorted_xy = distort_division(p_in_c[:, :2] / p_in_c[:, 2:], self.radial_k1)
            p_in_c = np.column_stack([distorted_xy, np.ones(len(p_in_c))])
        if not self.distortion:
            return p_in_c[:, :2] / p_in_c[:, 2:] * (self.fx, self.fy) + (self.cx, self.cy)
        zero = np.zeros(3)
        px, _ = cv2.projectPoints(np.ascontiguousarray(p_in_c), zero, zero, self.matrix(), np.array(self.distortion))
        return np.asarray(px).reshape(-1, 2)

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
