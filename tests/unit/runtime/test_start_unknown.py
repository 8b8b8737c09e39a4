"""A flight with unknown start: vision replaces it by the centre of the map."""

import math
import sqlite3
from pathlib import Path

import pytest

from source_folders import TOML, flight
from terrafix.core.clock import now_ns
from terrafix.core.config import Config, SourceSection
from terrafix.core.errors import MapError, SourceError
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.initial_position import map_bounds, start_is_unknown, with_map_center
from terrafix.core.node import NodeContext
from terrafix.messages import Origin
from terrafix.vision.edge import make_edge
from terrafix.vision.sources import open_source

WEST, SOUTH, EAST, NORTH = 11.0, 48.0, 11.02, 48.03  # 1.5 km wide, 3.3 km high
NO_START = TOML.replace("[start]\nlat_deg = 48.0\nlon_deg = 2.0\n", "")


def package(path: Path, value: str = f"[{WEST}, {SOUTH}, {EAST}, {NORTH}]") -> Path:
    """The part of a map package that is read: one row of its manifest."""
    db = sqlite3.connect(path)
    db.execute("CREATE TABLE terrafix_manifest (key TEXT, value TEXT)")
    db.execute("INSERT INTO terrafix_manifest VALUES ('bounds_wgs84', ?)", (value,))
    db.commit()
    db.close()
    return path


def context(folder: Path, map_path: Path | None) -> NodeContext:
    config = Config(source=SourceSection(path=str(folder)))
    return NodeContext(config=config, frames=MemoryFrameStore(), map_path=map_path, out_dir=folder)


def test_an_unknown_start_is_the_map_centre_with_the_size_of_the_map_as_sigma(tmp_path: Path) -> None:
    edge = make_edge(context(flight(tmp_path / "f", toml=NO_START), package(tmp_path / "map.gpkg")))
    try:
        origin, _facts = edge.poll(now_ns())
        assert isinstance(origin, Origin)
        assert (origin.lat_deg, origin.lon_deg) == pytest.approx((48.015, 11.01))
        half_height_m = math.radians(0.015) * 6_371_000
        assert origin.start_sigma_m == pytest.approx(half_height_m, rel=0.005)
    finally:
        edge.close()


def test_a_known_start_is_not_changed(tmp_path: Path) -> None:
    origin = open_source(str(flight(tmp_path / "f"))).origin()
    assert not start_is_unknown(origin)
    assert with_map_center(origin, (WEST, SOUTH, EAST, NORTH)) == origin


def test_a_source_without_start_and_without_map_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="neither a start coordinate nor a map to search; give --map, or --start"):
        make_edge(context(flight(tmp_path / "f", toml=NO_START), None))


@pytest.mark.parametrize("value", ["", "[1, 2]", "west"])
def test_a_manifest_without_bounds_is_a_damaged_map(tmp_path: Path, value: str) -> None:
    with pytest.raises(MapError, match="damaged map package"):
        map_bounds(package(tmp_path / "map.gpkg", value))
