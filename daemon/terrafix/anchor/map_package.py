"""Reads a map package: a GeoPackage whose imagery becomes windows in local metres at any scale, and its elevation."""

import hashlib
import math
import sqlite3
from pathlib import Path

import cv2
import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from terrafix.anchor.map_format import (
    DEM_TILE_PX,
    HASH_TABLE,
    IMAGERY_TABLE,
    TILE_PX,
    Level,
    Manifest,
    connect,
    read_manifest,
)
from terrafix.anchor.map_tiles import Key, TileStore
from terrafix.core.errors import MapError
from terrafix.core.geodesy import LocalFrame, local_crs

COARSER_ALLOWED = 1.1  # a level up to 10 % coarser than asked is used rather than one almost twice as fine
BLOCK_PX = 1024  # a window is rendered in blocks of this many pixels, each with an affine map of its own
MIN_BLOCK_PX = 64
AFFINE_TOLERANCE_PX = 0.02  # split a block until its affine map is this close to the projection, in pixels of the level
BLUR_MIN_SCALE = 1.17  # below this reduction the bilinear kernel is filter enough
EXACT_POINTS = 4096  # more points than this are projected through a quadratic fit (good to centimetres over 20 km)


class MapPackage:
    """An open package, read only. One thread at a time.

    A tile whose sha256 is not the recorded one is void and listed in ``damaged_tiles``: a bad block on a disk
    takes a tile away in flight, not the map. ``verify`` reads everything and raises."""

    def __init__(self, path: Path, db: sqlite3.Connection, manifest: Manifest) -> None:
        self.path = path
        self.manifest = manifest
        self._db = db
        self.tiles = TileStore(db)
        self.crs = CRS.from_user_input(manifest.crs)
        self._from_wgs84 = Transformer.from_crs(4326, self.crs, always_xy=True)
        self.x_min, self.y_max = db.execute(
            "SELECT min_x, max_y FROM gpkg_tile_matrix_set WHERE table_name = ?", (IMAGERY_TABLE,)
        ).fetchone()
        # The bounds of the contents are those of the imagery; the tile matrix reaches beyond them.
        self.bounds_crs: tuple[float, float, float, float] = db.execute(
            "SELECT min_x, min_y, max_x, max_y FROM gpkg_contents WHERE table_name = ?", (IMAGERY_TABLE,)
        ).fetchone()
        self.levels = [
            Level(*row)
            for row in db.execute(
                "SELECT zoom_level, pixel_x_size, pixel_y_size, matrix_width, matrix_height FROM gpkg_tile_matrix"
                " WHERE table_name = ? ORDER BY zoom_level",
                (IMAGERY_TABLE,),
            )
        ]

    @classmethod
    def open(cls, path: Path, *, verify: bool = False) -> "MapPackage":
        """Checks the file's size, format, manifest and list of tiles; with `verify` every tile too. Raises MapError."""
        db = connect(path)
        try:
            manifest = read_manifest(path, db)
            package = cls(path, db, manifest)
            if verify:
                package.verify()
        except sqlite3.DatabaseError as error:
            db.close()
            raise MapError(f"{path}: damaged map package ({error}); build or copy it again") from None
        except (MapError, CRSError) as error:
            db.close()
            raise MapError(str(error)) from None
        return package

    def verify(self) -> None:
        """Reads every tile and compares it with its recorded sha256. Raises MapError naming the first bad tile."""
        try:
            for zoom, column, row, expected in self._db.execute(f"SELECT * FROM {HASH_TABLE} ORDER BY 1, 2, 3"):
                data = self.tiles.blob((zoom, column, row))
                if data is None or hashlib.sha256(data).digest() != expected:
                    raise MapError(
                        f"{self.path}: tile zoom {zoom} column {column} row {row} was altered or lost; "
                        "build or copy the package again"
                    )
        except sqlite3.DatabaseError as error:
            raise MapError(f"{self.path}: damaged map package ({error}); build or copy it again") from None

    @property
    def damaged_tiles(self) -> set[Key]:
        """(zoom, column, row) of the tiles wanted so far that are not what was written; zoom -1 = elevation."""
        return self.tiles.damaged

    def ground_amsl_m(self, lat_deg: float, lon_deg: float) -> float | None:
        """Height of the ground at a place; None where the package does not know it."""
        here = np.zeros(1)
        up = self.bind(LocalFrame(lat_deg, lon_deg)).elevation(here, here)
        return float(up[0]) if up is not None and np.isfinite(up[0]) else None

    def covers(self, lat_deg: float, lon_deg: float) -> bool:
        """Whether the place lies in valid imagery."""
        x, y = self._from_wgs84.transform(lon_deg, lat_deg)
        if not (math.isfinite(x) and math.isfinite(y)):
            return False
        level = self.levels[-1]
        column_px = math.floor((x - self.x_min) / level.pixel_x)
        row_px = math.floor((self.y_max - y) / level.pixel_y)
        if not (0 <= column_px < level.columns * TILE_PX and 0 <= row_px < level.rows * TILE_PX):
            return False
        tile = self.tiles.tile((level.zoom, column_px // TILE_PX, row_px // TILE_PX))
        if tile is None:
            return False
        return tile[1] is None or bool(tile[1][row_px % TILE_PX, column_px % TILE_PX])

    def bind(self, frame: LocalFrame) -> "LocalMap":
        """The same map in the metres of a local frame."""
        return LocalMap(self, frame)

    def close(self) -> None:
        self._db.close()
        self.tiles.clear()


class LocalMap:
    """A package seen in the metres of a local frame: e east, n north, true north up at the frame's origin."""

    def __init__(self, package: MapPackage, frame: LocalFrame) -> None:
        self._package = package
        local = local_crs(frame.lat_deg, frame.lon_deg)
        self._to_crs = Transformer.from_crs(local, package.crs, always_xy=True)
        to_local = Transformer.from_crs(package.crs, local, always_xy=True)
        self.gsd_m = package.manifest.gsd_m
        self.bounds_m: tuple[float, float, float, float] = to_local.transform_bounds(
            *package.bounds_crs, densify_pts=51
        )
        # Ground size of one CRS unit at the centre of the map, to choose a level in metres.
        self._unit_m = self.gsd_m / math.sqrt(package.levels[-1].pixel_x * package.levels[-1].pixel_y)

    def window(
        self, e_min_m: float, n_max_m: float, width_px: int, height_px: int, gsd_m: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """North-up picture: (height_px, width_px, 3) uint8 BGR and (height_px, width_px) bool valid.

        The centre of pixel (r, c) is at e = e_min_m + (c + 0.5) gsd_m, n = n_max_m - (r + 0.5) gsd_m. Where the map
        has nothing the picture is zero and not valid."""
        image = np.zeros((height_px, width_px, 3), np.uint8)
        mask = np.zeros((height_px, width_px), np.uint8)
        level = self._level_for(gsd_m)
        for row in range(0, height_px, BLOCK_PX):
            for column in range(0, width_px, BLOCK_PX):
                part = (slice(row, min(row + BLOCK_PX, height_px)), slice(column, min(column + BLOCK_PX, width_px)))
                self._render(image[part], mask[part], e_min_m + column * gsd_m, n_max_m - row * gsd_m, gsd_m, level)
        return image, mask.view(bool)

    def elevation(self, e_m: np.ndarray, n_m: np.ndarray) -> np.ndarray | None:
        """Metres AMSL (float64, shape of e_m), bilinear; NaN where unknown; None when the package has no elevation."""
        grid = self._package.manifest.dem
        if grid is None:
            return None
        e_m, n_m = np.broadcast_arrays(np.asarray(e_m, np.float64), np.asarray(n_m, np.float64))
        x, y = self._project(e_m.ravel(), n_m.ravel())
        column = (x - grid.x_min) / grid.pixel - 0.5
        row = (grid.y_max - y) / grid.pixel - 0.5
        height_m = np.full(column.shape, np.nan)
        inside = np.flatnonzero(
            (column >= 0) & (row >= 0) & (column <= grid.width_px - 1) & (row <= grid.height_px - 1)
        )
        column, row = column[inside], row[inside]
        tile_column, tile_row = (column // DEM_TILE_PX).astype(np.int64), (row // DEM_TILE_PX).astype(np.int64)
        tile_id = tile_row * grid.width_px + tile_column
        for one in np.unique(tile_id):
            tr, tc = divmod(int(one), grid.width_px)
            tile = self._package.tiles.tile((-1, tc, tr))
            if tile is not None:
                here = tile_id == one
                values = _bilinear(tile[0], column[here] - tc * DEM_TILE_PX, row[here] - tr * DEM_TILE_PX)
                height_m[inside[here]] = values
        return height_m.reshape(e_m.shape)

    def _level_for(self, gsd_m: float) -> Level:
        """The coarsest level that still has the detail asked for."""
        for level in self._package.levels:
            if math.sqrt(level.pixel_x * level.pixel_y) * self._unit_m <= gsd_m * COARSER_ALLOWED:
                return level
        return self._package.levels[-1]

    def _project(self, e_m: np.ndarray, n_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Local metres (N,) to map coordinates (N,) each."""
        if e_m.size <= EXACT_POINTS:
            return self._to_crs.transform(e_m, n_m)
        e_0, n_0 = float(e_m.mean()), float(n_m.mean())
        span = max(float(np.ptp(e_m)), float(np.ptp(n_m)), 1.0)
        knots = np.linspace(-1.0, 1.0, 9)
        u, v = (a.ravel() for a in np.meshgrid(knots, knots))
        x, y = self._to_crs.transform(e_0 + u * span, n_0 + v * span)
        fit = np.linalg.lstsq(_quadratic(u, v), np.stack([x, y], axis=1), rcond=None)[0]
        xy = _quadratic((e_m - e_0) / span, (n_m - n_0) / span) @ fit
        return xy[:, 0], xy[:, 1]

    def _render(
        self, image: np.ndarray, mask: np.ndarray, e_min_m: float, n_max_m: float, gsd_m: float, level: Level
    ) -> None:
        """Fills one block (views into the window), splitting it until an affine map is exact enough."""
        height_px, width_px = mask.shape
        knots = np.array([0.0, 0.5, 1.0])
        c, r = (a.ravel() for a in np.meshgrid(knots * width_px - 0.5, knots * height_px - 0.5))
        x, y = self._to_crs.transform(e_min_m + (c + 0.5) * gsd_m, n_max_m - (r + 0.5) * gsd_m)
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            return
        # Pixel coordinates of the level, with integers at pixel centres as OpenCV has it.
        u = (x - self._package.x_min) / level.pixel_x - 0.5
        v = (self._package.y_max - y) / level.pixel_y - 0.5
        design = np.stack([c, r, np.ones_like(c)], axis=1)
        uv = np.stack([u, v], axis=1)
        affine = np.linalg.lstsq(design, uv, rcond=None)[0]  # (3, 2)
        error_px = float(np.abs(design @ affine - uv).max())
        if error_px > AFFINE_TOLERANCE_PX and max(width_px, height_px) > MIN_BLOCK_PX:
            for rows in _halves(height_px):
                for columns in _halves(width_px):
                    e_m, n_m = e_min_m + columns.start * gsd_m, n_max_m - rows.start * gsd_m
                    self._render(image[rows, columns], mask[rows, columns], e_m, n_m, gsd_m, level)
            return
        scale = math.sqrt(abs(np.linalg.det(affine[:2])))
        sigma_px = 0.5 * math.sqrt(scale * scale - 1.0) if scale > BLUR_MIN_SCALE else 0.0
        margin = 2 + math.ceil(3 * sigma_px)
        low = np.floor(uv.min(axis=0)).astype(int) - margin
        high = np.ceil(uv.max(axis=0)).astype(int) + margin + 1
        start, end = np.maximum(low, 0), np.minimum(high, [level.columns * TILE_PX, level.rows * TILE_PX])
        if (start >= end).any():
            return
        (u_0, v_0), (width, height) = (int(v) for v in start), (int(v) for v in end - start)
        source, source_mask = self._package.tiles.mosaic(level, u_0, v_0, width, height)
        if source_mask is None and ((start != low).any() or (end != high).any()):
            source_mask = np.full(source.shape[:2], 255, np.uint8)  # the window reaches beyond the tiles
        if source_mask is not None and not source_mask.any():
            return
        if sigma_px > 0:
            side = 2 * max(1, round(2.5 * sigma_px)) + 1
            source = cv2.GaussianBlur(source, (side, side), sigma_px)
            if source_mask is not None:
                source_mask = cv2.erode(source_mask, np.ones((side, side), np.uint8))
        matrix = affine.T - np.array([[0.0, 0.0, u_0], [0.0, 0.0, v_0]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        warped = cv2.warpAffine(source, matrix, (width_px, height_px), flags=flags)
        if source_mask is None:
            image[:], mask[:] = warped, 1
            return
        valid = cv2.warpAffine(source_mask, matrix, (width_px, height_px), flags=flags)
        mask[:] = valid == 255  # every pixel that was blended is valid
        image[:] = cv2.bitwise_and(warped, warped, mask=mask)


def _halves(size: int) -> list[slice]:
    """One slice, or two when the block is large enough to split."""
    half = size // 2
    return [slice(0, size)] if size <= MIN_BLOCK_PX else [slice(0, half), slice(half, size)]


def _quadratic(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(N, 6) terms of a polynomial of degree two."""
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)


def _bilinear(grid: np.ndarray, column: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Values of grid (257, 257) at fractional (column, row), each (N,) in [0, 256)."""
    c, r = np.floor(column).astype(np.int64), np.floor(row).astype(np.int64)
    s, t = column - c, row - r
    top = grid[r, c] * (1 - s) + grid[r, c + 1] * s
    bottom = grid[r + 1, c] * (1 - s) + grid[r + 1, c + 1] * s
    return top * (1 - t) + bottom * t
