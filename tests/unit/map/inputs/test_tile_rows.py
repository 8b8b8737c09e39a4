"""MBTiles whose rows count from the south, as specified, or from the north; every tile shows its own row."""

import math
import sqlite3
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from field_case import made
from terrafix.core.errors import MapError
from terrafix_tools.mapping.sources.tiles.files import MbtilesReader
from terrafix_tools.mapping.sources.tiles.grid import Tile

ZOOM, SIDE = 16, 4


def first_tile(lat_deg: float, lon_deg: float) -> tuple[int, int]:
    """Column and row, counted from the north (the "slippy map" formula)."""
    count = 1 << ZOOM
    column = int((lon_deg + 180.0) / 360.0 * count)
    return column, int((1.0 - math.asinh(math.tan(math.radians(lat_deg))) / math.pi) / 2.0 * count)


def edge_deg(row: float) -> float:
    return math.degrees(math.atan(math.sinh(math.pi * (1.0 - 2.0 * row / (1 << ZOOM)))))


def write(
    path: Path, lat_deg: float, *, north: bool, bounds: bool | str = True, scheme: str = "", metadata: bool = True
) -> tuple[Path, Tile]:
    """-> the file and its first tile, whose grey level is 0; that of the row below is 10, and so on."""
    column, row = first_tile(lat_deg, 14.36)
    count = 1 << ZOOM
    box = f"{column / count * 360 - 180},{edge_deg(row + SIDE)},{(column + SIDE) / count * 360 - 180},{edge_deg(row)}"
    db = sqlite3.connect(path)
    db.execute("CREATE TABLE tiles (zoom_level INT, tile_column INT, tile_row INT, tile_data BLOB)")
    if metadata:
        db.execute("CREATE TABLE metadata (name TEXT, value TEXT)")
        if bounds:
            db.execute("INSERT INTO metadata VALUES ('bounds', ?)", (box if bounds is True else bounds,))
        if scheme:
            db.execute("INSERT INTO metadata VALUES ('scheme', ?)", (scheme,))
    for across in range(SIDE):
        for down in range(SIDE):
            data = cv2.imencode(".png", np.full((256, 256, 3), 10 * down, np.uint8))[1].tobytes()
            stored = row + down if north else count - 1 - row - down
            db.execute("INSERT INTO tiles VALUES (?, ?, ?, ?)", (ZOOM, column + across, stored, data))
    db.commit()
    db.close()
    return path, Tile(ZOOM, column, row)


def levels(reader: MbtilesReader, first: Tile) -> list[int]:
    """Grey levels of the rows, from the north; -1: no tile."""
    found = []
    for down in range(SIDE):
        data = reader.get(Tile(ZOOM, first.column, first.row + down))
        picture = np.full((1, 1), -1) if data is None else cv2.imdecode(np.frombuffer(data, np.uint8), 0)
        assert picture is not None
        found.append(int(picture[0, 0]))
    reader.close()
    return found


RIGHT = [0, 10, 20, 30]


@pytest.mark.parametrize("lat_deg", [48.14, -33.9, 3.0, 80.0])
@pytest.mark.parametrize("scheme", ["", "tms", "xyz"])
def test_rows_from_either_side_are_read_where_the_bounds_say_which(tmp_path: Path, lat_deg: float, scheme: str) -> None:
    for north in (False, True):
        path, first = write(tmp_path / f"{north}.mbtiles", lat_deg, north=north, scheme=scheme)
        reader = MbtilesReader(path)
        assert bool(reader.notes) == north
        assert levels(reader, first) == RIGHT


def test_over_the_equator_where_both_readings_fit_the_scheme_counts(tmp_path: Path) -> None:
    middle_deg = edge_deg((1 << ZOOM) / 2 - SIDE / 2 + 0.5)
    for scheme, north in (("", False), ("tms", False), ("xyz", True)):
        path, first = write(tmp_path / f"{scheme}.mbtiles", middle_deg, north=north, scheme=scheme)
        assert levels(MbtilesReader(path), first) == RIGHT


@pytest.mark.parametrize("scheme", ["xyz", "zxy", "XYZ"])
def test_without_bounds_the_scheme_counts_and_without_both_the_specification(tmp_path: Path, scheme: str) -> None:
    path, first = write(tmp_path / "n.mbtiles", 48.14, north=True, bounds=False, scheme=scheme)
    reader = MbtilesReader(path)
    assert reader.notes == ("rows count from the north, as its scheme says",) and levels(reader, first) == RIGHT
    for metadata in (True, False):
        path, first = write(tmp_path / f"s{metadata}.mbtiles", 48.14, north=False, bounds=False, metadata=metadata)
        assert MbtilesReader(path).notes == () and levels(MbtilesReader(path), first) == RIGHT


@pytest.mark.parametrize("bounds", ["-180,-85,180,85", "nonsense", "1,2,3", "0,0,0,0", "-180,nan,180,85"])
def test_bounds_that_say_nothing_leave_the_specification(tmp_path: Path, bounds: str) -> None:
    path, first = write(tmp_path / "s.mbtiles", 48.14, north=False, bounds=bounds)
    assert MbtilesReader(path).notes == () and levels(MbtilesReader(path), first) == RIGHT


def test_bounds_that_fit_neither_reading_are_named(tmp_path: Path) -> None:
    path, first = write(tmp_path / "s.mbtiles", 48.14, north=False, bounds="14.3,10,14.4,10.1")
    reader = MbtilesReader(path)
    assert reader.notes == ("its bounds contradict its rows; rows count from the south, as specified",)
    assert levels(reader, first) == RIGHT


@pytest.mark.parametrize("change", ["zoom_level = 'x'", "zoom_level = 99", "tile_row = NULL", "tile_row = -5"])
def test_tiles_of_an_impossible_place_are_one_clear_line(tmp_path: Path, change: str) -> None:
    path, _ = write(tmp_path / "s.mbtiles", 48.14, north=False)
    db = sqlite3.connect(path)
    db.execute(f"UPDATE tiles SET {change}")
    db.commit()
    db.close()
    with pytest.raises(MapError, match=r"s\.mbtiles: a (zoom level|row)"):
        MbtilesReader(path)


def test_the_tile_files_of_the_field(data_set: Callable[[str], Path], tmp_path: Path) -> None:
    made(data_set, "mbtiles-xyz", tmp_path)
    column, row = first_tile(48.1446, 14.3558)
    found = [MbtilesReader(tmp_path / f"{name}.mbtiles") for name in ("tms", "xyz_rows", "xyz_scheme")]
    assert [bool(reader.notes) for reader in found] == [False, True, True]
    tiles = [[reader.get(Tile(16, column, row + down)) for down in range(4)] for reader in found]
    assert all(data is not None for of_file in tiles for data in of_file)
