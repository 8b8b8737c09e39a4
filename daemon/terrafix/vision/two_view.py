"""Geometric verification: whether the matches of two images determine the motion between them.

From flying height the ground is close to a plane, so its matches agree with one homography. Points above the ground
fail the RANSAC threshold or add noise, which the covariance includes. Over a town half of the matches are on roofs, and
the homography with most of them may be a slanted plane through roofs and streets. There the essential matrix, which
holds for points at any height (Nister 2004; MAGSAC++, Barath et al. 2020), gives the motion, and of the planes that
this motion leaves the level one with most matches is taken."""

from dataclasses import dataclass

import cv2
import numpy as np

from terrafix.core.camera import CameraCalibration, Mount
from terrafix.vision.features import Matches

RANSAC_PX = 2.5  # 0.4 m from 100 m; excludes points above the ground
# Of that threshold, where a match counts nothing, and before that in the first steps: over relief there are several
# homographies near by that a third of the matches leaves for the last bit, and from afar one is the best
HOMOGRAPHY_CUTOFF, WIDER = 1.25, (5.0, 5.0, 4.0, 3.2, 2.5, 2.0, 1.6)
# Matches of a homography, at least; steps of its reweighted least squares with HOMOGRAPHY_CUTOFF, at most, and the last
# one [px]; by how much the diagonal of their normal equations is larger, so that points on a line have a solution
MIN_HOMOGRAPHY, MAX_HOMOGRAPHY_STEPS, STEP_PX, HOMOGRAPHY_RIDGE = 8, 20, 1e-4, 1e-9
MIN_SPREAD = 0.12  # inliers must span this fraction of image width and height, else the pose is not determined
TWO_VIEW_MIN_INLIERS = 15  # by chance, 4 to 9 of 100 wrong matches agree
TWO_VIEW_MIN_INLIER_RATIO = 0.15
EPIPOLAR_PX = 1.5  # of a match from its epipolar line [spec: twice the 1-sigma of a feature, feature_tracker.py]
MIN_MOTION_DRAWS, MAX_MOTION_DRAWS = 100, 3000  # [spec: five of 30 % right matches are drawn in 99.9 %]
DRAWN = 0.999  # that probability
# Share of the matches on epipolar lines that one homography explains over ground without relief: there the essential
# matrix has a second solution, and the homography is the better model. [measured: docs/decisions/040]
PLANAR_SHARE = 0.75
TILT_SIGMA_RAD = np.radians(12.0)  # of the ground below a camera, against its mount [spec: tilt of a vehicle in wind]
# quantiles of the depth that are tried [spec: finds a layer of a sixth]
DEPTH_QUANTILES = (0.1, 0.25, 0.4, 0.55, 0.7, 0.85)
SHRINKING_PX = (12.0, 8.0, 5.0, 3.0, 2.0, 1.5, 1.5)  # scale of the robust weight by step [spec: down to EPIPOLAR_PX]


@dataclass(frozen=True)
class TwoView:
    """``a_px``, ``b_px`` (N, 2): matches that agree with one plane, out of ``matches``. ``lines_a_px``, ``lines_b_px``
    (M, 2): those that agree with one motion, at any height."""

    a_px: np.ndarray
    b_px: np.ndarray
    matches: int
    lines_a_px: np.ndarray
    lines_b_px: np.ndarray


