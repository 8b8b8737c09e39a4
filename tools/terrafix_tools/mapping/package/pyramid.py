"""Tile pyramid of a layer: a tile is the mean of its four children; depth first, so that only one path is in memory."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import rasterio

from terrafix.map.format import TILE_PX, Level
from terrafix_tools.mapping.imagery import Imagery
from terrafix_tools.mapping.mosaic.collar import BLEED_PX, TRIM_PX, Collar
from terrafix_tools.mapping.package.gpkg import GpkgWriter

JPEG_QUALITY = 95  # 8-11 MB/km2 at 0.3 m/px on aerial photographs; artefacts below one or two grey levels
# For partly valid tiles, because JPEG has no exact mask. One filter and the fastest level take a fifth of the time of
# level 6 with a filter chosen line by line, for 11 % more bytes of these tiles.
PNG_FAST = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP)
PNG_SMALL = (cv2.IMWRITE_PNG_COMPRESSION, 6)  # for drawings
CHUNK_LEVELS = 3  # the source is read in chunks of 2^3 tiles per side (2048 px)

# Part of what determines the bytes, besides the input.
BUILT_WITH = f"terrafix {version('terrafix')}, GDAL {rasterio.__gdal_version__}, OpenCV {cv2.__version__}"

Place = tuple[int, int]  # column, row of a chunk at the zoom of chunks


@dataclass(frozen=True)
class TileTree:
    """All tiles under one tile, children first, and that tile's own pixels (256, 256, 4); None = no imagery."""

    tiles: list[tuple[int, int, int, bytes]]  # zoom, column, row, data
    top: np.ndarray | None


@dataclass(frozen=True)
class ChunkRenderer:
    """Renders chunks from open imagery, in a worker process. ``open_renderer`` creates one from picklable arguments."""

    source: Imagery
    collar: Collar | None
    finest: int  # zoom
    lossless: bool = False

    def render(self, place: Place) -> TileTree:
        depth = min(CHUNK_LEVELS, self.finest)
        tiles: list[tuple[int, int, int, bytes]] = []
        pixels = self._read(place[0], place[1], TILE_PX << depth)
        mask = cv2.extractChannel(pixels, 3)
        return TileTree(tiles, self._reduce(self.finest - depth, place[0], place[1], pixels, mask, tiles))

    def _reduce(
        self,
        zoom: int,
        column: int,
        row: int,
        pixels: np.ndarray,
        mask: np.ndarray,
        tiles: list[tuple[int, int, int, bytes]],
    ) -> np.ndarray | None:
        """Adds a tile and all below it; returns it as (256, 256, 4) uint8 BGR and mask, None = no imagery.

        ``mask``: the mask of ``pixels`` alone, because OpenCV counts a plane faster than every fourth byte."""
        valid_px = cv2.countNonZero(mask)
        if valid_px == 0:
            return None
        whole = valid_px == mask.size
        tile: np.ndarray | None = pixels
        if zoom < self.finest:
            half = pixels.shape[0] // 2
            children = []
            for r in (0, 1):
                for c in (0, 1):
                    part = slice(r * half, (r + 1) * half), slice(c * half, (c + 1) * half)
                    below = self._reduce(zoom + 1, 2 * column + c, 2 * row + r, pixels[part], mask[part], tiles)
                    children.append(below)
            tile = parent_of(children, whole)
        if tile is not None:
            tiles.append((zoom, column, row, encode(tile, whole, self.lossless)))
        return tile

    def _read(self, chunk_column: int, chunk_row: int, side: int) -> np.ndarray:
        """(side, side, 4) uint8: BGR, zero where invalid, and the mask."""
        column, row = chunk_column * side, chunk_row * side
        source = self.source
        right, bottom = min(column + side, source.width_px), min(row + side, source.height_px)
        margin = BLEED_PX + TRIM_PX if self.collar else 0
        left, top = max(0, column - margin), max(0, row - margin)
        width = min(right + margin, source.width_px) - left
        height = min(bottom + margin, source.height_px) - top
        image, mask = source.read(left, top, width, height)
        if self.collar:
            self.collar.remove(image, mask, left, top)
        inner = slice(row - top, bottom - top), slice(column - left, right - left)
        image, mask = image[inner], mask[inner]
        pixels = cv2.cvtColor(image, cv2.COLOR_BGR2BGRA)
        if cv2.countNonZero(mask) == side * side:
            return pixels
        out = np.zeros((side, side, 4), np.uint8)
        cv2.copyTo(pixels, mask, out[: bottom - row, : right - column])
        return out


def open_renderer(
    open_imagery: Callable[[], Imagery], collar: Path | None, finest: int, lossless: bool
) -> ChunkRenderer:
    """Opens the imagery for the lifetime of the process."""
    return ChunkRenderer(open_imagery().__enter__(), Collar(collar) if collar else None, finest, lossless)


def levels_of(source: Imagery) -> tuple[Level, ...]:
    """Levels from one tile to the source's own pixels; every matrix covers the same area (requirement 45)."""
    steps = max(0, math.ceil(math.log2(max(source.width_px, source.height_px) / TILE_PX)))
    columns = math.ceil(source.width_px / (TILE_PX << steps))
    rows = math.ceil(source.height_px / (TILE_PX << steps))
    return tuple(
        Level(z, source.pixel_x * 2 ** (steps - z), source.pixel_y * 2 ** (steps - z), columns << z, rows << z)
        for z in range(steps + 1)
    )


