"""Generated flights: course, output folder, and rejected options."""

import contextlib
import csv
import math
import tomllib
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine
from typer.testing import CliRunner

from terrafix.core.errors import OutputError, SourceError, TerrafixError, UsageError
from terrafix.core.mavlink.tlog import read_tlog
from terrafix.vision.sources import open_source
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.camera.render import Renderer
from terrafix_lab.sim.flights.folder import (
    CAMERA,
    FRAME_HZ,
    Flight,
    flight_over,
    mission_over,
    plan_flight,
    write_flight,
)
from terrafix_lab.sim.flights.make import FlightOptions, make, write_map
from terrafix_lab.sim.flights.scene import Scene, scene_of_image, scene_of_place, scene_of_world
from terrafix_lab.sim.world import place as world
from terrafix_tools.cli import app
from terrafix_tools.mapping.build import build_package, layer_of
from terrafix_tools.mission.items import Box

DURATION_S = 90.0
GREY = np.full((4000, 6000, 3), 90, np.uint8)


@pytest.fixture(scope="module")
def place() -> world.World:
    return world.generate(2)


@pytest.fixture(scope="module")
def flight(place: world.World) -> Flight:
    return plan_flight(place, GREY, DURATION_S)


@pytest.fixture(scope="module")
def small() -> Scene:
    place = world.generate(2, width_m=1600.0, height_m=1200.0)
    return scene_of_world(place, np.full((2400, 3200, 3), 90, np.uint8))


@pytest.fixture
def image(tmp_path: Path) -> Path:
    """A square kilometre of noise, UTM 33."""
    path = tmp_path / "image.tif"
    rng = np.random.default_rng(1)
    profile = {"driver": "GTiff", "width": 1000, "height": 1000, "count": 3, "dtype": "uint8", "crs": "EPSG:32633"}
    with rasterio.open(path, "w", transform=Affine(1.0, 0.0, 500_000.0, 0.0, -1.0, 5_300_000.0), **profile) as file:
        file.write(rng.integers(0, 255, (3, 1000, 1000), dtype=np.uint8))
    return path


def test_a_generated_flight_covers_kilometres_inside_the_world(place: world.World, flight: Flight) -> None:
    assert 1700.0 < flight.path.length_m(DURATION_S) < 2500.0
    box = scene_of_world(place, GREY).box.shrunk(150.0)
    for t_s in np.arange(0.0, DURATION_S, 1.0):
        assert box.contains(*flight.path.state(float(t_s)).p_b_in_w_m[:2])


def test_the_scene_is_as_large_as_its_image(place: world.World, image: Path) -> None:
    def size(box: Box) -> tuple[float, float]:
        return box.east_m - box.west_m, box.north_m - box.south_m

    assert size(scene_of_world(place, GREY).box) == pytest.approx((3000.0, 2000.0), rel=0.02)
    scene: Scene = scene_of_image(image, None)
    assert size(scene.box) == pytest.approx((1000.0, 1000.0), rel=0.01)
    assert scene.height()(10.0, 20.0) == 0.0


def test_the_state_is_interpolated_linearly_between_steps(flight: Flight) -> None:
    a, b = flight.path.states[700], flight.path.states[701]
    middle = flight.path.state((a.t_s + b.t_s) / 2)
    assert middle.p_b_in_w_m == pytest.approx((a.p_b_in_w_m + b.p_b_in_w_m) / 2)
    assert flight.path.state(a.t_s).p_b_in_w_m == pytest.approx(a.p_b_in_w_m)
    assert flight.path.state(1e6).t_s == flight.path.states[-1].t_s


def test_the_error_of_the_start_is_within_its_stated_sigma(flight: Flight) -> None:
    start = flight.frame.to_local(*flight.start_wgs84)
    assert 0.1 < math.dist(start, flight.path.states[0].p_b_in_w_m[:2]) < 75.0


