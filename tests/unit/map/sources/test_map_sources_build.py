"""`terrafix map build --area` end to end: servers, files, estimate, package."""

import io
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rich.console import Console

import map_rasters
import map_servers
from map_servers import Reply, Request, serving
from terrafix.core.errors import MapError, TerrafixError, UsageError
from terrafix.map.package import MapPackage
from terrafix_tools.mapping.area.build import Order, build_order

WORLD = map_servers.pyramid(5, 6, zoom=17)


def order(tmp_path: Path, url: str, **more: object) -> Order:
    common: dict[str, object] = {
        "buffer_km": 0.0,
        "licence": "CC0",
        "cache": tmp_path / "cache",
        "say": console(io.StringIO()),
    }
    common |= {"area": WORLD.box_deg(0.3), "source": [url + "/{z}/{x}/{y}.png"], "gsd_m": 0.82, "rate": 500.0}
    return Order(out=tmp_path / "m.gpkg", **{**common, **more})  # type: ignore[arg-type]


def console(text: io.StringIO) -> Console:
    return Console(file=text, soft_wrap=True)


def assert_shows_the_world(package: Path, most: float = 2.7) -> None:
    """Compares the package with the image that the tiles were cut from, at its known position."""
    span_m = 2 * map_servers.HALF_M / (1 << WORLD.zoom)
    with rasterio.open(package) as file:
        assert file.crs.to_epsg() == 3857 and file.transform.a == pytest.approx(span_m / 256)
        column = (file.transform.c + map_servers.HALF_M) / file.transform.a - WORLD.column * 256
        row = (map_servers.HALF_M - file.transform.f) / file.transform.a - WORLD.row * 256
        assert column == pytest.approx(round(column), abs=1e-3) and row == pytest.approx(round(row), abs=1e-3)
        image, valid = file.read([3, 2, 1]).transpose(1, 2, 0), file.dataset_mask() > 0
    truth = WORLD.image[round(row) :, round(column) :][: image.shape[0], : image.shape[1]]
    assert valid.mean() > 0.98 and np.abs(image[valid].astype(float) - truth[valid]).mean() < most
    # The comparison is sensitive to a shift by one pixel.
    assert np.abs(image[:, 1:].astype(float) - truth[:, :-1])[valid[:, 1:]].mean() > 1.5 * most


@pytest.mark.slow
def test_a_tile_server_becomes_a_package_and_a_second_build_fetches_nothing(tmp_path: Path) -> None:
    with serving(WORLD.answer) as server:
        output = io.StringIO()
        out = build_order(order(tmp_path, server.url, say=console(output)))
        assert out is not None
        request = len(server.requests)
        assert request == 30 and "12 of 30 there, 18 to fetch" in output.getvalue()
        assert output.getvalue().endswith(f"written to {out}\n")
        first = out.read_bytes()
        build_order(order(tmp_path, server.url, say=console(output)))
        assert output.getvalue().endswith(f"written to {out}, which was replaced\n")
        assert len(server.requests) == request and out.read_bytes() == first
    assert_shows_the_world(out)
    package = MapPackage.open(out, verify=True)
    assert package.manifest.licence == "CC0" and package.manifest.source == server.url + "/{z}/{x}/{y}.png"
    assert package.manifest.gsd_m == pytest.approx(0.813, abs=0.002)
    package.close()


def test_an_estimate_fetches_a_sample_and_writes_nothing(tmp_path: Path) -> None:
    with serving(WORLD.answer) as server:
        output = io.StringIO()
        assert build_order(order(tmp_path, server.url, estimate_only=True, say=console(output))) is None
        assert len(server.requests) == 12
    assert not (tmp_path / "m.gpkg").exists() and "MB in" in output.getvalue()


@pytest.mark.slow
def test_a_failed_download_leaves_no_package_and_resumes_later(tmp_path: Path) -> None:
    broken = True

    def answer(request: Request) -> Reply:
        return Reply(403, b"enough for today") if broken and len(server.requests) > 20 else WORLD.answer(request)

    with serving(answer) as server:
        with pytest.raises(MapError, match="enough for today"):
            build_order(order(tmp_path, server.url))
        assert not list(tmp_path.glob("*.gpkg")) and not list(tmp_path.glob(".m.gpkg*"))
        broken = False
        build_order(order(tmp_path, server.url))
        assert max(server.completed.values()) == 1
    assert_shows_the_world(tmp_path / "m.gpkg")


