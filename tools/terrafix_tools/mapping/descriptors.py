"""Descriptors of a layer's tiles, for the search of a place that nobody knows: computed from the tiles as stored."""

import sqlite3

import cv2
import numpy as np

from terrafix.anchor.map_format import FORMAT_VERSION, TILE_PX, DescriptorTable, Layer, Level
from terrafix.anchor.map_tiles import TileStore
from terrafix_engines.retrieval.pooled import PooledGradientDescriber
from terrafix_tools.mapping.gpkg import GpkgWriter
from terrafix_tools.mapping.progress import Bar

# Ground metres of the pixels: four octaves. The search wants a 52nd of the height, so that they serve 50 to 1500 m
# above ground; finer ones would be as large as the imagery, and over a large map the search takes coarser cells anyway.
FINEST_M, COARSEST_M = 1.4, 23.0
PAD_PX = 32  # context around a tile, so that its rim is described as if there were no rim
PNG_LEVEL = 3  # 6 takes twice the time for 1 % less


def write_descriptors(
    writer: GpkgWriter, db: sqlite3.Connection, layer: Layer, unit_m: float, bar: Bar
) -> DescriptorTable | None:
    """Describes the tiles of ``layer``, which are in ``db`` already. None: no level has a scale that is searched.

    ``unit_m``: ground metres of one unit of the CRS. One process does this: 7 s for 100 km2, a twelfth of a build at
    0.5 m/px."""
    levels = [level for level in layer.levels if FINEST_M <= _gsd_m(level, unit_m) < COARSEST_M]
    if not levels:
        return None
    describer = PooledGradientDescriber()
    table = f"{layer.table}_descriptors"
    writer.add_descriptor_table(table, layer, describer.name)
    tiles = TileStore(db, FORMAT_VERSION)
    for level in levels:
        places = db.execute(
            f'SELECT tile_column, tile_row FROM "{layer.table}" WHERE zoom_level = ? ORDER BY tile_row, tile_column',
            (level.zoom,),
        ).fetchall()
        step = bar(f"{table}, {_gsd_m(level, unit_m):.1f} m/px", len(places))
        for column, row in places:
            writer.add_tile(table, level.zoom, column, row, _describe(describer, tiles, layer, level, column, row))
            step()
    return DescriptorTable(
        table=table,
        name=describer.name,
        pool=describer.stride,
        channels=describer.channels,
        zooms=tuple(level.zoom for level in levels),
        tiles=writer.tiles[table],
    )


def _describe(
    describer: PooledGradientDescriber, tiles: TileStore, layer: Layer, level: Level, column: int, row: int
) -> bytes:
    """A tile of ``map_format.DescriptorTable``."""
    side, pool = TILE_PX + 2 * PAD_PX, describer.stride
    picture, _ = tiles.mosaic(layer.table, level, column * TILE_PX - PAD_PX, row * TILE_PX - PAD_PX, side, side)
    rim, cells = slice(PAD_PX, PAD_PX + TILE_PX), TILE_PX // pool
    inner = slice(PAD_PX // pool, PAD_PX // pool + cells)
    described = describer.describe(cv2.cvtColor(picture, cv2.COLOR_BGRA2BGR))[:, inner, inner]
    valid = (picture[rim, rim, 3] == 255).reshape(cells, pool, cells, pool).all(axis=(1, 3))
    planes = np.concatenate([np.rint(described * 255.0) * valid, np.where(valid, 255.0, 0.0)[None]]).astype(np.uint8)
    return cv2.imencode(".png", planes.reshape(-1, cells), [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL])[1].tobytes()


def _gsd_m(level: Level, unit_m: float) -> float:
    return float(np.sqrt(level.pixel_x * level.pixel_y)) * unit_m
