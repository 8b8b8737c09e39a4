"""Opening map packages that are whole, damaged, altered, foreign or from the future."""

import sqlite3
from pathlib import Path

import map_rasters
import pytest

from terrafix.anchor.map_package import MapPackage
from terrafix.core.errors import MapError
from terrafix.core.geodesy import LocalFrame
from terrafix_tools.mapping.build import build


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
        "DELETE FROM terrafix_tile_hash WHERE zoom_level = 0",
        "UPDATE terrafix_tile_hash SET sha256 = zeroblob(32) WHERE zoom_level = 0",
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
    assert opened.damaged_tiles == {(2, 1, 1)}
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
