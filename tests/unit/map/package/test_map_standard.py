"""Packages follow the GeoPackage standard with any contents; and the standard check detects every violation."""

import logging
import shutil
import sqlite3
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import rasterio
from rasterio.transform import Affine

import map_rasters
from map_features import features
from map_standard import violations
from terrafix.core.signature import generate
from terrafix_tools.mapping.build import build_package, layer_of
from terrafix_tools.mapping.layers import ElevationInput, VectorInput
from terrafix_tools.mapping.package.dem import DemSource
from terrafix_tools.mapping.package.sign import sign_package

LOCAL = (
    'PROJCS["here",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],'
)
LOCAL += 'UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],PARAMETER["latitude_of_origin",23.5],'
LOCAL += 'PARAMETER["central_meridian",121],PARAMETER["scale_factor",1],PARAMETER["false_easting",300000],'
LOCAL += 'PARAMETER["false_northing",2600000],UNIT["metre",1]]'


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All contents: layers in three CRS (one without a code), holes, elevation, features, a signature."""
    folder = tmp_path_factory.mktemp("standard")
    holes = map_rasters.texture(700, 900)
    holes[:, 200:400, 100:700] = 0
    dem = 100 + np.arange(200 * 200, dtype=np.float32).reshape(1, 200, 200) / 50
    dem[0, 50:60, 50:60] = -9999
    corner = Affine(5, 0, 299_700, 0, -5, 2_600_300)
    dem_tif = map_rasters.write_tif(folder / "d.tif", dem, "EPSG:32651", corner, nodata=-9999)
    degrees = Affine(5e-6, 0, 121.04, 0, -5e-6, 23.5)
    layers = [
        layer_of(map_rasters.utm(folder / "a.tif", holes, nodata=0), date="2024-05-06", licence="CC0", ce90_m=3.0),
        layer_of(map_rasters.write_tif(folder / "b.tif", map_rasters.texture(300, 300, 2), "EPSG:4326", degrees)),
        layer_of(map_rasters.utm(folder / "c.tif", map_rasters.texture(64, 64, 3), crs=LOCAL), date="2014-01-01"),
    ]
    out = build_package(
        layers,
        folder / "m.gpkg",
        elevation=ElevationInput(partial(DemSource, dem_tif), source="d.tif", licence="CC0"),
        vectors=VectorInput(features(), source="area.osm.pbf", date="2024-01-02", licence="ODbL 1.0"),
    )
    generate(folder / "my.key", folder / "my.pub", "me")
    sign_package(out, folder / "my.key")
    return out


@pytest.mark.slow
def test_a_package_with_all_contents_follows_the_geopackage_standard(package: Path) -> None:
    assert violations(package) == []


def test_gdal_opens_a_package_without_warnings(package: Path, caplog: pytest.LogCaptureFixture) -> None:
    """GDAL's driver warns about versions, extensions, matrices and CRS."""
    caplog.set_level(logging.DEBUG)
    for table, bands in (("imagery", 4), ("imagery_2", 4), ("imagery_3", 4), ("elevation", 1)):
        with rasterio.open(f"GPKG:{package}:{table}") as file:
            assert file.count == bands and file.crs is not None
            assert file.checksum(1) > 0
    for table, count in (("roads", 2), ("water", 1), ("buildings", 1)):
        assert pyogrio.read_info(package, layer=table)["features"] == count
    assert [record.message for record in caplog.records if record.levelno >= logging.WARNING] == []


DAMAGE = {
    "2": "PRAGMA application_id = 1",
    "7": "INSERT INTO gpkg_tile_matrix_set VALUES ('nothing', 4326, 0, 0, 1, 1)",
    "11": "DELETE FROM gpkg_spatial_ref_sys WHERE srs_id = -1",
    "14, 41": "UPDATE gpkg_contents SET srs_id = 12345 WHERE table_name = 'imagery'",
    "14": "INSERT INTO gpkg_contents (table_name, data_type) VALUES ('ghost', 'attributes')",
    "15": "UPDATE gpkg_contents SET last_change = 'yesterday' WHERE table_name = 'imagery'",
    "116": "UPDATE gpkg_spatial_ref_sys SET definition_12_063 = 'UTM' WHERE srs_id = 32651",
    "35": "UPDATE gpkg_tile_matrix SET pixel_x_size = 7, matrix_width = matrix_width WHERE zoom_level = 1",
    "45": "UPDATE gpkg_tile_matrix SET matrix_width = matrix_width + 1 WHERE zoom_level = 1",
    "44": "DELETE FROM gpkg_tile_matrix WHERE table_name = 'imagery' AND zoom_level = 0",
    "36": "UPDATE imagery SET tile_data = x'00' WHERE id = 1",
    "49": "UPDATE gpkg_tile_matrix SET tile_width = 128, matrix_width = matrix_width * 2 WHERE table_name = 'imagery'",
    "58": "CREATE TABLE stray (id INTEGER PRIMARY KEY)",
    "60": "INSERT INTO gpkg_extensions VALUES ('ghost', NULL, 'my_extension', 'x', 'read-write')",
    "64": "UPDATE gpkg_extensions SET scope = 'sometimes' WHERE extension_name = 'terrafix_map'",
    "extension gpkg_rtree_index": "DELETE FROM gpkg_extensions WHERE extension_name = 'gpkg_rtree_index'",
    "extension gpkg_crs_wkt": "DELETE FROM gpkg_extensions WHERE extension_name = 'gpkg_crs_wkt'",
    "extension gpkg_2d_gridded_coverage": "DELETE FROM gpkg_extensions WHERE table_name = 'elevation'",
    "gridded coverage 10": "DELETE FROM gpkg_2d_gridded_tile_ancillary WHERE id = 1",
    "gridded coverage 3": "DELETE FROM gpkg_spatial_ref_sys WHERE srs_id = 4979",
    "19": "UPDATE roads SET geom = x'0001' WHERE fid = 1",
    "22": "DELETE FROM gpkg_geometry_columns WHERE table_name = 'roads'",
    "75": "DROP TRIGGER rtree_roads_geom_update1",
    "77": "DELETE FROM rtree_roads_geom WHERE id = 1",
    "96": "UPDATE gpkg_metadata_reference SET reference_scope = 'planet' WHERE md_file_id = 1",
}


@pytest.fixture
def copy(package: Path, tmp_path: Path) -> Iterator[tuple[Path, sqlite3.Connection]]:
    """A copy without the feature triggers, which call functions that only GDAL provides."""
    path = Path(shutil.copy(package, tmp_path / "copy.gpkg"))
    db = sqlite3.connect(path)
    for name, count in (("ST_IsEmpty", 1), ("ST_MinX", 1), ("ST_MaxX", 1), ("ST_MinY", 1), ("ST_MaxY", 1)):
        db.create_function(name, count, lambda _: 0)
    yield path, db
    db.close()


@pytest.mark.parametrize("requirement", DAMAGE)
def test_every_check_of_the_standard_can_fail(copy: tuple[Path, sqlite3.Connection], requirement: str) -> None:
    path, db = copy
    db.execute(DAMAGE[requirement])
    db.commit()
    assert any(found.startswith(requirement) for found in violations(path)), violations(path)
