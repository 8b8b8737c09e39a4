"""Mission files of ground stations: correct reading, and one clear line for invalid ones."""

import itertools
import json
import math
from pathlib import Path
from typing import Any

import pytest

from terrafix.core.errors import SourceError, UsageError
from terrafix_tools.mission.course import course
from terrafix_tools.mission.file import read_mission, write_mission
from terrafix_tools.mission.items import AltitudeFrame, Box, Do, Item, check, targets
from vehicle_missions import HOME, PLACE, at, flat, hills, mission

WAYPOINTS = """QGC WPL 110
0\t1\t0\t16\t0\t0\t0\t0\t48.00\t11.00\t512.3\t1
1\t0\t3\t22\t15\t0\t0\t0\t0\t0\t60\t1
2\t0\t3\t16\t0\t0\t0\t0\t48.01\t11.01\t100\t1
3\t0\t10\t18\t2\t0\t-80\t0\t48.02\t11.01\t120\t1
4\t0\t0\t19\t30\t0\t60\t0\t48.02\t11.02\t620\t1
5\t0\t3\t178\t0\t18\t-1\t0\t0\t0\t0\t1
6\t0\t3\t206\t25\t0\t0\t0\t0\t0\t0\t1
7\t0\t3\t30\t0\t0\t0\t0\t0\t0\t80\t1
8\t0\t3\t20\t0\t0\t0\t0\t0\t0\t0\t1
9\t0\t3\t21\t0\t0\t0\t0\t48.00\t11.00\t0\t1
"""


def plan(items: list[dict[str, Any]], home: Any = (48.0, 11.0, 500.0)) -> str:
    return json.dumps(
        {"fileType": "Plan", "version": 1, "mission": {"plannedHomePosition": list(home), "items": items}}
    )


def simple(command: int, frame: int, *params: float | None) -> dict[str, Any]:
    return {"type": "SimpleItem", "command": command, "frame": frame, "params": list(params), "autoContinue": True}


def test_a_waypoint_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.waypoints"
    path.write_text(WAYPOINTS)
    read = read_mission(path)
    assert (read.home_lat_deg, read.home_lon_deg) == (48.0, 11.0)
    assert read.starts_on_ground()
    assert read.items == (
        Item(Do.TAKE_OFF, 1, None, None, 60.0, AltitudeFrame.HOME),
        Item(Do.WAYPOINT, 2, 48.01, 11.01, 100.0, AltitudeFrame.HOME),
        Item(Do.LOITER_TURNS, 3, 48.02, 11.01, 120.0, AltitudeFrame.GROUND, amount=2.0, radius_m=-80.0),
        Item(Do.LOITER_TIME, 4, 48.02, 11.02, 620.0, AltitudeFrame.SEA, amount=30.0, radius_m=60.0),
        Item(Do.SPEED, 5, amount=18.0),
        Item(Do.ALTITUDE, 7, height_m=80.0),  # item 6 is a camera command: no movement
        Item(Do.RETURN, 8),
        Item(Do.LAND, 9, 48.0, 11.0),
    )


def test_a_plan_of_qgroundcontrol_gives_the_same_mission(tmp_path: Path) -> None:
    path = tmp_path / "a.plan"
    path.write_text(
        plan(
            [
                simple(22, 3, 15, 0, 0, None, 48.0, 11.0, 60),
                simple(16, 3, 5, 0, 0, None, 48.01, 11.01, 100),
                simple(17, 10, 0, 0, 90, None, 48.02, 11.01, 120),
            ]
        )
    )
    assert read_mission(path).items == (
        Item(Do.TAKE_OFF, 1, None, None, 60.0, AltitudeFrame.HOME),
        Item(Do.WAYPOINT, 2, 48.01, 11.01, 100.0, AltitudeFrame.HOME, amount=5.0),
        Item(Do.LOITER, 3, 48.02, 11.01, 120.0, AltitudeFrame.GROUND, radius_m=90.0),
    )


