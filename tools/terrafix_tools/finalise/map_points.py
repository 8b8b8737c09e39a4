"""Map matches as observations of points: reprojection errors by camera pose, lens and local distortion of the map."""

from dataclasses import dataclass

import gtsam
import numpy as np

from terrafix.core.geodesy import rot_from_quat
from terrafix.core.pnp import INDEPENDENT_MATCH_SHARE, PNP_MIN_INLIERS, outlier_inflation, random_inlier_probability
from terrafix.core.pose import POSE_HUBER_K, exp_so3, fit_pose, project_with_jacobian
from terrafix.estimator.factors.noise import whiten_common
from terrafix.estimator.measurements.map_pose import LOCAL_WARP, ROOFS
from terrafix.estimator.models.terrain import Terrain
from terrafix.estimator.state import HORIZONTAL, TRANSLATION, UP
from terrafix.messages import MapMatch, PnpInput
from terrafix.smoother.gnc import MAX_MU, MU_GROWTH, truncated_weights
from terrafix_tools.finalise.lens import Lens, as_described

# Reach of the correlation of a map's slow distortion: its gradient is the distortion over this.
WARP_REACH_M = 80.0  # [measured: docs/monte-carlo.md, slow warp of a map]
POSE, K1, FOCAL, CONSTANT = slice(0, 6), 6, 7, 8  # columns of PoseRows [spec: layout]
ROWS = 6  # of the reduced residual: those by the pose [spec: columns of the QR]


@dataclass(frozen=True)
class PoseRows:
    """Whitened linear residual around ``pose`` and ``lens``: ``rows`` (R, 9) by the tangent of the pose in the map's
    frame, by radial coefficient, by the logarithm of the focal length, and the constant."""

    pose: gtsam.Pose3
    lens: Lens
    rows: np.ndarray


@dataclass(frozen=True)
class PointFit:
    """The pose that fits the points of one match by itself, through ``lens``. ``inliers`` (N,) bool; ``sigma``: 1-sigma
    of an image coordinate, normalised; ``residual`` (N, 2): projection less ray."""

    r_w_c: np.ndarray
    p_m: np.ndarray
    lens: Lens
    rays: np.ndarray
    inliers: np.ndarray
    sigma: float
    residual: np.ndarray


