"""The copter that flies forth and back without end: laps that join, and images that do not repeat."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terrafix.core.errors import UsageError
from terrafix.core.geodesy import LocalFrame
from terrafix.vision.repeated_picture import HISTORY
from terrafix_lab.chaos.scene import LEG_M, ChaosScene, course_of
from terrafix_lab.chaos.shuttle import WAY, A, endless, lap_of, lap_steps, shuttle_in
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.flights.folder import FRAME_HZ, Flight
from terrafix_lab.sim.flights.path import STEP_S, FlownPath
from terrafix_lab.sim.interfaces import State

FRAME = LocalFrame(48.0, 11.0)
SPEED_MPS = 9.7  # a lap is no whole number of periods of the camera
DRIFT = np.array([0.01, -0.005, 0.004])  # m per s: a later pass is elsewhere, as in gusts


class Slope:
    """Rises to the east."""

    def height_amsl_m(self, e_m: np.ndarray, n_m: np.ndarray) -> np.ndarray:
        return 500.0 + 0.1 * e_m + 0.0 * n_m


def states_along_the_way() -> list[State]:
    corners = np.array([A, *WAY])
    lengths = np.cumsum([0.0, *np.hypot(*np.diff(corners, axis=0).T)])
    states = []
    for k in range(int(lengths[-1] / SPEED_MPS / STEP_S)):
        t_s = k * STEP_S
        leg = int(np.searchsorted(lengths, SPEED_MPS * t_s, side="right")) - 1
        unit = (corners[leg + 1] - corners[leg]) / LEG_M
        place = np.array([*(corners[leg] + (SPEED_MPS * t_s - lengths[leg]) * unit), 600.0]) + t_s * DRIFT
        velocity = np.array([*(SPEED_MPS * unit), 0.0]) + DRIFT
        angles = math.atan2(unit[0], unit[1]) + 1e-3 * t_s, -0.1 + 1e-4 * t_s, 0.05
        none = np.zeros(3)
        states.append(State(t_s, place, velocity, *angles, 0.0, none, none, math.nan))
    return states


def flown() -> Flight:
    nothing: Any = None
    ground: Any = Slope()
    path = FlownPath(states_along_the_way())
    return Flight(Kind.COPTER, FRAME, ground, nothing, path, nothing, (0.0, 0.0), 500.0, path.duration_s)


@pytest.fixture(params=[FRAME_HZ, 30.0])
def scene(tmp_path: Path, request: pytest.FixtureRequest) -> ChaosScene:
    lap = replace(lap_of(flown()), frame_hz=request.param)
    (tmp_path / "frames").mkdir()
    for i in range(len(lap.frame_times_s())):
        (tmp_path / "frames" / f"{i:04d}.jpg").write_bytes(str(i).encode())
    course_of(lap, tmp_path)
    return endless(tmp_path, request.param)


def test_a_lap_of_parts_of_an_image_or_of_too_many_is_refused(tmp_path: Path) -> None:
    for camera_hz in (0.0, 7.0, 120.0):
        with pytest.raises(UsageError, match="multiple of 2 up to 60"):
            shuttle_in(tmp_path, 1, camera_hz)


def test_a_lap_lasts_whole_periods_of_the_camera_from_the_first_leg_until_it_is_flown_again() -> None:
    states = states_along_the_way()
    begin, count = lap_steps(states)
    assert states[begin].p_b_in_w_m[0] == pytest.approx(LEG_M / 2, abs=SPEED_MPS * STEP_S + 0.2)
    assert count * STEP_S * FRAME_HZ == round(count * STEP_S * FRAME_HZ)
    assert count * STEP_S == pytest.approx(4.0 * LEG_M / SPEED_MPS, abs=0.5 / FRAME_HZ)
    assert states[begin + count].velocity_enu_mps == pytest.approx(states[begin].velocity_enu_mps)


def test_position_and_attitude_have_no_jump_and_the_velocity_is_that_of_the_position_where_laps_join(
    scene: ChaosScene,
) -> None:
    lap_s = len(scene.jpegs) / scene.frame_hz
    times_s = lap_s + np.arange(-1.0, 1.0, 0.01)
    course = [scene.course(t_s) for t_s in times_s.tolist()]
    place_m = np.array([[*FRAME.to_local(s.lat_deg, s.lon_deg), s.amsl_m] for s in course])
    velocity_mps = np.array([[s.ve_mps, s.vn_mps, -s.vd_mps] for s in course])
    assert np.diff(place_m, axis=0) / 0.01 == pytest.approx(velocity_mps[1:], abs=0.005)
    angles = np.array([[s.yaw_rad, s.pitch_rad, s.roll_rad] for s in course])
    assert np.abs(np.diff(angles, axis=0)).max() < 1e-3
    assert course[100].agl_m == pytest.approx(600.0 - (500.0 + 0.1 * place_m[100, 0]), abs=0.3)
    later, first = scene.course(3.0 * lap_s + 7.0), scene.course(7.0)
    assert (later.lat_deg, later.lon_deg, later.yaw_rad) == pytest.approx((first.lat_deg, first.lon_deg, first.yaw_rad))


def test_no_image_is_one_of_those_that_vision_takes_for_a_stale_buffer(scene: ChaosScene) -> None:
    count = len(scene.jpegs)
    seen = [scene.jpeg(i / scene.frame_hz) for i in range(2 * count)]
    assert seen[count:] == seen[:count], "lap for lap the same"
    assert all(seen[i] not in seen[max(0, i - HISTORY) : i] for i in range(2 * count))
