"""Elevation as a tiled gridded coverage (OGC 17-066r1), compared with GDAL's reader."""

import sqlite3
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
import rasterio.warp
from rasterio.transform import Affine

import map_rasters
from map_packages import alter
from terrafix.core.errors import MapError
from terrafix.core.geodesy import LocalFrame
from terrafix.map.package import MapPackage
from terrafix_tools.mapping import build as build_module
from terrafix_tools.mapping.build import build
from terrafix_tools.mapping.package.dem import encode_heights
from terrafix_tools.parallel import pool


def mountains() -> np.ndarray:
    """(1, 300, 300) float32 metres, with a cliff of 1500 m and a hole."""
    rng = np.random.default_rng(3)
    smooth = cv2.GaussianBlur(rng.normal(size=(300, 300)).astype(np.float32), (0, 0), 12)
    height_m = 200 + 80 * smooth / smooth.std()
    height_m[:, 180:] += 1500
    height_m[140:150, 140:150] = -32768
    return height_m[None]


def mountain_dem(folder: Path) -> Path:
    corner = Affine(5, 0, 299_500, 0, -5, 2_600_500)
    return map_rasters.write_tif(folder / "d.tif", mountains(), "EPSG:32651", corner, nodata=-32768)


@pytest.fixture
def package(tmp_path: Path) -> Path:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(700, 900))
    return build(tif, tmp_path / "m.gpkg", dem=mountain_dem(tmp_path))


def test_gdal_reads_the_same_heights(package: Path) -> None:
    opened = MapPackage.open(package, verify=True)
    frame = LocalFrame(23.497, 121.043)
    local = opened.bind(frame)
    with rasterio.open(f"GPKG:{package}:elevation") as file:
        assert file.crs.to_epsg() == 32651 and file.dtypes[0] == "float32"
        grid = opened.manifest.dem
        assert grid is not None and (file.width, file.height) == (grid.width_px, grid.height_px)
        assert file.transform.almost_equals(Affine(grid.pixel, 0, grid.x_min, 0, -grid.pixel, grid.y_max))
        height_m, mask = file.read(1), file.dataset_mask() > 0
        rng = np.random.default_rng(1)
        rows, columns = rng.integers(2, file.height - 2, 400), rng.integers(2, file.width - 2, 400)
        hole = file.index(300_225.0, 2_599_775.0)
        rows, columns = np.append(rows, hole[0]), np.append(columns, hole[1])
        x, y = file.xy(rows, columns)
        lon_deg, lat_deg = rasterio.warp.transform("EPSG:32651", "EPSG:4326", x, y)
    e_n = np.array([frame.to_local(la, lo) for la, lo in zip(lat_deg, lon_deg, strict=True)])
    ours = local.elevation(e_n[:, 0], e_n[:, 1])
    assert ours is not None
    known = np.isfinite(ours)
    assert 0.5 < known.mean() < 1.0 and known.sum() > 200
    here, seen = height_m[rows, columns], mask[rows, columns]
    steep = np.abs(here - ours) > 1.0  # a position error of a millimetre on the cliff
    assert seen[known].all() and steep[known].mean() < 0.02
    assert np.abs(here - ours)[known & ~steep].max() < 0.2
    assert np.isnan(ours[~seen]).all()
    opened.close()


