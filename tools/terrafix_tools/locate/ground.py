"""Ground at the end of a ray: by the point cloud of the fragment, by the elevation of the map, or as a plane."""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from terrafix.core.errors import SourceError
from terrafix.estimator.models.terrain import DEM_SIGMAS, FLAT_SIGMAS, LEVEL_M
from terrafix.estimator.state import HORIZONTAL, UP
from terrafix_tools.locate.cloud import Elevation, PointCloud
from terrafix_tools.locate.views import CameraView

MIN_POINTS, MAX_POINTS = 6, 12  # that give the level about a pixel
# Radius about a pixel within which points count, normalised image coordinates: 14 degrees. Beyond it the
# level below the camera is as good. [measured: docs/records.md, village-1]
NEAR = 0.25
MAX_GAP_RAD = np.pi  # largest angle between neighbouring points about the pixel: beyond, all lie on one side
MIN_SIGMA_SHARE = 0.1  # least sigma of a point, share of the median: none outweighs a hundred others
MIN_DESCENT = 0.05  # least downward component of a unit ray: 3 degrees below the horizon
REACH = 3.0  # how far a ray is followed, in distances to the plane below the camera
STEPS = 400  # samples along a ray over the elevation model
SLOPE_STEP_M = 15.0  # half distance of the difference quotient of the elevation: half a post of a 30 m model


class Surface(StrEnum):
    POINTS = "points"  # triangulated points of the fragment
    ELEVATION = "elevation"  # of the map
    PLANE = "plane"  # at the ground level of the estimator


@dataclass(frozen=True)
class GroundPatch:
    """Tangent plane of the ground: height AMSL ``up_m`` at ``at_m`` (2,) with ``slope`` (2,), rise towards east and
    north, and 1-sigma of the height of what the pixel shows, relative to the camera. ``level_sigma_m``: 1-sigma of the
    level that camera and ground have in common, which moves what the ray meets up or down, not sideways;
    ``slope_sigma``: 1-sigma of the slope of visible ground."""

    surface: Surface
    at_m: np.ndarray
    up_m: float
    slope: np.ndarray
    sigma_m: float
    level_sigma_m: float = 0.0
    slope_sigma: float = 0.0

    def heights_m(self, points_m: np.ndarray) -> np.ndarray:
        """AMSL heights (N,) of the plane at points (N, 2 or 3): east, north, ..."""
        return self.up_m + (points_m[:, HORIZONTAL] - self.at_m) @ self.slope

    def height_m(self, at_m: np.ndarray) -> float:
        """AMSL height at (east, north, ...)."""
        return float(self.heights_m(at_m[None])[0])

    def intersect(self, from_m: np.ndarray, ray: np.ndarray) -> np.ndarray:
        """Point (3,) at which the ray from ``from_m`` meets the plane."""
        falls = float(ray[UP] - self.slope @ ray[HORIZONTAL])
        return from_m + (self.height_m(from_m) - from_m[UP]) / falls * ray


def ground_patch(view: CameraView, ray: np.ndarray, cloud: PointCloud, elevation: Elevation | None) -> GroundPatch:
    """Ground that the unit ``ray`` (3,), world axes, from the camera meets. Raises SourceError: it meets none."""
    if ray[UP] > -MIN_DESCENT:
        raise SourceError(f"frame {view.frame_id}: the pixel shows no ground (horizon or sky); choose a lower one")
    reference = _elevation_patch(view, ray, elevation) or _plane_patch(view, ray)
    return _cloud_patch(view, ray, cloud, reference) or reference


def _plane_patch(view: CameraView, ray: np.ndarray) -> GroundPatch:
    """The plane of the map match where there is one, else level ground below the camera."""
    slope, relief_m, sigmas = np.zeros(2), 0.0, FLAT_SIGMAS
    if view.ground is not None:
        slope, relief_m, sigmas = np.array([view.ground.slope_e, view.ground.slope_n]), view.ground.relief_m, DEM_SIGMAS
    plane = GroundPatch(Surface.PLANE, view.p_c_in_w_m[HORIZONTAL], view.ground_m, slope, 0.0)
    at_m = plane.intersect(view.p_c_in_w_m, ray)
    away_m = float(np.hypot(*(at_m - view.p_c_in_w_m)[HORIZONTAL]))
    slope_sigma, level_share = sigmas
    level_sigma_m = float(np.hypot(LEVEL_M, level_share * view.height_m))
    sigma_m = float(np.linalg.norm([level_sigma_m, slope_sigma * away_m, relief_m]))
    return GroundPatch(Surface.PLANE, at_m[HORIZONTAL], float(at_m[UP]), slope, sigma_m, level_sigma_m, slope_sigma)


