"""Where the middle of the picture is, when nobody has calibrated the camera.

Rays that are all aside by as much are a place that is: no map and no odometry tells one from the other. But a lens
bends around its middle, and what it bends shows where that is. Points that three keyframes see are projected through a
lens with a middle of its own (Brown-Conrady, as OpenCV has it), the cameras and the points are taken out, and what the
points say of the lens is added up, keyframe after keyframe (an extended Kalman filter, in information form). This
stands beside the graph: there a middle would move every pose alike, and hold none of them."""

import gtsam
import numpy as np

from terrafix.core.camera import Mount
from terrafix.core.geodesy import rot_from_quat
from terrafix.estimator.factors.three_view import HUBER_K, MEDIAN_OFF, MOST_SIGMA, SHARED, ThreeViewPose, projected
from terrafix.estimator.models.lens_prior import LENS_PER_FOCAL_SIGMA, centre_sigma
from terrafix.estimator.models.plane_motion import EFFECTIVE_PAIRS
from terrafix.messages import Camera, LearntLens, NavEstimate

# k1, k2, p1, p2, the focal length (relative), and the middle, in the order of OpenCV; all of normalised coordinates.
SIZE, FOCAL, MIDDLE = 7, 4, slice(5, 7)
# 1-sigma of p1 and p2: lenses that sit askew in their mount. To the points it looks like another middle; calibrations
# of phones, action cameras and drones have 0.0001 to 0.001.
ASKEW_SIGMA = 5e-4
ROUNDS = 3  # of Gauss-Newton for the cameras, which are where the graph's own bundle has put them
HELD = 1e-6  # share of the information by which the cameras are held: the scale of a bundle is open
UNDISTORTED = 5  # steps of Newton's method from a picture to rays: good to a thousandth of a pixel


