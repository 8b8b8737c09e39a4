"""Opening map packages that are whole, damaged, altered, foreign or from the future."""

import sqlite3
import struct
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from rasterio.transform import Affine

import map_rasters
from terrafix.core.errors import MapError
from terrafix.core.geodesy import LocalFrame
from terrafix.map.checksum import BLANK, MARKER, VOLATILE
from terrafix.map.package import MapPackage
from terrafix_tools.mapping.build import build, build_package, layer_of
from terrafix_tools.mapping.dem import DemSource
from terrafix_tools.mapping.layers import ElevationInput, VectorInput


@pytest.fixture
def package(tmp_path: Path) -> Path:
    return build(map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(600, 600)), tmp_path / "m.gpkg")


def change(path: Path, statement: str) -> None:
    db = sqlite3.connect(path)
    db.execute(statement)
    db.commit()
    db.close()


def test_missing_foreign_and_truncated_files(tmp_path: Path, package: Path) -> None:
    with pytest.raises(MapError, match="no such map package"):
        MapPackage.open(tmp_path / "none.gpkg")
    with pytest.raises(MapError, match="not a map package"):
        MapPackage.open(tmp_path / "i.tif")
    (tmp_path / "empty.gpkg").write_bytes(b"")
    with pytest.raises(MapError, match="not a map package"):
        MapPackage.open(tmp_path / "empty.gpkg")
    change(tmp_path / "other.gpkg", "CREATE TABLE other (id INTEGER)")
    with pytest.raises(MapError, match="not a Terrafix map package"):
        MapPackage.open(tmp_path / "other.gpkg")
    whole = package.read_bytes()
    package.write_bytes(whole[: len(whole) - 10_000])
    with pytest.raises(MapError, match="truncated"):
        MapPackage.open(package)
    package.write_bytes(whole[:200] + bytes(20_000) + whole[20_200:])
    with pytest.raises(MapError, match=r"damaged|not a Terrafix"):
        MapPackage.open(package)


def test_a_future_format_says_update(package: Path) -> None:
    change(package, "UPDATE terrafix_manifest SET value = '99' WHERE key = 'format_version'")
    with pytest.raises(MapError, match=r"format 99.*update Terrafix"):
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
def test_an_altered_manifest_or_list_of_tiles_is_noticed_at_opening(package: Path, statement: str) -> None:
    change(package, statement)
    with pytest.raises(MapError, match="checksum mismatch"):
        MapPackage.open(package)


def test_an_altered_tile_is_void_in_flight_and_an_error_when_verified(package: Path) -> None:
    swap = (
        "UPDATE imagery SET tile_data = (SELECT tile_data FROM imagery WHERE zoom_level = 0)"
        " WHERE zoom_level = 2 AND tile_column = 1 AND tile_row = 1"
    )
    change(package, swap)
    opened = MapPackage.open(package)
    west, south, east, north = opened.manifest.bounds_wgs84
    local = opened.bind(LocalFrame((south + north) / 2, (west + east) / 2))
    image, valid = local.window(-100.0, 100.0, 400, 400, 0.5)
    assert 0.2 < valid.mean() < 0.8 and not image[~valid].any()
    assert opened.damaged_tiles == {("imagery", 2, 1, 1)}
    with pytest.raises(MapError, match="zoom 2 column 1 row 1"):
        opened.verify()
    opened.close()
    with pytest.raises(MapError, match="altered or lost"):
        MapPackage.open(package, verify=True)


def test_a_lost_tile_is_noticed(package: Path) -> None:
    change(package, "DELETE FROM imagery WHERE zoom_level = 2 AND tile_column = 0 AND tile_row = 0")
    with pytest.raises(MapError, match="zoom 2 column 0 row 0"):
        MapPackage.open(package, verify=True)


def test_a_path_with_odd_characters_opens(tmp_path: Path) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(64, 64))
    folder = tmp_path / "a b?c#d%41é"
    MapPackage.open(build(tif, folder / "m.gpkg"), verify=True).close()
    assert [p.name for p in folder.iterdir()] == ["m.gpkg"]


