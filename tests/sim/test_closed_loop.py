"""The closed loop: what the autopilot is told moves the aircraft, and the same seed flies the same flight."""

import csv
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terrafix_tools.mapping.build import build
from terrafix_tools.sim.autopilot.parameters import Gps, Kind
from terrafix_tools.sim.closed_loop.flight import Conditions, plan_over
from terrafix_tools.sim.closed_loop.loop import Flown, fly
from terrafix_tools.sim.flights.scene import Scene, scene_of_world
from terrafix_tools.sim.sensors.gnss_events import Drag, Jam, Outage
from terrafix_tools.sim.world import place as world

COMMAND = [sys.executable, "-m", "terrafix_tools.cli", "sim", "fly"]
Place = tuple[Scene, Path]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Place:
    """A small generated place: the camera sees it in autumn, the map is of summer."""
    folder = tmp_path_factory.mktemp("place")
    made = world.generate(3, width_m=1500.0, height_m=1300.0, gsd_m=0.5)
    world.write_image(folder / "map.tif", made, made.look("summer"))
    world.write_dem(folder / "dem.tif", made)
    build(folder / "map.tif", folder / "map.gpkg", dem=folder / "dem.tif", date="2020-07-10", licence="Generated.")
    return scene_of_world(made, made.look("autumn")), folder / "map.gpkg"


def flown(place: Place, out: Path, kind: Kind = Kind.PLANE, *, sees: bool = False, **options: Any) -> Flown:
    """``sees``: with a camera; without one only GNSS is left, and the flight is quickly simulated."""
    plan = plan_over(*place, kind, seed=3, length_m=20_000.0, **options)
    return fly(plan if sees else replace(plan, view=lambda _state, _index: None), out)


def track(out: Path) -> dict[str, np.ndarray]:
    """track.csv by column."""
    with (out / "track.csv").open() as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}


@pytest.mark.slow
def test_a_spoofed_position_moves_the_aircraft_the_other_way(place: Place, tmp_path: Path) -> None:
    pulled = Conditions(events=(Drag(start_s=20.0, east_mps=4.0),))
    flown(place, tmp_path / "honest", duration_s=60.0)
    flown(place, tmp_path / "pulled", duration_s=60.0, conditions=pulled)
    honest, spoofed = track(tmp_path / "honest"), track(tmp_path / "pulled")
    before = honest["t_s"] < 20.0
    assert np.array_equal(honest["east_m"][before], spoofed["east_m"][before])
    assert honest["error_m"].max() < 10.0
    # The belief follows the spoofer, and the aircraft flies where the belief is on the course: west of it.
    believed_off_m = spoofed["believed_east_m"] - spoofed["east_m"]
    assert believed_off_m[-1] == pytest.approx(160.0, abs=30.0)
    assert (honest["east_m"] - spoofed["east_m"])[-1] > 60.0


@pytest.mark.slow
def test_without_gnss_and_camera_a_plane_dead_reckons_and_a_copter_fails_safe(place: Place, tmp_path: Path) -> None:
    lost = Conditions(events=(Outage(start_s=30.0),))
    plane = flown(place, tmp_path / "plane", duration_s=60.0, conditions=lost)
    assert plane.peer.failsafes == 0
    assert 5.0 < track(tmp_path / "plane")["error_m"][-1] < 150.0
    copter = flown(place, tmp_path / "copter", Kind.COPTER, duration_s=60.0, conditions=lost)
    assert copter.peer.failsafes == 1
    assert any("EKF Failsafe: changed to LAND Mode" in text for text in copter.peer.autopilot_texts)


def test_frames_that_the_camera_does_not_give_are_rows_without_a_position(place: Place, tmp_path: Path) -> None:
    out = flown(place, tmp_path, duration_s=5.0, frame_hz=2.0)
    rows = list(csv.DictReader((tmp_path / "estimates.csv").read_text().splitlines()))
    assert len(rows) == out.summary["frames"] == 11
    assert len((tmp_path / "truth.csv").read_text().splitlines()) == 1 + 11


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(Kind))
def test_jammed_it_flies_on_gps_input(kind: Kind, place: Place, tmp_path: Path) -> None:
    jammed = Conditions(events=(Jam(start_s=15.0, fade_s=3.0),))
    result = flown(place, tmp_path, kind, sees=True, duration_s=45.0, conditions=jammed)
    peer = result.peer
    assert peer.failsafes == peer.rejected == peer.resets == 0
    assert peer.accepted > 150  # of 270 in the 27 s after the jam
    assert peer.healthy_share == 1.0
    assert track(tmp_path)["error_m"].max() < 25.0
    assert json.loads((tmp_path / "peer.json").read_text())["accepted"] == peer.accepted


@pytest.mark.slow
def test_as_the_only_gps(place: Place, tmp_path: Path) -> None:
    result = flown(place, tmp_path, sees=True, duration_s=30.0, gps=Gps.ALONE)
    assert result.peer.accepted > 200
    assert result.peer.not_in_use == 0
    assert track(tmp_path)["error_m"].max() < 25.0


@pytest.mark.slow
def test_the_same_seed_flies_the_same_flight(place: Place, tmp_path: Path) -> None:
    for name in ("one", "two"):
        flown(place, tmp_path / name, sees=True, duration_s=12.0)
    for file in ("estimates.csv", "truth.csv", "track.csv", "peer.json"):
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes(), file
    assert (tmp_path / "one" / "estimates.csv").read_text().count("satellite_anchored") > 10


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--duration", "-5"], 2, "--duration -5"),
        (["--jam-after", "-1"], 2, "--jam-after -1"),
        (["--frame-hz", "0"], 2, "--frame-hz 0"),
        (["--length-km", "-1"], 2, "--length-km -1"),
        (["--length-km", "1000"], 2, "--length-km 1000"),
        (["--spoof-after", "-1"], 2, "--spoof-after -1"),
        (["--image", "x.tif"], 2, "--image needs --map"),
        pytest.param(["--mission", "{far}"], 4, "outside the world", marks=pytest.mark.slow),
    ],
)
def test_what_cannot_be_flown_is_one_clear_line(arguments: list[str], code: int, said: str, tmp_path: Path) -> None:
    far = tmp_path / "far.waypoints"
    row = "\t0\t3\t16\t0\t0\t0\t0\t"
    far.write_text(f"QGC WPL 110\n0{row}47.0\t8.0\t0\t1\n1{row}47.1\t8.0\t100\t1\n")
    words = [word.replace("{far}", str(far)) for word in arguments]
    done = subprocess.run(
        [*COMMAND, "--out", str(tmp_path / "out"), *words], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == code, done.stderr
    assert done.stderr.strip().count("\n") == 0
    assert said in done.stderr


def test_a_folder_that_no_flight_made_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("precious")
    done = subprocess.run([*COMMAND, "--out", str(tmp_path)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 6
    assert "no fly made" in done.stderr
    assert (tmp_path / "thesis.txt").read_text() == "precious"
