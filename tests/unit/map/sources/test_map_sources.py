"""Imagery sources: source specifications and tile files."""

import contextlib
import gzip
import sqlite3
from pathlib import Path

import cv2
import numpy as np
import pytest
from pmtiles.tile import Compression, TileType, zxy_to_tileid
from pmtiles.writer import Writer
from pyproj import CRS

import map_servers
from terrafix.core.errors import ConfigError, MapError, UsageError
from terrafix_tools.mapping.area.files import read_area
from terrafix_tools.mapping.area.polygons import Area, Placed
from terrafix_tools.mapping.sources.spec import SourceSpec, parse_sources, read_sources
from terrafix_tools.mapping.sources.tiles.files import open_tiles
from terrafix_tools.mapping.sources.tiles.grid import Tile, ground_pixel_m, tiles_of, zoom_for
from terrafix_tools.mapping.sources.tiles.image import TileDamage, decode, image_side
from terrafix_tools.mapping.sources.tiles.imagery import TileImagery
from terrafix_tools.mapping.sources.tiles.job import tile_file_opener
from terrafix_tools.mapping.sources.tiles.store import TileStore
from terrafix_tools.mapping.sources.tiles.url_template import UrlTemplate

BERLIN = Tile(17, 70406, 42987)  # the tile of the Brandenburg Gate, by the formula of the OpenStreetMap wiki


def test_the_tile_index_of_a_known_position() -> None:
    lon_deg, lat_deg = 13.3777, 52.5163
    area = Area("gate", (np.array([[lon_deg, lat_deg], [lon_deg + 1e-6, lat_deg], [lon_deg, lat_deg + 1e-6]]),))
    assert list(tiles_of(Placed(area, CRS.from_epsg(3857)), 17)) == [BERLIN]


def test_the_zoom_follows_the_requested_resolution() -> None:
    # 156543.03 m per pixel at zoom 0 on the equator, halved with every zoom level.
    assert zoom_for(0.6, 0.0, 256) == 18 and zoom_for(0.59, 0.0, 256) == 19 and zoom_for(0.6, 0.0, 512) == 17
    assert zoom_for(0.3, 60.0, 256) == 18
    assert ground_pixel_m(18, 60.0, 256) == pytest.approx(0.29858, abs=1e-4)


@pytest.mark.parametrize(
    ("template", "url"),
    [
        ("http://h/{z}/{x}/{y}.png", "http://h/17/70406/42987.png"),
        ("http://h/{z}/{x}/{-y}.png", "http://h/17/70406/88084.png"),
        ("http://{a,b,c}.h/{z}/{x}/{y}", "http://c.h/17/70406/42987"),
        ("http://h/w/{TileMatrix}/{TileRow}/{TileCol}.jpg", "http://h/w/17/42987/70406.jpg"),
        ("http://h?REQUEST=GetTile&TILEMATRIX=EPSG:3857:{z}&TILEROW={y}&TILECOL={x}", "http://h?REQUEST=GetTile&TILEMATRIX=EPSG:3857:17&TILEROW=42987&TILECOL=70406"),
        ("http://h/{z}/{x}/{y}?key=${MAP_KEY}", "http://h/17/70406/42987?key=a{b}"),
    ],
)  # fmt: skip
def test_url_templates_are_expanded(template: str, url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAP_KEY", "a{b}")
    UrlTemplate(template).check()
    assert UrlTemplate(template).url(BERLIN) == url


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("http://h/{z}/{x}.png", "not the address of a tile"),
        ("http://h/{z}/{x}/{y}/{-y}.png", "not the address of a tile"),
        ("http://h/{z}/{x}/{y}/{style}.png", "{style} is not known"),
        ("ftp://h/{z}/{x}/{y}.png", "starts with http"),
        ("http://h/{z}/{x}/{y}?k=${NO_SUCH_KEY}", "export NO_SUCH_KEY"),
    ],
)
def test_invalid_url_templates_are_rejected(text: str, reason: str) -> None:
    with pytest.raises(UsageError, match=reason.replace("{", r"\{").replace("}", r"\}")):
        parse_sources([text], licence="CC0")


def test_a_network_source_needs_a_licence() -> None:
    with pytest.raises(UsageError, match="needs the licence"):
        parse_sources(["http://h/{z}/{x}/{y}.png"])
    assert parse_sources(["a.tif", "sentinel-2"])[1].service == "sentinel-2"


