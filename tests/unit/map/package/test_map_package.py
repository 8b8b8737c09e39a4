"""Opening of map packages: intact, damaged, altered, of other programs, or of a future format."""

import sqlite3
import struct
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from rasterio.transform import Affine

import map_rasters
from map_packages import alter, bound
from terrafix.core.errors import MapError
from terrafix.map.checksum import DIGEST_MARKER, EMPTY_DIGEST, VOLATILE_HEADER_BYTES
from terrafix.map.package import MapPackage
from terrafix_tools.mapping.build import build, build_package, layer_of
from terrafix_tools.mapping.layers import ElevationInput, VectorInput
from terrafix_tools.mapping.package.dem import DemSource


@pytest.fixture
def package(tmp_path: Path) -> Path:
    return build(map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(600, 600)), tmp_path / "m.gpkg")


def test_missing_foreign_and_truncated_files_are_rejected(tmp_path: Path, package: Path) -> None:
    with pytest.raises(MapError, match="no such map package"):
        MapPackage.open(tmp_path / "none.gpkg")
    with pytest.raises(MapError, match="not a map package"):
        MapPackage.open(tmp_path / "i.tif")
    (tmp_path / "empty.gpkg").write_bytes(b"")
    with pytest.raises(MapError, match="not a map package"):
        MapPackage.open(tmp_path / "empty.gpkg")
    alter(tmp_path / "other.gpkg", "CREATE TABLE other (id INTEGER)")
    with pytest.raises(MapError, match="not a Terrafix map package"):
        MapPackage.open(tmp_path / "other.gpkg")
    whole = package.read_bytes()
    package.write_bytes(whole[: len(whole) - 10_000])
    with pytest.raises(MapError, match="truncated"):
        MapPackage.open(package)
    package.write_bytes(whole[:200] + bytes(20_000) + whole[20_200:])
    with pytest.raises(MapError, match=r"damaged|not a Terrafix"):
        MapPackage.open(package)


@pytest.mark.parametrize(("version", "remedy"), [("99", "update Terrafix"), ("1", "build it again")])
def test_a_future_format_asks_for_an_update_and_an_earlier_one_for_a_build(
    package: Path, version: str, remedy: str
) -> None:
    alter(package, f"UPDATE terrafix_manifest SET value = '{version}' WHERE key = 'format_version'")
    with pytest.raises(MapError, match=f"format {version}.*{remedy}"):
        MapPackage.open(package)


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE terrafix_manifest SET value = 'mine' WHERE key = 'licence'",
        "UPDATE terrafix_manifest SET value = '0.1' WHERE key = 'gsd_m'",
        "DELETE FROM terrafix_hash WHERE zoom_level = 0",
        "UPDATE terrafix_hash SET sha256 = zeroblob(32) WHERE zoom_level = 0",
    ],
)
def test_an_altered_manifest_or_tile_list_is_detected_at_opening(package: Path, statement: str) -> None:
    alter(package, statement)
    with pytest.raises(MapError, match="checksum mismatch"):
        MapPackage.open(package)


def test_an_altered_tile_is_missing_in_flight_and_an_error_when_verified(package: Path) -> None:
    swap = (
        "UPDATE imagery SET tile_data = (SELECT tile_data FROM imagery WHERE zoom_level = 0)"
        " WHERE zoom_level = 2 AND tile_column = 1 AND tile_row = 1"
    )
    alter(package, swap)
    opened = MapPackage.open(package)
    image, valid = bound(opened).window(-100.0, 100.0, 400, 400, 0.5)
    assert 0.2 < valid.mean() < 0.8 and not image[~valid].any()
    assert opened.tiles.damaged == {("imagery", 2, 1, 1)}
    with pytest.raises(MapError, match="zoom 2 column 1 row 1"):
        opened.verify()
    opened.close()
    with pytest.raises(MapError, match="altered or lost"):
        MapPackage.open(package, verify=True)


def test_a_lost_tile_is_detected(package: Path) -> None:
    alter(package, "DELETE FROM imagery WHERE zoom_level = 2 AND tile_column = 0 AND tile_row = 0")
    with pytest.raises(MapError, match="zoom 2 column 0 row 0"):
        MapPackage.open(package, verify=True)


def test_a_path_with_special_characters_opens(tmp_path: Path) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(64, 64))
    folder = tmp_path / "a b?c#d%41é"
    MapPackage.open(build(tif, folder / "m.gpkg"), verify=True).close()
    assert [p.name for p in folder.iterdir()] == ["m.gpkg"]


def everything(path: Path, *, verify: bool = True) -> tuple[object, ...]:
    """All data that a flight can read from a package."""
    opened = MapPackage.open(path, verify=verify)
    try:
        (west, south, east, north), local = opened.manifest.bounds_wgs84, bound(opened)
        image, valid = local.window(-160.0, 160.0, 320, 320, 1.0)
        far, _ = local.window(-160.0, 160.0, 80, 80, 4.0)
        up = local.elevation(np.linspace(-100, 100, 50), np.zeros(50))
        roads = opened.features("roads", west - 1, south - 1, east + 1, north + 1)
        features = [(f.kind, f.name, f.attributes, [p.tobytes() for p in f.parts]) for f in roads]
        heights = None if up is None else up.tobytes()
        assert not opened.tiles.damaged
        return opened.manifest, image.tobytes(), valid.tobytes(), far.tobytes(), heights, features
    finally:
        opened.close()


