"""Estimates the principal point of a camera that is not calibrated.

An error of the principal point shifts all rays alike and looks like an error of position: neither the map nor odometry
separates the two. Lens distortion does, since it is centred on the principal point. Points that three keyframes see are
projected with a lens model that has its own principal point (Brown-Conrady, as OpenCV), cameras and points are
eliminated, and the information on the lens accumulates over keyframes (extended Kalman filter, information form). The
filter stands beside the graph, in which a principal point would shift every pose alike and constrain none."""

import gtsam
import numpy as np

from terrafix.core.camera import camera_rotation
from terrafix.estimator.factors.three_view import (
    MAX_RESIDUAL_RATIO,
    MEDIAN_RESIDUAL,
    POINT_HUBER_K,
    SHARED_TRIPLES,
    ThreeViewPose,
    project_triples,
)
from terrafix.estimator.models.lens_prior import RADIAL_K1_PER_FOCAL_SIGMA, principal_point_sigma
from terrafix.estimator.models.plane_motion import EFFECTIVE_PAIRS
from terrafix.messages import Camera, LensEstimate, NavEstimate

# k1, k2, p1, p2, focal length (relative), principal point; normalised image coordinates.
LENS_SIZE, FOCAL_INDEX, PRINCIPAL_POINT = 7, 4, slice(5, 7)  # [spec: order of OpenCV]
# 1-sigma of p1 and p2, tangential distortion of a decentred lens, which the points hardly separate from the principal
# point; published calibrations of phones, action cameras and drones have 0.0001 to 0.001.
TANGENTIAL_SIGMA = 5e-4  # [tuned]
CAMERA_ITERATIONS = 3  # of Gauss-Newton for the cameras, which start at the solution of the three-view factor [tuned]
DAMPING = 1e-6  # share of the information that constrains the cameras: the scale of the three views is free [tuned]
UNDISTORT_ITERATIONS = 5  # of Newton's method: accurate to a thousandth of a pixel [tuned]


