"""The orthomosaic as a cloud-optimised GeoTIFF that states its date, its accuracy and its origin."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from rasterio.errors import RasterioError
from rasterio.shutil import copy
from rasterio.transform import Affine

from terrafix.core.errors import OutputError
from terrafix_tools.mapping.orthomosaic.composite import Composite

# Keys of the metadata. In the default domain: GDAL's COG driver does not copy others.
DATE, CE90_M, FLOWN_BY, FLIGHT = "TERRAFIX_DATE", "TERRAFIX_CE90_M", "TERRAFIX_FLOWN_BY", "TERRAFIX_FLIGHT"
ALPHA = 255


@dataclass(frozen=True)
class Statement:
    """What a layer says of itself. ``ce90_m``: radius that contains 90 % of the position errors; ``date``: YYYY-MM-DD,
    empty: unknown."""

    date: str
    ce90_m: float
    flown_by: str
    flight: str

    def tags(self) -> dict[str, str]:
        return {DATE: self.date, CE90_M: f"{self.ce90_m:.2f}", FLOWN_BY: self.flown_by, FLIGHT: self.flight}


def write_cog(out: Path, made: Composite, statement: Statement) -> None:
    """Red, green, blue and alpha. Raises OutputError."""
    grid = made.grid
    profile = {
        "driver": "GTiff",
        "width": grid.width_px,
        "height": grid.height_px,
        "count": 4,
        "dtype": "uint8",
        "crs": grid.crs.to_wkt(),
        "transform": Affine(grid.gsd_m, 0.0, grid.x_min, 0.0, -grid.gsd_m, grid.y_max),
        "tiled": True,
        "photometric": "RGB",
        "alpha": "YES",  # stated here: GDAL may have written the head of a large file before a later call
    }
    try:
        with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as scratch:
            plain, finished = Path(scratch) / "plain.tif", Path(scratch) / "cog.tif"
            with rasterio.open(plain, "w", **profile) as file:
                for band, channel in enumerate((2, 1, 0), start=1):
                    file.write(made.image[..., channel], band)
                file.write(np.where(made.valid, ALPHA, 0).astype(np.uint8), 4)
                file.update_tags(**statement.tags())
            copy(plain, finished, driver="COG", compress="DEFLATE", predictor="YES", overview_resampling="average")
            finished.replace(out)
    except (OSError, RasterioError) as error:
        raise OutputError(f"{out}: cannot be written ({error}); choose another file") from None


def read_statement(path: Path) -> Statement | None:
    """What a layer that ``write_cog`` has written says of itself; None: another file, or none that can be read."""
    try:
        with rasterio.open(path) as file:
            tags = file.tags()
        return Statement(tags.get(DATE, ""), float(tags[CE90_M]), tags.get(FLOWN_BY, ""), tags.get(FLIGHT, ""))
    except (OSError, RasterioError, KeyError, ValueError):
        return None
