"""Tiles of a server that are not needed, because better sources cover them completely."""

import numpy as np
from rasterio.transform import Affine

from terrafix_tools.mapping.area.polygons import Area, Placed
from terrafix_tools.mapping.mosaic.compositing import Mosaic, MosaicPlan, Opener
from terrafix_tools.mapping.mosaic.grid import Grid
from terrafix_tools.mapping.sources.tiles.grid import HALF_M, MERCATOR, TileRange, tile_span_m

TILE_CELLS = 16  # cells per side of a tile; a cell counts as covered when all of it is valid
BLOCK_TILES = 32  # tiles per side of a block that is examined at a time


def uncovered(area: Area, better: tuple[Opener, ...], tiles: TileRange) -> TileRange:
    """The tiles of a range in which the better sources leave a gap in the area.

    Reads those sources once, in blocks. Raises MapError as they do."""
    if not better or not tiles.count:
        return tiles
    rows, columns = tiles.touched.shape
    cell_m = tile_span_m(tiles.zoom) / TILE_CELLS
    grid = Grid(
        crs="EPSG:3857",
        x_min=tiles.column * cell_m * TILE_CELLS - HALF_M,
        y_max=HALF_M - tiles.row * cell_m * TILE_CELLS,
        pixel_x=cell_m,
        pixel_y=cell_m,
        width_px=columns * TILE_CELLS,
        height_px=rows * TILE_CELLS,
    )
    placed = Placed(area, MERCATOR)
    needed = tiles.touched.copy()
    with Mosaic(MosaicPlan(area, grid, better)) as mosaic:
        for row in range(0, rows, BLOCK_TILES):
            for column in range(0, columns, BLOCK_TILES):
                block = needed[row : row + BLOCK_TILES, column : column + BLOCK_TILES]
                if not block.any():
                    continue
                c, r, height, width = column * TILE_CELLS, row * TILE_CELLS, *(TILE_CELLS * n for n in block.shape)
                corner = Affine(cell_m, 0, grid.x_min + c * cell_m, 0, -cell_m, grid.y_max - r * cell_m)
                wanted = placed.burn(corner, width, height)
                _, mask = mosaic.read(c, r, width, height)
                # A sliver of the area without a cell centre is not detected here: such a tile is fetched.
                block &= _any_of(wanted & (mask == 0)) | ~_any_of(wanted)
    return TileRange(tiles.zoom, tiles.column, tiles.row, needed)


def _any_of(cells: np.ndarray) -> np.ndarray:
    """(rows x TILE_CELLS, columns x TILE_CELLS) -> (rows, columns)."""
    rows, columns = cells.shape[0] // TILE_CELLS, cells.shape[1] // TILE_CELLS
    return np.asarray(cells.reshape(rows, TILE_CELLS, columns, TILE_CELLS).any(axis=(1, 3)))