class PrincipalPointFilter:
    """``offset`` (2,): normalised coordinates, right and down, of where the camera's description has the middle; known
    to ``cov`` (2, 2)."""

    def __init__(self, camera: Camera, learnt: LearntLens | None = None) -> None:
        """``learnt``: by an estimator that was there before in this flight."""
        aside = centre_sigma(camera)
        self._open = aside > 0.0
        # Who states what the lens bends has found its middle as well as he has; the rays are straightened around that.
        self._learns = self._open and not camera.distortion
        lens, focal = LENS_PER_FOCAL_SIGMA * camera.focal_sigma, camera.focal_sigma
        self._is = np.zeros(SIZE)
        self._information = np.zeros((SIZE, SIZE))
        if self._open:
            sigmas = np.array([lens, lens, ASKEW_SIGMA, ASKEW_SIGMA, focal, aside, aside])
            self._information = np.diag(sigmas**-2)
        if self._learns and learnt is not None:
            self._is = np.array(learnt.value)
            self._information = np.array(learnt.information).reshape(SIZE, SIZE)
        self.cov = self._covariance()

    @property
    def offset(self) -> np.ndarray:
        return self._is[MIDDLE]

    @property
    def learnt(self) -> LearntLens | None:
        """None: nothing is learnt of it."""
        if not self._learns:
            return None
        return LearntLens(value=tuple(map(float, self._is)), information=tuple(map(float, self._information.ravel())))

    def see(self, triples: np.ndarray, sigma_norm: float, at: ThreeViewPose) -> None:
        """``triples`` (N, 6) normalised (first, middle, last) with the 1-sigma of a coordinate, by cameras ``at``."""
        if not self._learns:
            return
        seen = triples.reshape(-1, 3, 2)[:, [1, 0, 2]]  # the middle one comes first
        try:
            told = _told(seen, sigma_norm, at, self._is)
        except np.linalg.LinAlgError:  # a lens under way that folds the picture
            told = None
        if told is None or not all(np.isfinite(numbers).all() for numbers in told):
            return
        information, pull = told
        self._information = self._information + information
        self._is = self._is - np.linalg.solve(self._information, pull)
        self.cov = self._covariance()

    def aside(self, lever: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """East and north (2,) from where the graph has a camera to where it is, and the covariance (2, 2) of that.
        ``lever``: the horizontal part (2, 2) of R_w_c, times the height."""
        return lever @ self.offset, lever @ self.cov @ lever.T

    def _covariance(self) -> np.ndarray:
        return np.linalg.inv(self._information)[MIDDLE, MIDDLE] if self._open else np.zeros((2, 2))


def graph_aside(said: NavEstimate, camera: Camera, learnt: LearntLens) -> np.ndarray:
    """(2,) from where a graph had the camera to where it was said to be."""
    r_w_c = rot_from_quat(said.q_w_b) @ Mount.of(camera).r_b_c()
    return PrincipalPointFilter(camera, learnt).aside(said.agl_m * r_w_c[:2, :2])[0]


def _told(
    seen: np.ndarray, sigma_norm: float, at: ThreeViewPose, lens: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """What points ``seen`` (N, 3, 2) say of the ``lens``: information (SIZE, SIZE), and how it pulls (SIZE,).
    None: they do not fit."""
    n, unit = len(seen), 1.0 / at.height_m
    points = np.column_stack([_rays(seen[:, 0], lens), np.ones(n)])
    at = ThreeViewPose(_scaled(at.first, unit), _scaled(at.last, unit), 1.0, 0.0, 0.0)
    for round_ in range(ROUNDS + 1):
        xy, by_cameras, by_point = projected(points, np.zeros_like(seen), at)
        shown, by_ray, by_lens = _shown(xy.reshape(-1, 2), lens)
        residual = shown.reshape(n, 6) - seen.reshape(n, 6)
        by_ray = by_ray.reshape(n, 3, 2, 2)
        by_point = (by_ray @ by_point.reshape(n, 3, 2, 3)).reshape(n, 6, 3)
        by_all = np.concatenate(
            [(by_ray @ by_cameras[:, :, :12].reshape(n, 3, 2, 12)).reshape(n, 6, 12), by_lens.reshape(n, 6, SIZE)],
            axis=2,
        )
        off = np.sqrt(np.sum(residual**2, axis=1) / 3.0)  # three of six numbers are the point's
        sigma = max(sigma_norm, float(np.median(off)) / MEDIAN_OFF)
        independent = min(1.0, EFFECTIVE_PAIRS / n) / SHARED
        weight = np.minimum(1.0, HUBER_K * sigma / np.maximum(off, 1e-12)) * (independent / sigma**2)
        weighted = np.swapaxes(by_point * weight[:, None, None], 1, 2)
        inner = np.linalg.inv(weighted @ by_point + 1e-12 * np.eye(3))
        across = np.swapaxes(weighted @ by_all, 1, 2)
        pull = (weighted @ residual[:, :, None])[:, :, 0]
        flat = by_all.reshape(6 * n, -1)
        gain = across @ inner
        whole = (flat * np.repeat(weight, 6)[:, None]).T @ flat - np.einsum("nij,nkj->ik", gain, across)
        push = np.einsum("nri,nr,n->i", by_all, residual, weight) - np.einsum("nij,nj->i", gain, pull)
        held = whole[:12, :12] + HELD * np.trace(whole[:12, :12]) / 12 * np.eye(12)
        if round_ == ROUNDS:
            break
        step = -np.linalg.solve(held, push[:12])
        points = points - np.einsum("nij,nj->ni", inner, pull + np.einsum("nij,i->nj", across[:, :12], step))
        at = ThreeViewPose(at.first.retract(step[:6]), at.last.retract(step[6:]), 1.0, 0.0, 0.0)
    if not sigma < MOST_SIGMA * sigma_norm:
        return None
    of_cameras = np.linalg.solve(held, whole[:12, 12:])
    return whole[12:, 12:] - whole[12:, :12] @ of_cameras, push[12:] - of_cameras.T @ push[:12]


def _scaled(pose: gtsam.Pose3, unit: float) -> gtsam.Pose3:
    return gtsam.Pose3(pose.rotation(), unit * pose.translation())


def _shown(ray: np.ndarray, lens: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where a ``lens`` (SIZE,) shows rays (N, 2); by ray (N, 2, 2); by lens (N, 2, SIZE)."""
    k1, k2, p1, p2, focal = lens[: FOCAL + 1]
    x, y = ray[:, :1], ray[:, 1:]
    r2 = x**2 + y**2
    straight = 1.0 + k1 * r2 + k2 * r2**2
    by_p1, by_p2 = np.hstack([2 * x * y, r2 + 2 * y**2]), np.hstack([r2 + 2 * x**2, 2 * x * y])
    bent = ray * straight + p1 * by_p1 + p2 * by_p2
    by_ray = ray[:, :, None] * ray[:, None, :] * (2 * k1 + 4 * k2 * r2)[:, :, None] + straight[:, :, None] * np.eye(2)
    xx, xy, yy = 2 * p1 * y + 6 * p2 * x, 2 * p1 * x + 2 * p2 * y, 6 * p1 * y + 2 * p2 * x
    by_ray += np.hstack([xx, xy, xy, yy]).reshape(-1, 2, 2)
    by_lens = np.zeros((len(ray), 2, SIZE))
    by_lens[:, :, :FOCAL] = (1.0 + focal) * np.stack([ray * r2, ray * r2**2, by_p1, by_p2], axis=2)
    by_lens[:, :, FOCAL] = bent
    by_lens[:, :, MIDDLE] = np.eye(2)
    return (1.0 + focal) * bent + lens[MIDDLE], (1.0 + focal) * by_ray, by_lens


def _rays(seen: np.ndarray, lens: np.ndarray) -> np.ndarray:
    """The inverse of ``_shown``: (N, 2) both."""
    ray = seen - lens[MIDDLE]
    for _ in range(UNDISTORTED):
        shown, by_ray, _ = _shown(ray, lens)
        ray = ray - np.linalg.solve(by_ray, (shown - seen)[:, :, None])[:, :, 0]
    return ray
