"""`terrafix map check`: matchable ground, missions that leave the map, and the report."""

import datetime
import json
import math
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

import map_rasters
from map_packages import centre_of
from terrafix.core.errors import MapError, UsageError
from terrafix.core.geodesy import LocalFrame
from terrafix.map.package import MapPackage
from terrafix_tools.mapping.build import build
from terrafix_tools.mapping.check.mission import mission_route
from terrafix_tools.mapping.check.preview_page import page, picture
from terrafix_tools.mapping.check.sight import MatchabilityProbe, Sight
from terrafix_tools.mapping.check.suitability import DEFAULT_CAMERA, check
from terrafix_tools.mapping.check.text import lines_of
from terrafix_tools.mission.file import write_mission
from terrafix_tools.mission.items import Do, Item, Mission

WIDTH_PX, HEIGHT_PX = 1050, 350  # three kinds of ground side by side, a metre a pixel
TEXTURE_E_M, FLAT_E_M, ROWS_E_M = -350.0, 0.0, 350.0  # their middles


def ground() -> np.ndarray:
    """(3, 350, 1050): rich texture; a lake with camera noise; periodic orchard rows."""
    bands = np.clip(4.0 * map_rasters.texture(HEIGHT_PX, WIDTH_PX) - 384.0, 1, 254).astype(np.uint8)
    rng = np.random.default_rng(5)
    lake = cv2.GaussianBlur(rng.normal(size=(HEIGHT_PX, 350)).astype(np.float32), (0, 0), 1.0)
    bands[:, :, 350:700] = np.clip(70 + 8 * lake, 1, 250).astype(np.uint8)
    rows, columns = np.mgrid[0:HEIGHT_PX, 0:350]
    trees = 110 + 60 * np.cos(2 * np.pi * rows / 20) * np.cos(2 * np.pi * columns / 20)
    bands[:, :, 700:] = trees.astype(np.uint8)
    return bands


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("check")
    tif = map_rasters.utm(folder / "i.tif", ground(), pixel_m=1.0)
    return build(tif, folder / "m.gpkg", date="2020-01-01", licence="CC0", ce90_m=4.0)


@pytest.fixture
def opened(package: Path) -> Iterator[MapPackage]:
    opened = MapPackage.open(package)
    yield opened
    opened.close()


@pytest.fixture
def frame(opened: MapPackage) -> LocalFrame:
    return centre_of(opened)


def probe_of(opened: MapPackage, frame: LocalFrame, agl_m: float) -> MatchabilityProbe:
    return MatchabilityProbe(opened.bind(frame), opened.layer(), DEFAULT_CAMERA, agl_m)


def mission_over(folder: Path, frame: LocalFrame, *places_m: tuple[float, float]) -> Path:
    """A waypoint file through positions (e, n) of the local frame, 100 m above home."""
    places = [frame.to_wgs84(*place) for place in places_m]
    items = tuple(Item(Do.WAYPOINT, i, lat, lon, 100.0) for i, (lat, lon) in enumerate(places, start=1))
    path = folder / "mission.waypoints"
    write_mission(path, Mission("m", *places[0], items))
    return path


def test_texture_is_matchable_and_water_and_orchard_rows_are_not(opened: MapPackage, frame: LocalFrame) -> None:
    probe = probe_of(opened, frame, 100.0)
    for n_m in (-60.0, -20.0, 20.0, 60.0):
        assert probe.at(TEXTURE_E_M, n_m) == Sight.SEES
        assert probe.at(FLAT_E_M, n_m) == Sight.BLIND
        assert probe.at(ROWS_E_M, n_m) == Sight.BLIND
    assert probe.at(-600.0, 0.0) == Sight.NO_MAP
    assert probe.at(-520.0, 0.0) == Sight.NO_MAP  # half the frame is beyond the edge