def test_a_source_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "maps.toml"
    path.write_text(
        '[[source]]\npath = "town.tif"\ndate = "2023-06-01"\nce90_m = 3.0\n'
        '[[source]]\nurl = "http://h/{z}/{x}/{y}.png"\nlicence = "CC BY 4.0"\nrequests_per_s = 2\nconnections = 1\n'
        'user_agent = "me"\nheaders = { Referer = "http://me" }\nlayer = "old"\n',
        encoding="utf-8",
    )
    first, second = read_sources(path)
    assert first.path == str(tmp_path / "town.tif") and first.ce90_m == 3.0 and not first.from_network
    assert (second.limits.requests_per_s, second.limits.connections, second.limits.user_agent) == (2.0, 1, "me")
    assert second.headers == {"Referer": "http://me"} and second.layer == "old"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "source"),
        ("source = []", r"has no \[\[source\]\]"),
        ('[[source]]\nurl = "http://h/{z}/{x}/{y}"\n', "needs the licence"),
        ('[[source]]\npath = "a.tif"\nurl = "http://h/{z}/{x}/{y}"\n', "exactly one of"),
        ("[[source]]\n", "exactly one of"),
        ('[[source]]\npath = "a.tif"\nzooom = 3\n', "zooom"),
        ('[[source]]\nwmts = "http://h"\nlicence = "x"\n', "layer_name"),
        ('[[source]]\nservice = "landsat"\n', "there is sentinel-2"),
        ('[[source]]\npath = "a.tif"\nconnections = 99\n', "connections = 99 is out of"),
        ("[[source]\n", "cannot be read as TOML"),
    ],
)
def test_invalid_source_files_are_rejected(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "maps.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=reason) as caught:
        read_sources(path)
    assert str(path) in str(caught.value)


WORLD = map_servers.pyramid(3, 4, zoom=16)


def write_mbtiles(path: Path, skip: tuple[int, int] | None = None) -> Path:
    places = [(column, row) for column in range(4) for row in range(3) if (column, row) != skip]
    with TileStore(path, "test") as store:
        for column, row in places:
            tile = Tile(16, WORLD.column + column, WORLD.row + row)
            store.add(tile, WORLD.tile(*tile))
    return path


def write_pmtiles(path: Path) -> Path:
    tiles = [Tile(16, WORLD.column + c, WORLD.row + r) for c in range(4) for r in range(3)]
    with path.open("wb") as file:
        writer = Writer(file)
        for tile in sorted(tiles, key=lambda t: zxy_to_tileid(*t)):
            writer.write_tile(zxy_to_tileid(*tile), WORLD.tile(*tile))
        header = {"tile_type": TileType.PNG, "tile_compression": Compression.NONE, "min_zoom": 16, "max_zoom": 16}
        header |= {"min_lon_e7": 0, "min_lat_e7": 0, "max_lon_e7": 0, "max_lat_e7": 0}
        header |= {"center_zoom": 16, "center_lon_e7": 0, "center_lat_e7": 0}
        writer.finalize(header, {})
    return path


@pytest.mark.parametrize("kind", ["mbtiles", "pmtiles"])
def test_tile_files_are_read_pixel_by_pixel(tmp_path: Path, kind: str) -> None:
    path = (write_mbtiles if kind == "mbtiles" else write_pmtiles)(tmp_path / f"a.{kind}")
    area = read_area(WORLD.box_deg(), buffer_km=1.0)
    with tile_file_opener(SourceSpec(path=str(path)), area, None)() as imagery:
        left = round((WORLD.column * 256) - (imagery.x_min + map_servers.HALF_M) / imagery.pixel_x)
        top = round((WORLD.row * 256) - (map_servers.HALF_M - imagery.y_max) / imagery.pixel_y)
        image, mask = imagery.read(left - 10, top - 20, 4 * 256 + 20, 3 * 256 + 40)
    assert (image[20:-20, 10:-10] == WORLD.image).all() and (mask[20:-20, 10:-10] == 255).all()
    assert not mask[:20].any() and not mask[:, :10].any() and not mask[-20:].any() and not mask[:, -10:].any()


def test_a_missing_tile_is_a_hole_and_the_requested_zoom_must_exist(tmp_path: Path) -> None:
    path = write_mbtiles(tmp_path / "a.mbtiles", skip=(1, 1))
    area = read_area(WORLD.box_deg(0.2), buffer_km=0.0)
    with tile_file_opener(SourceSpec(path=str(path)), area, None)() as imagery:
        _, mask = imagery.read(0, 0, imagery.width_px, imagery.height_px)
    assert not mask[256:512, 256:512].any() and mask.sum() == 255 * 11 * 256 * 256
    with pytest.raises(MapError, match="has no zoom 12; it has 16 to 16"):
        tile_file_opener(SourceSpec(path=str(path), zoom=12), area, None)


def test_invalid_tile_files_are_reported(tmp_path: Path) -> None:
    for name in ("a.mbtiles", "a.pmtiles"):
        with pytest.raises(MapError, match="no such file"):
            open_tiles(tmp_path / name)
        (tmp_path / name).write_bytes(b"something else that is long enough" * 10)
        with pytest.raises(MapError, match=r"not an? (MBTiles|PMTiles) file"):
            open_tiles(tmp_path / name)
    for start in (b"", b"PMTiles\x03" + bytes(60)):
        (tmp_path / "b.pmtiles").write_bytes(start)
        with pytest.raises(MapError, match="not a PMTiles file"):
            open_tiles(tmp_path / "b.pmtiles")
    write_pmtiles(tmp_path / "c.pmtiles")
    data = bytearray((tmp_path / "c.pmtiles").read_bytes())
    data[130:170] = bytes(40)
    (tmp_path / "c.pmtiles").write_bytes(bytes(data))
    with pytest.raises(MapError, match="damaged"):
        open_tiles(tmp_path / "c.pmtiles").get(Tile(16, WORLD.column, WORLD.row))


def test_a_tile_file_of_empty_tiles_is_reported(tmp_path: Path) -> None:
    with contextlib.closing(sqlite3.connect(tmp_path / "a.mbtiles")) as db:
        db.execute("CREATE TABLE tiles (zoom_level INTEGER, tile_column INTEGER, tile_row INTEGER, tile_data BLOB)")
        db.execute("INSERT INTO tiles VALUES (16, 1, 1, NULL)")
        for tile in ("x''", "'text'"):
            db.execute(f"UPDATE tiles SET tile_data = {tile}")
            db.commit()
            reader = open_tiles(tmp_path / "a.mbtiles")
            with pytest.raises(MapError, match=r"a\.mbtiles: its tiles are not square images"):
                image_side(reader.first(16), tmp_path / "a.mbtiles")
            reader.close()


def test_a_damaged_tile_in_a_tile_file_is_reported(tmp_path: Path) -> None:
    path = write_mbtiles(tmp_path / "a.mbtiles")
    with TileStore(path, "test") as store:
        store.add(Tile(16, WORLD.column, WORLD.row), b"")
    placed = Placed(read_area(WORLD.box_deg(0.2), buffer_km=0.0), CRS.from_epsg(3857))
    with TileImagery(open_tiles(path), 16, 256, placed) as imagery, pytest.raises(MapError, match="empty answer"):
        imagery.read(0, 0, 10, 10)


def test_tile_images_are_decoded() -> None:
    grey = np.arange(256, dtype=np.uint8)[None].repeat(256, axis=0)
    assert (decode(cv2.imencode(".png", grey)[1].tobytes(), 256)[:, :, :3] == grey[:, :, None]).all()
    clear = np.full((256, 256, 4), 100, np.uint8)
    clear[:, :, 3] = 255
    clear[:100, :, 3] = 0
    clear[100:110, :, 3] = 128
    mask = decode(cv2.imencode(".png", clear)[1].tobytes(), 256)[:, :, 3]
    assert not mask[:110].any() and (mask[110:] == 255).all()
    deep = (grey.astype(np.uint16) << 8) + 7
    assert (decode(cv2.imencode(".png", deep)[1].tobytes(), 256)[:, :, 0] == grey).all()
    webp = cv2.imencode(".webp", cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
    assert (decode(webp, 256)[:, :, 0] == grey).all()
    for cut in (
        webp[:-20],
        cv2.imencode(".png", clear)[1].tobytes()[:-20],
        cv2.imencode(".jpg", grey)[1].tobytes()[:-90],
    ):
        with pytest.raises(TileDamage, match="cut off"):
            decode(cut, 256)
    with pytest.raises(TileDamage, match="neither JPEG"):
        decode(gzip.compress(b"x"), 256)