def test_the_elevation_tables_follow_the_standard(package: Path) -> None:
    db = sqlite3.connect(package)
    assert db.execute("SELECT data_type FROM gpkg_contents WHERE table_name = 'elevation'").fetchone() == (
        "2d-gridded-coverage",
    )
    row = db.execute(
        "SELECT datatype, scale, offset, data_null, grid_cell_encoding, uom FROM gpkg_2d_gridded_coverage_ancillary"
        " WHERE tile_matrix_set_name = 'elevation'"
    ).fetchone()
    assert row == ("integer", 1.0, 0.0, 65535.0, "grid-value-is-center", "m")
    count, matched = db.execute(
        "SELECT count(*), count(tpudt_id) FROM elevation LEFT JOIN gpkg_2d_gridded_tile_ancillary"
        " ON tpudt_name = 'elevation' AND tpudt_id = elevation.id"
    ).fetchone()
    assert count == matched > 1
    extended = db.execute("SELECT table_name FROM gpkg_extensions WHERE extension_name = 'gpkg_2d_gridded_coverage'")
    names = {"gpkg_2d_gridded_coverage_ancillary", "gpkg_2d_gridded_tile_ancillary", "elevation"}
    assert {name for (name,) in extended} == names
    assert db.execute("SELECT organization_coordsys_id FROM gpkg_spatial_ref_sys WHERE srs_id = 4979").fetchone()
    for (data,) in db.execute("SELECT tile_data FROM elevation"):
        tile = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        assert tile.shape == (256, 256) and tile.dtype == np.uint16
    assert db.execute("PRAGMA foreign_key_check").fetchall() == []
    db.close()


@pytest.mark.parametrize(("low", "span"), [(-430.0, 3.0), (0.0, 655.0), (100.0, 8700.0), (12.345, 0.0)])
def test_heights_are_preserved_by_their_encoding(low: float, span: float) -> None:
    height_m = (low + span * np.random.default_rng(1).random((256, 256))).astype(np.float32)
    known = np.ones((256, 256), bool)
    known[:3] = False
    data, scale, offset = encode_heights(np.where(known, height_m, np.nan).astype(np.float32), known)
    coded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert (coded[:3] == 65535).all() and (coded[3:] < 65535).all()
    back = coded.astype(np.float64) * scale + offset
    assert np.abs(back - height_m)[known].max() <= max(0.0051, span / 65534)


@pytest.mark.slow
def test_several_processes_write_the_same_heights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build_module, "TILES_PER_WORKER", 4)
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(700, 900))
    dem = mountain_dem(tmp_path)
    started: list[int] = []
    executor = pool.ProcessPoolExecutor
    monkeypatch.setattr(pool, "ProcessPoolExecutor", lambda n, *more: (started.append(n), executor(n, *more))[1])
    (tmp_path / "b").mkdir()
    one, two = build(tif, tmp_path / "m.gpkg", dem=dem), build(tif, tmp_path / "b" / "m.gpkg", dem=dem, workers=2)
    assert started == [2] and one.read_bytes() == two.read_bytes()


def test_an_altered_tile_scale_is_detected(package: Path) -> None:
    alter(package, "UPDATE gpkg_2d_gridded_tile_ancillary SET offset = offset + 100 WHERE tpudt_id = 1")
    with pytest.raises(MapError, match="tile of elevation, zoom 0 column 0 row 0 was altered"):
        MapPackage.open(package, verify=True)


def test_a_truncated_dem_is_a_one_line_error(tmp_path: Path) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(300, 300))
    dem = mountain_dem(tmp_path)
    dem.write_bytes(dem.read_bytes()[:150_000])
    with pytest.raises(MapError, match=r"d\.tif: elevation cannot be read"):
        build(tif, tmp_path / "m.gpkg", dem=dem)
    dem.write_bytes(b"")
    with pytest.raises(MapError, match="not an image"):
        build(tif, tmp_path / "m.gpkg", dem=dem)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["d.tif", "i.tif"]


def test_imagery_and_elevation_files_are_not_confused(tmp_path: Path) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(300, 300))
    dem = map_rasters.utm(tmp_path / "d.tif", mountains())
    with pytest.raises(MapError, match=r"i\.tif: has 3 bands, elevation has one"):
        build(tif, tmp_path / "m.gpkg", dem=tif)
    for heights in (dem, map_rasters.utm(tmp_path / "e.tif", mountains().astype(np.int16))):
        with pytest.raises(MapError, match=r"one band of (float32|int16) is elevation"):
            build(heights, tmp_path / "m.gpkg")
    assert not (tmp_path / "m.gpkg").exists()
