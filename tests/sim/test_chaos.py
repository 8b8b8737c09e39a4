"""One cell of the fault matrix with the real processes: a short flight over a small place."""

from collections.abc import Callable
from pathlib import Path

import pytest

from terrafix_lab.chaos.run import fly_cell
from terrafix_lab.chaos.scene import ChaosScene, course_of
from terrafix_lab.faults.fault import Phase
from terrafix_lab.faults.processes import killed
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.flights.folder import flight_over, write_flight
from terrafix_lab.sim.flights.scene import scene_of_place
from terrafix_lab.sim.world import place as world
from terrafix_lab.sim.world.mapped import CAMERA_SEASON, write_map

pytestmark = [pytest.mark.real_time, pytest.mark.slow]
SEED, SIDE_M, AGL_M, DURATION_S = 3, 700.0, 90.0, 24.0
RESTART_LIMIT_S = 4.0
BUSY = 2.0  # load average a core; Terrafix alone is below 1


def small_scene(folder: Path) -> ChaosScene:
    place = world.generate(SEED, width_m=SIDE_M, height_m=SIDE_M)
    write_map(place, folder / "map.gpkg")
    ground = scene_of_place(place, CAMERA_SEASON)
    flight = flight_over(ground, Kind.COPTER, seed=SEED, duration_s=DURATION_S, agl_m=AGL_M)
    write_flight(folder, flight, "map.gpkg", seed=SEED, telemetry=False)
    jpegs = sorted((folder / "frames").glob("*.jpg"))
    return ChaosScene(folder / "map.gpkg", jpegs, course_of(flight, folder), {Phase.START: 1.0}, DURATION_S)


def test_the_link_killed_before_the_first_fix_comes_back_with_a_right_position(
    tmp_path: Path, stall_ms: Callable[[], float]
) -> None:
    scene = small_scene(tmp_path)
    outcome = fly_cell(scene, killed("link"), Phase.START, tmp_path / "cell", seed=SEED)
    assert outcome.wrong == 0, outcome
    assert outcome.silence_s is not None and outcome.silence_s < RESTART_LIMIT_S + stall_ms() / 1e3
    assert outcome.not_recorded_s is not None and outcome.not_recorded_s < 1.0
    if outcome.verdict != "ok" and outcome.load is not None and outcome.load > BUSY:
        pytest.skip(f"a load of {outcome.load:.0f} a core leaves map matching too little of the processors")
    assert outcome.verdict == "ok" and outcome.fixes > 20, outcome
    assert not (tmp_path / "cell").exists(), "the folder of a cell without a broken promise is removed"
