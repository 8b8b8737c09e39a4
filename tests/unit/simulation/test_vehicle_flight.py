"""Vehicle models: plausible flight, within limits, steering by the navigation solution."""

import math

import numpy as np
import pytest

from terrafix_lab.sim.vehicle.copter import Copter, CopterLimits
from terrafix_lab.sim.vehicle.plane import Plane, PlaneLimits
from terrafix_lab.sim.vehicle.wind import Gusts, Wind
from terrafix_tools.mission.course import course
from terrafix_tools.mission.items import AltitudeFrame, Box, Do, Item
from vehicle_missions import HOME, PLACE, STEP_S, at, flat, fly, hills, mission, positions

CALM = Wind(0.0, 0.0)
G = 9.80665
LEG = mission(at(Do.WAYPOINT, *HOME), at(Do.WAYPOINT, 100.0, 3000.0))
CORNERS = mission(
    at(Do.WAYPOINT, *HOME),
    at(Do.WAYPOINT, 100.0, 600.0),
    at(Do.WAYPOINT, 700.0, 600.0, 160.0),
    at(Do.WAYPOINT, 700.0, -900.0, 160.0),
)


def test_turns_are_coordinated_and_within_the_bank_limit() -> None:
    plane = Plane(CORNERS, PLACE, flat, wind=CALM)
    states = fly(plane, 80.0)
    roll = np.array([s.roll_rad for s in states])
    assert 0.45 < np.abs(roll).max() < PlaneLimits().bank_rad + math.radians(2.0)
    roll_rate = np.diff(roll) / STEP_S
    assert 0.2 < np.abs(roll_rate).max() <= math.radians(61.0)
    yaw_rate = np.gradient(np.unwrap([s.yaw_rad for s in states]), STEP_S)
    speed = np.array([s.airspeed_mps for s in states])
    turning = np.abs(roll) > 0.3
    assert turning.sum() > 100
    assert yaw_rate[turning] == pytest.approx((G * np.tan(roll) / speed)[turning], abs=0.02)
    aside = np.array([s.force_b_mps2[1] for s in states])
    assert np.abs(aside).max() < 0.8  # no sideslip acceleration


def test_climb_speed_and_height_are_held() -> None:
    plane = Plane(CORNERS, PLACE, flat, wind=CALM)
    states = fly(plane, 120.0)
    climb = np.array([s.velocity_enu_mps[2] for s in states])
    assert climb.max() <= PlaneLimits().climb_mps + 0.01
    assert climb.max() > 2.0
    assert states[-1].agl_m == pytest.approx(160.0, abs=2.0)
    assert np.abs(np.array([s.airspeed_mps for s in states]) - 22.0).max() < 1.0


def test_heights_refer_to_sea_level_home_or_the_ground_below() -> None:
    """All three are the same height at the waypoint; over hills only one follows the ground."""
    for altitude_frame, wanted in ((AltitudeFrame.SEA, 520.0), (AltitudeFrame.HOME, 520.0 - hills(*HOME))):
        flown = mission(*(at(Do.WAYPOINT, 100.0, n, wanted, altitude_frame=altitude_frame) for n in (-50.0, 4000.0)))
        plane = Plane(flown, PLACE, hills, wind=CALM)
        up = positions(fly(plane, 60.0))[:, 2]
        assert np.abs(up - 520.0).max() < 1.0, altitude_frame
    flown = mission(*(at(Do.WAYPOINT, 100.0, n, 120.0, altitude_frame=AltitudeFrame.GROUND) for n in (-50.0, 4000.0)))
    plane = Plane(flown, PLACE, hills, wind=CALM)
    states = fly(plane, 60.0)
    assert np.abs([s.agl_m - 120.0 for s in states]).max() < 8.0
    assert np.ptp(positions(states)[:, 2]) > 10.0
    for s in states[::100]:
        assert s.agl_m == pytest.approx(s.p_b_in_w_m[2] - hills(*s.p_b_in_w_m[:2]), abs=0.3)