def _elevation_patch(view: CameraView, ray: np.ndarray, elevation: Elevation | None) -> GroundPatch | None:
    """The first crossing of the ray and the elevation model; None: the model does not reach there."""
    if elevation is None:
        return None
    distance_m = REACH * view.height_m / -float(ray[UP]) * np.arange(1, STEPS + 1) / STEPS
    points_m = view.p_c_in_w_m + distance_m[:, None] * ray
    ground_m = elevation(points_m[:, 0], points_m[:, 1])
    if ground_m is None:
        return None
    above_m = points_m[:, UP] - ground_m
    below = np.flatnonzero(above_m <= 0.0)
    if not len(below) or below[0] == 0 or not np.isfinite(above_m[: below[0]]).all():
        return None
    i = int(below[0])
    share = above_m[i - 1] / (above_m[i - 1] - above_m[i])
    at_m = points_m[i - 1] + share * (points_m[i] - points_m[i - 1])
    steps_m = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]) * SLOPE_STEP_M
    around_m = elevation(*(at_m[HORIZONTAL] + steps_m).T)
    if around_m is None or not np.isfinite(around_m).all():
        return None
    slope = np.array([around_m[0] - around_m[1], around_m[2] - around_m[3]]) / (2.0 * SLOPE_STEP_M)
    if ray[UP] - slope @ ray[HORIZONTAL] > 0.5 * ray[UP]:  # an edge: the ray meets the ground at a flatter place
        slope = np.zeros(2)
    sigma_m = float(np.hypot(LEVEL_M, DEM_SIGMAS[1] * view.height_m))
    return GroundPatch(Surface.ELEVATION, at_m[HORIZONTAL], float(at_m[UP]), slope, sigma_m, sigma_m, DEM_SIGMAS[0])


def _cloud_patch(view: CameraView, ray: np.ndarray, cloud: PointCloud, reference: GroundPatch) -> GroundPatch | None:
    """Plane at the level of the points about the ray, with the slope of ``reference``, whose level the cloud has; None:
    there are too few.

    The height of what a pixel shows departs from that level as those of the points do beyond their own errors (houses,
    trees, relief between them), and by the error of the slope on the way to it from their middle. Where all lie on one
    side, the ground there may as well be that of ``reference``. An error of its level is one of the height of the
    camera, too, which was measured above the same ground, and moves the points with it."""
    x, y, z = view.r_w_c.T @ ray
    near, away = cloud.seen_near(view, np.array([x, y]) / z, NEAR, MAX_POINTS)
    count = len(away)
    if count < MIN_POINTS:
        return None
    weight = 1.0 / np.square(np.maximum(near.sigma_m, MIN_SIGMA_SHARE * np.median(near.sigma_m)))
    weight /= weight.sum()
    above_m = near.points_m[:, UP] - reference.heights_m(near.points_m)
    mean_m = float(weight @ above_m)
    own_m2 = count / float(np.sum(near.sigma_m**-2.0))
    surface_m2 = max(float(weight @ np.square(above_m - mean_m)) * count / (count - 1) - own_m2, 0.0)
    from_middle_m = float(np.linalg.norm(weight @ near.points_m[:, HORIZONTAL] - reference.at_m))
    departure_m = np.sqrt(surface_m2 * (1.0 + weight @ weight) + own_m2 / count)
    one_sided_m = mean_m if _largest_gap_rad(away) > MAX_GAP_RAD else 0.0
    sigma_m = float(np.linalg.norm([departure_m, reference.slope_sigma * from_middle_m, one_sided_m]))
    return replace(reference, surface=Surface.POINTS, up_m=reference.up_m + mean_m, sigma_m=sigma_m)


def _largest_gap_rad(away: np.ndarray) -> float:
    """Largest angle between neighbouring directions of ``away`` (N, 2)."""
    bearings = np.sort(np.arctan2(away[:, 1], away[:, 0]))
    return float(np.diff(bearings, append=bearings[0] + 2.0 * np.pi).max())