@pytest.mark.slow
@pytest.mark.parametrize("telemetry", [True, False])
def test_the_flight_folder_is_complete_and_matches_the_truth(small: Scene, telemetry: bool, tmp_path: Path) -> None:
    short = flight_over(small, seed=2, duration_s=2.0)
    seen: list[tuple[int, int]] = []
    write_flight(tmp_path, short, "../map.gpkg", seed=2, telemetry=telemetry, progress=lambda *step: seen.append(step))
    count = round(2.0 * FRAME_HZ)
    assert seen[-1] == (count, count)
    with (tmp_path / "frames.csv").open() as file:
        frame_rows = list(csv.DictReader(file))
    with (tmp_path / "truth.csv").open() as file:
        truth = list(csv.DictReader(file))
    assert [row["file"] for row in frame_rows] == [row["file"] for row in truth]
    assert all((tmp_path / "frames" / row["file"]).is_file() for row in frame_rows)
    with contextlib.closing(open_source(str(tmp_path))) as source:
        shots = list(source.shots())
    assert len(shots) == count and not any(shot.frame.error for shot in shots)
    assert bool(shots[-1].states) == telemetry
    assert tomllib.loads((tmp_path / "flight.toml").read_text())["map"] == "../map.gpkg"
    state = short.path.state(float(frame_rows[2]["t_s"]))
    e_m, n_m = short.frame.to_local(float(truth[2]["lat_deg"]), float(truth[2]["lon_deg"]))
    assert (e_m, n_m) == pytest.approx(tuple(state.p_b_in_w_m[:2]), abs=0.02)


def test_the_errors_of_the_log_match_flight_toml(flight: Flight, tmp_path: Path) -> None:
    flight.telemetry.write(tmp_path / "telemetry.tlog")
    yaw, roll, height = [], [], []
    for reading in read_tlog(tmp_path / "telemetry.tlog"):
        truth = flight.path.state(reading.t_ns / 1e9)
        if reading.yaw_rad is not None and reading.roll_rad is not None:
            yaw.append(math.degrees(math.remainder(reading.yaw_rad - truth.yaw_rad, math.tau)))
            roll.append(math.degrees(reading.roll_rad - truth.roll_rad))
        elif reading.agl_m is not None:
            height.append(reading.agl_m - (float(truth.p_b_in_w_m[2]) - flight.ground_amsl_m))
    assert len(yaw) >= 50 * DURATION_S and len(height) >= 10 * DURATION_S
    assert 0.2 < np.abs(yaw).max() < 12.0
    assert 0.05 < np.std(roll) < 1.0 and np.abs(roll).max() < 3.0
    assert np.abs(height).max() < 9.0


@pytest.mark.slow
def test_the_same_seed_gives_the_same_flight(place: world.World) -> None:
    scene = scene_of_world(place, GREY)
    ends = [flight_over(scene, Kind.COPTER, seed=seed, duration_s=5.0).path.states[-1].p_b_in_w_m for seed in (5, 5, 6)]
    assert np.array_equal(ends[0], ends[1]) and not np.allclose(ends[0], ends[2])


@pytest.mark.slow
def test_without_a_duration_the_flight_ends_with_the_mission(small: Scene) -> None:
    mission = mission_over(small, Kind.PLANE, seed=1, length_m=2500.0, agl_m=120.0)
    done = flight_over(small, seed=1, mission=mission)
    assert done.path.length_m() == pytest.approx(2500.0, rel=0.12)
    assert done.duration_s == pytest.approx(2500.0 / 22.0, rel=0.2)


@pytest.mark.slow
def test_the_command_makes_a_readable_flight_folder(image: Path, tmp_path: Path) -> None:
    """Over an image, from a mission file, with a jammed receiver."""
    make(tmp_path / "a", FlightOptions(image=image, vehicle=Kind.COPTER, agl_m=60.0, length_km=0.5, duration_s=1.0))
    out = tmp_path / "b"
    arguments = ["sim", "make", "--out", str(out), "--image", str(image), "--vehicle", "copter", "--quiet"]
    arguments += ["--mission", str(tmp_path / "a" / "mission.waypoints"), "--duration", "3", "--jam-after", "1"]
    done = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "6 frames" in done.output
    with contextlib.closing(open_source(str(out))) as source:
        assert len(list(source.shots())) == 6
        assert source.map_hint() == (out / "map.gpkg").resolve()
    assert (out / "map.gpkg").is_file() and (out / "telemetry.tlog").stat().st_size > 10_000


