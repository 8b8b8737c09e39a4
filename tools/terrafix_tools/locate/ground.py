"""Ground at the end of a ray: by the point cloud of the fragment, by the elevation of the map, or as a plane."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from terrafix.core.errors import SourceError
from terrafix.estimator.models.terrain import DEM_SIGMAS, FLAT_SIGMAS, LEVEL_M
from terrafix.estimator.state import HORIZONTAL, UP
from terrafix_tools.locate.cloud import Elevation, PointCloud
from terrafix_tools.locate.views import CameraView

MIN_POINTS = 6  # of a plane through the cloud: twice its unknowns
NEAR_SHARE = 0.12  # radius about the end of the ray within which points count, share of the height above ground
MAX_GAP_RAD = np.pi  # largest angle between two points as seen from the end of the ray: beyond, they lie on one side
ITERATIONS = 4  # of ray and plane through the points near its end
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
    north, and 1-sigma of the height of what the pixel shows."""

    surface: Surface
    at_m: np.ndarray
    up_m: float
    slope: np.ndarray
    sigma_m: float

    def height_m(self, at_m: np.ndarray) -> float:
        """AMSL height at (east, north, ...)."""
        return self.up_m + float(self.slope @ (at_m[HORIZONTAL] - self.at_m))

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
    sigma_m = float(np.linalg.norm([LEVEL_M, level_share * view.height_m, slope_sigma * away_m, relief_m]))
    return GroundPatch(Surface.PLANE, at_m[HORIZONTAL], float(at_m[UP]), slope, sigma_m)


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
    at_m = (points_m[i - 1] + share * (points_m[i] - points_m[i - 1]))[HORIZONTAL]
    steps = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]]) * SLOPE_STEP_M
    around_m = elevation(*(at_m + steps).T)
    if around_m is None or not np.isfinite(around_m).all():
        return None
    slope = np.array([around_m[1] - around_m[2], around_m[3] - around_m[4]]) / (2.0 * SLOPE_STEP_M)
    sigma_m = float(np.hypot(LEVEL_M, DEM_SIGMAS[1] * view.height_m))
    return GroundPatch(Surface.ELEVATION, at_m, float(around_m[0]), slope, sigma_m)


def _cloud_patch(view: CameraView, ray: np.ndarray, cloud: PointCloud, reference: GroundPatch) -> GroundPatch | None:
    """Plane through the points about the end of the ray; None: there are too few, or all lie on one side."""
    patch = reference
    for _ in range(ITERATIONS):
        at_m = patch.intersect(view.p_c_in_w_m, ray)
        points_m, sigma_m = cloud.near(at_m, NEAR_SHARE * view.height_m)
        if len(points_m) < MIN_POINTS or _largest_gap_rad(points_m, at_m) > MAX_GAP_RAD:
            return None
        patch = _plane_through(points_m, sigma_m, at_m, reference.sigma_m)
    return patch


def _plane_through(points_m: np.ndarray, sigma_m: np.ndarray, at_m: np.ndarray, level_sigma_m: float) -> GroundPatch:
    """Weighted least squares. The height of what the pixel shows departs from the plane as those of the points do:
    houses, trees, the relief between them."""
    design = np.column_stack([np.ones(len(points_m)), points_m[:, HORIZONTAL] - at_m[HORIZONTAL]])
    weight = 1.0 / np.square(np.maximum(sigma_m, 0.1 * np.median(sigma_m)))
    normal = (design * weight[:, None]).T @ design
    fit = np.linalg.solve(normal, (design * weight[:, None]).T @ points_m[:, UP])
    residual_m = points_m[:, UP] - design @ fit
    departure_m2 = float(weight @ residual_m**2 / weight.sum()) * len(points_m) / (len(points_m) - 3)
    of_fit_m2 = departure_m2 * float(np.linalg.inv(normal)[0, 0] * weight.sum() / len(points_m))
    sigma = float(np.sqrt(departure_m2 + of_fit_m2 + level_sigma_m**2))
    return GroundPatch(Surface.POINTS, at_m[HORIZONTAL], float(fit[0]), fit[1:], sigma)


def _largest_gap_rad(points_m: np.ndarray, at_m: np.ndarray) -> float:
    """Largest angle between neighbouring directions from ``at_m`` to the points."""
    away_m = points_m[:, HORIZONTAL] - at_m[HORIZONTAL]
    bearings = np.sort(np.arctan2(away_m[:, 1], away_m[:, 0]))
    return float(np.diff(bearings, append=bearings[0] + 2.0 * np.pi).max())
