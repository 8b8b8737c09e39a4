"""Conversion of elevation raster heights to AMSL as autopilots define it."""

from pathlib import Path

import numpy as np
import pytest
import rasterio

import map_rasters
from map_geoids import undulation_m, write_geoid
from terrafix.core.errors import MapError, UsageError
from terrafix_tools.mapping.choices import Datum
from terrafix_tools.mapping.package import heights
from terrafix_tools.mapping.package.heights import to_amsl

HEIGHT_M = np.linspace(300.0, 900.0, 200 * 300, dtype=np.float32).reshape(1, 200, 300)


def write_dem(path: Path) -> Path:
    """UTM zone 51, near 121 east, 23.5 north; a void in one corner."""
    height_m = HEIGHT_M.copy()
    height_m[0, :20, :30] = -9999.0
    return map_rasters.utm(path, height_m, pixel_m=30.0, nodata=-9999.0)


def test_ellipsoidal_heights_are_reduced_by_the_undulation(tmp_path: Path) -> None:
    dem, geoid = write_dem(tmp_path / "dem.tif"), write_geoid(tmp_path / "geoid.gtx")
    used, note = to_amsl(dem, Datum.ELLIPSOID, tmp_path / "out.tif", geoid)
    assert used == tmp_path / "out.tif" and "ellipsoid to EGM96" in note
    with rasterio.open(used) as file:
        made = file.read(1)
        assert file.transform == rasterio.open(dem).transform and file.crs.to_epsg() == 32651
    for column, row in ((40, 5), (299, 199), (150, 100), (0, 199)):
        expected = HEIGHT_M[0, row, column] - undulation_m(column, row)
        assert made[row, column] == pytest.approx(expected, abs=0.002)
    assert np.isnan(made[:20, :30]).all() and np.isfinite(made[20:]).all()


def test_egm2008_heights_are_converted_when_both_grids_exist(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other = write_geoid(tmp_path / "egm08.gtx", constant_m=0.7)
    monkeypatch.setitem(heights.GRIDS, Datum.EGM2008, str(other))
    used, _ = to_amsl(write_dem(tmp_path / "d.tif"), Datum.EGM2008, tmp_path / "o.tif", write_geoid(tmp_path / "g.gtx"))
    with rasterio.open(used) as file:
        assert np.nanmax(np.abs(file.read(1)[50:] - HEIGHT_M[0, 50:] - 0.7)) < 0.002


def test_ellipsoidal_heights_take_the_other_geoid_where_only_it_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(heights.GRIDS, Datum.EGM96, "no_such_grid.tif")
    monkeypatch.setitem(heights.GRIDS, Datum.EGM2008, str(write_geoid(tmp_path / "egm08.gtx")))
    used, note = to_amsl(write_dem(tmp_path / "dem.tif"), Datum.ELLIPSOID, tmp_path / "out.tif")
    with rasterio.open(used) as file:
        assert file.read(1)[100, 150] == pytest.approx(HEIGHT_M[0, 100, 150] - undulation_m(150, 100), abs=0.002)
    assert "converted from ellipsoid to EGM2008, used as AMSL: PROJ lacks the grid no_such_grid.tif" in note


def test_missing_geoid_grids_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(heights.GRIDS, Datum.EGM96, "no_such_grid.tif")
    monkeypatch.setitem(heights.GRIDS, Datum.EGM2008, "no_such_grid.tif")
    dem = write_dem(tmp_path / "dem.tif")
    assert to_amsl(dem, Datum.EGM96, tmp_path / "o.tif") == (dem, "heights above EGM96, as given")
    used, note = to_amsl(dem, Datum.EGM2008, tmp_path / "o.tif")
    assert used == dem and "lacks the grid no_such_grid.tif, no_such_grid.tif (pyproj sync --file no_such_grid" in note
    with pytest.raises(UsageError, match=r"count from the ellipsoid .*pyproj sync"):
        to_amsl(dem, Datum.ELLIPSOID, tmp_path / "o.tif")
    (tmp_path / "bad.gtx").write_bytes(b"nothing")
    with pytest.raises(UsageError, match="not a grid of a geoid"):
        to_amsl(dem, Datum.ELLIPSOID, tmp_path / "o.tif", tmp_path / "bad.gtx")
    far = write_geoid(tmp_path / "far.gtx", west=-60.0)
    with pytest.raises(MapError, match="grid of the geoid ends"):
        to_amsl(dem, Datum.ELLIPSOID, tmp_path / "o.tif", far)
