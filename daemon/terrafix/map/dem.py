"""Elevation of a map package, sampled in the coordinates of a local frame."""

import numpy as np
from pyproj import CRS

from terrafix.core.geodesy import transformer
from terrafix.map.format import DEM_TILE_PX, ELEVATION_TABLE, DemGrid
from terrafix.map.tile_cache import TileStore

MAX_EXACT_POINTS = 4096  # above this count, points are projected by a quadratic fit (error: centimetres over 20 km)
CORNERS = ((0, 0), (0, 1), (1, 0), (1, 1))  # row, column


class ElevationView:
    """Bilinear sampler of the elevation grid. ``local``: CRS of the local frame; ``crs``: CRS of the grid."""

    def __init__(self, grid: DemGrid, tiles: TileStore, local: CRS, crs: CRS) -> None:
        self._grid = grid
        self._tiles = tiles
        self._to_crs = transformer(local, crs)

    def at(self, e_m: np.ndarray, n_m: np.ndarray) -> np.ndarray:
        """Local coordinates (any shape, metres) -> height AMSL in metres, float64, same shape. NaN where unknown."""
        e_m, n_m = np.broadcast_arrays(np.asarray(e_m, np.float64), np.asarray(n_m, np.float64))
        grid = self._grid
        x, y = self._project(e_m.ravel(), n_m.ravel())
        column = (x - grid.x_min) / grid.pixel - 0.5
        row = (grid.y_max - y) / grid.pixel - 0.5
        inside = np.flatnonzero(
            (column >= 0) & (row >= 0) & (column <= grid.width_px - 1) & (row <= grid.height_px - 1)
        )
        c, r = np.floor(column[inside]).astype(np.int64), np.floor(row[inside]).astype(np.int64)
        s, t = column[inside] - c, row[inside] - r
        posts = self._posts(np.stack([r + dr for dr, _ in CORNERS]), np.stack([c + dc for _, dc in CORNERS]))
        top, bottom = posts[0] * (1 - s) + posts[1] * s, posts[2] * (1 - s) + posts[3] * s
        height_m = np.full(column.shape, np.nan)
        height_m[inside] = top * (1 - t) + bottom * t
        return height_m.reshape(e_m.shape)

    def _posts(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Stored heights (metres AMSL) at integer grid indices (row, column); NaN for void or missing tiles."""
        tile_row, tile_column = row // DEM_TILE_PX, column // DEM_TILE_PX
        tile_id = tile_row * self._grid.width_px + tile_column
        heights_m = np.full(row.shape, np.nan)
        for unique_id in np.unique(tile_id):
            tr, tc = divmod(int(unique_id), self._grid.width_px)
            tile = self._tiles.tile((ELEVATION_TABLE, 0, tc, tr))
            if tile is not None:
                in_tile = tile_id == unique_id
                heights_m[in_tile] = tile[0][row[in_tile] - tr * DEM_TILE_PX, column[in_tile] - tc * DEM_TILE_PX]
        return heights_m

    def _project(self, e_m: np.ndarray, n_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Local coordinates (N,) in metres -> map coordinates x (N,), y (N,) in CRS units."""
        if e_m.size <= MAX_EXACT_POINTS:
            return self._to_crs.transform(e_m, n_m)
        e_0, n_0 = float(e_m.mean()), float(n_m.mean())
        span = max(float(np.ptp(e_m)), float(np.ptp(n_m)), 1.0)
        knots = np.linspace(-1.0, 1.0, 9)
        u, v = (a.ravel() for a in np.meshgrid(knots, knots))
        x, y = self._to_crs.transform(e_0 + u * span, n_0 + v * span)
        fit = np.linalg.lstsq(_quadratic(u, v), np.stack([x, y], axis=1), rcond=None)[0]
        xy = _quadratic((e_m - e_0) / span, (n_m - n_0) / span) @ fit
        return xy[:, 0], xy[:, 1]


def _quadratic(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(N,), (N,) -> (N, 6): the monomials of a bivariate polynomial of degree two."""
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