def everything(path: Path, *, verify: bool = True) -> tuple[object, ...]:
    """All that a flight can learn from a package."""
    opened = MapPackage.open(path, verify=verify)
    try:
        west, south, east, north = opened.manifest.bounds_wgs84
        local = opened.bind(LocalFrame((south + north) / 2, (west + east) / 2))
        image, valid = local.window(-160.0, 160.0, 320, 320, 1.0)
        far, _ = local.window(-160.0, 160.0, 80, 80, 4.0)
        up = local.elevation(np.linspace(-100, 100, 50), np.zeros(50))
        roads = opened.features("roads", west - 1, south - 1, east + 1, north + 1)
        said = [(f.kind, f.name, f.attributes, [p.tobytes() for p in f.parts]) for f in roads]
        heights = None if up is None else up.tobytes()
        assert not opened.damaged_tiles
        return opened.manifest, image.tobytes(), valid.tobytes(), far.tobytes(), heights, said
    finally:
        opened.close()


@pytest.mark.slow
def test_one_flipped_bit_anywhere_is_refused(tmp_path: Path) -> None:
    """All over the file: tiles, manifest, hashes, tables of the standard, indices, schema, free space. What SQLite may
    change by looking is refused or changes nothing."""
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
    header = [at for start, end in VOLATILE for at in range(start, end)]
    for at in (*rng.integers(0, len(whole), 200), whole.index(MARKER) + 3, whole.index(MARKER) + 20, *header):
        bit = 1 << int(rng.integers(8))
        path.write_bytes(whole[:at] + bytes([whole[at] ^ bit]) + whole[at + 1 :])
        try:
            same = everything(path) == expected
            assert same and at in header, f"nobody notices bit {bit} of byte {at}"
        except MapError as error:
            assert str(path) in str(error) and "\n" not in str(error)


def test_swapped_tiles_are_refused(package: Path) -> None:
    """Two good tiles in each other's places."""
    change(package, "UPDATE imagery SET tile_column = 9 WHERE zoom_level = 2 AND tile_column = 0 AND tile_row = 0")
    change(package, "UPDATE imagery SET tile_column = 0 WHERE zoom_level = 2 AND tile_column = 1 AND tile_row = 0")
    change(package, "UPDATE imagery SET tile_column = 1 WHERE zoom_level = 2 AND tile_column = 9 AND tile_row = 0")
    with pytest.raises(MapError, match="zoom 2 column 0 row 0 was altered"):
        MapPackage.open(package, verify=True)


def test_the_placement_that_other_programs_read_does_not_move_ours(package: Path) -> None:
    """The tables of the standard are outside the checksum: what flies takes its placement from the manifest.

    But they are under the seal."""
    before = everything(package)
    change(package, "UPDATE gpkg_tile_matrix_set SET min_x = min_x + 1000, max_y = max_y + 1000")
    change(package, "UPDATE gpkg_tile_matrix SET pixel_x_size = 2 * pixel_x_size")
    assert everything(package, verify=False) == before
    with pytest.raises(MapError, match="altered since it was built"):
        everything(package)


def test_a_look_with_a_program_that_opens_for_writing_leaves_the_seal_whole(package: Path) -> None:
    """QGIS switches to a write-ahead log and back; that changes the header and nothing else."""
    before = package.read_bytes()
    db = sqlite3.connect(package)
    for mode in ("WAL", "DELETE"):
        db.execute(f"PRAGMA journal_mode = {mode}")
        assert db.execute("SELECT count(*) FROM imagery").fetchone()[0] > 0
    db.close()
    assert package.read_bytes() != before
    MapPackage.open(package, verify=True).close()


def test_a_seal_that_signing_left_blank_says_nothing_and_one_that_is_gone_is_missed(package: Path) -> None:
    whole = package.read_bytes()
    at = whole.index(MARKER)
    package.write_bytes(whole[:at] + BLANK + whole[at + len(BLANK) :])
    MapPackage.open(package, verify=True).close()
    package.write_bytes(whole[:at] + bytes(len(BLANK)) + whole[at + len(BLANK) :])
    with pytest.raises(MapError, match="altered since it was built"):
        MapPackage.open(package, verify=True)
