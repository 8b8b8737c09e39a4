"""Position of an object from pixels of one or several frames, with covariance.

The unknown is one point. Each pixel is a measurement of its direction, with the covariance of the camera pose; the
ground gives its height. Errors of the poses of one flight are correlated to an unknown degree (one map, one barometer,
one compass), so n pixels together count as much as one: covariance intersection with equal weights (Julier and Uhlmann
1997). Several directions add what a single one lacks, the height of an object that stands above the ground."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from terrafix.core.errors import UsageError
from terrafix.core.gate import CHI2_95, GATE
from terrafix.core.pose import project_with_jacobian, world_to_tangent
from terrafix.estimator.state import HORIZONTAL, TRANSLATION, UP
from terrafix_tools.locate.ground import GroundPatch, Surface
from terrafix_tools.locate.views import CameraView

PIXEL_SIGMA = 1.0  # 1-sigma of a pointed pixel, per axis, pixels of the stored frame
CHI2_999 = 13.816  # 99.9 %: the gate of a pixel against the others
ITERATIONS = 10  # of Gauss-Newton
STEP_TOLERANCE_M = 1e-4


@dataclass(frozen=True)
class Pixel:
    """Pixel (u, v) of the frame of ``view``, u to the right and v down, pixel centres at whole numbers."""

    view: CameraView
    u: float
    v: float

    def normalised(self) -> np.ndarray:
        """(2,) undistorted normalised image coordinates."""
        return self.view.calibration.normalise(np.array([[self.u, self.v]]))[0]

    def ray(self) -> np.ndarray:
        """(3,) unit, world axes."""
        ray = self.view.r_w_c @ np.array([*self.normalised(), 1.0])
        return np.asarray(ray / np.linalg.norm(ray))


@dataclass(frozen=True)
class ObjectPosition:
    """``p_m`` (3,): in the local frame of the flight, up is AMSL; ``cov`` (3, 3). ``test_ratios``: of each pixel, its
    squared Mahalanobis distance from the common point over the gate; above 1 it shows something else."""

    p_m: np.ndarray
    cov: np.ndarray
    surface: Surface
    test_ratios: tuple[float, ...]

    @property
    def radius95_m(self) -> float:
        """Longer half axis of the horizontal 95 % ellipse."""
        return float(np.sqrt(CHI2_95 * np.linalg.eigvalsh(self.cov[HORIZONTAL, HORIZONTAL])[-1]))

    @property
    def consistent(self) -> bool:
        return max(self.test_ratios) <= 1.0


def check_pixel(pixel: Pixel) -> None:
    """Raises UsageError: outside the frame."""
    camera = pixel.view.calibration
    if not (-0.5 <= pixel.u <= camera.width - 0.5 and -0.5 <= pixel.v <= camera.height - 0.5):
        raise UsageError(
            f"--pixel {pixel.u:g},{pixel.v:g}: outside the frame, which has {camera.width} x {camera.height} pixels"
        )


def locate_object(pixels: Sequence[Pixel], patches: Sequence[GroundPatch]) -> ObjectPosition:
    """Position of the one object that all ``pixels`` show. ``patches``: ground at the ray of each pixel; the most exact
    one of the first kind in the order of ``Surface`` is used, unless all pixels together contradict its height: a mast
    stands above the points about it."""
    order = list(Surface)
    rank = [(order.index(patch.surface), patch.sigma_m) for patch in patches]
    best = rank.index(min(rank))
    ground = patches[best]
    start_m = ground.intersect(pixels[best].view.p_c_in_w_m, pixels[best].ray())
    anywhere = replace(ground, sigma_m=pixels[best].view.height_m)
    free_m, free_cov = _solved(pixels, start_m, anywhere)
    normal = np.array([*-ground.slope, 1.0])
    above_m = free_m[UP] - ground.height_m(free_m)
    stands = above_m**2 > GATE[1] * (normal @ free_cov @ normal + ground.sigma_m**2)
    point_m, cov = (free_m, free_cov) if stands else _solved(pixels, start_m, ground)
    cov[UP, UP] += ground.level_sigma_m**2
    return ObjectPosition(point_m, cov, ground.surface, tuple(_test_ratio(pixel, point_m) for pixel in pixels))


def _solved(pixels: Sequence[Pixel], start_m: np.ndarray, ground: GroundPatch) -> tuple[np.ndarray, np.ndarray]:
    """-> point (3,) by all ``pixels`` and the ``ground``, and its covariance (3, 3)."""
    point_m, information, normal = start_m, np.eye(3), np.array([*-ground.slope, 1.0]) / ground.sigma_m
    for _ in range(ITERATIONS):
        information = np.outer(normal, normal)
        gradient = normal * (ground.height_m(point_m) - point_m[UP]) / ground.sigma_m
        for pixel in pixels:
            error, by_point, noise = _residual(pixel, point_m)
            weighted = by_point.T @ np.linalg.inv(noise) / len(pixels)
            information = information + weighted @ by_point
            gradient = gradient + weighted @ error
        step = np.linalg.solve(information, gradient)
        point_m = point_m + step
        if float(np.abs(step).max()) < STEP_TOLERANCE_M:
            break
    return point_m, np.linalg.inv(information)


def _residual(pixel: Pixel, point_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> measured less predicted direction (2,), its Jacobian by the point (2, 3) and its covariance (2, 2), normalised
    image coordinates."""
    view = pixel.view
    xy, jacobian, _ = project_with_jacobian(view.r_w_c, view.p_c_in_w_m, point_m[None])
    by_pose = jacobian[0]
    pixel_sigma = PIXEL_SIGMA / np.array([view.calibration.fx, view.calibration.fy])
    noise = by_pose @ world_to_tangent(view.cov, view.r_w_c) @ by_pose.T + np.diag(pixel_sigma**2)
    return pixel.normalised() - xy[0], -by_pose[:, TRANSLATION] @ view.r_w_c.T, noise


def _test_ratio(pixel: Pixel, point_m: np.ndarray) -> float:
    error, _, noise = _residual(pixel, point_m)
    return float(error @ np.linalg.solve(noise, error)) / CHI2_999
