"""Tiles of one zoom as one image; implements Imagery."""

from collections import OrderedDict
from pathlib import Path
from typing import Protocol

import numpy as np

from terrafix.core.errors import MapError
from terrafix.map.format import InputStatement
from terrafix_tools.mapping.area.polygons import Placed
from terrafix_tools.mapping.imagery import Imagery
from terrafix_tools.mapping.sources.tiles.grid import HALF_M, MERCATOR, Tile, tile_span_m, tiles_of
from terrafix_tools.mapping.sources.tiles.image import TileDamage, decode

CACHE_BYTES = 64 << 20  # decoded tiles; adjacent windows share a row of them


class TileReader(Protocol):
    """Source of tiles: a download store, an MBTiles or a PMTiles file."""

    path: Path
    notes: tuple[str, ...]  # what was assumed about the file

    def get(self, tile: Tile) -> bytes | None: ...

    def close(self) -> None: ...


class TileImagery(Imagery):
    """All tiles of ``zoom`` that touch an area, on the grid of EPSG:3857. A context manager."""

    def __init__(self, reader: TileReader, zoom: int, tile_px: int, placed: Placed) -> None:
        self.path = reader.path
        self._reader, self._zoom, self._tile_px = reader, zoom, tile_px
        tiles = tiles_of(placed, zoom)
        self._column, self._row, self._touched = tiles.column, tiles.row, tiles.touched
        span_m = tile_span_m(zoom)
        rows, columns = tiles.touched.shape
        self.crs = MERCATOR
        self.width_px, self.height_px = columns * tile_px, rows * tile_px
        self.pixel_x = self.pixel_y = span_m / tile_px
        self.x_min, self.y_max = tiles.column * span_m - HALF_M, HALF_M - tiles.row * span_m
        self._statements = (
            InputStatement(
                name=reader.path.name, kind="imagery", unit="metre", datum=MERCATOR.name, accuracy_m=0.0,
                assumed=reader.notes,
            ),
        )  # fmt: skip
        self._decoded: OrderedDict[Tile, np.ndarray | None] = OrderedDict()

    @property
    def statements(self) -> tuple[InputStatement, ...]:
        return self._statements

    def close(self) -> None:
        self._reader.close()

    def read(self, column: int, row: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
        """A window inside the image: (height, width, 3) uint8 BGR and mask (height, width) uint8 of 0 and 255.

        Raises MapError: a tile is damaged."""
        out = np.zeros((height, width, 4), np.uint8)
        side = self._tile_px
        for tile_row in range(row // side, (row + height - 1) // side + 1):
            for tile_column in range(column // side, (column + width - 1) // side + 1):
                pixels = self._tile(tile_column, tile_row)
                if pixels is None:
                    continue
                left, top = tile_column * side - column, tile_row * side - row
                x0, y0, x1, y1 = max(left, 0), max(top, 0), min(left + side, width), min(top + side, height)
                out[y0:y1, x0:x1] = pixels[y0 - top : y1 - top, x0 - left : x1 - left]
        return np.ascontiguousarray(out[:, :, :3]), np.ascontiguousarray(out[:, :, 3])

    def _tile(self, column: int, row: int) -> np.ndarray | None:
        if not self._touched[row, column]:
            return None
        tile = Tile(self._zoom, self._column + column, self._row + row)
        if tile in self._decoded:
            self._decoded.move_to_end(tile)
            return self._decoded[tile]
        data = self._reader.get(tile)
        try:
            pixels = None if data is None else decode(data, self._tile_px)
        except TileDamage as damage:
            raise MapError(f"{self.path}: tile {tile.zoom}/{tile.column}/{tile.row}: {damage}") from None
        self._decoded[tile] = pixels
        while len(self._decoded) * 4 * self._tile_px**2 > CACHE_BYTES:
            self._decoded.popitem(last=False)
        return pixels
