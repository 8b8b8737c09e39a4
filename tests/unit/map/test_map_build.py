"""Map builds from common image formats, and the errors for unusable images."""

import math
import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import rasterio
import rasterio.warp
from rasterio.enums import ColorInterp
from rasterio.transform import Affine

import map_rasters
from terrafix.core.errors import MapError, OutputError, TerrafixError, UsageError
from terrafix.core.geodesy import LocalFrame
from terrafix.map.package import MapPackage
from terrafix_tools.mapping.build import build, ensure_package
from terrafix_tools.mapping.source import ImagerySource
from terrafix_tools.mapping.workers import decoding


def finest(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The map at full resolution, as GDAL reads the package: (h, w, 3) RGB and (h, w) bool."""
    with rasterio.open(path) as file:
        return file.read([1, 2, 3]).transpose(1, 2, 0), file.dataset_mask() > 0


def test_the_package_is_a_geopackage_that_gdal_reads(tmp_path: Path) -> None:
    bands = map_rasters.texture(700, 900)
    out = build(map_rasters.utm(tmp_path / "i.tif", bands), tmp_path / "m.gpkg", date="2024-05-06", licence="CC0")
    with rasterio.open(out) as file:
        assert file.driver == "GPKG" and file.crs.to_epsg() == 32651
        assert (file.width, file.height) == (900, 700)
        assert file.transform.almost_equals(Affine(0.5, 0, 300_000, 0, -0.5, 2_600_000))
        assert len(file.overviews(1)) == 2
    tables = {"terrafix_manifest", "terrafix_signature", "imagery_descriptors"}
    assert {name for name, _ in pyogrio.list_layers(out)} == tables  # pytest turns a warning into an error
    assert pyogrio.read_info(out, layer="terrafix_manifest")["features"] > 15
    image, valid = finest(out)
    assert valid.all()
    assert np.abs(image.astype(float) - bands.transpose(1, 2, 0)).mean() < 3.0
    db = sqlite3.connect(out)
    assert db.execute("PRAGMA application_id").fetchone()[0] == 0x47504B47
    assert db.execute("PRAGMA user_version").fetchone()[0] == 10300
    assert db.execute("PRAGMA integrity_check").fetchone()[0] == "ok"
    assert db.execute("PRAGMA foreign_key_check").fetchall() == []
    assert {r[0] for r in db.execute("SELECT srs_id FROM gpkg_spatial_ref_sys")} == {-1, 0, 4326, 4979, 32651}
    width, height = db.execute("SELECT max_x - min_x, max_y - min_y FROM gpkg_tile_matrix_set").fetchone()
    for row in db.execute("SELECT matrix_width, pixel_x_size, matrix_height, pixel_y_size FROM gpkg_tile_matrix"):
        assert row[0] * row[1] * 256 == pytest.approx(width) and row[2] * row[3] * 256 == pytest.approx(height)
    outside = "SELECT count(*) FROM imagery JOIN gpkg_tile_matrix USING (zoom_level) WHERE tile_column >= matrix_width"
    assert db.execute(outside).fetchone()[0] == 0
    assert dict(db.execute("SELECT key, value FROM terrafix_manifest"))["licence"] == "CC0"
    db.close()
    package = MapPackage.open(out, verify=True)
    assert (package.manifest.date, package.manifest.source, package.manifest.has_dem) == ("2024-05-06", "i.tif", False)
    package.close()


def test_the_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(300, 500))
    (tmp_path / "b").mkdir()
    one, two = build(tif, tmp_path / "m.gpkg"), build(tif, tmp_path / "b" / "m.gpkg")
    assert one.read_bytes() == two.read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["b", "i.tif", "m.gpkg"]


def test_a_stated_accuracy_is_stored_and_a_missing_one_is_none(tmp_path: Path) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(300, 500))
    for ce90_m in (5.0, None):
        package = MapPackage.open(build(tif, tmp_path / "m.gpkg", ce90_m=ce90_m))
        assert package.manifest.ce90_m == ce90_m
        package.close()


def gray(rgb: np.ndarray) -> np.ndarray:
    return rgb[:1]


def deep(rgb: np.ndarray) -> np.ndarray:
    return (rgb.astype(np.uint16) * 12) + 300


def floating(rgb: np.ndarray) -> np.ndarray:
    return rgb.astype(np.float32) / 255


@pytest.mark.parametrize("change", [gray, deep, floating])
def test_gray_16_bit_and_float_images_are_converted(tmp_path: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    rgb = map_rasters.texture(300, 300)
    image, valid = finest(build(map_rasters.utm(tmp_path / "i.tif", change(rgb)), tmp_path / "m.gpkg"))
    assert valid.all()
    expected = np.repeat(rgb[:1], 3, axis=0) if change is gray else rgb
    assert np.corrcoef(image[:, :, 0].ravel(), expected[0].ravel())[0, 1] > 0.99
    assert np.corrcoef(image[:, :, 2].ravel(), expected[2].ravel())[0, 1] > 0.99
    assert image.std() > 25


def test_near_infrared_is_dropped_and_alpha_is_the_mask(tmp_path: Path) -> None:
    rgb = map_rasters.texture(300, 300)
    fourth = np.full((1, 300, 300), 255, np.uint8)
    fourth[0, 100:200, 100:200] = 0
    four = np.concatenate([rgb, fourth])
    plain = [ColorInterp.gray, ColorInterp.undefined, ColorInterp.undefined, ColorInterp.undefined]
    image, valid = finest(build(map_rasters.utm(tmp_path / "n.tif", four, colorinterp=plain), tmp_path / "n.gpkg"))
    assert valid.all()
    assert np.abs(image.astype(float) - rgb.transpose(1, 2, 0)).mean() < 3.0
    rgba = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha]
    image, valid = finest(build(map_rasters.utm(tmp_path / "a.tif", four, colorinterp=rgba), tmp_path / "a.gpkg"))
    assert np.array_equal(valid, fourth[0] > 0)


def test_palette_images_and_nodata_are_converted(tmp_path: Path) -> None:
    index = (map_rasters.texture(300, 300)[:1] // 32).astype(np.uint8)
    colours = {i: (30 * i, 255 - 30 * i, 20 + 10 * i, 255) for i in range(8)}
    tif = map_rasters.utm(tmp_path / "p.tif", index, colormap=colours)
    image, _ = finest(build(tif, tmp_path / "p.gpkg"))
    expected = np.array([colours[i][:3] for i in range(8)])[index[0]]
    assert np.abs(image.astype(float) - expected).mean() < 12  # JPEG on hard edges
    rgb = map_rasters.texture(300, 300)
    rgb[:, :50] = 7
    _, valid = finest(build(map_rasters.utm(tmp_path / "v.tif", rgb, nodata=7), tmp_path / "v.gpkg"))
    assert not valid[:50].any() and valid[50:].mean() > 0.999


@pytest.mark.slow
@pytest.mark.parametrize("empty", [0, 255])
def test_a_collar_without_a_mask_is_invalid_and_shadows_are_not(tmp_path: Path, empty: int) -> None:
    height, width = 700, 2200  # more than one block of the search
    rgb = map_rasters.texture(height, width)
    rows, columns = np.mgrid[0:height, 0:width]
    collar = (rows + columns < 400) | (rows - columns > 500) | (columns > 2100)
    rgb[:, collar] = empty
    rgb[:, 300:340, 1200:1240] = empty
    tif = map_rasters.utm(
        tmp_path / "c.tif", rgb, compress="jpeg", photometric="ycbcr", tiled=True, blockxsize=256, blockysize=256
    )
    _, valid = finest(build(tif, tmp_path / "c.gpkg"))
    assert valid[collar].mean() < 1e-3
    lost = ~valid & ~collar
    assert lost.mean() < 0.01
    assert valid[250:400, 1150:1300].all()


def test_geographic_and_rotated_images_are_warped_north_up(tmp_path: Path) -> None:
    rgb = map_rasters.texture(400, 400)
    geographic = Affine(5e-6, 0, 20.5, 0, -5e-6, -34.0)
    package = MapPackage.open(
        build(map_rasters.write_tif(tmp_path / "g.tif", rgb, "EPSG:4326", geographic), tmp_path / "g.gpkg")
    )
    assert package.manifest.crs == "EPSG:32734"
    assert package.manifest.gsd_m == pytest.approx(0.4620, rel=0.01)  # the finer side, 5e-6 degrees of longitude
    assert package.covers(-34.001, 20.501) and not package.covers(-33.999, 20.501)
    package.close()
    cos, sin = 0.5 * math.cos(0.5), 0.5 * math.sin(0.5)
    rotated = Affine(cos, sin, 300_000, sin, -cos, 2_600_000)
    tif = map_rasters.write_tif(tmp_path / "r.tif", rgb, "EPSG:32651", rotated)
    _, valid = finest(build(tif, tmp_path / "r.gpkg"))
    assert valid.sum() * 0.25 == pytest.approx(400 * 400 * 0.25, rel=0.02)


def test_elevation_is_interpolated_bilinearly_with_voids(tmp_path: Path) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(600, 600))
    x = 299_000 + 10 * (np.arange(300) + 0.5)
    y = 2_601_000 - 10 * (np.arange(300) + 0.5)
    height_m = (100 + 0.05 * (x[None, :] - 300_000) - 0.02 * (y[:, None] - 2_600_000)).astype(np.float32)
    height_m[110:113, 110:113] = -9999  # not declared as nodata
    dem = map_rasters.write_tif(
        tmp_path / "d.tif", height_m[None], "EPSG:32651", Affine(10, 0, 299_000, 0, -10, 2_601_000)
    )
    package = MapPackage.open(build(tif, tmp_path / "m.gpkg", dem=dem), verify=True)
    assert package.manifest.has_dem
    frame = LocalFrame(*_wgs84(300_150.0, 2_599_850.0))
    local = package.bind(frame)
    places = np.array([[300_020.0, 2_599_980.0], [300_280.0, 2_599_720.0], [300_000.0, 2_600_000.0]])
    e_n = np.array([frame.to_local(*_wgs84(*place)) for place in places])
    found = local.elevation(e_n[:, 0], e_n[:, 1])
    assert found is not None
    expected = 100 + 0.05 * (places[:, 0] - 300_000) - 0.02 * (places[:, 1] - 2_600_000)
    assert found == pytest.approx(expected, abs=0.02)
    assert package.ground_amsl_m(frame.lat_deg, frame.lon_deg) == pytest.approx(110.5, abs=0.02)
    void = frame.to_local(*_wgs84(300_115.0, 2_599_885.0))
    answer = local.elevation(np.array([void[0], 1e6, np.inf]), np.array([void[1], 0.0, 0.0]))
    assert answer is not None and np.isnan(answer).all()
    grid = np.meshgrid(np.linspace(-140, 0, 90), np.linspace(40, 140, 90))  # through the quadratic fit
    many = local.elevation(*grid)
    few = local.elevation(grid[0][::9, ::9], grid[1][::9, ::9])
    assert many is not None and few is not None
    assert many.shape == (90, 90) and many[::9, ::9] == pytest.approx(few, abs=1e-3, nan_ok=True)
    package.close()
    without = MapPackage.open(build(tif, tmp_path / "n.gpkg"))
    assert without.bind(frame).elevation(np.zeros(1), np.zeros(1)) is None
    assert without.ground_amsl_m(frame.lat_deg, frame.lon_deg) is None
    without.close()


def _wgs84(x: float, y: float) -> tuple[float, float]:
    lon_deg, lat_deg = rasterio.warp.transform("EPSG:32651", "EPSG:4326", [x], [y])
    return lat_deg[0], lon_deg[0]


def test_ensure_package_builds_once_and_returns_existing_packages(tmp_path: Path) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(300, 300))
    first = ensure_package(tif, tmp_path / "cache")
    stamp = first.stat().st_mtime_ns
    assert ensure_package(tif, tmp_path / "cache") == first and first.stat().st_mtime_ns == stamp
    assert ensure_package(first, tmp_path / "cache") == first
    map_rasters.utm(tif, map_rasters.texture(310, 300))
    os.utime(tif, ns=(1, 1))
    assert ensure_package(tif, tmp_path / "cache") != first
    content = first.read_bytes()
    first.write_bytes(content[: len(content) // 2])
    map_rasters.utm(tif, map_rasters.texture(300, 300))
    again = ensure_package(tif, tmp_path / "cache")
    MapPackage.open(again, verify=True).close()


def test_a_cached_package_that_does_not_say_what_was_read_is_built_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(300, 300))
    with monkeypatch.context() as before:
        before.setattr("terrafix_tools.mapping.build.merged", lambda *_: [])  # as earlier versions built it
        old = ensure_package(tif, tmp_path / "cache")
        assert not MapPackage.open(old).manifest.inputs
    again = ensure_package(tif, tmp_path / "cache")
    assert again == old and MapPackage.open(again).manifest.inputs


def broken(tmp_path: Path, what: str) -> Path:
    rgb = map_rasters.texture(64, 64)
    path = tmp_path / "broken.tif"
    if what == "missing":
        return path
    if what == "text":
        path.write_text("not an image")
    elif what == "no crs":
        map_rasters.write_tif(path, rgb, None, Affine(1, 0, 5, 0, -1, 5))
    elif what == "empty":
        map_rasters.utm(path, rgb * 0, nodata=0)
    elif what == "truncated":
        map_rasters.utm(path, map_rasters.texture(600, 600))
        path.write_bytes(path.read_bytes()[:400_000])
    return path


@pytest.mark.parametrize(
    ("what", "expected_text"),
    [
        ("missing", "no such file"),
        ("text", "not an image"),
        ("no crs", "no coordinate system"),
        ("empty", "no valid pixel"),
        ("truncated", "cannot be read"),
    ],
)
def test_unusable_imagery_is_a_one_line_error_and_leaves_no_file(tmp_path: Path, what: str, expected_text: str) -> None:
    path = broken(tmp_path, what)
    with pytest.raises(MapError, match=expected_text) as caught:
        build(path, tmp_path / "out" / "m.gpkg")
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


def test_unusable_outputs_and_options_are_reported(tmp_path: Path) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(64, 64))
    (tmp_path / "file").write_text("in the way")
    wrong: list[tuple[type[TerrafixError], Path, str]] = [
        (OutputError, tmp_path, ""),
        (OutputError, tif, ""),
        (OutputError, tmp_path / "file" / "m.gpkg", ""),
        (UsageError, tmp_path / "m.gpkg", "yesterday"),
    ]
    for error, out, date in wrong:
        with pytest.raises(error):
            build(tif, out, date=date)
    assert tif.stat().st_size > 0 and sorted(p.name for p in tmp_path.iterdir()) == ["file", "i.tif"]


def test_elevation_that_does_not_cover_the_imagery_is_reported(tmp_path: Path) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(64, 64))
    elsewhere = map_rasters.write_tif(
        tmp_path / "d.tif", np.full((1, 50, 50), 9, np.float32), "EPSG:4326", Affine(0.001, 0, 10, 0, -0.001, 50)
    )
    with pytest.raises(MapError, match="no elevation under"):
        build(tif, tmp_path / "m.gpkg", dem=elsewhere)


@pytest.mark.slow
def test_an_interrupted_build_leaves_no_file(tmp_path: Path) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", np.tile(map_rasters.texture(500, 500), (1, 12, 12)))
    out = tmp_path / "out" / "m.gpkg"
    program = f"""import signal
from pathlib import Path
from terrafix_tools.mapping.build import build
signal.signal(signal.SIGINT, signal.default_int_handler)
build(Path({str(tif)!r}), Path({str(out)!r}))"""
    child = subprocess.Popen([sys.executable, "-c", program], stderr=subprocess.DEVNULL)
    deadline_s = time.monotonic() + 30
    while time.monotonic() < deadline_s and not list(tmp_path.glob("out/.m.gpkg.*/part.gpkg")):
        time.sleep(0.02)
    child.send_signal(signal.SIGINT)
    assert child.wait(timeout=30) != 0
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.slow
def test_the_package_is_byte_identical_for_any_number_of_workers(tmp_path: Path) -> None:
    """Enough chunks for two processes, and an empty border, so that the workers share a collar mask."""
    bands = np.tile(map_rasters.texture(500, 500), (1, 13, 13))
    bands[:, :300] = 0
    tif = map_rasters.utm(tmp_path / "i.tif", bands, tiled=True)
    (tmp_path / "b").mkdir()
    one, two = build(tif, tmp_path / "m.gpkg", workers=1), build(tif, tmp_path / "b" / "m.gpkg", workers=2)
    assert one.read_bytes() == two.read_bytes()


def test_a_raster_is_decoded_once_while_it_fits_into_the_cache(tmp_path: Path) -> None:
    """What was read once is there, though the file has lost its pixels since."""
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(512, 512), tiled=True, blockxsize=256, blockysize=256)
    with decoding(1), ImagerySource(tif) as source:
        first, _ = source.read(0, 0, 512, 512)
        with tif.open("r+b") as file:
            file.truncate(20_000)
        again, _ = source.read(0, 0, 512, 512)
    np.testing.assert_array_equal(first, again)


def test_an_imagery_error_in_a_worker_is_reported(tmp_path: Path) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", np.tile(map_rasters.texture(500, 500), (1, 13, 13)), tiled=True)
    tif.write_bytes(tif.read_bytes()[:60_000_000])
    with pytest.raises(MapError, match=r"i\.tif: cannot be read near column"):
        build(tif, tmp_path / "m.gpkg", workers=2)
    assert [p.name for p in tmp_path.iterdir()] == ["i.tif"]


@pytest.mark.slow
def test_a_full_disk_is_a_one_line_error_and_leaves_no_file(tmp_path: Path) -> None:
    """A file size limit simulates a full disk: the system returns an error in the same place."""
    tif = map_rasters.utm(tmp_path / "i.tif", np.tile(map_rasters.texture(500, 500), (1, 4, 4)))
    program = f"""import resource
from pathlib import Path
from terrafix.core.errors import OutputError
from terrafix_tools.mapping.build import build
resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))
try:
    build(Path({str(tif)!r}), Path({str(tmp_path / "out" / "m.gpkg")!r}))