@pytest.mark.parametrize("vehicle", [Plane, Copter])
def test_the_vehicle_steers_by_the_given_navigation(vehicle: type[Plane] | type[Copter]) -> None:
    """A navigation error of 40 m to the east moves it 40 m west of its leg; the physics uses the truth."""
    made = vehicle(LEG, PLACE, flat, wind=CALM)
    states = fly(made, 60.0, np.array([40.0, 0.0, -5.0]))
    last = states[-1].p_b_in_w_m
    assert last[0] == pytest.approx(HOME[0] - 40.0, abs=2.0)
    assert states[-1].agl_m == pytest.approx(105.0, abs=1.5)


def test_wind_drifts_the_nose_and_not_the_track() -> None:
    plane = Plane(LEG, PLACE, flat, wind=Wind(6.0, 0.0, turbulence=0.0))
    states = fly(plane, 60.0)
    assert abs(states[-1].p_b_in_w_m[0] - HOME[0]) < 10.0
    assert math.sin(states[-1].yaw_rad) == pytest.approx(-6.0 / 22.0, abs=0.03)


def test_a_plane_takes_off_and_lands_at_its_points() -> None:
    flown = course(4, 4000.0, Box(-900.0, -600.0, 900.0, 600.0), PLACE, agl_m=100.0, from_ground=True)
    plane = Plane(flown, PLACE, flat, seed=4)
    states = fly(plane, 320.0)
    assert plane.finished
    assert max(s.agl_m for s in states) == pytest.approx(100.0, abs=12.0)
    assert states[300].airspeed_mps < 6.0 and states[300].agl_m == 0.0  # stands for the sensor calibration
    flying = [i for i, s in enumerate(states) if s.agl_m > 1.0]
    touch = states[flying[-1]].p_b_in_w_m[:2]
    assert math.dist(touch, PLACE.to_local(flown.items[-1].lat_deg, flown.items[-1].lon_deg)) < 30.0
    assert np.linalg.norm(states[-1].velocity_enu_mps) < 0.01
    assert min(s.agl_m for s in states) > -0.5
    sink = states[flying[-1]].velocity_enu_mps[2]
    assert -1.5 < sink < 0.0


def test_a_copter_takes_off_waits_circles_and_lands_on_the_point() -> None:
    flown = mission(
        Item(Do.TAKE_OFF, height_m=30.0),
        at(Do.WAYPOINT, 200.0, -50.0, 40.0, amount=8.0),
        at(Do.LOITER_TURNS, 200.0, 100.0, 40.0, amount=1.0, radius_m=25.0),
        at(Do.LAND, 100.0, 100.0, 0.0),
    )
    copter = Copter(flown, PLACE, flat, seed=4)
    states = fly(copter, 200.0)
    p = positions(states)
    assert copter.finished
    assert math.dist(p[-1, :2], (100.0, 100.0)) < 1.0 and abs(states[-1].agl_m) < 0.2
    assert sum(math.dist(q[:2], (200.0, -50.0)) < 3.0 for q in p) * STEP_S >= 8.0
    circle = np.array([q[:2] - (200.0, 100.0) for q in p if abs(math.dist(q[:2], (200.0, 100.0)) - 25.0) < 4.0])
    assert np.ptp(np.unwrap(np.arctan2(circle[:, 0], circle[:, 1]))) > 1.8 * math.pi
    limits = CopterLimits()
    tilt = [math.acos(math.cos(s.roll_rad) * math.cos(s.pitch_rad)) for s in states]
    assert max(tilt) <= limits.tilt_rad + math.radians(2.0)
    climb = np.array([s.velocity_enu_mps[2] for s in states])
    assert climb.max() < limits.climb_mps + 0.5 and climb.min() > -limits.sink_mps - 0.8


