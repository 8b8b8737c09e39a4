"""Closed loop of autopilot and vehicle: GPS errors move the aircraft, and the same seed gives the same flight."""

import csv
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from terrafix.core.errors import OutputError
from terrafix_lab.sim.autopilot.parameters import Gps, Kind
from terrafix_lab.sim.closed_loop.flight import Conditions, plan_over
from terrafix_lab.sim.closed_loop.loop import Flown, fly
from terrafix_lab.sim.flights.scene import Scene, scene_of_world
from terrafix_lab.sim.sensors.gnss_events import Drag, Jam, Outage
from terrafix_lab.sim.world import place as world
from terrafix_tools.cli import app, main
from terrafix_tools.mapping.build import build

COMMAND = ["terrafix", "sim", "fly"]
Place = tuple[Scene, Path]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Place:
    """A small generated place: the camera images show autumn, the map summer."""
    folder = tmp_path_factory.mktemp("place")
    generated = world.generate(3, width_m=1500.0, height_m=1300.0, gsd_m=0.5)
    world.write_image(folder / "map.tif", generated, generated.render("summer"))
    world.write_dem(folder / "dem.tif", generated)
    build(folder / "map.tif", folder / "map.gpkg", dem=folder / "dem.tif", date="2020-07-10", licence="Generated.")
    return scene_of_world(generated, generated.render("autumn")), folder / "map.gpkg"


def run_flight(place: Place, out: Path, kind: Kind = Kind.PLANE, *, camera: bool = False, **options: Any) -> Flown:
    """Runs a flight. ``camera``: with images; without them only GNSS is left, and the simulation is fast."""
    plan = plan_over(*place, kind, seed=3, length_m=20_000.0, **options)
    return fly(plan if camera else replace(plan, view=lambda _state, _index: None), out)


def track(out: Path) -> dict[str, np.ndarray]:
    """-> columns of track.csv."""
    with (out / "track.csv").open() as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}


@pytest.mark.slow
def test_a_spoofed_gnss_position_moves_the_aircraft_in_the_opposite_direction(place: Place, tmp_path: Path) -> None:
    pulled = Conditions(events=(Drag(start_s=20.0, east_mps=4.0),))
    run_flight(place, tmp_path / "honest", duration_s=60.0)
    run_flight(place, tmp_path / "pulled", duration_s=60.0, conditions=pulled)
    honest, spoofed = track(tmp_path / "honest"), track(tmp_path / "pulled")
    before = honest["t_s"] < 20.0
    assert np.array_equal(honest["east_m"][before], spoofed["east_m"][before])
    assert honest["error_m"].max() < 10.0
    # The position of the autopilot follows the spoofer and is kept on the course: the aircraft is west of it.
    error_m = spoofed["believed_east_m"] - spoofed["east_m"]
    assert error_m[-1] == pytest.approx(160.0, abs=30.0)
    assert (honest["east_m"] - spoofed["east_m"])[-1] > 60.0


@pytest.mark.slow
def test_without_gnss_and_camera_a_plane_dead_reckons_and_a_copter_fails_safe(place: Place, tmp_path: Path) -> None:
    lost = Conditions(events=(Outage(start_s=30.0),))
    plane = run_flight(place, tmp_path / "plane", duration_s=60.0, conditions=lost)
    assert plane.peer.failsafes == 0
    assert 5.0 < track(tmp_path / "plane")["error_m"][-1] < 150.0
    copter = run_flight(place, tmp_path / "copter", Kind.COPTER, duration_s=60.0, conditions=lost)
    assert copter.peer.failsafes == 1
    assert any("EKF Failsafe: changed to LAND Mode" in text for text in copter.peer.autopilot_texts)


def test_missing_camera_frames_are_rows_without_a_position(place: Place, tmp_path: Path) -> None:
    out = run_flight(place, tmp_path, duration_s=5.0, frame_hz=2.0)
    rows = list(csv.DictReader((tmp_path / "estimates.csv").read_text().splitlines()))
    assert len(rows) == out.summary["frames"] == 11
    assert len((tmp_path / "truth.csv").read_text().splitlines()) == 1 + 11


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(Kind))
def test_the_aircraft_flies_on_gps_input_while_gnss_is_jammed(kind: Kind, place: Place, tmp_path: Path) -> None:
    jammed = Conditions(events=(Jam(start_s=15.0, fade_s=3.0),))
    result = run_flight(place, tmp_path, kind, camera=True, duration_s=45.0, conditions=jammed)
    peer = result.peer
    assert peer.failsafes == peer.rejected == peer.resets == 0
    assert peer.accepted > 150  # of 270 in the 27 s after the jam
    assert peer.healthy_share == 1.0
    assert track(tmp_path)["error_m"].max() < 25.0
    assert json.loads((tmp_path / "peer.json").read_text())["accepted"] == peer.accepted


@pytest.mark.slow
def test_the_aircraft_flies_with_gps_input_as_its_only_gps(place: Place, tmp_path: Path) -> None:
    result = run_flight(place, tmp_path, camera=True, duration_s=30.0, gps=Gps.ALONE)
    assert result.peer.accepted > 200
    assert result.peer.not_in_use == 0
    assert track(tmp_path)["error_m"].max() < 25.0


@pytest.mark.slow
def test_the_same_seed_gives_identical_output_files(place: Place, tmp_path: Path) -> None:
    for name in ("one", "two"):
        run_flight(place, tmp_path / name, camera=True, duration_s=12.0)
    for file in ("estimates.csv", "truth.csv", "track.csv", "peer.json"):
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes(), file
    assert (tmp_path / "one" / "estimates.csv").read_text().count("satellite_anchored") > 10


@pytest.mark.parametrize(
    ("arguments", "code", "expected"),
    [
        (["--duration", "-5"], 2, "--duration -5"),
        (["--jam-after", "-1"], 2, "--jam-after -1"),
        (["--frame-hz", "0"], 2, "--frame-hz 0"),
        (["--length-km", "-1"], 2, "--length-km -1"),
        (["--length-km", "1000"], 2, "--length-km 1000"),
        (["--spoof-after", "-1"], 2, "--spoof-after -1"),
        (["--image", "x.tif"], 2, "--image needs --map"),
        (["--mission", "{far}"], 4, "outside the world"),
    ],
)
def test_an_impossible_flight_is_an_error_of_one_line(
    arguments: list[str],
    code: int,
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    far = tmp_path / "far.waypoints"
    row = "\t0\t3\t16\t0\t0\t0\t0\t"
    far.write_text(f"QGC WPL 110\n0{row}47.0\t8.0\t0\t1\n1{row}47.1\t8.0\t100\t1\n")
    filled = [part.replace("{far}", str(far)) for part in arguments]
    monkeypatch.setattr(sys, "argv", [*COMMAND, "--out", str(tmp_path / "out"), *filled])
    with pytest.raises(SystemExit) as ended:
        main()
    printed = capsys.readouterr().err
    assert ended.value.code == code, printed
    assert printed.strip().count("\n") == 0
    assert expected in printed


def test_sim_fly_does_not_write_into_a_foreign_folder(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("precious")
    refused = CliRunner().invoke(app, ["sim", "fly", "--out", str(tmp_path)])
    assert isinstance(refused.exception, OutputError) and "not made by fly" in str(refused.exception)
    assert (tmp_path / "thesis.txt").read_text() == "precious"
