"""Orthomosaic of a flight: pixels lie where the ground is, the file states date and accuracy, `map build` takes it."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from pyproj import CRS, Transformer
from typer.testing import CliRunner

import pointed_flight as rig
from flight_records import ORIGIN, PERIOD_NS
from terrafix import messages as m
from terrafix.core.camera import CameraCalibration
from terrafix.core.config import Config
from terrafix.core.errors import OutputError, SourceError, UsageError
from terrafix.core.geodesy import local_crs
from terrafix.map.package import MapPackage
from terrafix.recorder.provenance import header
from terrafix.recorder.writer import FlightWriter
from terrafix_tools.cli import app
from terrafix_tools.locate.locator import FlightLocator
from terrafix_tools.locate.views import CameraView
from terrafix_tools.mapping.area.build import with_statement
from terrafix_tools.mapping.orthomosaic.composite import Composite, OrthomosaicGrid, grid_around
from terrafix_tools.mapping.orthomosaic.frames import spread
from terrafix_tools.mapping.orthomosaic.make import OrthomosaicRequest, make
from terrafix_tools.mapping.orthomosaic.write import read_statement
from terrafix_tools.mapping.sources.spec import SourceSpec

FRAMES = 4
NOON_NS = 1_783_080_000_000_000_000  # 2026-07-03 12:00:00 UTC
UTM = CRS.from_epsg(32632)


def colours(e_m: np.ndarray, n_m: np.ndarray) -> np.ndarray:
    """Colour (..., 3) BGR of level ground: blue tells east, green north."""
    return np.stack([e_m + 90.0, n_m + 100.0, np.full_like(e_m, 50.0)], axis=-1)


def image(i: int) -> np.ndarray:
    """Frame ``i`` of the rig over that ground."""
    u, v = np.meshgrid(np.arange(rig.CAMERA.width), np.arange(rig.CAMERA.height))
    xy = CameraCalibration.of(rig.CAMERA).normalise(np.stack([u, v], axis=-1).reshape(-1, 2).astype(float))
    rays = np.column_stack([xy, np.ones(len(xy))]) @ rig.r_w_c().T
    ground = rig.camera_m(i)[:2] + rig.AGL_M * rays[:, :2] / -rays[:, 2:]
    shown = colours(ground[:, 0], ground[:, 1]).reshape(rig.CAMERA.height, rig.CAMERA.width, 3)
    return np.clip(np.rint(shown), 0, 255).astype(np.uint8)


def write_flight(folder: Path, *more: m.Message, images: bool = True) -> Path:
    writer = FlightWriter(folder / "flight.mcap", header(Config()))
    for message in (*rig.messages(FRAMES), *more):
        writer.write(message, message.t_ns)
        if images and isinstance(message, m.Frame):
            data = bytes(cv2.imencode(".png", image(message.frame_id))[1])
            writer.write_frame_image(message.t_ns, message.frame_id, data, "png")
    writer.close()
    return folder


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    clock = m.WallClock(t_ns=PERIOD_NS, unix_ns=NOON_NS, source="autopilot")
    return write_flight(tmp_path_factory.mktemp("run"), clock)


@pytest.fixture(scope="module")
def mosaic(flight: Path) -> Path:
    with rasterio.Env(GDAL_CACHEMAX=100_000):  # bytes: GDAL writes at once what it would keep of a large file
        make(OrthomosaicRequest(flight, flight / "mosaic.tif", gsd_m=0.5, flown_by="crew 7"))
    return flight / "mosaic.tif"


def test_each_pixel_shows_the_ground_at_its_coordinates(mosaic: Path) -> None:
    with rasterio.open(mosaic) as file:
        assert file.crs.to_epsg() == UTM.to_epsg() and file.res == (0.5, 0.5)
        red, green, blue, alpha = file.read().astype(float)
        row, column = np.nonzero(alpha)
        x, y = rasterio.transform.xy(file.transform, row, column)
    e_m, n_m = Transformer.from_crs(UTM, local_crs(48.0, 11.0), always_xy=True).transform(x, y)
    expected = colours(np.asarray(e_m), np.asarray(n_m))
    assert len(row) > 100_000
    shown = np.column_stack([blue[row, column], green[row, column], red[row, column]])
    inside = (expected[:, 0] < 254.0) & (expected[:, 0] > 1.0)
    assert np.abs(shown - expected)[inside].max() < 1.6


def test_ground_that_no_frame_shows_is_transparent(mosaic: Path) -> None:
    with rasterio.open(mosaic) as file:
        alpha = file.read(4)
        covered_m2 = float((alpha > 0).sum()) * 0.25
    along_m, across_m = rig.AGL_M * 600 / 500, rig.AGL_M * 800 / 500  # of one frame; the image top is east
    assert covered_m2 == pytest.approx((along_m + (FRAMES - 1) * rig.STEP_M) * across_m, rel=0.03)
    assert set(np.unique(alpha)) == {0, 255}


def test_file_is_a_cloud_optimised_geotiff_with_its_statement(mosaic: Path) -> None:
    with rasterio.open(mosaic) as file:
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert file.tags()["TERRAFIX_DATE"] == "2026-07-03"
        assert [c.name for c in file.colorinterp] == ["red", "green", "blue", "alpha"]
    stated = read_statement(mosaic)
    assert stated is not None
    assert (stated.date, stated.flown_by, stated.flight) == ("2026-07-03", "crew 7", mosaic.parent.name)


def test_accuracy_is_that_of_pixels_located_without_points(
    mosaic: Path, flight: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stated = read_statement(mosaic)
    assert stated is not None
    locator = FlightLocator.open(flight)
    no_points = locator.cloud(-1)
    monkeypatch.setattr(locator, "cloud", lambda _fragment: no_points)
    middle = locator.locate([("1", (399.5, 299.5))])
    corner = locator.locate([("1", (0.25 * 799, 0.25 * 599))])
    low, high = (2.146 * np.sqrt(np.trace(found.cov[:2, :2]) / 2.0) for found in (middle, corner))
    assert 0.9 * low < stated.ce90_m < 1.1 * high and low < high


def test_steepest_frame_is_shown() -> None:
    grid = OrthomosaicGrid(local_crs(48.0, 11.0), -100.0, 20.0, 1.0, 300, 40)
    made = Composite(grid, ORIGIN, None)
    views = {i: view_of(i) for i in range(FRAMES)}
    for i in (2, 0, 3, 1):
        made.add(views[i], image(i))
    below = [made.frame_of[20, 100 + int(rig.STEP_M * i)] for i in range(FRAMES)]
    assert below == [0, 1, 2, 3]
    assert made.frame_of[20, 100 + 9] == 0 and made.frame_of[20, 100 + 11] == 1


def test_relief_moves_what_a_frame_shows_to_its_place() -> None:
    """A plateau 20 m high fills the view: the same pixels are seen on ground that is nearer."""
    grid = OrthomosaicGrid(local_crs(48.0, 11.0), -40.0, 40.0, 1.0, 80, 80)
    made = Composite(grid, ORIGIN, lambda e_m, _n_m: np.full(e_m.shape, rig.START_AMSL_M + 20.0))
    made.add(view_of(0), image(0))
    east_m, north_m = np.array([24.5]), np.array([-15.5])  # a fifth nearer: 1.25 times as far on the level ground
    expected = colours(1.25 * east_m, 1.25 * north_m)[0]
    assert np.abs(made.image[55, 64].astype(float) - expected).max() < 1.6


def test_frame_outside_the_raster_draws_nothing() -> None:
    made = Composite(OrthomosaicGrid(local_crs(48.0, 11.0), 5000.0, 6000.0, 1.0, 50, 50), ORIGIN, None)
    made.add(view_of(0), image(0))
    assert not made.valid.any()


def view_of(i: int, sigma_m: float = 1.0) -> CameraView:
    return CameraView(
        frame_id=i,
        file="",
        t_ns=0,
        p_c_in_w_m=rig.camera_m(i),
        r_w_c=rig.r_w_c(),
        cov=np.diag([sigma_m**2, 0.5, 1.0, 1e-4, 1e-4, 1e-4]),
        calibration=CameraCalibration.of(rig.CAMERA),
        ground_m=rig.START_AMSL_M,
        fragment_id=0,
    )


def test_frames_with_uncertain_positions_and_near_ones_are_left_out() -> None:
    views = {0: view_of(0), 1: view_of(1, sigma_m=10.1), 2: view_of(2, sigma_m=9.9)}
    assert [view.frame_id for view in spread(views, 10.0)] == [0, 2]
    hovering = {i: view_of(0) for i in range(3)} | {3: view_of(1)}
    assert [view.p_c_in_w_m[0] for view in spread(hovering, 10.0)] == [0.0, 20.0]


def test_default_pixel_is_that_of_the_frames_and_the_raster_holds_all_of_them() -> None:
    grid = grid_around([view_of(i) for i in range(FRAMES)], ORIGIN, local_crs(48.0, 11.0), None)
    assert grid.gsd_m == pytest.approx(rig.AGL_M / rig.CAMERA.fx)
    assert grid.x_min == pytest.approx(-60.0, abs=0.3) and grid.y_max == pytest.approx(80.0, abs=0.3)
    assert grid.width_px * grid.gsd_m == pytest.approx(120.0 + 3 * rig.STEP_M, abs=0.5)


def test_too_fine_a_raster_is_refused_with_a_coarser_one() -> None:
    with pytest.raises(UsageError, match=r"too many; give a coarser --gsd, for example 0\.0\d"):
        grid_around([view_of(0)], ORIGIN, local_crs(48.0, 11.0), 0.002)


def test_other_file_states_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.tif").write_bytes(b"no raster")
    profile = {"driver": "GTiff", "width": 4, "height": 4, "count": 1, "dtype": "uint8"}
    with rasterio.open(
        tmp_path / "b.tif", "w", crs="EPSG:32632", transform=rasterio.Affine(2, 0, 0, 0, -2, 9), **profile
    ):
        pass
    assert [read_statement(tmp_path / name) for name in ("a.tif", "b.tif", "none.tif")] == [None] * 3


def test_map_build_takes_date_and_accuracy_of_the_mosaic(mosaic: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["map", "build", str(mosaic), "--out", str(tmp_path / "a.gpkg")])
    assert done.exit_code == 0, done.output
    layer = MapPackage.open(tmp_path / "a.gpkg").layer()
    stated = read_statement(mosaic)
    assert stated is not None and (layer.date, layer.ce90_m) == (stated.date, stated.ce90_m)


def test_mosaic_is_a_layer_of_its_own_unless_something_else_is_given(mosaic: Path) -> None:
    spec = with_statement(SourceSpec(path=str(mosaic)))
    assert spec.layer == f"flight {mosaic.parent.name} 2026-07-03"
    given = SourceSpec(path=str(mosaic), date="2026-01-01", ce90_m=3.0, layer="summer")
    assert with_statement(given) == given
    assert with_statement(SourceSpec(url="https://a/{z}/{x}/{y}")) == SourceSpec(url="https://a/{z}/{x}/{y}")


def test_command_says_what_was_made(flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "m.tif"
    done = CliRunner().invoke(app, ["map", "mosaic", str(flight), str(out), "--gsd", "1", "--date", "2025-05-05"])
    assert done.exit_code == 0, done.output
    assert "4 frames, 0.028 km2 at 1.00 m a pixel, CE90 " in done.output and "2025-05-05; written to" in done.output


def test_frames_of_the_source_are_taken_where_the_record_has_none(tmp_path: Path) -> None:
    source = tmp_path / "flight"
    (source / "frames").mkdir(parents=True)
    for i in range(FRAMES):
        cv2.imwrite(str(source / "frames" / f"{i:04d}.png"), image(i))
    rows = "".join(f"{i:04d}.png,{0.5 * i}\n" for i in range(FRAMES))
    (source / "frames.csv").write_text(f"file,t_s\n{rows}")
    (source / "flight.toml").write_text(
        "[camera]\nwidth = 800\nheight = 600\nfx = 500.0\nfy = 500.0\ncx = 399.5\ncy = 299.5\n"
        "[start]\nlat_deg = 48.0\nlon_deg = 11.0\n"
    )
    run = tmp_path / "run"
    run.mkdir()
    write_flight(run, images=False)
    with pytest.raises(SourceError, match="names no source; give its flight with --frames"):
        make(OrthomosaicRequest(run, tmp_path / "m.tif"))
    given = make(OrthomosaicRequest(run, tmp_path / "a.tif", frames=source, gsd_m=1.0))
    (run / "summary.json").write_text(json.dumps({"source": str(source)}))
    named = make(OrthomosaicRequest(run, tmp_path / "b.tif", gsd_m=1.0))
    assert given.frames == named.frames == FRAMES and given.statement.date == ""


@pytest.mark.parametrize(
    ("changed", "error", "words"),
    [
        ({"out": Path("m.png")}, UsageError, r"a GeoTIFF ends in \.tif"),
        ({"out": Path("/nowhere/m.tif")}, OutputError, "/nowhere: no such folder"),
        ({"date": "3 July"}, UsageError, "write it YYYY-MM-DD"),
        ({"max_sigma_m": 0.5}, SourceError, r"no frame has a position that is known to 0\.5 m; give a larger --sigma"),
    ],
)
def test_wrong_requests_are_named(
    flight: Path, tmp_path: Path, changed: dict[str, object], error: type[Exception], words: str
) -> None:
    options: dict[str, object] = {"out": tmp_path / "m.tif", **changed}
    with pytest.raises(error, match=words):
        make(OrthomosaicRequest(flight, **options))  # type: ignore[arg-type]
