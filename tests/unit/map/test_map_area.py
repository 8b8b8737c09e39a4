"""The area of a map: boxes, KML, GeoJSON, missions; buffers and corridors; rejected inputs."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS, Geod
from rasterio.transform import Affine

from terrafix.core.errors import SourceError, TerrafixError, UsageError
from terrafix_tools.mapping.area.checks import check_area
from terrafix_tools.mapping.area.files import read_area
from terrafix_tools.mapping.area.polygons import Area, Placed

EARTH = Geod(ellps="WGS84")
SQUARE = [[13.0, 47.0], [13.1, 47.0], [13.1, 47.1], [13.0, 47.1], [13.0, 47.0]]


def inside(area: Area, lon_deg: float, lat_deg: float) -> bool:
    """Point in polygon test, by GDAL's rasterisation with cells of a ten-thousandth of a degree."""
    grid = Affine(1e-4, 0, lon_deg - 5e-5, 0, -1e-4, lat_deg + 5e-5)
    return bool(Placed(area, CRS.from_epsg(4326)).burn(grid, 1, 1)[0, 0])


def away(lon_deg: float, lat_deg: float, azimuth_deg: float, distance_m: float) -> tuple[float, float]:
    lon, lat, _ = EARTH.fwd(lon_deg, lat_deg, azimuth_deg, distance_m)
    return float(lon), float(lat)


def kml(*placemarks: str) -> str:
    body = "".join(f"<Placemark>{p}</Placemark>" for p in placemarks)
    return f'<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document>{body}</Document></kml>'


def kml_polygon(points: list[list[float]], hole: str = "") -> str:
    text = " ".join(f"{x},{y},0" for x, y in points)
    ring = f"<LinearRing><coordinates>\n{text}\n</coordinates></LinearRing>"
    return f"<Polygon>{hole}<outerBoundaryIs>{ring}</outerBoundaryIs></Polygon>"


def test_a_box_without_buffer_has_the_size_of_the_box() -> None:
    size_km2 = check_area(read_area("13.0, 47.0, 13.1, 47.1", buffer_km=0.0))
    exact_m2, _ = EARTH.polygon_area_perimeter([13.0, 13.1, 13.1, 13.0], [47.0, 47.0, 47.1, 47.1])
    assert size_km2 == pytest.approx(exact_m2 / 1e6, rel=0.003)


def test_a_buffer_adds_a_band_and_round_corners() -> None:
    size_km2 = check_area(read_area("13.0,47.0,13.1,47.1", buffer_km=2.0))
    inner_m2, around_m = EARTH.polygon_area_perimeter([13.0, 13.1, 13.1, 13.0], [47.0, 47.0, 47.1, 47.1])
    assert size_km2 == pytest.approx(inner_m2 / 1e6 + around_m / 1e3 * 2.0 + math.pi * 4.0, rel=0.01)


def test_the_default_buffer_is_20_km() -> None:
    west, south, _, _ = read_area("13.0,47.0,13.1,47.1").bounds_deg
    _, _, west_m = EARTH.inv(13.0, 47.05, west, 47.05)
    _, _, south_m = EARTH.inv(13.05, 47.0, 13.05, south)
    assert west_m == pytest.approx(20_000, rel=0.012) and south_m == pytest.approx(20_000, rel=0.012)


@pytest.mark.parametrize("azimuth_deg", range(0, 360, 15))
def test_a_buffer_is_nowhere_thinner_than_requested(azimuth_deg: float) -> None:
    area = read_area("13.0,47.0,13.1,47.1", buffer_km=5.0)
    corner = (13.1, 47.1) if azimuth_deg <= 90 else (13.0, 47.0)
    assert inside(area, *away(*corner, azimuth_deg, 4_990.0))
    if azimuth_deg <= 90:
        assert not inside(area, *away(*corner, azimuth_deg, 5_080.0))


def test_kml_polygons_are_merged_and_holes_are_filled(tmp_path: Path) -> None:
    ring = "<LinearRing><coordinates>13.02,47.02 13.08,47.02 13.05,47.08</coordinates></LinearRing>"
    hole = f"<innerBoundaryIs>{ring}</innerBoundaryIs>"
    other = [[13.2, 47.0], [13.3, 47.0], [13.25, 47.1]]
    path = tmp_path / "a.kml"
    path.write_text(kml(kml_polygon(SQUARE, hole), kml_polygon(other)), encoding="utf-8")
    area = read_area(str(path), buffer_km=0.0)
    assert area.bounds_deg == (13.0, 47.0, 13.3, 47.1)
    assert inside(area, 13.05, 47.05) and inside(area, 13.25, 47.05) and not inside(area, 13.15, 47.05)


def test_all_geojson_polygon_types_are_read(tmp_path: Path) -> None:
    shifted = [[x + 1.0, y] for x, y in SQUARE]
    document = {
        "type": "FeatureCollection",
        "features": [
            {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [SQUARE]}},
            {"type": "Feature", "properties": None, "geometry": None},
            {"type": "Feature", "geometry": {"type": "MultiPolygon", "coordinates": [[shifted]]}},
            {"type": "Feature", "geometry": {"type": "Point", "coordinates": [50.0, 10.0]}},
        ],
    }
    path = tmp_path / "a.geojson"
    path.write_text(json.dumps(document), encoding="utf-8")
    area = read_area(str(path), buffer_km=0.0)
    assert area.bounds_deg == (13.0, 47.0, 14.1, 47.1) and len(area.rings) == 2


