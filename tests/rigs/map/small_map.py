"""A small map package: imagery of 120 by 100 pixels at 0.5 m, planar elevation."""

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rasterio.transform import Affine

import map_rasters
from terrafix_tools.mapping.build import build

DEM_CORNER = Affine(50.0, 0, 299_450.0, 0, -50.0, 2_600_550.0)
DEM_SIDE = 25
NAME = "small.gpkg"


def write(folder: Path) -> Path:
    path = folder / NAME
    path.write_bytes(_content())
    return path


@cache
def _content() -> bytes:
    row, column = np.indices((DEM_SIDE, DEM_SIDE), np.float32)
    with TemporaryDirectory() as made:
        folder = Path(made)
        image = map_rasters.utm(folder / "i.tif", map_rasters.texture(100, 120))
        height_m = (100.0 + 2.5 * column - row)[None]
        dem = map_rasters.write_tif(folder / "d.tif", height_m, "EPSG:32651", DEM_CORNER)
        return build(image, folder / NAME, dem=dem, date="2020-07-10", licence="CC0", ce90_m=4.0).read_bytes()