@pytest.mark.parametrize("vehicle", [Plane, Copter])
def test_a_vehicle_takes_off_in_any_gust(vehicle: type[Plane] | type[Copter]) -> None:
    flown = mission(Item(Do.TAKE_OFF, height_m=40.0), at(Do.WAYPOINT, 900.0, -50.0, 40.0))
    for seed in range(8):
        made = vehicle(flown, PLACE, hills, wind=Wind(5.0, 6.0), seed=seed)
        assert fly(made, 35.0)[-1].agl_m > 25.0 and not made.crashed, seed


@pytest.mark.parametrize("vehicle", [Plane, Copter])
def test_a_vehicle_that_hits_the_ground_has_crashed(vehicle: type[Plane] | type[Copter]) -> None:
    """A hill, and a height above sea level."""
    flown = mission(
        at(Do.WAYPOINT, *HOME, 430.0, altitude_frame=AltitudeFrame.SEA),
        at(Do.WAYPOINT, 100.0, 900.0, 430.0, altitude_frame=AltitudeFrame.SEA),
    )
    made = vehicle(flown, PLACE, lambda e_m, n_m: 400.0 + max(0.0, 60.0 - abs(n_m - 300.0) / 2), wind=CALM)
    states = fly(made, 60.0)
    assert made.crashed and made.finished
    assert 150.0 < states[-1].p_b_in_w_m[1] < 450.0


def test_a_copter_turns_its_yaw_to_the_course() -> None:
    copter = Copter(CORNERS, PLACE, flat, wind=CALM)
    states = fly(copter, 100.0)
    v = states[-1].velocity_enu_mps
    assert math.hypot(v[0], v[1]) == pytest.approx(10.0, abs=0.5)
    assert math.remainder(math.atan2(v[0], v[1]) - states[-1].yaw_rad, math.tau) == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize(("vehicle", "speed"), [(Plane, 18.0), (Copter, 6.0)])
def test_a_speed_change_item_is_executed(vehicle: type[Plane] | type[Copter], speed: float) -> None:
    flown = mission(Item(Do.SPEED, amount=speed), *LEG.items)
    made = vehicle(flown, PLACE, flat, wind=CALM)
    assert fly(made, 30.0)[-1].airspeed_mps == pytest.approx(speed, abs=0.5)


@pytest.mark.parametrize("vehicle", [Plane, Copter])
def test_a_timed_loiter_ends_and_an_unlimited_one_counts_as_finished(vehicle: type[Plane] | type[Copter]) -> None:
    flown = mission(at(Do.WAYPOINT, *HOME), at(Do.LOITER_TIME, 100.0, 250.0, amount=20.0), at(Do.LOITER, 100.0, 600.0))
    made = vehicle(flown, PLACE, flat, wind=CALM)
    states = fly(made, 36.0)
    assert not made.finished
    states = fly(made, 84.0)
    assert made.finished
    assert math.dist(states[-1].p_b_in_w_m[:2], (100.0, 600.0)) < 150.0


def test_gusts_have_the_strength_and_length_of_the_standard() -> None:
    """MIL-F-8785C at 100 m, wind of 5 m/s: sigma_w 0.5 m/s, sigma_u 0.69 m/s; scale lengths 263 m and 100 m."""
    gusts = Gusts(Wind(5.0, 0.0), seed=1)
    drawn = np.array([gusts.step(0.05, 100.0, 20.0, 0.0) for _ in range(120_000)])  # heading north
    across, along, up = drawn.T
    assert along.std() == pytest.approx(0.69, rel=0.12)
    assert across.std() == pytest.approx(0.69, rel=0.12)
    assert up.std() == pytest.approx(0.50, rel=0.08)
    lag = round(263.0 / 20.0 / 0.05)
    assert np.mean(along[:-lag] * along[lag:]) / along.var() == pytest.approx(math.exp(-1.0), abs=0.12)
