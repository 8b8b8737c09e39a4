"""The ground of a simulated flight as functions of position: relief, objects on it, and the error of its map.

No picture is rendered. Odometry and map matches are computed from points of the ground."""

import copy
import math

import numpy as np

WAVES = 24  # plane waves of a field
RELIEF_WAVES_M = (300.0, 3000.0)
# How two orthophotos of one place differ, beyond a constant: 25 m patches of the two dates of the village map were
# matched with each other. Covariance 1.1 m^2 at 50 m, 0.6 at 100 m, 0.2 at 160 m, 0 beyond; half of it is one map's,
# and that is a lower bound: errors that both dates share, as of the elevation model, do not show. So the warp of a map
# that states a large error is scaled in proportion, as the estimator has to expect.
WARP_M, WARP_SHARE, WARP_WAVES_M = 0.8, 0.33, (200.0, 700.0)
# Shadows displace what stands above the ground (docs/integrity.md#light): 1-sigma, east and north, of a frame's mean.
SHADOW_M = np.array([0.98, 0.60])
# Residuals of map matches after the pose, on real flights: 0.5 % of the height in each coordinate. Four fifths of it
# repeat when the same ground is observed half a second later; uncorrelated beyond a tenth of the height.
DETAIL_M, DETAIL_WAVES_M = 0.35, (25.0, 60.0)
HOUSE_CELL_M, HOUSE_HALF_M, HOUSE_HEIGHT_M = 24.0, (4.0, 9.0), (3.0, 9.0)
TREE_CELL_M, TREE_HALF_M, TREE_HEIGHT_M = 11.0, (1.5, 4.0), (3.0, 12.0)
SETTLED_WAVES_M = (400.0, 1500.0)
MAP_SEES_TOPS = 0.5  # share of an object's height that shifts a patch against the map's bare ground


class _Waves:
    """A smooth random field: plane waves of random direction, length and phase, unit variance."""

    def __init__(self, rng: np.random.Generator, lengths_m: tuple[float, float], count: int = WAVES) -> None:
        length = np.exp(rng.uniform(math.log(lengths_m[0]), math.log(lengths_m[1]), count))
        course = rng.uniform(0.0, 2.0 * math.pi, count)
        self._k = np.stack([np.sin(course), np.cos(course)]) * (2.0 * math.pi / length)  # (2, count)
        self._phase = rng.uniform(0.0, 2.0 * math.pi, count)
        weight = length if lengths_m == RELIEF_WAVES_M else np.ones(count)  # the amplitude grows with the wavelength
        self._amplitude = weight * math.sqrt(2.0 / float((weight**2).sum()))

    def __call__(self, places_m: np.ndarray) -> np.ndarray:
        """(N, 2) east, north -> (N,)"""
        return np.sin(places_m @ self._k + self._phase) @ self._amplitude


class Terrain:
    """``hills_m``: 1-sigma of the relief. ``settled`` 0..1: share of the ground that houses and trees cover."""

    def __init__(self, seed: int, hills_m: float, settled: float) -> None:
        rng = np.random.default_rng([seed, 51])
        self._hills_m, self._settled = hills_m, settled
        self._relief = _Waves(rng, RELIEF_WAVES_M)
        self._settlement = _Waves(rng, SETTLED_WAVES_M, 8)
        self._salt = int(rng.integers(1 << 62))
        self._origin_m = np.zeros(2)

    def seen_from(self, origin_m: np.ndarray) -> "Terrain":
        """The same ground in a frame with its origin at ``origin_m`` (2,) of this one."""
        moved = copy.copy(self)
        moved._origin_m = self._origin_m + origin_m
        return moved

    def bare_m(self, places_m: np.ndarray) -> np.ndarray:
        """Height of the bare ground, AMSL, at (N, 2)."""
        return self._hills_m * self._relief(places_m + self._origin_m)

    def bare_at_m(self, e_m: float, n_m: float) -> float:
        return float(self.bare_m(np.array([[e_m, n_m]]))[0])

    def standing_m(self, places_m: np.ndarray) -> np.ndarray:
        """Height of objects (roofs, tree crowns) above the bare ground at (N, 2); 0 where there is none."""
        places_m = places_m + self._origin_m
        settled = np.clip(self._settled * (1.0 + self._settlement(places_m)), 0.0, 0.9)
        houses = self._blocks(places_m, 1, HOUSE_CELL_M, HOUSE_HALF_M, HOUSE_HEIGHT_M, settled)
        trees = self._blocks(places_m, 2, TREE_CELL_M, TREE_HALF_M, TREE_HEIGHT_M, 0.5 * settled)
        return np.maximum(houses, trees)

    def _blocks(
        self,
        places_m: np.ndarray,
        kind: int,
        cell_m: float,
        half_m: tuple[float, float],
        height_m: tuple[float, float],
        share: np.ndarray,
    ) -> np.ndarray:
        """At most one block in each cell of a grid; size, position and height are a hash of the cell."""
        cells = np.floor(places_m / cell_m).astype(np.int64)
        there, size, east, north, height = self._uniform(cells, kind)
        half = half_m[0] + size * (half_m[1] - half_m[0])
        middle = (cells + 0.5) * cell_m + (np.stack([east, north], 1) - 0.5) * (cell_m - 2.0 * half[:, None])
        inside = (np.abs(places_m - middle) < half[:, None]).all(axis=1) & (there < share)
        return np.where(inside, height_m[0] + height * (height_m[1] - height_m[0]), 0.0)

    def _uniform(self, cells: np.ndarray, kind: int) -> np.ndarray:
        """(5, N) in 0..1, a function of the cell alone (splitmix64's finaliser, Steele et al. 2014)."""
        key = cells[:, 0].astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        key ^= cells[:, 1].astype(np.uint64) * np.uint64(0xC2B2AE3D27D4EB4F)
        number = np.arange(5, dtype=np.uint64)[:, None] + np.uint64(8 * kind)
        z = key[None, :] + np.uint64(self._salt) + number * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return ((z ^ (z >> np.uint64(31))) >> np.uint64(11)) / float(1 << 53)


class MapError:
    """Mapped less true position: a constant offset, a smooth warp, shadows, and fine detail."""

    def __init__(self, seed: int, offset_m: np.ndarray, sigma_m: float) -> None:
        """``offset_m`` (2,): the constant registration error of the map; ``sigma_m``: the 1-sigma per axis that
        the map states."""
        rng = np.random.default_rng([seed, 52])
        self.offset_m = offset_m
        self._warp_m = max(WARP_M, WARP_SHARE * sigma_m)
        self._warp = (_Waves(rng, WARP_WAVES_M), _Waves(rng, WARP_WAVES_M))
        self._detail = (_Waves(rng, DETAIL_WAVES_M), _Waves(rng, DETAIL_WAVES_M))
        self._shadow = (_Waves(rng, SETTLED_WAVES_M, 8), _Waves(rng, SETTLED_WAVES_M, 8))

    def at(self, places_m: np.ndarray) -> np.ndarray:
        """(N, 2) -> (N, 2) metres."""
        warp, detail, shadow = (
            np.stack([field(places_m) for field in fields], 1) for fields in (self._warp, self._detail, self._shadow)
        )
        return self.offset_m + self._warp_m * warp + DETAIL_M * detail + SHADOW_M * shadow