def test_a_written_mission_is_read_back(tmp_path: Path) -> None:
    made = course(3, 5000.0, Box(-900.0, -600.0, 900.0, 600.0), PLACE, agl_m=120.0, from_ground=True)
    write_mission(tmp_path / "c.waypoints", made)
    read = read_mission(tmp_path / "c.waypoints")
    assert len(read.items) == len(made.items)
    for a, b in zip(read.items, made.items, strict=True):
        assert (a.do, a.altitude_frame, a.amount) == (b.do, b.altitude_frame, b.amount)
        if b.lat_deg is not None:
            assert (a.lat_deg, a.lon_deg) == pytest.approx((b.lat_deg, b.lon_deg), abs=1e-7)
        if b.height_m is not None:
            assert a.height_m == pytest.approx(b.height_m, abs=1e-3)


HEAD = "QGC WPL 110\n0 1 0 16 0 0 0 0 48.0 11.0 500 1\n"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("hello", "neither"),
        ("{", "not valid JSON"),
        ('{"mission": ' + 100_000 * "[", "not valid JSON"),
        ('{"mission": {}}', "not a QGroundControl plan"),
        (plan([{"type": "ComplexItem", "complexItemType": "survey"}]), "item 1: a 'survey' without its positions"),
        (plan([{"type": "ComplexItem", "complexItemType": "dance"}]), "item 1: 'dance' is not supported"),
        (plan([simple(16, 3, 0, 0, 0)]), "3 params"),
        (plan([simple(84, 3, 0, 0, 0, 0, 48, 11, 50)]), "command 84 is not supported"),
        (plan([]), "no item"),
        ('{"mission": {"plannedHomePosition": [1, 2, 3], "items": 5}}', "not a QGroundControl plan"),
        (plan([simple(16, 3, 0, 0, float("inf"), 0, 48, 11, 50)]), "inf is not allowed"),
        (HEAD + "1 0 3 16 nan 0 0 0 48 11 50 1", "line 3: nan or inf"),
        ("QGC WPL 110\n", "contains no mission"),
        (HEAD + "1 0 3 16 x 0 0 0 48 11 50 1", "line 3: .* not a row of numbers"),
        (HEAD + "1 0 3 16 0 0 0 0 48 11", "10 cells"),
        (HEAD + "1 0 3 19 -30 0 0 0 48 11 50 1", "item 1: -30 is not a valid duration"),
        (HEAD + "1 0 3 178 0 0 0 0 0 0 0 1", "0 is not a valid duration, number of turns or speed"),
        (HEAD + "1 0 7 16 0 0 0 0 48 11 50 1", "altitude frame 7"),
        (HEAD + "1 0 3 16 0 0 0 0 0 0 50 1", "needs latitude and longitude"),
        (HEAD + "1 0 3 16 0 0 0 0 148 11 50 1", "not a valid latitude"),
        (HEAD + "1 0 3 16 0 0 0 0 48 11 50000 1", "height of 50000"),
    ],
)
def test_a_wrong_file_is_one_clear_line(text: str, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "m"
    path.write_text(text)
    with pytest.raises(SourceError, match=reason) as error:
        read_mission(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_the_course_is_read_from_unsupported_items(tmp_path: Path) -> None:
    """Items of ArduPilot: a jump, a spline, DO_LAND_START, a region of interest, a waypoint at 0, 0 (here)."""
    rows = [
        "3 84 0 0 0 0 48.0 11.0 50",  # VTOL take-off: from home
        "3 82 0 0 0 0 48.1 11.1 100",  # spline
        "3 177 2 3 0 0 0 0 0",  # jump
        "3 178 0 -1 50 0 0 0 0",  # speed unchanged
        "3 195 0 0 0 0 47.0 10.0 0",  # region of interest
        "3 16 0 0 0 0 0 0 80",
        "3 189 0 0 0 0 48.2 11.2 60",
        "7 16 0 0 0 0 48.3 11.3 40",  # an unknown frame
        "3 85 0 0 0 0 48.4 11.4 0",  # VTOL landing
        "3 20 0 0 0 0 0 0 0",
    ]
    path = tmp_path / "m.waypoints"
    path.write_text(HEAD + "\n".join(f"{i} 0 {row} 1" for i, row in enumerate(rows, start=1)))
    with pytest.raises(SourceError, match="item 1: MAVLink command 84"):
        read_mission(path)
    read = read_mission(path, course_only=True)
    assert read.starts_on_ground() and read.items[-1].do is Do.RETURN
    assert [(i.number, i.lat_deg) for i in read.items[1:-1]] == [(2, 48.1), (7, 48.2), (8, 48.3), (9, 48.4)]


def test_a_missing_mission_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no such mission file"):
        read_mission(tmp_path / "nope.plan")


def test_the_error_of_a_mission_outside_the_world_names_item_and_distance() -> None:
    box = Box(-500.0, -500.0, 500.0, 500.0)
    check(mission(at(Do.WAYPOINT, 0.0, 450.0)), PLACE, box)
    with pytest.raises(SourceError, match=r"item 0 \(waypoint\) at 48\.0\d+, 11\.0\d* lies 250 m outside the world"):
        check(mission(at(Do.WAYPOINT, 0.0, 750.0)), PLACE, box)
    with pytest.raises(SourceError, match="home at"):
        check(mission(at(Do.WAYPOINT, 0.0, 0.0)), PLACE, Box(-50.0, -500.0, 50.0, 500.0))
    with pytest.raises(SourceError, match="no waypoint"):
        check(mission(Item(Do.TAKE_OFF, height_m=50.0)), PLACE, box)


@pytest.mark.parametrize(
    ("altitude_frame", "height_m"),
    [(AltitudeFrame.SEA, 380.0), (AltitudeFrame.HOME, 3.0), (AltitudeFrame.GROUND, -10.0)],
)
def test_a_height_below_the_ground_is_rejected(altitude_frame: AltitudeFrame, height_m: float) -> None:
    with pytest.raises(SourceError, match=r"item 0 \(waypoint\) is .* m .* the ground"):
        targets(mission(at(Do.WAYPOINT, 0.0, 0.0, height_m, altitude_frame=altitude_frame)), PLACE, flat)


def test_heights_above_home_become_heights_amsl() -> None:
    made = targets(
        mission(
            at(Do.WAYPOINT, 0.0, 0.0, 100.0),
            at(Do.WAYPOINT, 0.0, 0.0, 500.0, altitude_frame=AltitudeFrame.SEA),
            at(Do.WAYPOINT, 0.0, 0.0, 100.0, altitude_frame=AltitudeFrame.GROUND),
            Item(Do.RETURN),
        ),
        PLACE,
        hills,
    )
    assert [t.up_m(50.0) for t in made[:3]] == pytest.approx([100.0 + hills(*HOME), 500.0, 150.0])
    assert (made[3].e_m, made[3].n_m) == pytest.approx(HOME, abs=1e-3)
    assert math.isnan(made[3].height_m)


@pytest.mark.parametrize("length_m", [3000.0, 10_000.0, 25_000.0])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_course_is_closed_inside_the_box_and_has_the_wanted_length(length_m: float, seed: int) -> None:
    box = Box(-1100.0, -600.0, 1000.0, 700.0)
    made = course(seed, length_m, box, PLACE, agl_m=120.0)
    places = [PLACE.to_local(i.lat_deg, i.lon_deg) for i in made.items if i.lat_deg and i.lon_deg]
    assert all(box.shrunk(-0.1).contains(*p) for p in places)
    assert math.dist(places[0], places[-1]) < 0.1
    assert sum(math.dist(a, b) for a, b in itertools.pairwise(places)) == pytest.approx(1.06 * length_m, rel=0.06)
    assert len(set(places)) == len(places) - 1  # all laps differ
    assert course(seed, length_m, box, PLACE, agl_m=120.0) == made != course(9, length_m, box, PLACE, agl_m=120.0)
    assert targets(made, PLACE, flat)[0].over_ground


def test_an_impossible_course_is_one_clear_line() -> None:
    box = Box(-1100.0, -600.0, 1000.0, 700.0)
    for length_m in (0.0, -5.0, math.nan, math.inf):
        with pytest.raises(UsageError, match="positive length"):
            course(1, length_m, box, PLACE, agl_m=120.0)
    with pytest.raises(UsageError, match="larger image"):
        course(1, 1000.0, box.shrunk(640.0), PLACE, agl_m=120.0)
