"""The benchmark of the map build: both sides do the same work on the same raster."""

from pathlib import Path

import pytest
import rasterio
from rasterio.transform import Affine

import map_rasters
from terrafix_tools.bench.map_build import cog_options, measure, write_cog
from terrafix_tools.mapping.source import ImagerySource


def test_the_ratio_is_that_of_the_measured_times(tmp_path: Path) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(300, 300))
    found = measure(tif, tmp_path, repeats=1)
    assert found["megapixels"] == pytest.approx(0.1)
    assert found["ratio_75"]["cpu"] == pytest.approx(found["build"]["cpu_s"] / found["cog_75"]["cpu_s"], rel=0.02)
    assert found["cog_75"]["mb"] < found["cog_95"]["mb"] < found["build"]["mb"]


def test_an_image_in_degrees_is_projected_to_the_same_grid_by_both(tmp_path: Path) -> None:
    degrees = Affine(5e-6, 0, 121.0, 0, -5e-6, 23.5)
    tif = map_rasters.write_tif(tmp_path / "i.tif", map_rasters.texture(300, 300), "EPSG:4326", degrees)
    write_cog(tif, tmp_path / "cog.tif", cog_options(tif, 75, 1))
    with ImagerySource(tif) as source, rasterio.open(tmp_path / "cog.tif") as cog:
        assert (cog.width, cog.height, cog.crs.to_epsg()) == (source.width_px, source.height_px, 32651)
        assert cog.transform.almost_equals(source.transform, 1e-6)