except OutputError as error:
    print(error)"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert "m.gpkg: cannot be written" in done.stdout and done.stdout.count("\n") == 1, done.stderr
    assert list((tmp_path / "out").iterdir()) == []


def alive_in_group(group: int) -> list[str]:
    """Running processes of a process group; proc_pid_stat(5): pid (comm) state ppid pgrp."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            name, fields = path.read_text().rsplit(")", 1)
        except OSError:  # it has just exited
            continue
        state, _, pgrp = fields.split()[:3]
        if int(pgrp) == group and state != "Z":
            found.append(name)
    return found


@pytest.mark.slow
def test_ctrl_c_with_workers_leaves_no_file_and_no_process(tmp_path: Path) -> None:
    """As in a terminal: the interrupt goes to the whole process group."""
    tif = map_rasters.utm(tmp_path / "i.tif", np.tile(map_rasters.texture(500, 500), (1, 20, 20)), tiled=True)
    script = tmp_path / "program.py"
    script.write_text(f"""from pathlib import Path
from terrafix_tools.mapping.build import build
if __name__ == "__main__":
    build(Path({str(tif)!r}), Path({str(tmp_path / "out" / "m.gpkg")!r}), workers=2)""")
    child = subprocess.Popen([sys.executable, str(script)], stderr=subprocess.PIPE, start_new_session=True)
    deadline_s = time.monotonic() + 60
    while time.monotonic() < deadline_s and child.poll() is None:
        parts = list(tmp_path.glob("out/.m.gpkg.*/part.gpkg"))
        if parts and parts[0].stat().st_size > 1_000_000:
            break
        time.sleep(0.02)
    os.killpg(child.pid, signal.SIGINT)
    _, stderr = child.communicate(timeout=60)
    assert child.returncode != 0 and stderr.count(b"Traceback") <= 1  # of the parent only, not of a worker
    assert list((tmp_path / "out").iterdir()) == []
    deadline_s = time.monotonic() + 30
    while time.monotonic() < deadline_s and alive_in_group(child.pid):
        time.sleep(0.05)
    assert alive_in_group(child.pid) == []


@pytest.mark.parametrize("date", ["2024-13-01", "2024-1-1", "20240101", "2024-02-30"])
def test_invalid_dates_are_rejected(tmp_path: Path, date: str) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(64, 64))
    with pytest.raises(UsageError, match="YYYY-MM-DD"):
        build(tif, tmp_path / "m.gpkg", date=date)


def test_an_unusable_coordinate_system_is_rejected(tmp_path: Path) -> None:
    local = 'ENGCRS["Site",EDATUM["Pole"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]'
    corner = Affine(1, 0, 5, 0, -1, 5)
    tif = map_rasters.write_tif(tmp_path / "i.tif", map_rasters.texture(64, 64), local, corner)
    with pytest.raises(MapError, match=r"i\.tif: .*(not on the earth|no coordinate system)"):
        build(tif, tmp_path / "m.gpkg")
    far = Affine(1, 0, 3e9, 0, -1, 5e9)  # invalid UTM coordinates
    tif = map_rasters.write_tif(tmp_path / "j.tif", map_rasters.texture(64, 64), "EPSG:32651", far)
    with pytest.raises(MapError, match=r"j\.tif"):
        build(tif, tmp_path / "m.gpkg")
    assert not (tmp_path / "m.gpkg").exists()


def test_images_across_the_antimeridian_or_at_a_pole_are_rejected(tmp_path: Path) -> None:
    """There west is greater than east, and the centre of the map would be on the other side of the earth."""
    bands = map_rasters.texture(64, 64)
    places = {
        "antimeridian": ("EPSG:4326", Affine(0.01, 0, 179.7, 0, -0.01, 10.0)),
        "84": ("EPSG:3413", Affine(10.0, 0, -300.0, 0, -10.0, 300.0)),
    }
    for reason, (crs, corner) in places.items():
        with pytest.raises(MapError, match=rf"i\.tif: .*{reason}.*--area"):
            build(map_rasters.write_tif(tmp_path / "i.tif", bands, crs, corner), tmp_path / "m.gpkg")
    assert [path.name for path in tmp_path.iterdir()] == ["i.tif"]


def test_an_output_that_is_not_a_regular_file_is_not_replaced(tmp_path: Path) -> None:
    """A rename would replace a device or a pipe."""
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(64, 64))
    os.mkfifo(tmp_path / "pipe.gpkg")
    with pytest.raises(OutputError, match="is not a regular file"):
        build(tif, tmp_path / "pipe.gpkg")
    assert (tmp_path / "pipe.gpkg").is_fifo()
    with pytest.raises(OutputError, match=r"end in \.gpkg"):
        build(tif, tmp_path / "m.tif")
