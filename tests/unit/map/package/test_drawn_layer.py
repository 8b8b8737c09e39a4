"""The layer that is drawn from roads, water and buildings, alone and beside imagery."""

from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import map_rasters
from map_features import line, polygon
from terrafix.core.errors import MapError, UsageError
from terrafix.core.geodesy import LocalFrame
from terrafix.map.format import Ce90Origin
from terrafix.map.package import MapPackage
from terrafix_tools.mapping.area.build import Order, build_order
from terrafix_tools.mapping.area.polygons import Area
from terrafix_tools.mapping.build import build_package, layer_of
from terrafix_tools.mapping.check.suitability import check
from terrafix_tools.mapping.layers import Feature, VectorInput
from terrafix_tools.mapping.place_index import IndexOptions, write_index
from terrafix_tools.mapping.vectors.drawing import BUILDING, GROUND, ROAD, WATER

FRAME = LocalFrame(48.0, 11.0)
SIDE_M = 200.0


def ring(*corners_m: tuple[float, float]) -> list[tuple[float, float]]:
    """-> closed ring in longitude and latitude of corners in east and north."""
    points = [FRAME.to_wgs84(e_m, n_m)[::-1] for e_m, n_m in corners_m]
    return [*points, points[0]]


def square(side_m: float, centre_m: tuple[float, float] = (0.0, 0.0)) -> list[tuple[float, float]]:
    (e, n), half = centre_m, side_m / 2
    return ring((e - half, n - half), (e + half, n - half), (e + half, n + half), (e - half, n + half))


def east_west(n_m: float) -> list[tuple[float, float]]:
    return [FRAME.to_wgs84(e_m, n_m)[::-1] for e_m in (-90.0, 90.0)]


def drawn(path: Path, *given: Feature) -> np.ndarray:
    """-> the drawing (200, 200) at 1 m; row 0 is the northernmost, the middle is at (0, 0)."""
    area = Area("test", (np.array(square(SIDE_M + 20.0)[:-1]),))
    vectors = VectorInput(given, source="area.osm.pbf", licence="ODbL 1.0", drawn_in=area, ce90_m=6.0)
    package = MapPackage.open(build_package([], path, vectors=vectors), verify=True)
    image, valid = package.bind(FRAME).window(-SIDE_M / 2, SIDE_M / 2, int(SIDE_M), int(SIDE_M), 1.0)
    package.close()
    assert valid.all()
    return image[:, :, 0].astype(int)


def test_a_road_is_drawn_with_its_width_where_it_lies(tmp_path: Path) -> None:
    road = line(east_west(50.0)), {"kind": "primary", "width": "20"}
    picture = drawn(tmp_path / "m.gpkg", ("roads", *road))
    column = picture[:, 100]
    (rows,) = np.nonzero(column > (GROUND + ROAD) / 2)
    assert abs(rows.mean() + 0.5 - 50.0) < 0.6 and abs(len(rows) - 20) <= 1  # row 50 is 50 m north
    assert column[0] == GROUND and picture[100, 100] == GROUND


def test_a_line_without_a_width_has_that_of_its_kind_and_a_footpath_is_not_drawn(tmp_path: Path) -> None:
    lines = [("roads", line(east_west(n_m)), {"kind": kind}) for n_m, kind in ((60.0, "motorway"), (-60.0, "footway"))]
    column = drawn(tmp_path / "m.gpkg", *lines)[:, 100]
    assert abs(np.count_nonzero(column[:100] > (GROUND + ROAD) / 2) - 24) <= 1
    assert (column[100:] == GROUND).all()


def test_surfaces_are_filled_up_to_their_holes_and_buildings_lie_above_roads_and_water(tmp_path: Path) -> None:
    lake = "water", polygon(square(80.0), square(40.0)), {"kind": "water"}
    house = "buildings", polygon(square(10.0, (30.0, 0.0))), {"kind": "yes"}
    bridge = "roads", line(east_west(30.0)), {"kind": "primary"}
    picture = drawn(tmp_path / "m.gpkg", house, bridge, lake)
    assert picture[100, 100] == GROUND  # in the hole
    assert picture[130, 100] == WATER and picture[100, 130] == BUILDING
    assert abs(picture[70, 100] - ROAD) < 10