class Pyramid:
    """Writes the chunks of a layer, which arrive in the order of ``places``, and the levels above them."""

    def __init__(
        self, source: Imagery, levels: tuple[Level, ...], table: str, writer: GpkgWriter, lossless: bool
    ) -> None:
        self._width_px, self._height_px = source.width_px, source.height_px
        self._levels, self._table, self._writer = levels, table, writer
        self._lossless = lossless
        self._chunk_zoom = max(0, levels[-1].zoom - CHUNK_LEVELS)

    def places(self) -> list[Place]:
        """Chunks in depth-first order."""
        found: list[Place] = []

        def visit(zoom: int, column: int, row: int) -> None:
            if not self._exists(zoom, column, row):
                return
            if zoom == self._chunk_zoom:
                found.append((column, row))
                return
            for r in (0, 1):
                for c in (0, 1):
                    visit(zoom + 1, 2 * column + c, 2 * row + r)

        for row in range(self._levels[0].rows):
            for column in range(self._levels[0].columns):
                visit(0, column, row)
        return found

    def write(self, chunks: Iterator[TileTree]) -> bool:
        """True when any pixel was valid."""
        tops = [
            self._tile(0, column, row, chunks)
            for row in range(self._levels[0].rows)
            for column in range(self._levels[0].columns)
        ]
        return any(top is not None for top in tops)

    def _tile(self, zoom: int, column: int, row: int, chunks: Iterator[TileTree]) -> np.ndarray | None:
        if not self._exists(zoom, column, row):
            return None
        if zoom == self._chunk_zoom:
            chunk = next(chunks)
            for tile_zoom, tile_column, tile_row, data in chunk.tiles:
                self._writer.add_tile(self._table, tile_zoom, tile_column, tile_row, data)
            return chunk.top
        children = [self._tile(zoom + 1, 2 * column + c, 2 * row + r, chunks) for r in (0, 1) for c in (0, 1)]
        tile = parent_of(children)
        if tile is not None:
            self._writer.add_tile(self._table, zoom, column, row, encode(tile, lossless=self._lossless))
        return tile

    def _exists(self, zoom: int, column: int, row: int) -> bool:
        side = TILE_PX << (self._levels[-1].zoom - zoom)
        return column * side < self._width_px and row * side < self._height_px


def parent_of(children: list[np.ndarray | None], whole: bool = False) -> np.ndarray | None:
    """The tile above four children (row by row); None when no pixel is valid.

    ``whole``: all pixels are known to be valid; testing that takes longer than the rest."""
    if all(child is None for child in children):
        return None
    merged = np.zeros((2 * TILE_PX, 2 * TILE_PX, 4), np.uint8)
    for index, child in enumerate(children):
        if child is not None:
            r, c = divmod(index, 2)
            merged[r * TILE_PX : (r + 1) * TILE_PX, c * TILE_PX : (c + 1) * TILE_PX] = child
    tile = halve(merged, whole)
    return tile if whole or _valid_px(tile) else None


def halve(tile: np.ndarray, whole: bool = False) -> np.ndarray:
    """(2h, 2w, 4) -> (h, w, 4): mean of the valid pixels out of four; valid when at least two of them are."""
    out = cv2.resize(tile, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    if whole:
        return out
    share = cv2.extractChannel(out, 3)  # mean of the masks: 0, 64, 128, 191 or 255 for 0 to 4 valid pixels
    rows, columns = np.nonzero((share > 64) & (share < 255))
    parts = tile.reshape(tile.shape[0] // 2, 2, tile.shape[1] // 2, 2, 4)[rows, :, columns].astype(np.uint16)
    total = parts[..., :3].sum(axis=(1, 2))  # invalid pixels are zero
    count = np.count_nonzero(parts[..., 3], axis=(1, 2))[:, None]
    out[rows, columns, :3] = (total + count // 2) // count
    valid = cv2.threshold(share, 64, 255, cv2.THRESH_BINARY)[1]
    return cv2.copyTo(cv2.insertChannel(valid, out, 3), valid)


def _valid_px(tile: np.ndarray) -> int:
    """Uses OpenCV: NumPy takes ten times as long to access every fourth byte."""
    return cv2.countNonZero(cv2.extractChannel(tile, 3))


def _all_valid(tile: np.ndarray) -> bool:
    return _valid_px(tile) == tile.shape[0] * tile.shape[1]


def encode(tile: np.ndarray, whole: bool = False, lossless: bool = False) -> bytes:
    """JPEG when every pixel is valid, else PNG with alpha; both are supported by all GeoPackage readers.

    ``lossless``: PNG in any case. A drawing has sharp edges on even ground: JPEG adds edges of its own beside them."""
    if not lossless and (whole or _all_valid(tile)):
        return cv2.imencode(".jpg", cv2.cvtColor(tile, cv2.COLOR_BGRA2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[
            1
        ].tobytes()
    return cv2.imencode(".png", tile, PNG_SMALL if lossless else PNG_FAST)[1].tobytes()