@pytest.mark.slow
def test_several_sources_and_dates_are_built_from_a_source_file(tmp_path: Path) -> None:
    """A local image first, a server for the rest of the area, and a second, older layer."""
    with serving(WORLD.answer) as server:
        # Tiles 2.. of the world from a server, 0 and 1 from an inverted GeoTIFF of the same raster.
        span_m = 2 * map_servers.HALF_M / (1 << WORLD.zoom)
        corner = WORLD.column * span_m - map_servers.HALF_M, map_servers.HALF_M - WORLD.row * span_m
        place = rasterio.Affine(span_m / 256, 0, corner[0], 0, -span_m / 256, corner[1])
        left = 255 - WORLD.image[:, :512, ::-1].transpose(2, 0, 1)
        map_rasters.write_tif(tmp_path / "left.tif", left, "EPSG:3857", place)
        (tmp_path / "maps.toml").write_text(
            f'[[source]]\npath = "left.tif"\ndate = "2024-05-01"\nlicence = "own flight"\nce90_m = 2.0\n'
            f'[[source]]\nurl = "{server.url}/{{z}}/{{x}}/{{y}}.png"\ndate = "2022-05-01"\nlicence = "CC0"\n'
            f"ce90_m = 6.0\n"
            f"requests_per_s = 500\n"
            f'[[source]]\npath = "left.tif"\nlayer = "old"\ndate = "2011-05-01"\nlicence = "archive"\n'
        )
        build_order(order(tmp_path, server.url, source=[], sources=tmp_path / "maps.toml", licence=""))
        # Tiles that a better source covers are not fetched.
        assert {int(a.path.split("/")[2]) - WORLD.column for a in server.requests} == {1, 2, 3, 4, 5}
    package = MapPackage.open(tmp_path / "m.gpkg", verify=True)
    new, old = package.manifest.layers
    assert (new.date, new.ce90_m, new.licence) == ("2022-05-01", 6.0, "own flight; CC0")
    assert (old.date, old.source, old.ce90_m) == ("2011-05-01", "old", 6.0)  # estimated: it coincides with the new one
    package.close()
    with rasterio.open(f"GPKG:{tmp_path / 'm.gpkg'}:imagery") as file:
        image = file.read([3, 2, 1]).transpose(1, 2, 0)
        column = round((file.transform.c - corner[0]) / file.transform.a)
        row = round((corner[1] - file.transform.f) / file.transform.a)
    truth = WORLD.image.copy()
    truth[:, :512] = 255 - truth[:, :512]
    truth = truth[row : row + image.shape[0], column : column + image.shape[1]]
    assert np.abs(image.astype(float) - truth)[10:-10, 10:-10].mean() < 4.0


def test_missing_options_are_reported_before_the_download(tmp_path: Path) -> None:
    with serving(WORLD.answer) as server:
        for change, reason in (
            ({"licence": ""}, "needs the licence"),
            ({"source": []}, "--area needs a --source"),
            ({"gsd_m": 0.0}, "between 0.01 and 100"),
            ({"area": "13,47,13.1,47.1", "buffer_km": None, "corridor_km": 1.0}, "neither a mission nor a line"),
            ({"area": "10,40,12,42"}, "at most 20,000"),
            ({"area": ""}, "give one image"),
            ({"area": "", "source": ["one.tif"], "buffer_km": None, "gsd_m": 0.0}, "need --area"),
            ({"source": [str(tmp_path / "none.tif")]}, "no such file"),
            ({"dem": "none.tif"}, "none.tif: no such file; check --dem"),
            ({"osm": "none.osm.pbf"}, "check --osm"),
        ):
            with pytest.raises(TerrafixError, match=reason):
                build_order(order(tmp_path, server.url, **change))
        assert not server.requests
    assert not list(tmp_path.glob("*.gpkg"))


@pytest.mark.slow
def test_a_large_download_waits_for_confirmation(tmp_path: Path) -> None:
    with serving(WORLD.answer) as server, pytest.raises(UsageError, match="add --yes"):
        build_order(order(tmp_path, server.url, buffer_km=20.0, rate=5.0))