@pytest.mark.slow
def test_the_command_generates_a_place_and_its_map(tmp_path: Path) -> None:
    arguments = ["sim", "make", "--out", str(tmp_path / "a"), "--size-km", "0.6", "--seed", "3", "--vehicle", "copter"]
    arguments += ["--agl", "50", "--duration", "1", "--quiet"]
    done = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    with contextlib.closing(open_source(str(tmp_path / "a"))) as source:
        shots = list(source.shots())
    assert len(shots) == 2 and all(shot.image is not None and np.std(shot.image) > 5.0 for shot in shots)
    with rasterio.open(tmp_path / "a" / "map.tif") as file:
        assert (file.width * file.res[0], file.height * file.res[1]) == (600.0, 600.0)
    assert (tmp_path / "a" / "map.gpkg").stat().st_size > 50_000


def test_a_place_rendered_on_demand_equals_the_whole_place() -> None:
    place = world.generate(3, width_m=600.0, height_m=600.0)
    whole, made = scene_of_world(place, place.render("autumn")), scene_of_place(place, "autumn")
    assert made.box == whole.box
    assert made.height()(50.0, -80.0) == whole.height()(50.0, -80.0)
    down = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    above = np.array([20.0, 10.0, made.height()(20.0, 10.0) + 60.0])
    seen = [Renderer(scene.ground, CAMERA, seed=1).frame(above, down, 0).astype(float) for scene in (whole, made)]
    assert np.abs(seen[0] - seen[1]).mean() < 3.0


@pytest.mark.parametrize(
    ("changes", "kind", "reason"),
    [
        ({"size_km": 50.0}, UsageError, "100 km2"),
        ({"size_km": 2.0, "image": Path("a.tif")}, UsageError, "--size-km"),
        ({"duration_s": -5.0}, UsageError, "--duration -5"),
        ({"duration_s": math.nan}, UsageError, "--duration nan"),
        ({"length_km": 0.0}, UsageError, "--length-km 0"),
        ({"agl_m": 5.0}, UsageError, "--agl 5"),
        ({"jam_after_s": -1.0}, UsageError, "--jam-after -1"),
        ({"dem": Path("dem.tif")}, UsageError, "belong to --image"),
        ({"mission": Path("m.plan"), "length_km": 2.0}, UsageError, "omit --length-km and"),
        ({"mission": Path("m.plan")}, SourceError, "no such mission file"),
        ({"events": Path("e.toml")}, SourceError, "--events"),
    ],
)
def test_invalid_options_are_rejected_before_anything_is_written(
    changes: dict[str, object], kind: type[TerrafixError], reason: str, tmp_path: Path
) -> None:
    with pytest.raises(kind, match=reason):
        make(tmp_path / "out", FlightOptions(**changes))  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()


def test_a_map_package_of_two_layers_is_taken_as_it_is(image: Path, tmp_path: Path) -> None:
    package = build_package([layer_of(image), layer_of(image, date="2020-05-01")], tmp_path / "two.gpkg")
    write_map(tmp_path / "map.gpkg", FlightOptions(image=image, map_path=package), None)
    assert (tmp_path / "map.gpkg").read_bytes() == package.read_bytes()


def test_a_mission_outside_the_image_or_without_room_is_an_error(image: Path, tmp_path: Path) -> None:
    (tmp_path / "m.waypoints").write_text(
        "QGC WPL 110\n0 1 0 16 0 0 0 0 47.85 15.0 0 1\n1 0 3 16 0 0 0 0 47.95 15.0 100 1\n"
    )
    with pytest.raises(SourceError, match="outside the world"):
        make(tmp_path / "out", FlightOptions(image=image, mission=tmp_path / "m.waypoints"))
    (tmp_path / "m.waypoints").write_text(
        "QGC WPL 110\n0 1 0 16 0 0 0 0 47.850 15.007 0 1\n1 0 0 16 0 0 0 0 47.850 15.007 -50 1\n"
    )
    with pytest.raises(SourceError, match="50 m in the ground"):
        make(tmp_path / "out", FlightOptions(image=image, mission=tmp_path / "m.waypoints"))
    with pytest.raises(UsageError, match="larger image"):
        make(tmp_path / "out", FlightOptions(image=image, agl_m=300.0))
    assert not (tmp_path / "out").exists()


def test_an_unwritable_folder_is_one_clear_line(small: Scene, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="choose another --out"):
        make(tmp_path / "file", FlightOptions())
    with pytest.raises(OutputError, match="cannot be written"):
        write_flight(tmp_path / "file", flight_over(small, seed=1, duration_s=1.0), "map.gpkg", seed=2)
