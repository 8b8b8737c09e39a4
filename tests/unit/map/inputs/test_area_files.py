"""Areas as programs write them: encodings, archives, tracks, way points. Sizes are those of a box in geodesics."""

import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from pyproj import Geod

from field_case import made
from terrafix.core.errors import UsageError
from terrafix_tools.mapping.area.checks import check_area
from terrafix_tools.mapping.area.files import read_area

CORNERS = ["14.35,48.14", "14.36,48.14", "14.36,48.15", "14.35,48.15"]
BOX_KM2 = abs(
    Geod(ellps="WGS84").polygon_area_perimeter([14.35, 14.36, 14.36, 14.35], [48.14, 48.14, 48.15, 48.15])[0] / 1e6
)
HEAD = '<?xml version="1.0" encoding="{}"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark>'
TAIL = "</Placemark></Document></kml>"


def ring(*corners: str) -> str:
    return f"<LinearRing><coordinates>{' '.join(corners)}</coordinates></LinearRing>"


BOX = f"<name>Fl\xfcgpl\xe4tze</name><Polygon><outerBoundaryIs>{ring(*CORNERS)}</outerBoundaryIs></Polygon>"


def written(path: Path, body: str, encoding: str = "utf-8", declared: str = "UTF-8") -> str:
    path.write_bytes((HEAD.format(declared) + body + TAIL).encode(encoding))
    return str(path)


@pytest.mark.parametrize(
    ("encoding", "declared"),
    [
        ("utf-8", "UTF-8"),
        ("utf-8-sig", "UTF-8"),
        ("utf-16", "UTF-16"),
        ("utf-16", "UTF-8"),
        ("utf-8", "UTF-16"),
        ("iso-8859-1", "ISO-8859-1"),
        ("iso-8859-1", "UTF-8"),
        ("cp1252", "windows-1252"),
        ("utf-8", "no-such-encoding"),
    ],
)
def test_a_kml_is_read_in_its_encoding_declared_or_not(tmp_path: Path, encoding: str, declared: str) -> None:
    area = read_area(written(tmp_path / "a.kml", BOX, encoding, declared), buffer_km=0.0)
    assert check_area(area) == pytest.approx(BOX_KM2, rel=0.01)


def test_spaces_behind_commas_are_read_and_decimal_commas_refused(tmp_path: Path) -> None:
    spaced = BOX.replace(",", ", ").replace("48.14 ", "48.14, 0 ")
    assert check_area(read_area(written(tmp_path / "s.kml", spaced), buffer_km=0.0)) == pytest.approx(BOX_KM2, rel=0.01)
    for comma in (BOX.replace(".", ","), BOX.replace(".", ",").replace(" 14", ",0 14")):
        with pytest.raises(UsageError, match=r"a position of more than 3 numbers, as decimal commas make it"):
            read_area(written(tmp_path / "c.kml", comma), buffer_km=0.0)


def test_a_ring_without_a_polygon_is_one_and_the_ring_of_a_polygon_counts_once(tmp_path: Path) -> None:
    assert check_area(read_area(written(tmp_path / "r.kml", ring(*CORNERS)), buffer_km=0.0)) == pytest.approx(
        BOX_KM2, rel=0.01
    )
    assert len(read_area(written(tmp_path / "p.kml", BOX), buffer_km=0.0).rings) == 1


def test_a_track_and_the_points_of_a_planner_are_paths(tmp_path: Path) -> None:
    coords = "".join(f"<gx:coord>{corner.replace(',', ' ')} 300</gx:coord>" for corner in CORNERS)
    track = f'<gx:Track xmlns:gx="http://www.google.com/kml/ext/2.2">{coords}</gx:Track>'
    line = f"<LineString><coordinates>{' '.join(CORNERS)}</coordinates></LineString>"
    points = "".join(f"<Point><coordinates>\n {corner}\n</coordinates></Point>" for corner in CORNERS)
    areas = [read_area(written(tmp_path / "a.kml", body), corridor_km=0.5) for body in (line, track, points)]
    assert [check_area(area) for area in areas] == pytest.approx([check_area(areas[0])] * 3)
    assert areas[2].notes == ("its 4 points are read as way points, in their order",)
    beside = read_area(written(tmp_path / "b.kml", BOX + points), buffer_km=0.0)
    assert check_area(beside) == pytest.approx(BOX_KM2, rel=0.01)
    assert beside.notes == ("4 point(s) beside the outlines are left out",)


def test_a_link_to_another_document_is_named(tmp_path: Path) -> None:
    """As Google Earth saves a place that it shows from the network."""
    link = "<NetworkLink><Link><href>https://maps.example/area.kml</href></Link></NetworkLink>"
    with pytest.raises(UsageError, match=r"n.kml: has no shape of its own, only a link to https://maps.example/area.k"):
        read_area(written(tmp_path / "n.kml", link), buffer_km=0.0)
    beside = read_area(written(tmp_path / "b.kml", f"<MultiGeometry>{BOX}</MultiGeometry>{link}"), buffer_km=0.0)
    assert check_area(beside) == pytest.approx(BOX_KM2, rel=0.01)
    assert beside.notes == ("1 link(s) to other documents are not followed",)


@pytest.mark.parametrize("inside", ["doc.kml", "files/area.kml", "wpmz/waylines.wpml"])
def test_an_archive_is_read_by_its_document(tmp_path: Path, inside: str) -> None:
    """DJI's archives hold a template beside the flown route."""
    with zipfile.ZipFile(tmp_path / "a.kmz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("wpmz/template.kml", HEAD.format("UTF-8") + "<Point/>" + TAIL)
        archive.writestr(inside, HEAD.format("UTF-8") + BOX + TAIL)
    area = read_area(str(tmp_path / "a.kmz"), buffer_km=0.0)
    assert check_area(area) == pytest.approx(BOX_KM2, rel=0.01)
    (tmp_path / "a.kmz").rename(tmp_path / "named.kml")
    assert check_area(read_area(str(tmp_path / "named.kml"), buffer_km=0.0)) == pytest.approx(BOX_KM2, rel=0.01)


def test_a_broken_empty_or_huge_archive_is_one_clear_line(tmp_path: Path) -> None:
    path = tmp_path / "a.kmz"
    for name, text, reason in (("a.png", "x", "an archive without a .kml"), ("doc.kml", " " * (65 << 20), "has 65 MB")):
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(name, text)
        with pytest.raises(UsageError, match=reason):
            read_area(str(path), buffer_km=0.0)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(UsageError, match="not an archive that can be read"):
        read_area(str(path), buffer_km=0.0)


def test_every_area_of_the_field_has_its_size_or_is_refused(data_set: Callable[[str], Path], tmp_path: Path) -> None:
    made(data_set, "kml", tmp_path)
    sizes = {"plain": 0.828, "spaces": 0.828, "hole": 0.828, "nons": 0.828, "latin1": 0.828, "utf16": 0.828}
    for name, km2 in (sizes | {"linear_ring": 0.414}).items():
        assert check_area(read_area(str(tmp_path / f"{name}.kml"), buffer_km=0.0)) == pytest.approx(km2, rel=0.01), name
    for name in ("gx_track", "dji_waypoints", "multi"):
        assert check_area(read_area(str(tmp_path / f"{name}.kml"), corridor_km=1.0)) > 3.0, name
    with pytest.raises(UsageError, match="decimal commas"):
        read_area(str(tmp_path / "decimal_comma.kml"), buffer_km=0.0)
