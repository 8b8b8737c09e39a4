"""Ground under the vehicle: the plane of the last map match, and the uncertainty of elevation away from it."""

import numpy as np

from terrafix.estimator.models.plane_motion import Ground
from terrafix.estimator.models.terrain_roughness import TerrainRoughness
from terrafix.estimator.state import HORIZONTAL, UP
from terrafix.messages import GroundPlane

# 1-sigma of slope and of level (share of the height) of the visible ground: fields and towns without a DEM; with a DEM,
# what houses and trees leave. [tuned]
FLAT_SIGMAS, DEM_SIGMAS = (0.03, 0.02), (0.015, 0.01)
# ... and at any height: local error of a DEM. [spec: Copernicus DEM handbook, 2 m relative at 90 %]
LEVEL_M = 1.2
RELIEF_SLOPE = 2.0  # slope error of a plane per share of the height by which relief departs from it [tuned]
# Root of the number of keyframes in a row, about fifteen, that see the same hill with the same error. [tuned]
RELIEF_REPEATS = 4.0
SLOPE_REACH_M = 150.0  # range of a fitted slope around the place of the match [tuned]


class Terrain:
    """``ground_m``: AMSL elevation at the last map match. Until then flat, at the elevation of the start."""

    def __init__(self, ground_m: float) -> None:
        self.ground_m = ground_m
        self._at_m = np.zeros(2)  # east, north of that elevation
        self._relief_m = 0.0  # departure of the ground from a plane
        self._slope: tuple[float, float] | None = None  # towards east and north; None: no DEM
        self.roughness = TerrainRoughness()

    def update(self, ground: GroundPlane | None, at_m: np.ndarray | None) -> None:
        """``ground``: of a map match; None: no DEM. ``at_m`` (east, north, ...): camera of the match; None: its node
        has left the graph."""
        if ground is None:
            return
        self.ground_m, self._slope, self._relief_m = ground.amsl_m, (ground.slope_e, ground.slope_n), ground.relief_m
        if at_m is not None:
            self._at_m = at_m[HORIZONTAL]

    @property
    def has_dem(self) -> bool:
        """Whether a DEM gives the ground. Without one, heights are above whatever ground is seen, as if all ground were
        at one level."""
        return self._slope is not None

    def elevation_m(self, p_m: np.ndarray) -> float:
        """AMSL elevation under (east, north, ...). The slope holds within SLOPE_REACH_M."""
        slope, away_m = np.array(self._slope or (0.0, 0.0)), p_m[HORIZONTAL] - self._at_m
        reach_m = float(np.hypot(*away_m))
        return self.ground_m + float(slope @ away_m) * min(1.0, SLOPE_REACH_M / max(reach_m, 1.0))

    def height_above_m(self, p_m: np.ndarray) -> float:
        """Height of a point (3,), east, north and AMSL, above the ground under it."""
        return float(p_m[UP]) - self.elevation_m(p_m)

    def rise_sigma_m(self, distance_m: float) -> float:
        """1-sigma of the change of elevation over a distance, without a DEM; 0 with one."""
        return 0.0 if self.has_dem else self.roughness.walk_sigma * float(np.sqrt(distance_m))

    def slope_sigma(self, height_m: float) -> float:
        """1-sigma of the slope of the ground that a frame shows from this height, without a DEM."""
        return self.rise_sigma_m(height_m) / height_m

    def curvature_sigma(self, height_m: float) -> float:
        """1-sigma of the curvature, 1/m: by the same random walk, from the centre to half the height on both sides. The
        sum of both ends' elevations above the centre is a walk over both halves."""
        reach_m = 0.5 * height_m
        return self.rise_sigma_m(2.0 * reach_m) / reach_m**2

    def ground_plane(self, p_m: np.ndarray, height_m: float, height_sigma_m: float, share: float) -> Ground:
        """The plane for odometry from ``p_m`` (east, north, ...). ``share`` of the matches agreed."""
        slope_e, slope_n = self._slope or (0.0, 0.0)
        slope_sigma, level_share = FLAT_SIGMAS if self._slope is None else DEM_SIGMAS
        # An unknown slope is visible for a while, as are points off the plane, all on one side of it.
        slope_sigma = float(np.hypot(slope_sigma, RELIEF_REPEATS * self.slope_sigma(height_m)))
        relief_share = RELIEF_REPEATS * self._relief_m / height_m
        slope_sigma = float(np.hypot(slope_sigma, RELIEF_SLOPE * relief_share))
        away_m = float(np.hypot(*(p_m[HORIZONTAL] - self._at_m)))
        beyond_m = 0.0 if self._slope is None else max(0.0, away_m - SLOPE_REACH_M)
        level_m = np.hypot(LEVEL_M, self.roughness.walk_sigma * np.sqrt(beyond_m))
        level_share = float(np.sqrt(level_share**2 + relief_share**2 + (level_m / height_m) ** 2))
        return Ground(
            height_m,
            height_sigma_m,
            slope_e=slope_e,
            slope_n=slope_n,
            slope_sigma=slope_sigma,
            level_share=level_share,
            curvature_sigma=self.curvature_sigma(height_m),
            share=share,
        )