def test_faint_ground_is_placed_only_while_it_looks_as_on_the_map(tmp_path: Path) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(300, 300))
    faint = MapPackage.open(build(tif, tmp_path / "m.gpkg", date=str(datetime.date.today())))
    probe = probe_of(faint, centre_of(faint), 60.0)
    assert [probe.at(e_m, 0.0) for e_m in (-15.0, 0.0, 15.0)] == [Sight.WEAK] * 3
    report = check(faint, agl_m=60.0).report
    assert report.alone == report.sees + report.weak > 0.7 > report.sees
    faint.close()


def test_the_check_grid_and_its_fractions(opened: MapPackage) -> None:
    checked = check(opened)
    report = checked.report
    assert report.sees + report.weak + report.blind == pytest.approx(1.0)
    assert report.blind == pytest.approx(0.62, abs=0.15) and report.alone == report.sees > 0.15 and report.weak > 0.0
    columns = (TEXTURE_E_M, FLAT_E_M, ROWS_E_M)
    row = int((checked.grid.n_max_m - 0.0) / checked.grid.step_m)
    seen = [checked.grid.sight[row, int((e_m - checked.grid.e_min_m) / checked.grid.step_m)] for e_m in columns]
    assert seen == [Sight.SEES, Sight.BLIND, Sight.BLIND]
    shown = picture(checked)
    height, width = shown.shape[:2]
    thirds = [shown[height // 2 - 30 : height // 2 + 30, x - 30 : x + 30] for x in (width // 6, width // 2)]
    (blue, _, red), (_, lake_green, lake_red) = (part.mean(axis=(0, 1)) for part in thirds)
    assert blue > red + 20 and lake_red > lake_green + 60  # the colours of SEES and BLIND
    assert report.cell_m == pytest.approx(1.0) and report.frame_gsd_m == pytest.approx(100 / 914)
    # CE90 4 m: sigma 4/2.1460; matching: median of one cell. Median of the two together.
    assert report.expected_error_m == pytest.approx(math.hypot(1.1774 * 4 / 2.146, 1.0), rel=1e-3)
    assert any("elevation" in text for text in report.warnings) and not any(
        "accuracy" in text for text in report.warnings
    )


@pytest.mark.slow
def test_a_mission_check_lists_the_stretches_without_fixes(
    tmp_path: Path, opened: MapPackage, frame: LocalFrame
) -> None:
    path = mission_over(tmp_path, frame, (-420.0, 0.0), (0.0, 0.0), (0.0, 60.0))
    mission = check(opened, mission=path).report.mission
    assert mission is not None and mission.outside == []
    assert mission.length_m == pytest.approx(480, abs=2)
    longest = mission.blind[0]
    assert longest.length_m == pytest.approx(210, abs=70) and longest.after_item in (0, 1)
    start_e_m, _ = frame.to_local(*longest.start)
    assert start_e_m == pytest.approx(-150, abs=60)  # the lake begins at -175 m


@pytest.mark.slow
def test_a_mission_check_lists_where_it_leaves_the_map(tmp_path: Path, opened: MapPackage, frame: LocalFrame) -> None:
    path = mission_over(tmp_path, frame, (-400.0, 0.0), (-400.0, 300.0), (-300.0, 300.0), (-300.0, 0.0))
    report = check(opened, mission=path).report
    assert report.mission is not None
    (outside,) = report.mission.outside
    assert outside.length_m == pytest.approx(2 * 125 + 100, abs=40)  # the edge is at 175 m
    assert outside.after_item == 1
    assert frame.to_local(*outside.start)[1] == pytest.approx(175 + 10, abs=12)
    assert "after item 1" in dict(lines_of(report))["outside"]


@pytest.mark.slow
def test_map_check_fails_with_a_reason(tmp_path: Path, package: Path, frame: LocalFrame) -> None:
    path = mission_over(tmp_path, frame, (-400.0, 0.0), (-400.0, 300.0))
    command = [sys.executable, "-m", "terrafix_tools.cli", "map", "check", str(package), "--mission", str(path)]
    done = subprocess.run([*command, "--json"], capture_output=True, text=True, timeout=120)
    assert done.returncode == MapError.exit_code
    assert json.loads(done.stdout)["mission"]["outside"][0]["after_item"] == 1
    assert re.fullmatch(r"terrafix: .*mission\.waypoints: leaves the map for .* after item 1, from .*\n", done.stderr)
    inside = mission_over(tmp_path, frame, (-400.0, 0.0), (-400.0, 50.0))
    done = subprocess.run([*command[:-1], str(inside)], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")
    assert "sees" in done.stdout and "outside" not in done.stdout


def test_loiter_and_return_items_are_part_of_the_path(frame: LocalFrame) -> None:
    home = frame.to_wgs84(-400.0, 0.0)
    there = frame.to_wgs84(-400.0, 100.0)
    items = (
        Item(Do.TAKE_OFF, 1, height_m=50.0),
        Item(Do.LOITER_TURNS, 2, *there, 50.0, amount=2, radius_m=-80.0),
        Item(Do.RETURN, 3),
    )
    route = mission_route(Mission("m", *home, items), frame)
    assert route.points_m[0] == pytest.approx((-400.0, 0.0), abs=0.1)
    assert route.points_m[-1] == pytest.approx((-400.0, 0.0), abs=0.1)
    assert route.points_m[:, 1].max() == pytest.approx(180.0, abs=2)
    assert np.hypot(*np.diff(route.points_m, axis=0).T).max() <= 22


@pytest.mark.slow
def test_a_map_that_is_too_coarse_or_a_height_that_is_too_low_is_reported(tmp_path: Path, opened: MapPackage) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(64, 64), pixel_m=10.0)
    coarse = MapPackage.open(build(tif, tmp_path / "m.gpkg"))
    report = check(coarse, agl_m=120.0).report
    assert any("no fix will come" in text for text in report.warnings)
    assert any("does not say when" in text for text in report.warnings)
    assert any("accuracy is not stated; 10 m" in text for text in report.warnings)
    coarse.close()
    with pytest.raises(UsageError, match="below 30 m"):
        check(opened, agl_m=20.0)
    with pytest.raises(MapError, match="has no layer"):
        check(opened, layer="summer")


@pytest.mark.slow
def test_the_preview_page_needs_no_other_file(tmp_path: Path, opened: MapPackage, frame: LocalFrame) -> None:
    path = mission_over(tmp_path, frame, (-400.0, 0.0), (-300.0, 0.0))
    text = page(check(opened, mission=path))
    assert text.startswith("<!doctype html>") and "The mission stays on this map" in text
    assert not re.findall(r'(?:href|src)="(?!data:)', text) and "http" not in text.replace("http-equiv", "")
    assert text.count("data:image/") == 1 and "m.gpkg" in text
    assert 10_000 < len(text) < 3_000_000


@pytest.mark.slow
def test_real_water_is_not_matchable_and_a_real_town_is(tmp_path: Path, data_set: Callable[[str], Path]) -> None:
    reef = MapPackage.open(build(data_set("imagery/single/reef.tif"), tmp_path / "reef.gpkg"))
    west, south, east, north = reef.manifest.bounds_wgs84
    frame = LocalFrame(south, west)
    probe = probe_of(reef, frame, 100.0)

    def at(column_share: float, row_share: float) -> Sight:
        """Fractions of the image size, from its north-western corner."""
        e_m, n_m = frame.to_local(north + (south - north) * row_share, west + (east - west) * column_share)
        return probe.at(e_m, n_m)

    assert {at(0.36, y) for y in (0.30, 0.35, 0.40, 0.46)} == {Sight.BLIND}  # open water
    assert {at(x, 0.50) for x in (0.74, 0.78)} == {Sight.SEES}  # bushes and houses ashore
    reef.close()
    town = MapPackage.open(build(data_set("maps/town.tif"), tmp_path / "town.gpkg"))
    assert check(town, agl_m=120.0).report.sees > 0.95
    town.close()
