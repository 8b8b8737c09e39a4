"""Roads, water and buildings in a package, compared with GDAL's reader."""

import json
import struct
from pathlib import Path

import numpy as np
import pyogrio
import pytest

import map_rasters
from map_features import HOLE, LAT, LON, ROAD, SQUARE, features, line
from map_packages import alter
from terrafix.core.errors import MapError
from terrafix.map.package import MapPackage
from terrafix.map.vectors import wkb_parts
from terrafix_tools.mapping.build import build_package, layer_of
from terrafix_tools.mapping.layers import VectorInput


@pytest.fixture
def package(tmp_path: Path) -> Path:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(64, 64))
    vectors = VectorInput(features(), source="area.osm.pbf", date="2024-01-02", licence="ODbL 1.0")
    return build_package([layer_of(tif)], tmp_path / "m.gpkg", vectors=vectors)


def test_gdal_reads_what_was_written(package: Path) -> None:
    assert {name for name, _ in pyogrio.list_layers(package)} >= {"roads", "water", "buildings"}
    meta, fids, geometry, values = pyogrio.raw.read(package, layer="roads", return_fids=True)
    assert meta["crs"] == "EPSG:4326" and list(meta["fields"]) == ["kind", "name", "attributes"]
    assert list(values[0]) == ["primary", "track"] and values[1][0] == "Straße 1"
    assert json.loads(values[2][0]) == {"kind": "primary", "lanes": "2", "name": "Straße 1"}
    assert geometry[0] == line(ROAD) and list(fids) == [1, 2]
    box = (LON + 0.5, LAT + 0.5, LON + 2, LAT + 2)  # by the R-tree
    assert list(pyogrio.raw.read(package, layer="roads", bbox=box)[3][0]) == ["track"]
    assert len(pyogrio.raw.read(package, layer="buildings", bbox=box)[2]) == 0
    info = pyogrio.read_info(package, layer="roads")
    assert info["features"] == 2 and info["total_bounds"] == pytest.approx((LON, LAT, LON + 1.1, LAT + 1))


def test_reading_features_of_a_box_returns_parts_and_attributes(package: Path) -> None:
    opened = MapPackage.open(package, verify=True)
    assert [(v.table, v.features, v.licence) for v in opened.manifest.vectors] == [
        ("roads", 2, "ODbL 1.0"),
        ("buildings", 1, "ODbL 1.0"),
        ("water", 1, "ODbL 1.0"),
    ]
    near = (LON - 0.01, LAT - 0.01, LON + 0.01, LAT + 0.01)
    road, track = opened.features("roads", *near)
    assert (road.kind, road.name, road.attributes["lanes"]) == ("primary", "Straße 1", "2")
    assert np.array_equal(road.parts[0], ROAD) and len(track.parts) == 2
    (house,) = opened.features("buildings", *near)
    assert np.array_equal(house.parts[0], SQUARE) and np.array_equal(house.parts[1], HOLE)
    assert opened.features("roads", LON + 5, LAT, LON + 6, LAT + 1) == []
    assert opened.features("railways", *near) == []
    opened.close()


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE roads SET name = 'other' WHERE fid = 1",
        "UPDATE roads SET kind = NULL WHERE fid = 1",
        "UPDATE roads SET geom = (SELECT geom FROM roads WHERE fid = 2) WHERE fid = 1",
        "DELETE FROM roads WHERE fid = 2",
    ],
)
def test_altered_features_are_detected(package: Path, statement: str) -> None:
    alter(package, statement)
    opened = MapPackage.open(package)
    with pytest.raises(MapError, match="features of roads were altered"):
        opened.features("roads", LON - 1, LAT - 1, LON + 2, LAT + 2)
    opened.close()
    with pytest.raises(MapError, match="features of roads were altered"):
        MapPackage.open(package, verify=True)


@pytest.mark.parametrize(
    ("table", "wkb", "expected"),
    [
        ("roads", b"", "not two-dimensional WKB"),
        ("roads", line(ROAD)[:-3], "not two-dimensional WKB"),
        ("roads", line(ROAD) + b"x", "not two-dimensional WKB"),
        ("roads", struct.pack("<BI3d", 1, 1001, 1, 2, 3), "not two-dimensional WKB"),
        ("roads", line([(float("nan"), 1.0), (2.0, 3.0)]), "not two-dimensional WKB"),
        ("roads", struct.pack("<BII", 1, 2, 4_000_000_000), "not two-dimensional WKB"),
        ("imagery_9", line(ROAD), "cannot be the name"),
        ('x"; DROP TABLE imagery; --', line(ROAD), "cannot be the name"),
    ],
)
def test_features_that_cannot_be_stored_are_reported(tmp_path: Path, table: str, wkb: bytes, expected: str) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(64, 64))
    vectors = VectorInput([(table, wkb, {})], source="my.osm")
    with pytest.raises(MapError, match=f"my.osm: .*{expected}"):
        build_package([layer_of(tif)], tmp_path / "m.gpkg", vectors=vectors)
    assert not (tmp_path / "m.gpkg").exists()


def test_deep_geometry_nesting_is_rejected() -> None:
    bomb = struct.pack("<BII", 1, 7, 1) * 100_000
    with pytest.raises(MapError, match="not two-dimensional WKB"):
        wkb_parts(bomb)
