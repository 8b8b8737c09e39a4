"""The ground under the vehicle, as the map's elevation gave it last: a plane, and how far it is from being one."""

import numpy as np

from terrafix.estimator.models.plane_motion import Ground
from terrafix.estimator.models.terrain_roughness import TerrainRoughness
from terrafix.messages import MapMatch

# 1-sigma of the slope and of the level (share of the height) of the ground that is seen: fields and towns without a
# DEM; what houses and trees leave with one.
FLAT_SIGMAS, DEM_SIGMAS = (0.03, 0.02), (0.015, 0.01)
# ... and at any height: what a DEM misses from one place to the next (Copernicus DEM handbook: 2 m, 90 %, relative).
LEVEL_M = 1.2
RELIEF_SLOPE = 2.0  # a plane that misses the ground by this share of the height misses its slope by so much more
# ... and one hill is seen by some fifteen keyframes in a row, each with the same mistake: root of that many.
RELIEF_REPEATS = 4.0
SLOPE_REACH_M = 150.0  # from where a plane was fitted: farther away it says nothing


class Terrain:
    """``ground_m``: AMSL of the ground below. Flat at the start's height until a match says more."""

    def __init__(self, ground_m: float) -> None:
        self.ground_m = ground_m
        self._at_m = np.zeros(2)  # where that is so
        self._relief_m = 0.0  # how far the ground departs from a plane
        self._slope: tuple[float, float] | None = None  # of the ground, east and north; None: no DEM
        self.ruggedness = TerrainRoughness()

    def hear(self, match: MapMatch, at_m: np.ndarray | None) -> None:
        """``at_m`` (east, north, ...): the camera of the match; None: the graph no longer has it."""
        if match.ground is None:
            return
        self.ground_m, self._slope, self._relief_m = match.ground[0], match.ground[1:], match.relief_m
        if at_m is not None:
            self._at_m = at_m[:2]

    @property
    def is_told(self) -> bool:
        """A DEM tells the ground. Else heights are above whatever ground is seen, as if all of it were at one level."""
        return self._slope is not None

    def below(self, p_m: np.ndarray) -> float:
        """AMSL of the ground under (east, north, ...). A slope is that of one footprint: hills end."""
        slope, away_m = np.array(self._slope or (0.0, 0.0)), p_m[:2] - self._at_m
        reach_m = float(np.hypot(*away_m))
        return self.ground_m + float(slope @ away_m) * min(1.0, SLOPE_REACH_M / max(reach_m, 1.0))

    def rise_sigma_m(self, way_m: float) -> float:
        """By which the ground may have risen or fallen over a way, without anybody telling."""
        return 0.0 if self.is_told else self.ruggedness.rise * float(np.sqrt(way_m))

    def slope_sigma(self, height_m: float) -> float:
        """Of the ground that a frame shows from this height, where nobody tells it."""
        return self.rise_sigma_m(height_m) / height_m

    def bend_sigma(self, height_m: float) -> float:
        """Of its curvature, 1/m: by the same walk, from the middle to half of the height on both sides. What the ends
        are above the middle, together, is a walk over both halves."""
        reach_m = 0.5 * height_m
        return self.rise_sigma_m(2.0 * reach_m) / reach_m**2

    def seen_from(self, p_m: np.ndarray, height_m: float, height_sigma_m: float, share: float) -> Ground:
        """The plane for odometry seen at ``p_m`` (east, north, ...), of whose matches this ``share`` agreed."""
        slope_e, slope_n = self._slope or (0.0, 0.0)
        slope_sigma, level_share = FLAT_SIGMAS if self._slope is None else DEM_SIGMAS
        # A slope that nobody knows is in sight for a while, as are points off the plane, all on one side of it.
        slope_sigma = float(np.hypot(slope_sigma, RELIEF_REPEATS * self.slope_sigma(height_m)))
        relief_share = RELIEF_REPEATS * self._relief_m / height_m
        slope_sigma = float(np.hypot(slope_sigma, RELIEF_SLOPE * relief_share))
        untold_m = 0.0 if self._slope is None else max(0.0, float(np.hypot(*(p_m[:2] - self._at_m))) - SLOPE_REACH_M)
        level_m = np.hypot(LEVEL_M, self.ruggedness.rise * np.sqrt(untold_m))
        level_share = float(np.sqrt(level_share**2 + relief_share**2 + (level_m / height_m) ** 2))
        bend_sigma = self.bend_sigma(height_m)
        return Ground(
            height_m,
            height_sigma_m,
            slope_e=slope_e,
            slope_n=slope_n,
            slope_sigma=slope_sigma,
            level_share=level_share,
            bend_sigma=bend_sigma,
            share=share,
        )