@pytest.mark.slow
def test_a_flipped_bit_anywhere_is_detected(tmp_path: Path) -> None:
    """In tiles, manifest, hashes, tables of the standard, indices, schema and free space. The header bytes that SQLite
    rewrites may be altered without an effect."""
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(400, 400))
    plane = np.linspace(100, 160, 40 * 40, dtype=np.float32).reshape(1, 40, 40)
    corner = Affine(50, 0, 299_000, 0, -50, 2_601_000)
    dem = map_rasters.write_tif(tmp_path / "d.tif", plane, "EPSG:32651", corner)
    road = struct.pack("<BII4d", 1, 2, 2, 121.04, 23.49, 121.05, 23.5)
    path = build_package(
        [layer_of(tif)],
        tmp_path / "m.gpkg",
        elevation=ElevationInput(partial(DemSource, dem), source="d.tif"),
        vectors=VectorInput([("roads", road, {"kind": "track"})], source="s"),
    )
    whole = path.read_bytes()
    expected = everything(path)
    rng = np.random.default_rng(7)
    header = [at for start, end in VOLATILE_HEADER_BYTES for at in range(start, end)]
    for at in (
        *rng.integers(0, len(whole), 200),
        whole.index(DIGEST_MARKER) + 3,
        whole.index(DIGEST_MARKER) + 20,
        *header,
    ):
        bit = 1 << int(rng.integers(8))
        path.write_bytes(whole[:at] + bytes([whole[at] ^ bit]) + whole[at + 1 :])
        try:
            same = everything(path) == expected
            assert same and at in header, f"nobody notices bit {bit} of byte {at}"
        except MapError as error:
            assert str(path) in str(error) and "\n" not in str(error)


def test_swapped_tiles_are_detected(package: Path) -> None:
    """Two valid tiles at swapped positions."""
    alter(package, "UPDATE imagery SET tile_column = 9 WHERE zoom_level = 2 AND tile_column = 0 AND tile_row = 0")
    alter(package, "UPDATE imagery SET tile_column = 0 WHERE zoom_level = 2 AND tile_column = 1 AND tile_row = 0")
    alter(package, "UPDATE imagery SET tile_column = 1 WHERE zoom_level = 2 AND tile_column = 9 AND tile_row = 0")
    with pytest.raises(MapError, match="zoom 2 column 0 row 0 was altered"):
        MapPackage.open(package, verify=True)


def test_the_georeference_is_read_from_the_manifest_and_not_the_geopackage_tables(package: Path) -> None:
    """The GeoPackage tables are not covered by the checksum; the reader takes the georeference from the manifest.

    The file digest covers them."""
    before = everything(package)
    alter(package, "UPDATE gpkg_tile_matrix_set SET min_x = min_x + 1000, max_y = max_y + 1000")
    alter(package, "UPDATE gpkg_tile_matrix SET pixel_x_size = 2 * pixel_x_size")
    assert everything(package, verify=False) == before
    with pytest.raises(MapError, match="altered since it was built"):
        everything(package)


def test_opening_the_file_for_writing_does_not_invalidate_the_file_digest(package: Path) -> None:
    """QGIS switches to a write-ahead log and back, which changes only the header."""
    before = package.read_bytes()
    db = sqlite3.connect(package)
    for mode in ("WAL", "DELETE"):
        db.execute(f"PRAGMA journal_mode = {mode}")
        assert db.execute("SELECT count(*) FROM imagery").fetchone()[0] > 0
    db.close()
    assert package.read_bytes() != before
    MapPackage.open(package, verify=True).close()


def test_a_blank_file_digest_is_accepted_and_a_missing_one_is_not(package: Path) -> None:
    whole = package.read_bytes()
    at = whole.index(DIGEST_MARKER)
    package.write_bytes(whole[:at] + EMPTY_DIGEST + whole[at + len(EMPTY_DIGEST) :])
    MapPackage.open(package, verify=True).close()
    package.write_bytes(whole[:at] + bytes(len(EMPTY_DIGEST)) + whole[at + len(EMPTY_DIGEST) :])
    with pytest.raises(MapError, match="altered since it was built"):
        MapPackage.open(package, verify=True)


def test_a_package_is_closed_with_the_last_of_its_views_whatever_thread_opened_it(package: Path) -> None:
    with ThreadPoolExecutor(1) as other:
        opened = other.submit(MapPackage.open, package).result()
    database, elevation = opened._db, bound(opened).elevation
    del opened
    assert elevation(np.zeros(1), np.zeros(1)) is None, "a map without elevation, which is open"
    database.execute("SELECT 1")
    del elevation
    with pytest.raises(sqlite3.ProgrammingError, match="closed"):
        database.execute("SELECT 1")