def write_waypoints(path: Path, places: list[tuple[float, float]]) -> Path:
    rows = ["QGC WPL 110", "0\t1\t0\t16\t0\t0\t0\t0\t47.0\t13.0\t0\t1"]
    rows += [f"{i}\t0\t3\t16\t0\t0\t0\t0\t{lat}\t{lon}\t100\t1" for i, (lon, lat) in enumerate(places, start=1)]
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path


def test_a_corridor_follows_the_mission_without_closing_it(tmp_path: Path) -> None:
    path = write_waypoints(tmp_path / "m.waypoints", [(13.3, 47.0), (13.3, 47.2)])
    area = read_area(str(path), corridor_km=1.0)
    length_m = EARTH.line_length([13.0, 13.3, 13.3], [47.0, 47.0, 47.2])
    # Two straight parts with round ends; at the bend the inside overlaps and the outside is rounded.
    bend_km2 = math.pi / 4 - 1.0
    assert check_area(area) == pytest.approx(length_m / 1e3 * 2.0 + math.pi + bend_km2, rel=0.015)
    assert inside(area, 13.15, 47.0) and inside(area, 13.3, 47.1) and not inside(area, 13.15, 47.1)


def test_a_qgroundcontrol_plan_is_read_as_a_mission(tmp_path: Path) -> None:
    item = {"type": "SimpleItem", "command": 16, "frame": 3, "params": [0, 0, 0, None, 47.05, 13.2, 80], "doJumpId": 1}
    mission = {"plannedHomePosition": [47.0, 13.1, 400], "items": [item], "version": 2}
    path = tmp_path / "m.plan"
    path.write_text(json.dumps({"fileType": "Plan", "mission": mission}), encoding="utf-8")
    area = read_area(str(path), corridor_km=2.0)
    assert inside(area, 13.15, 47.025)
    assert area.bounds_deg[0] == pytest.approx(away(13.1, 47.0, 270, 2000)[0], abs=0.001)


def write_plan(path: Path, *items: dict[str, object]) -> Path:
    mission = {"plannedHomePosition": [47.0, 13.0, 400], "items": items, "version": 2}
    path.write_text(json.dumps({"fileType": "Plan", "mission": mission}), encoding="utf-8")
    return path


def simple(lat: float, lon: float, command: int = 16) -> dict[str, object]:
    return {"type": "SimpleItem", "command": command, "frame": 3, "params": [0, 0, 0, None, lat, lon, 80]}


PLOT = [[47.1, 13.2], [47.1, 13.21], [47.11, 13.21], [47.11, 13.2]]
TRIGGER = {"type": "SimpleItem", "command": 206, "frame": 2, "params": [25, 0, 1, 0, 0, 0, 0]}
LINES = {"Items": [simple(47.1, 13.2), TRIGGER, simple(47.11, 13.25)], "VisualTransectPoints": []}
COMPLEX = {  # as QGroundControl 4 writes them, reduced to their positions -> the flown position
    "survey": ({"TransectStyleComplexItem": LINES, "polygon": PLOT, "angle": 0}, (13.25, 47.11)),
    "CorridorScan": ({"TransectStyleComplexItem": LINES, "polyline": PLOT[:2], "CorridorWidth": 50}, (13.25, 47.11)),
    "StructureScan": ({"polygon": PLOT, "CameraCalc": {"DistanceToSurface": 1000}, "EntranceAltitude": 50},
                      (13.2205, 47.1155)),
    "fwLandingPattern": ({"landingApproachCoordinate": [47.2, 13.3, 40], "landCoordinate": [47.21, 13.31, 0]},
                         (13.31, 47.21)),
}  # fmt: skip


@pytest.mark.parametrize("kind", COMPLEX)
def test_complex_plan_items_have_their_flown_positions(tmp_path: Path, kind: str) -> None:
    fields, (lon, lat) = COMPLEX[kind]
    path = write_plan(
        tmp_path / "m.plan", simple(47.0, 13.1), {"type": "ComplexItem", "complexItemType": kind} | fields
    )
    area = read_area(str(path), corridor_km=0.3)
    assert inside(area, lon, lat) and inside(area, 13.05, 47.0)
    assert not inside(area, *away(lon, lat, 60.0, 500.0))


@pytest.mark.parametrize("kind", COMPLEX)
def test_complex_plan_items_without_positions_are_named(tmp_path: Path, kind: str) -> None:
    path = write_plan(tmp_path / "m.plan", simple(47.0, 13.1), {"type": "ComplexItem", "complexItemType": kind})
    with pytest.raises(SourceError, match=f"item 2: a '{kind}' without"):
        read_area(str(path), corridor_km=0.3)


