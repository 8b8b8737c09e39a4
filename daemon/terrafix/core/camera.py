"""Pinhole camera with Brown-Conrady distortion, and its mount in the body."""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from terrafix.messages import Camera

# Of a ray: what a lens bends is undone no farther than to this share of it, or four times as far out.
LEAST_STRAIGHT = 0.25


def straightened(xy: np.ndarray, bend: float) -> np.ndarray:
    """Normalised coordinates (N, 2) as a lens of this ``bend`` shows them -> where they really look.

    The division model (Fitzgibbon 2001). Near the middle it is OpenCV's k1; one number follows an action camera
    (k1 -0.28, k2 0.09, k3 -0.012) to 0.2 % of its focal length out to 47 degrees, and k1 alone to 1.3 %."""
    return np.asarray(xy / np.maximum(1.0 + bend * np.sum(np.square(xy), axis=1, keepdims=True), LEAST_STRAIGHT))


def bent(xy: np.ndarray, bend: float) -> np.ndarray:
    """The inverse of ``straightened``."""
    inside = np.maximum(1.0 - 4.0 * bend * np.sum(np.square(xy), axis=1, keepdims=True), 0.0)
    return np.asarray(xy * 2.0 / (1.0 + np.sqrt(inside)))


@dataclass(frozen=True)
class CameraCalibration:
    """Pixels of the stored frames; ``distortion`` in OpenCV order (k1 k2 p1 p2 k3 ...), empty = none. ``bend``: what
    the lens bends beyond its description (``straightened``)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    bend: float = 0.0

    @classmethod
    def of(cls, camera: Camera) -> "CameraCalibration":
        return cls(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion)

    def matrix(self) -> np.ndarray:
        """K (3x3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def normalise(self, px: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) -> undistorted normalised coordinates (N, 2)."""
        if self.distortion:
            points = np.ascontiguousarray(px, dtype=np.float64).reshape(-1, 1, 2)
            xy = np.asarray(cv2.undistortPoints(points, self.matrix(), np.array(self.distortion))).reshape(-1, 2)
        else:
            xy = (px - (self.cx, self.cy)) / (self.fx, self.fy)
        return straightened(xy, self.bend) if self.bend else xy

    def project(self, p_in_c: np.ndarray) -> np.ndarray:
        """Points in the camera frame (N, 3), z > 0 -> distorted pixels (N, 2)."""
        if self.bend:
            p_in_c = np.column_stack([bent(p_in_c[:, :2] / p_in_c[:, 2:], self.bend), np.ones(len(p_in_c))])
        if not self.distortion:
            return p_in_c[:, :2] / p_in_c[:, 2:] * (self.fx, self.fy) + (self.cx, self.cy)
        zero = np.zeros(3)
        px, _ = cv2.projectPoints(np.ascontiguousarray(p_in_c), zero, zero, self.matrix(), np.array(self.distortion))
        return np.asarray(px).reshape(-1, 2)

    def scaled(self, factor: float) -> "CameraCalibration":
        """The same camera on frames resized by ``factor`` (pixel centres at integer + 0.5)."""
        return CameraCalibration(
            round(self.width * factor),
            round(self.height * factor),
            self.fx * factor,
            self.fy * factor,
            (self.cx + 0.5) * factor - 0.5,
            (self.cy + 0.5) * factor - 0.5,
            self.distortion,
            self.bend,
        )


@dataclass(frozen=True)
class Mount:
    """Camera in the body: yaw, then pitch (-90 = straight down, image top forward), then roll; degrees."""

    yaw_deg: float = 0.0
    pitch_deg: float = -90.0
    roll_deg: float = 0.0
    tolerance_deg: float = 5.0  # 1-sigma of the real tilt around the nominal one

    @classmethod
    def of(cls, camera: Camera) -> "Mount":
        return cls(camera.mount_yaw_deg, camera.mount_pitch_deg, camera.mount_roll_deg, camera.mount_tolerance_deg)

    def r_b_c(self) -> np.ndarray:
        """R_b_c (3x3): camera coordinates into body FRD."""
        y, p, r = (math.radians(v) for v in (self.yaw_deg, self.pitch_deg, self.roll_deg))
        rz = np.array([[math.cos(y), -math.sin(y), 0], [math.sin(y), math.cos(y), 0], [0, 0, 1.0]])
        ry = np.array([[math.cos(p), 0, math.sin(p)], [0, 1.0, 0], [-math.sin(p), 0, math.cos(p)]])
        rx = np.array([[1.0, 0, 0], [0, math.cos(r), -math.sin(r)], [0, math.sin(r), math.cos(r)]])
        forward_looking = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # camera z = body x, camera x = body y
        return rz @ ry @ rx @ forward_looking