@dataclass(frozen=True)
class MatchedPoints:
    """All 2D-3D matches of a frame, also those that PnP has rejected. ``xy`` (N, 2): normalised by the description of
    the camera; ``points_m`` (N, 3): on the map; ``weights`` (N,). ``r_w_c``, ``p_m``: the pose of PnP, by the radial
    coefficient ``k1``. ``local_m``, ``roofs_m``, ``slope``: 1-sigma of what the ground as seen differs by from the
    map's: sideways, in height, slope."""

    xy: np.ndarray
    points_m: np.ndarray
    weights: np.ndarray
    given: PnpInput
    r_w_c: np.ndarray
    p_m: np.ndarray
    k1: float
    local_m: float
    roofs_m: float
    slope: float

    @classmethod
    def of(cls, match: MapMatch, solved: MapMatch, terrain: Terrain) -> "MatchedPoints | None":
        """``solved``: ``match`` with the pose of its points. None: the matcher has computed the pose itself."""
        if match.pnp is None or solved.pose is None or not match.matches:
            return None
        rows = np.array(match.matches)
        r_w_c, p_m = rot_from_quat(solved.pose.q_w_c), np.array(solved.pose.p_c_in_w_m)
        height_m = max(float(p_m[UP]) - terrain.ground_m, 1.0)
        return cls(
            as_described(rows[:, :2], match.radial_k1),
            rows[:, 2:5],
            rows[:, 5],
            match.pnp,
            r_w_c,
            p_m,
            match.radial_k1,
            LOCAL_WARP * match.map_sigma_m,
            ROOFS * height_m,
            terrain.slope_sigma(height_m),
        )

    def fit(self, lens: Lens) -> PointFit | None:
        """Which of the points agree is decided again, by graduated non-convexity as for whole matches. None: the points
        that agree are too few, or do not determine a pose."""
        rays = lens.rays(self.xy)
        r_w_c, p_m, inliers = self._agreeing(rays, lens)
        if inliers.sum() < PNP_MIN_INLIERS:
            return None
        found = fit_pose(
            self.points_m[inliers], rays[inliers], r_w_c, p_m, self.given.sigma_floor, self.weights[inliers]
        )
        if found is None:
            return None
        projected, _, _ = project_with_jacobian(found.r_w_c, found.p_c_in_w_m, self.points_m)
        return PointFit(found.r_w_c, found.p_c_in_w_m, lens, rays, inliers, found.sigma, projected - rays)

    def accepted(self) -> np.ndarray:
        """(N,) bool: the points that PnP had accepted in flight."""
        pose = gtsam.Pose3(gtsam.Rot3.ClosestTo(self.r_w_c), self.p_m)
        return self.off(pose, Lens(self.k1)) < self.given.threshold

    def off(self, pose: gtsam.Pose3, lens: Lens) -> np.ndarray:
        """(N,) distance of every point from its projection by ``pose`` through ``lens``, normalised."""
        projected, _, _ = project_with_jacobian(pose.rotation().matrix(), pose.translation(), self.points_m)
        return np.asarray(np.linalg.norm(projected - lens.rays(self.xy), axis=1))

    def _agreeing(self, rays: np.ndarray, lens: Lens) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """-> pose of the matches that agree with each other (3, 3) and (3,), and which these are (N,)."""
        r_w_c, p_m = self.r_w_c, self.p_m.copy()
        centre_up_m = float(np.median(self.points_m[:, UP]))
        p_m[UP] = centre_up_m + (p_m[UP] - centre_up_m) * np.exp(lens.log_focal)
        limits = np.full(len(rays), self.given.threshold**2)
        weights, mu = np.ones(len(rays)), 0.0
        while True:
            projected, by_pose, depth_m = project_with_jacobian(r_w_c, p_m, self.points_m)
            off = rays - projected
            flat = by_pose.reshape(-1, 6)
            left = flat.T * np.repeat(weights * self.weights, 2)
            scale = np.array([1.0] * 3 + [1.0 / float(np.median(np.abs(depth_m)))] * 3)
            normal = (left @ flat) / scale / scale[:, None] + 1e-9 * np.eye(6)
            step = np.linalg.solve(normal, (left @ off.ravel()) / scale) / scale
            r_w_c = r_w_c @ exp_so3(step[:3])
            p_m = p_m + r_w_c @ step[TRANSLATION]
            projected, _, depth_m = project_with_jacobian(r_w_c, p_m, self.points_m)
            squares = np.sum((rays - projected) ** 2, axis=1)
            if mu == 0.0:
                worst = float(np.max(squares / limits))
                mu = 1.0 / max(2.0 * worst - 1.0, 1.0 / MAX_MU)
            elif mu > MAX_MU:
                return r_w_c, p_m, (squares < limits) & (depth_m > 0.0)
            weights = truncated_weights(squares, limits, mu)
            mu *= MU_GROWTH

    def rows(self, fit: PointFit) -> PoseRows:
        """Reduced to ROWS residuals. What no pose explains is left out, also where the lens would explain it: roofs
        that lean outwards and a shifted principal point have the same pattern."""
        points_m, rays, own = self.points_m[fit.inliers], fit.rays[fit.inliers], fit.residual[fit.inliers]
        _, by_pose, _ = project_with_jacobian(fit.r_w_c, fit.p_m, points_m)
        by_lens = np.stack([np.sum(rays**2, axis=1, keepdims=True) * rays, rays], axis=2)
        full = np.concatenate([by_pose, by_lens, own[:, :, None]], axis=2).reshape(2 * len(rays), -1)
        agrees = np.minimum(1.0, POSE_HUBER_K * fit.sigma / np.maximum(np.linalg.norm(own, axis=1), 1e-12))
        inflation = outlier_inflation(len(self.xy), len(rays), random_inlier_probability(self.given))
        weight = agrees * self.weights[fit.inliers] * INDEPENDENT_MATCH_SHARE / inflation
        whiten = np.repeat(np.sqrt(weight) / fit.sigma, 2)[:, None]
        reduced = np.linalg.qr(whiten_common(full * whiten, self._common(by_pose, points_m, fit) * whiten), mode="r")
        pose = gtsam.Pose3(gtsam.Rot3.ClosestTo(fit.r_w_c), fit.p_m)
        return PoseRows(pose, fit.lens, np.asarray(reduced)[:ROWS])

    def _common(self, by_pose: np.ndarray, points_m: np.ndarray, fit: PointFit) -> np.ndarray:
        """(2N, 9) by what all points of the frame have in common, each in its 1-sigma: the map is shifted, stretched
        and sheared there, roofs are higher than its ground, and the ground slopes."""
        by_point = -by_pose[:, :, TRANSLATION] @ fit.r_w_c.T
        from_centre_m = (points_m - points_m.mean(axis=0))[:, None, HORIZONTAL]
        from_camera_m = (points_m - fit.p_m)[:, None, HORIZONTAL]
        shifts = by_point * np.array([self.local_m, self.local_m, self.roofs_m])
        gradient = self.local_m / WARP_REACH_M
        stretched = [by_point[:, :, [axis]] * from_centre_m * gradient for axis in (0, 1)]
        slopes = by_point[:, :, [UP]] * from_camera_m * self.slope
        return np.concatenate([shifts, *stretched, slopes], axis=2).reshape(2 * len(points_m), -1)


def rows_of_pose(pose: gtsam.Pose3, cov: np.ndarray, by_lens: np.ndarray, lens: Lens) -> PoseRows:
    """Rows of a pose with covariance (6, 6) that was computed through ``lens``; ``by_lens`` (6, 2): its change by
    radial coefficient and logarithm of the focal length."""
    root = np.linalg.inv(np.linalg.cholesky(cov))
    return PoseRows(pose, lens, root @ np.column_stack([np.eye(6), -by_lens, np.zeros(6)]))