class PrincipalPointFilter:
    """``offset`` (2,): of the principal point from the described one, normalised coordinates, right and down, with
    covariance ``cov`` (2, 2)."""

    def __init__(self, camera: Camera, learnt: LensEstimate | None = None) -> None:
        """``learnt``: by an estimator that ran before in this flight."""
        offset_sigma = principal_point_sigma(camera)
        self._uncertain = offset_sigma > 0.0
        # A described distortion was calibrated together with its principal point; rays are undistorted around that.
        self._estimates = self._uncertain and not camera.distortion
        lens, focal = RADIAL_K1_PER_FOCAL_SIGMA * camera.focal_sigma, camera.focal_sigma
        self._x = np.zeros(LENS_SIZE)
        self._information = np.zeros((LENS_SIZE, LENS_SIZE))
        if self._uncertain:
            sigmas = np.array([lens, lens, TANGENTIAL_SIGMA, TANGENTIAL_SIGMA, focal, offset_sigma, offset_sigma])
            self._information = np.diag(sigmas**-2)
        if self._estimates and learnt is not None:
            self._x = np.array(learnt.value)
            self._information = np.array(learnt.information).reshape(LENS_SIZE, LENS_SIZE)
        self.cov = self._covariance()

    @property
    def offset(self) -> np.ndarray:
        return self._x[PRINCIPAL_POINT]

    @property
    def learnt(self) -> LensEstimate | None:
        """For a checkpoint; None: nothing is estimated."""
        if not self._estimates:
            return None
        return LensEstimate(value=tuple(map(float, self._x)), information=tuple(map(float, self._information.ravel())))

    def update(self, triples: np.ndarray, sigma_norm: float, at: ThreeViewPose) -> None:
        """``triples`` (N, 6): normalised points in the first, middle and last camera, ``sigma_norm`` of a coordinate;
        ``at``: those cameras."""
        if not self._estimates:
            return
        seen = triples.reshape(-1, 3, 2)[:, [1, 0, 2]]  # the middle camera comes first
        try:
            added = _information(seen, sigma_norm, at, self._x)
        except np.linalg.LinAlgError:  # an iterate whose distortion folds the image
            added = None
        if added is None or not all(np.isfinite(numbers).all() for numbers in added):
            return
        information, gradient = added
        self._information = self._information + information
        self._x = self._x - np.linalg.solve(self._information, gradient)
        self.cov = self._covariance()

    def shift(self, jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """-> shift (2,), east and north [m], from the camera of the graph to the true one, and its covariance (2, 2).
        ``jacobian`` (2, 2): ``FilterState.principal_point_jacobian``."""
        return jacobian @ self.offset, jacobian @ self.cov @ jacobian.T

    def _covariance(self) -> np.ndarray:
        return (
            np.linalg.inv(self._information)[PRINCIPAL_POINT, PRINCIPAL_POINT] if self._uncertain else np.zeros((2, 2))
        )


def graph_shift(published: NavEstimate, camera: Camera, learnt: LensEstimate) -> np.ndarray:
    """(2,): from the camera of the graph to the published position [m]."""
    r_w_c = camera_rotation(published, camera)
    return PrincipalPointFilter(camera, learnt).shift(published.agl_m * r_w_c[:2, :2])[0]


def _information(
    seen: np.ndarray, sigma_norm: float, at: ThreeViewPose, lens: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Information (LENS_SIZE, LENS_SIZE) of points ``seen`` (N, 3, 2) on the ``lens`` (LENS_SIZE,), and its
    gradient (LENS_SIZE,): a step of Gauss-Newton with cameras and points eliminated (Schur complement). None: the
    residuals are too large."""
    n, unit = len(seen), 1.0 / at.height_m
    points = np.column_stack([_undistort(seen[:, 0], lens), np.ones(n)])
    at = ThreeViewPose(_scaled(at.first, unit), _scaled(at.last, unit), 1.0, 0.0, 0.0)
    for round_ in range(CAMERA_ITERATIONS + 1):
        xy, by_cameras, by_point = project_triples(points, np.zeros_like(seen), at)
        projected_xy, by_ray, by_lens = _distort(xy.reshape(-1, 2), lens)
        residual = projected_xy.reshape(n, 6) - seen.reshape(n, 6)
        by_ray = by_ray.reshape(n, 3, 2, 2)
        by_point = (by_ray @ by_point.reshape(n, 3, 2, 3)).reshape(n, 6, 3)
        by_all = np.concatenate(
            [(by_ray @ by_cameras[:, :, :12].reshape(n, 3, 2, 12)).reshape(n, 6, 12), by_lens.reshape(n, 6, LENS_SIZE)],
            axis=2,
        )
        off = np.sqrt(np.sum(residual**2, axis=1) / 3.0)  # three of six numbers are the point's
        sigma = max(sigma_norm, float(np.median(off)) / MEDIAN_RESIDUAL)
        independent = min(1.0, EFFECTIVE_PAIRS / n) / SHARED_TRIPLES
        weight = np.minimum(1.0, POINT_HUBER_K * sigma / np.maximum(off, 1e-12)) * (independent / sigma**2)
        weighted = np.swapaxes(by_point * weight[:, None, None], 1, 2)
        inner = np.linalg.inv(weighted @ by_point + 1e-12 * np.eye(3))
        across = np.swapaxes(weighted @ by_all, 1, 2)
        pull = (weighted @ residual[:, :, None])[:, :, 0]
        flat = by_all.reshape(6 * n, -1)
        gain = across @ inner
        whole = (flat * np.repeat(weight, 6)[:, None]).T @ flat - np.einsum("nij,nkj->ik", gain, across)
        push = np.einsum("nri,nr,n->i", by_all, residual, weight) - np.einsum("nij,nj->i", gain, pull)
        held = whole[:12, :12] + DAMPING * np.trace(whole[:12, :12]) / 12 * np.eye(12)
        if round_ == CAMERA_ITERATIONS:
            break
        step = -np.linalg.solve(held, push[:12])
        points = points - np.einsum("nij,nj->ni", inner, pull + np.einsum("nij,i->nj", across[:, :12], step))
        at = ThreeViewPose(at.first.retract(step[:6]), at.last.retract(step[6:]), 1.0, 0.0, 0.0)
    if not sigma < MAX_RESIDUAL_RATIO * sigma_norm:
        return None
    of_cameras = np.linalg.solve(held, whole[:12, 12:])
    return whole[12:, 12:] - whole[12:, :12] @ of_cameras, push[12:] - of_cameras.T @ push[:12]


def _scaled(pose: gtsam.Pose3, unit: float) -> gtsam.Pose3:
    return gtsam.Pose3(pose.rotation(), unit * pose.translation())


def _distort(ray: np.ndarray, lens: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image points (N, 2) of rays (N, 2) through ``lens`` (LENS_SIZE,), and the Jacobians by ray (N, 2, 2) and lens
    (N, 2, LENS_SIZE)."""
    k1, k2, p1, p2, focal = lens[: FOCAL_INDEX + 1]
    x, y = ray[:, :1], ray[:, 1:]
    r2 = x**2 + y**2
    straight = 1.0 + k1 * r2 + k2 * r2**2
    by_p1, by_p2 = np.hstack([2 * x * y, r2 + 2 * y**2]), np.hstack([r2 + 2 * x**2, 2 * x * y])
    bent = ray * straight + p1 * by_p1 + p2 * by_p2
    by_ray = ray[:, :, None] * ray[:, None, :] * (2 * k1 + 4 * k2 * r2)[:, :, None] + straight[:, :, None] * np.eye(2)
    xx, xy, yy = 2 * p1 * y + 6 * p2 * x, 2 * p1 * x + 2 * p2 * y, 6 * p1 * y + 2 * p2 * x
    by_ray += np.hstack([xx, xy, xy, yy]).reshape(-1, 2, 2)
    by_lens = np.zeros((len(ray), 2, LENS_SIZE))
    by_lens[:, :, :FOCAL_INDEX] = (1.0 + focal) * np.stack([ray * r2, ray * r2**2, by_p1, by_p2], axis=2)
    by_lens[:, :, FOCAL_INDEX] = bent
    by_lens[:, :, PRINCIPAL_POINT] = np.eye(2)
    return (1.0 + focal) * bent + lens[PRINCIPAL_POINT], (1.0 + focal) * by_ray, by_lens


def _undistort(seen: np.ndarray, lens: np.ndarray) -> np.ndarray:
    """The inverse of ``_distort``: (N, 2) both."""
    ray = seen - lens[PRINCIPAL_POINT]
    for _ in range(UNDISTORT_ITERATIONS):
        distorted, by_ray, _ = _distort(ray, lens)
        ray = ray - np.linalg.solve(by_ray, (distorted - seen)[:, :, None])[:, :, 0]
    return ray