@pytest.mark.slow
def test_map_build_area_runs_from_the_command_line(tmp_path: Path) -> None:
    with serving(WORLD.answer) as server:
        command = [sys.executable, "-m", "terrafix_tools.cli", "map", "build", "--area", WORLD.box_deg(1.6)]
        command += ["--buffer", "0", "--source", server.url + "/{z}/{x}/{y}.png", "--gsd", "0.82", "--licence", "CC0"]
        command += ["--rate", "500", "--out", str(tmp_path / "m.gpkg"), "--cache", str(tmp_path / "cache")]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        assert "km2 with its buffer" in done.stderr
    assert_shows_the_world(tmp_path / "m.gpkg")
    done = subprocess.run([*command, "--corridor", "2"], capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and done.stderr.startswith("terrafix: --buffer and --corridor exclude")


@pytest.mark.slow
def test_workers_change_no_byte_and_a_mission_gets_a_corridor_hint(tmp_path: Path) -> None:
    west, south, east, north = (float(v) for v in WORLD.box_deg(1.0).split(","))
    item = {"type": "SimpleItem", "command": 16, "frame": 3, "params": [0, 0, 0, None, north, east, 80]}
    mission = {"plannedHomePosition": [south, west, 400], "items": [item]}
    (tmp_path / "m.plan").write_text(json.dumps({"fileType": "Plan", "mission": mission}))
    output = io.StringIO()
    with serving(WORLD.answer) as server:
        common = {"area": str(tmp_path / "m.plan"), "say": console(output)}
        with pytest.raises(UsageError, match="add --yes"):
            build_order(order(tmp_path, server.url, **{**common, "buffer_km": None, "rate": 5.0}))
        assert "--corridor 2 along the mission would be" in output.getvalue()
        narrow = {**common, "buffer_km": None, "corridor_km": 0.1}
        build_order(order(tmp_path, server.url, **narrow))
        one = (tmp_path / "m.gpkg").read_bytes()
        build_order(order(tmp_path, server.url, workers=2, **narrow))
    assert (tmp_path / "m.gpkg").read_bytes() == one
    with rasterio.open(tmp_path / "m.gpkg") as file:
        valid = file.dataset_mask() > 0
    assert 0.2 < valid.mean() < 0.9 and valid[-5:].any() and not valid[0, 0] and not valid[-1, -1]


@pytest.mark.slow
def test_an_area_build_includes_elevation_and_vectors(tmp_path: Path) -> None:
    west, south, east, north = (float(v) for v in WORLD.box_deg(1.0).split(","))
    (tmp_path / "a.osm").write_text(
        f'<osm version="0.6"><node id="1" version="1" lon="{west}" lat="{south}"/>'
        f'<node id="2" version="1" lon="{east}" lat="{north}"/><node id="3" version="1" lon="{east}" lat="{south}"/>'
        '<way id="1" version="1"><nd ref="1"/><nd ref="2"/><tag k="highway" v="track"/></way>'
        '<way id="2" version="1"><nd ref="1"/><nd ref="2"/><nd ref="3"/><nd ref="1"/><tag k="building" v="barn"/></way>'
        "</osm>"
    )
    place = rasterio.Affine(0.001, 0, west - 0.05, 0, -0.001, north + 0.05)
    map_rasters.write_tif(tmp_path / "dem.tif", np.full((1, 120, 120), 612.0, np.float32), "EPSG:4326", place)
    with serving(WORLD.answer) as server:
        more = {"osm": str(tmp_path / "a.osm"), "dem": str(tmp_path / "dem.tif")}
        build_order(order(tmp_path, server.url, **more))
    package = MapPackage.open(tmp_path / "m.gpkg", verify=True)
    assert package.manifest.has_dem
    assert {(v.table, v.features, v.licence) for v in package.manifest.vectors} == {
        ("roads", 1, "(c) OpenStreetMap contributors, ODbL 1.0"),
        ("buildings", 1, "(c) OpenStreetMap contributors, ODbL 1.0"),
    }
    assert package.ground_amsl_m((south + north) / 2, (west + east) / 2) == pytest.approx(612.0, abs=0.02)
    package.close()