def test_a_mission_with_one_position_becomes_a_circle(tmp_path: Path) -> None:
    path = write_waypoints(tmp_path / "m.waypoints", [(13.0, 47.0)])
    assert check_area(read_area(str(path), buffer_km=3.0)) == pytest.approx(math.pi * 9.0, rel=0.015)


REFUSED = {
    "bowtie.kml": (kml(kml_polygon([[13, 47], [13.1, 47.1], [13.1, 47], [13, 47.1]])), "crosses itself near 47.05"),
    "spike.kml": (kml(kml_polygon([[13, 47], [13.1, 47], [13.2, 47]])), "without area|crosses itself"),
    "two.kml": (kml(kml_polygon([[13, 47], [13.1, 47]])), "without area"),
    "empty.kml": (kml(kml_polygon([])), "contains no point"),
    "nothing.kml": (kml("<Point><coordinates>13,47</coordinates></Point>"), "contains no polygon and no line"),
    "words.kml": (kml("<LineString><coordinates>here,there</coordinates></LineString>"), "no numbers"),
    "broken.kml": ("<kml><Document>", "not valid XML"),
    "swapped.kml": (kml(kml_polygon([[47, 113], [47.1, 113], [47.1, 113.1]])), "is not a position"),
    "date.kml": (kml(kml_polygon([[179.9, 10], [-179.9, 10], [-179.9, 10.1], [179.9, 10.1]])), "antimeridian"),
    "not.geojson": ("{", "not valid JSON"),
    "list.geojson": ("[1, 2]", "not GeoJSON"),
    "deep.geojson": ("[" * 100_000, "not valid JSON"),
    "bare.geojson": ('{"type": "Feature"}', "contains no polygon"),
    "flat.geojson": ('{"type": "Polygon", "coordinates": [[1, 2, 3]]}', "no list of"),
    "topo.geojson": ('{"type": "Topology", "coordinates": []}', "is not an area"),
    "plan.json": ('{"fileType": "Plan"}', "name it .plan"),
    "zip.kmz": ("", "not valid XML"),
    "area.shp": ("", "give a box W,S,E,N"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_an_invalid_area_file_is_rejected_with_the_reason(tmp_path: Path, name: str) -> None:
    text, reason = REFUSED[name]
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(UsageError, match=reason) as caught:
        read_area(str(tmp_path / name), buffer_km=0.0)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "buffer_km", "reason"),
    [
        ("13.1,47.0,13.0,47.1", 0.0, "west is east of east"),
        ("13.0,47.1,13.1,47.0", 0.0, "an empty box"),
        ("13.0,47.0,13.0,47.1", 0.0, "an empty box"),
        ("13.0,47.0,13.1,97.1", 0.0, "is not a position"),
        ("10.0,83.9,10.1,83.95", 20.0, "degrees of latitude"),
        ("10.0,-85,10.1,-84.9", 0.0, "degrees of latitude"),
        ("179.9,10,179.95,10.1", 20.0, "antimeridian"),
        ("10.0,40.0,12.0,42.0", 0.0, "at most 20,000"),
        ("13.0,47.0,13.1,47.1", -1.0, "between 0 and 200"),
        ("13.0,47.0,13.1,47.1", math.nan, "between 0 and 200"),
        ("nowhere.kml", 1.0, "no such file"),
    ],
)
def test_invalid_boxes_and_buffers_are_rejected(text: str, buffer_km: float, reason: str) -> None:
    with pytest.raises(UsageError, match=reason):
        check_area(read_area(text, buffer_km=buffer_km))


def test_20_km_around_a_route_of_300_km_are_one_area() -> None:
    assert 13_000.0 < check_area(read_area("10.0,47.0,13.95,47.001", buffer_km=20.0)) < 14_000.0


def test_a_corridor_needs_a_line_and_a_width(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="neither a mission nor a line"):
        read_area("13.0,47.0,13.1,47.1", corridor_km=2.0)
    with pytest.raises(UsageError, match="exclude each other"):
        read_area("13.0,47.0,13.1,47.1", corridor_km=2.0, buffer_km=2.0)
    with pytest.raises(UsageError, match="line without width"):
        read_area(str(write_waypoints(tmp_path / "m.waypoints", [(13.1, 47.0)])), buffer_km=0.0)
    with pytest.raises(SourceError, match="no such mission"):
        read_area(str(tmp_path / "none.waypoints"), corridor_km=1.0)


def test_a_star_polygon_is_valid_and_swapped_vertices_are_a_self_intersection(tmp_path: Path) -> None:
    angle = np.linspace(0, 2 * np.pi, 600, endpoint=False)
    radius = np.where(np.arange(600) % 2, 0.05, 0.03)
    points = np.stack([13.0 + radius * np.cos(angle), 47.0 + radius * np.sin(angle)], axis=1)
    path = tmp_path / "star.geojson"
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [points.tolist()]}), encoding="utf-8")
    assert check_area(read_area(str(path), buffer_km=0.0)) > 10.0
    points[[100, 300]] = points[[300, 100]]
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [points.tolist()]}), encoding="utf-8")
    with pytest.raises(TerrafixError, match="crosses itself"):
        read_area(str(path), buffer_km=0.0)
