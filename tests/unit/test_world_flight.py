"""The simulated flight: physics that a pilot would accept, sensors with honest errors, and the folder it leaves."""

import contextlib
import csv
import math
import tomllib
from pathlib import Path

import numpy as np
import pytest

from terrafix.core.errors import OutputError
from terrafix.vision.sources import open_source
from terrafix_tools.sim import world
from terrafix_tools.sim.trajectory import AIRSPEED_MPS
from terrafix_tools.sim.world_flight import FRAME_HZ, Flight, plan_flight, write_flight

DURATION_S = 90.0


@pytest.fixture(scope="module")
def flight() -> Flight:
    place = world.generate(2)
    return plan_flight(place, np.full((4000, 6000, 3), 90, np.uint8), DURATION_S)


def test_it_flies_kilometres_inside_the_map(flight: Flight) -> None:
    assert 1800.0 < flight.trajectory.length_m() < 2700.0
    for t_s in np.arange(0.0, DURATION_S, 1.0):
        p = flight.trajectory.state(float(t_s)).p_b_in_w_m
        x, y = flight.ground.px_from_local @ (p[0], p[1], 1.0)
        assert 500 < x < 5500 and 500 < y < 3500  # a quarter of a kilometre from the edge


def test_height_bank_and_turns_are_those_of_a_fixed_wing(flight: Flight) -> None:
    states = [flight.trajectory.state(float(t)) for t in np.arange(0.0, DURATION_S, 0.2)]
    agl = np.array([s.agl_m for s in states])
    assert agl.min() > 105.0 and agl.max() < 170.0 and np.ptp(agl) > 15.0
    roll = np.array([s.roll_rad for s in states])
    assert 0.25 < np.abs(roll).max() < math.radians(33.0)
    yaw_rate = np.diff(np.unwrap([s.yaw_rad for s in states])) / 0.2
    turning = np.abs(yaw_rate) > 0.1
    assert turning.any()
    coordinated = AIRSPEED_MPS * yaw_rate[turning] / 9.81  # tangent of the bank of a level turn
    assert float(np.median(np.abs(np.tan(roll[:-1][turning]) - coordinated))) < 0.06


def test_velocity_is_the_derivative_of_position(flight: Flight) -> None:
    for t_s in (3.0, 31.7, 62.2):
        before, after = flight.trajectory.state(t_s - 0.1), flight.trajectory.state(t_s + 0.1)
        difference = (after.p_b_in_w_m - before.p_b_in_w_m) / 0.2
        assert difference == pytest.approx(flight.trajectory.state(t_s).velocity_enu_mps, abs=0.15)


def test_wind_blows_the_aircraft_sideways(flight: Flight) -> None:
    drift = []
    for t_s in np.arange(0.0, DURATION_S, 1.0):
        s = flight.trajectory.state(float(t_s))
        course = math.atan2(s.velocity_enu_mps[0], s.velocity_enu_mps[1])
        drift.append(abs(math.remainder(course - s.yaw_rad, 2 * math.pi)))
    assert 0.08 < max(drift) < 0.4


def test_sensors_err_as_much_as_they_say(flight: Flight) -> None:
    yaw, roll, height = [], [], []
    for t_s in np.arange(0.0, DURATION_S, 0.5):
        truth, said = flight.trajectory.state(float(t_s)), flight.sensors.report(float(t_s))
        yaw.append(math.degrees(math.remainder(said.yaw_rad - truth.yaw_rad, 2 * math.pi)))
        roll.append(math.degrees(said.roll_rad - truth.roll_rad))
        height.append(said.agl_m - (float(truth.p_b_in_w_m[2]) - flight.ground_amsl_m))
    assert 1.5 < abs(float(np.mean(yaw))) < 2.5
    assert 0.3 < float(np.std(roll)) < 0.8
    assert abs(float(np.mean(height))) < 8.0 and 0.3 < float(np.std(height)) < 1.5


@pytest.mark.parametrize("telemetry", [True, False])
def test_the_folder_is_complete_and_agrees_with_the_truth(telemetry: bool, tmp_path: Path) -> None:
    place = world.generate(2)
    short = plan_flight(place, np.full((4000, 6000, 3), 90, np.uint8), 2.0)
    seen: list[tuple[int, int]] = []
    write_flight(tmp_path, short, "../map.gpkg", seed=2, telemetry=telemetry, progress=lambda *step: seen.append(step))
    count = round(2.0 * FRAME_HZ)
    assert seen[-1] == (count, count)
    with (tmp_path / "frames.csv").open() as file:
        said = list(csv.DictReader(file))
    with (tmp_path / "truth.csv").open() as file:
        truth = list(csv.DictReader(file))
    assert [row["file"] for row in said] == [row["file"] for row in truth]
    assert all((tmp_path / "frames" / row["file"]).is_file() for row in said)
    assert ("yaw_deg" in said[0]) == telemetry
    with contextlib.closing(open_source(str(tmp_path))) as source:
        shots = list(source.shots())
    assert len(shots) == count and not any(shot.frame.error for shot in shots)
    assert bool(shots[-1].states) == telemetry
    about = tomllib.loads((tmp_path / "flight.toml").read_text())
    assert about["map"] == "../map.gpkg"
    state = short.trajectory.state(float(said[2]["t_s"]))
    e_m, n_m = short.frame.to_local(float(truth[2]["lat_deg"]), float(truth[2]["lon_deg"]))
    assert (e_m, n_m) == pytest.approx(tuple(state.p_b_in_w_m[:2]), abs=0.02)


def test_an_unwritable_folder_is_one_clear_line(tmp_path: Path) -> None:
    place = world.generate(2, width_m=1600.0, height_m=1200.0)
    short = plan_flight(place, np.full((2400, 3200, 3), 90, np.uint8), 1.0)
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="cannot be written"):
        write_flight(tmp_path / "file", short, "map.gpkg", seed=2)