class TwoViewGeometry:
    """Of pairs of images of ``camera``, whose size is that of the images, in ``mount``."""

    def __init__(self, camera: CameraCalibration, mount: Mount | None = None) -> None:
        self._camera = camera
        self._size_px = (camera.width, camera.height)
        self._down = (mount or Mount()).r_b_c().T[:, 2]  # (3,): of a level vehicle, camera axes

    def verify(self, matches: Matches) -> TwoView | None:
        """The matches on one plane; None: they do not determine a motion."""
        two_view = self.fit(matches)
        return two_view if self.is_verified(two_view) else None

    def is_verified(self, two_view: TwoView) -> bool:
        enough = len(two_view.a_px) >= max(TWO_VIEW_MIN_INLIERS, TWO_VIEW_MIN_INLIER_RATIO * two_view.matches)
        return enough and covers_image(two_view.a_px, self._size_px) and covers_image(two_view.b_px, self._size_px)

    def fit(self, matches: Matches) -> TwoView:
        """The matches on one plane, however few these are."""
        a, b = matches.a_px, matches.b_px
        if len(a) < TWO_VIEW_MIN_INLIERS:
            return TwoView(a[:0], b[:0], len(matches), a[:0], b[:0])
        x, y = self._camera.normalise(a), self._camera.normalise(b)
        fewest = min((TWO_VIEW_MIN_INLIERS / len(a)) ** 5, DRAWN)  # share of the draws, if no more matches are right
        draws = int(np.clip(np.log1p(-DRAWN) / np.log1p(-fewest), MIN_MOTION_DRAWS, MAX_MOTION_DRAWS))
        limit = EPIPOLAR_PX / self._camera.fx
        essential, mask = cv2.findEssentialMat(x, y, np.eye(3), cv2.USAC_MAGSAC, DRAWN, limit, draws)
        on_lines = np.zeros(len(a), bool) if mask is None else mask.ravel() > 0
        if on_lines.sum() < TWO_VIEW_MIN_INLIERS:  # points on a plane are on epipolar lines, too
            return TwoView(a[:0], b[:0], len(matches), a[on_lines], b[on_lines])
        inlier = homography_inliers(a, b)
        if inlier.sum() < PLANAR_SHARE * on_lines.sum():
            inlier = on_lines.copy()
            inlier[on_lines] = self._on_level(x[on_lines], y[on_lines], essential)
        return TwoView(a[inlier], b[inlier], len(matches), a[on_lines], b[on_lines])

    def _on_level(self, x: np.ndarray, y: np.ndarray, essential: np.ndarray) -> np.ndarray:
        """(N,) bool: which of the matches (N, 2), (N, 2), normalised, are on the plane below with most of them.

        With the motion known, the inverse depth of a match is known, and that of a plane is linear in its ray: an M-
        estimate of the plane (Geman and McClure 1987) with a prior on its tilt, from several levels."""
        _, r, t, _ = cv2.recoverPose(essential, x, y, np.eye(3))
        x, y = (np.column_stack([one, np.ones(len(one))]) for one in (x, y))
        across, along = np.cross(y, x @ r.T), np.cross(y, t.ravel())
        length = np.linalg.norm(along, axis=1)
        inverse_depth = -np.sum(across * along, axis=1) / np.maximum(length**2, 1e-12)
        px = self._camera.fx * length  # displacement in the image by inverse depth
        aside = np.eye(3) - np.outer(self._down, self._down)
        best = np.zeros(len(x), bool)
        for level in np.quantile(inverse_depth / np.maximum(x @ self._down, 0.1), DEPTH_QUANTILES):
            plane = level * self._down
            prior = aside / max(TILT_SIGMA_RAD * abs(level), 1e-9) ** 2
            for scale_px in SHRINKING_PX:
                off_px = (x @ plane - inverse_depth) * px
                weighted = x.T * (px / (1.0 + (off_px / scale_px) ** 2)) ** 2
                plane = np.linalg.solve(weighted @ x + prior, weighted @ inverse_depth)
            found = np.abs((x @ plane - inverse_depth) * px) < RANSAC_PX
            if found.sum() > best.sum():
                best = found
        return best


def covers_image(points: np.ndarray, size_px: tuple[int, int]) -> bool:
    """True when the points (N, 2) px cover enough of the image in both directions."""
    return bool(np.all(np.ptp(points, axis=0) > np.multiply(size_px, MIN_SPREAD)))


