"""Precomputed descriptors of a layer's tiles for relocalization; computed from the encoded tiles."""

import contextlib
import sqlite3
from dataclasses import dataclass

import cv2
import numpy as np

from terrafix.map.format import TILE_PX, DescriptorTable, Layer, Level
from terrafix.map.tile_cache import Part, copy_tile_part, decode_tile
from terrafix_engines.retrieval.pooled import PooledGradientDescriber
from terrafix_tools.mapping.package.gpkg import GpkgWriter
from terrafix_tools.mapping.package.pyramid import Place
from terrafix_tools.parallel.pool import PoolProvider, render_pieces
from terrafix_tools.progress import Bar

# Ground metres per pixel: four octaves. The search uses an 80th of the height, so these serve 75 to 1800 m;
# finer ones would be as large as the imagery, and the search of a large map uses coarser cells anyway.
FINEST_M, COARSEST_M = 1.4, 23.0
PAD_PX = 32  # margin around a tile, so that its descriptors have no edge effect
PNG_LEVEL = 3  # level 6 takes twice the time for 1 % less size
BLOCK = 4  # tiles per side of a block that is processed at a time, from 36 images of 50 kB
WHOLE_TILE: Part = (slice(None), slice(None))
BLOCKS_PER_WORKER = 8  # a fifth of a second each: with fewer, a process does not compensate its start


@dataclass(frozen=True)
class TileBlock:
    """Tiles of one level to describe, with the encoded images of these tiles and of their neighbours."""

    zoom: int
    places: tuple[Place, ...]
    pictures: dict[Place, bytes]


class BlockDescriber:
    """Renderer of descriptor tiles in a worker process."""

    def __init__(self) -> None:
        self._describer = PooledGradientDescriber()

    def render(self, block: TileBlock) -> list[tuple[int, Place, bytes]]:
        """Zoom, position and encoded descriptor tile (``format.DescriptorTable``) of each tile."""
        columns, rows = ([place[axis] for place in block.places] for axis in (0, 1))
        first = min(columns) - 1, min(rows) - 1
        size = (max(rows) + 2 - first[1]) * TILE_PX, (max(columns) + 2 - first[0]) * TILE_PX
        mosaic = np.zeros((*size, 4), np.uint8)
        for place, data in block.pictures.items():
            copy_tile_part(decode_tile(data), WHOLE_TILE, mosaic[_slices(place, first, 0)])
        return [(block.zoom, place, self._describe(mosaic[_slices(place, first, PAD_PX)])) for place in block.places]

    def _describe(self, picture: np.ndarray) -> bytes:
        """A tile with ``PAD_PX`` of its neighbours around it, (h, w, 4) uint8 -> PNG."""
        rim, cells = slice(PAD_PX, PAD_PX + TILE_PX), TILE_PX // self._describer.stride
        inner = slice(PAD_PX // self._describer.stride, PAD_PX // self._describer.stride + cells)
        described = self._describer.describe(cv2.cvtColor(picture, cv2.COLOR_BGRA2BGR))[:, inner, inner]
        pool = self._describer.stride
        valid = (picture[rim, rim, 3] == 255).reshape(cells, pool, cells, pool).all(axis=(1, 3))
        planes = np.concatenate([np.rint(described * 255.0) * valid, np.where(valid, 255.0, 0.0)[None]])
        coded = planes.astype(np.uint8).reshape(-1, cells)
        return cv2.imencode(".png", coded, [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL])[1].tobytes()


def write_descriptors(
    writer: GpkgWriter, db: sqlite3.Connection, layer: Layer, unit_m: float, crew: PoolProvider, bar: Bar
) -> DescriptorTable | None:
    """Writes descriptors of the tiles of ``layer``, which are already in ``db``. None: no level has a searched scale.

    ``unit_m``: ground metres per unit of the CRS."""
    levels = [level for level in layer.levels if FINEST_M <= _gsd_m(level, unit_m) < COARSEST_M]
    if not levels:
        return None
    describer = PooledGradientDescriber()
    table = f"{layer.table}_descriptors"
    writer.add_descriptor_table(table, layer, describer.name)
    blocks = [(level.zoom, block) for level in levels for block in _blocks(db, layer.table, level.zoom)]
    step = bar("descriptors", len(blocks))
    wanted = (_read_block(db, layer.table, zoom, block) for zoom, block in blocks)
    rendered = render_pieces(BlockDescriber, wanted, len(blocks), crew, per_worker=BLOCKS_PER_WORKER)
    with contextlib.closing(rendered) as described:
        for tiles in described:
            for zoom, (column, row), data in tiles:
                writer.add_tile(table, zoom, column, row, data)
            step()
    return DescriptorTable(
        table=table,
        name=describer.name,
        pool=describer.stride,
        channels=describer.channels,
        zooms=tuple(level.zoom for level in levels),
        tiles=writer.tiles[table],
    )


def _blocks(db: sqlite3.Connection, table: str, zoom: int) -> list[tuple[Place, ...]]:
    """Columns and rows of a level's tiles."""
    query = f'SELECT tile_column, tile_row FROM "{table}" WHERE zoom_level = ? ORDER BY tile_row, tile_column'
    blocks: dict[Place, list[Place]] = {}
    for column, row in db.execute(query, (zoom,)):
        blocks.setdefault((column // BLOCK, row // BLOCK), []).append((column, row))
    return [tuple(block) for block in blocks.values()]


def _read_block(db: sqlite3.Connection, table: str, zoom: int, places: tuple[Place, ...]) -> TileBlock:
    columns, rows = ([place[axis] for place in places] for axis in (0, 1))
    found = db.execute(
        f'SELECT tile_column, tile_row, tile_data FROM "{table}"'
        " WHERE zoom_level = ? AND tile_column BETWEEN ? AND ? AND tile_row BETWEEN ? AND ?",
        (zoom, min(columns) - 1, max(columns) + 1, min(rows) - 1, max(rows) + 1),
    )
    return TileBlock(zoom, places, {(column, row): data for column, row, data in found})


def _slices(place: Place, first: Place, pad_px: int) -> Part:
    """Rows and columns of a tile, and ``pad_px`` around it, in a mosaic whose first tile is ``first``."""
    left, top = ((at - start) * TILE_PX for at, start in zip(place, first, strict=True))
    return slice(top - pad_px, top + TILE_PX + pad_px), slice(left - pad_px, left + TILE_PX + pad_px)


def _gsd_m(level: Level, unit_m: float) -> float:
    return float(np.sqrt(level.pixel_x * level.pixel_y)) * unit_m