def test_a_package_of_vectors_alone_states_their_accuracy_and_covers_the_area(tmp_path: Path) -> None:
    drawn(tmp_path / "m.gpkg", ("roads", line(east_west(0.0)), {"kind": "primary"}))
    package = MapPackage.open(tmp_path / "m.gpkg")
    (layer,) = package.manifest.layers
    assert layer.is_drawn and layer.source == "area.osm.pbf" and layer.licence == "ODbL 1.0"
    assert (layer.ce90_m, layer.ce90_origin, layer.gsd_m) == (6.0, Ce90Origin.STATED, pytest.approx(1.0, abs=0.001))
    assert package.covers(48.0, 11.0) and not package.covers(48.01, 11.0)
    assert [table.table for table in package.manifest.vectors] == ["roads"]
    package.close()


def test_an_area_without_a_feature_is_no_map_of_vectors(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="no road, water or building lies in this area"):
        drawn(tmp_path / "m.gpkg")
    assert list(tmp_path.iterdir()) == []


def test_a_null_model_needs_imagery(tmp_path: Path) -> None:
    area = Area("test", (np.array(square(SIDE_M)[:-1]),))
    vectors = VectorInput([], source="area.osm.pbf", drawn_in=area)
    with pytest.raises(UsageError, match="--null-agl: a null model is fitted on imagery"):
        build_package([], tmp_path / "m.gpkg", vectors=vectors, null_agl_m=(100.0,))


def test_the_drawn_layer_comes_after_imagery_and_leaves_it_as_it_is(tmp_path: Path) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(64, 64))
    west, south, east, north = MapPackage.open(
        build_package([layer_of(tif)], tmp_path / "a.gpkg")
    ).manifest.bounds_wgs84
    corners = np.array([(west, south), (east, south), (east, north), (west, north)])
    road = "roads", line([(west, south), (east, north)]), {"kind": "primary"}
    vectors = VectorInput([road], source="area.osm.pbf", date="2030-01-01", drawn_in=Area("test", (corners,)))
    build_package([layer_of(tif)], tmp_path / "b.gpkg", vectors=vectors)
    alone, both = (MapPackage.open(tmp_path / name) for name in ("a.gpkg", "b.gpkg"))
    assert [layer.table for layer in both.manifest.layers] == ["imagery", "drawn"]
    assert both.manifest.layers[0] == alone.manifest.layers[0] and both.layer().table == "imagery"
    hashes = {row for row in both.tiles.hashes() if row[0].startswith("imagery")}
    assert hashes == set(alone.tiles.hashes())


def test_map_check_says_that_there_is_no_imagery_and_an_index_of_it_is_refused(tmp_path: Path) -> None:
    drawn(tmp_path / "m.gpkg", ("buildings", polygon(square(60.0)), {"kind": "yes"}))
    package = MapPackage.open(tmp_path / "m.gpkg")
    notes = check(package).report.warnings
    package.close()
    assert any(note.startswith("roads, water and buildings instead of imagery") for note in notes)
    assert not any("when the imagery was taken" in note for note in notes)
    with pytest.raises(MapError, match="has no imagery, and the search of a drawn map uses no index"):
        write_index([tmp_path / "m.gpkg"], tmp_path / "places", IndexOptions(60.0, "pooled-gradient"))


def test_an_osm_extract_without_imagery_makes_a_map(tmp_path: Path) -> None:
    (west, south), (east, north) = square(SIDE_M)[0], square(SIDE_M)[2]
    nodes = "".join(
        f'<node id="{i}" version="1" lon="{lon}" lat="{lat}"/>' for i, (lon, lat) in enumerate(east_west(0.0), start=1)
    )
    way = '<way id="9" version="1"><nd ref="1"/><nd ref="2"/><tag k="highway" v="primary"/></way>'
    (tmp_path / "a.osm").write_text(f'<osm version="0.6">{nodes}{way}</osm>', encoding="utf-8")
    order = Order(
        tmp_path / "m.gpkg",
        area=f"{west},{south},{east},{north}",
        buffer_km=0.0,
        osm=str(tmp_path / "a.osm"),
        osm_ce90_m=8.0,
        say=Console(quiet=True),
    )
    build_order(order)
    package = MapPackage.open(tmp_path / "m.gpkg", verify=True)
    assert [(layer.table, layer.ce90_m) for layer in package.manifest.layers] == [("drawn", 8.0)]
    image, _ = package.bind(FRAME).window(-5.0, 20.0, 10, 40, 1.0)
    package.close()
    assert abs(image[20, 5, 0] - ROAD) < 10 and image[0, 5, 0] == GROUND