def homography_inliers(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N,) bool: matches (N, 2), (N, 2) px that agree with the homography of most of them."""
    matrix = fit_homography(a, b, RANSAC_PX)
    return np.zeros(len(a), bool) if matrix is None else _transfer_px(matrix, a, b) < RANSAC_PX


def fit_homography(a: np.ndarray, b: np.ndarray, threshold_px: float) -> np.ndarray | None:
    """Homography (3, 3) of most of the matches (N, 2), (N, 2) px; None: they are too few. RANSAC finds it, and
    reweighted least squares over all matches make of whichever sample it drew the same one: a weight that falls to zero
    with the distance leaves no match that hangs on the last bit (Beaton and Tukey 1974)."""
    if len(a) < MIN_HOMOGRAPHY:
        return None
    matrix, _ = cv2.findHomography(a, b, cv2.RANSAC, threshold_px, maxIters=1500, confidence=0.999)
    if matrix is None:
        return None
    centre, scale = a.mean(axis=0), max(float(a.std()), 1e-6)
    local = np.array([[scale, 0.0, centre[0]], [0.0, scale, centre[1]], [0.0, 0.0, 1.0]])
    matrix, points = matrix @ local, np.column_stack([(a - centre) / scale, np.ones(len(a))])
    matrix = matrix / matrix[2, 2]
    for share in (*WIDER, *[HOMOGRAPHY_CUTOFF] * MAX_HOMOGRAPHY_STEPS):
        step = _homography_step(matrix, points, b, share * threshold_px)
        if not np.isfinite(step).all():
            break
        matrix = matrix + step
        if share == HOMOGRAPHY_CUTOFF and float(np.abs(step).max()) < STEP_PX:
            break
    return np.asarray(matrix @ np.linalg.inv(local))


def _homography_step(matrix: np.ndarray, points: np.ndarray, b: np.ndarray, cutoff_px: float) -> np.ndarray:
    """(3, 3) Gauss-Newton step of a homography with 1 as its last entry, from ``points`` (N, 3), homogeneous, to ``b``
    (N, 2) px."""
    mapped = points @ matrix.T
    to = mapped[:, :2] / mapped[:, 2:]
    off = b - to
    weight = np.square(np.maximum(1.0 - np.einsum("ni,ni->n", off, off) / cutoff_px**2, 0.0)) / np.square(mapped[:, 2])
    # By the rows of the matrix: the point for u or v, and less u or v times the point for the last one.
    weighted = points * weight[:, None]
    normal = np.zeros((8, 8))
    normal[:3, :3] = normal[3:6, 3:6] = weighted.T @ points
    for k in (0, 1):
        rows = slice(3 * k, 3 * k + 3)
        normal[rows, 6:] = -weighted.T @ (points[:, :2] * to[:, k : k + 1])
        normal[6:, rows] = normal[rows, 6:].T
    square = np.einsum("ni,ni->n", to, to)
    normal[6:, 6:] = (weighted[:, :2] * square[:, None]).T @ points[:, :2]
    normal[range(8), range(8)] *= 1.0 + HOMOGRAPHY_RIDGE
    weighted = weighted * mapped[:, 2:]
    along = np.einsum("ni,ni->n", to, off)
    right = np.concatenate([*(weighted.T @ off).T, -(weighted[:, :2].T @ along)])
    if not (np.isfinite(normal).all() and normal.diagonal().min() > 0.0):
        return np.full((3, 3), np.nan)
    return np.append(np.linalg.solve(normal, right), 0.0).reshape(3, 3)


def _transfer_px(matrix: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N,) distance of the points ``b`` from those to which ``matrix`` (3, 3) takes ``a``; infinite beyond its
    horizon."""
    mapped = np.column_stack([a, np.ones(len(a))]) @ matrix.T
    ahead = mapped[:, 2] * matrix[2, 2] > 0.0
    off = np.linalg.norm(mapped[:, :2] / np.where(ahead, mapped[:, 2], 1.0)[:, None] - b, axis=1)
    return np.where(ahead, off, np.inf)


def select_spread(points: np.ndarray, limit: int, size_px: tuple[int, int]) -> np.ndarray:
    """Indices of at most ``limit`` points, round-robin over an 8 x 6 grid of the image, for an even distribution. A
    grid of the points themselves would move with any one at their border, and select others everywhere."""
    if len(points) <= limit:
        return np.arange(len(points))
    cell = np.clip(points / size_px * (8, 6), 0, (7, 5)).astype(int)
    key = cell[:, 1] * 8 + cell[:, 0]
    order = np.argsort(key, kind="stable")
    first = np.r_[True, np.diff(key[order]) > 0]
    rank = np.arange(len(order)) - np.maximum.accumulate(np.where(first, np.arange(len(order)), 0))
    return np.sort(order[np.argsort(rank, kind="stable")[:limit]])
