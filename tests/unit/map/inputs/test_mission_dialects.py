"""Missions as ground stations and scripts write them: one course for the area of a map, its check and preflight."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink

from terrafix.core.errors import SourceError
from terrafix.core.geodesy import LocalFrame
from terrafix_tools.mapping.area.checks import check_area
from terrafix_tools.mapping.area.files import read_area
from terrafix_tools.mapping.check.mission import mission_route
from terrafix_tools.mission import commands
from terrafix_tools.mission.file import read_mission
from terrafix_tools.mission.items import AltitudeFrame, Do, Mission

HOME = "0 1 0 16 0 0 0 0 48.14 14.35 300 1"
FIRST, LAST = "1 0 3 16 0 0 0 0 48.145 14.355 100 1", "3 0 3 16 0 0 0 0 48.15 14.36 100 1"
PLACE = (48.148, 14.358)


def course(folder: Path, *rows: str, version: str = "110", encoding: str = "utf-8") -> Mission:
    path = folder / "m.waypoints"
    path.write_bytes("\r\n".join([f"QGC WPL {version}", *rows, ""]).encode(encoding))
    return read_mission(path, course_only=True)


def places(mission: Mission) -> list[tuple[float, float]]:
    return [(i.lat_deg, i.lon_deg) for i in mission.items if i.lat_deg is not None and i.lon_deg is not None]


def test_every_mission_of_the_field_gives_its_area(data_set: Callable[[str], Path]) -> None:
    found = sorted(data_set("field/mission-items").glob("*.waypoints"))
    assert len(found) > 20
    for path in found:
        if path.name.startswith("home_only"):
            with pytest.raises(SourceError, match="neither home nor any item has a position; set the home position"):
                read_area(str(path), corridor_km=1.0)
            continue
        area = read_area(str(path), corridor_km=1.0)
        # a straight line of 1.34 km from home over both items, 1 km to either side
        assert check_area(area) == pytest.approx(5.86, abs=0.1), path.name


@pytest.mark.parametrize("command", sorted(commands.KNOWN - {20, 177, 179, 601}))
def test_a_command_adds_its_position_only_when_it_is_flown_to(tmp_path: Path, command: int) -> None:
    """The positions of MAVLink's own description: those with a location that are neither looked at, a border, a rally
    point, nor in metres."""
    entry = mavlink.enums["MAV_CMD"].get(command)
    location = bool(entry and entry.has_location) or command == 85
    name = entry.name if entry else ""
    aside = ("ROI", "LOCAL", "FENCE", "RALLY", "SPATIAL", "SET_HOME", "GLOBAL_ORIGIN", "SUBMODE", "GATE", "EXTERNAL")
    flown = location and not any(word in name for word in aside) and name != "MAV_CMD_NAV_FOLLOW"
    mission = course(tmp_path, HOME, FIRST, f"2 0 3 {command} 0 0 0 0 {PLACE[0]} {PLACE[1]} 100 1", LAST)
    assert (PLACE in places(mission)) == flown, name
    assert not mission.notes


def test_every_command_of_mavlink_is_known() -> None:
    named = {number for number, entry in mavlink.enums["MAV_CMD"].items() if not entry.name.endswith("ENUM_END")}
    assert named <= commands.KNOWN


def test_a_position_of_a_command_that_is_not_flown_to_may_be_anything(tmp_path: Path) -> None:
    """Parameters 5 to 7 of a script, a servo or a camera are no position."""
    mission = course(
        tmp_path, HOME, FIRST, "2 0 3 42702 1 2 3 4 500 -900 77777 1", "3 0 2 2000 0 0 0 nan nan nan nan 1"
    )
    assert places(mission) == [(48.145, 14.355)]


def test_an_unknown_command_is_named_once_with_its_items(tmp_path: Path) -> None:
    rows = [f"{i} 0 3 62000 0 0 0 0 47.0 13.0 0 1" for i in range(2, 9)]
    mission = course(tmp_path, HOME, FIRST, *rows, LAST)
    assert mission.notes == ("MAVLink command 62000 is not known: item 2, 3, 4, 5 and 3 more",)
    assert places(mission) == [(48.145, 14.355), (48.15, 14.36)]


@pytest.mark.parametrize("command", [16, 17, 18, 19, 31, 82, 21])
def test_an_item_without_a_position_is_flown_where_the_vehicle_is(tmp_path: Path, command: int) -> None:
    mission = course(tmp_path, HOME, FIRST, f"2 0 3 {command} 0 0 0 0 0 0 80 1", LAST)
    assert places(mission) == [(48.145, 14.355), (48.15, 14.36)]


def test_a_take_off_with_a_position_is_flown_to_and_one_without_starts_at_home(tmp_path: Path) -> None:
    for command in (22, 84):
        there = course(tmp_path, HOME, f"1 0 3 {command} 0 0 0 0 {PLACE[0]} {PLACE[1]} 60 1", LAST)
        assert there.starts_on_ground() and places(there)[0] == PLACE
        here = course(tmp_path, HOME, f"1 0 3 {command} 0 0 0 0 0 0 60 1", LAST)
        assert here.starts_on_ground() and places(here) == [(48.15, 14.36)]


def test_version_120_has_no_home_row(tmp_path: Path) -> None:
    """QGroundControl before its plans, and the flight plans of Parrot: the first row is an item."""
    rows = ["0 0 3 2500 0 30 2073600 0 0 0 0 1", "1 0 3 16 0 5 0 360 34.08 -118.27 3 1", "2 0 3 50000 0 -1 0 0 0 0 0 1",
            "3 0 3 21 0 0 0 360 34.09 -118.28 3 1"]  # fmt: skip
    mission = course(tmp_path, *rows, version="120")
    assert places(mission) == [(34.08, -118.27), (34.09, -118.28)]
    assert (mission.home_lat_deg, mission.home_lon_deg) == (34.08, -118.27)
    with_home = course(tmp_path, HOME, FIRST, LAST, version="120")
    assert (with_home.home_lat_deg, len(with_home.items)) == (48.14, 2)
    with pytest.raises(SourceError, match="a waypoint file of version 100; save it as 'QGC WPL 110'"):
        course(tmp_path, HOME, FIRST, version="100")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "iso-8859-1"])
def test_comments_and_encodings_do_not_matter(tmp_path: Path, encoding: str) -> None:
    mission = course(tmp_path, "# Flugplätze", HOME, "", FIRST + " # über Grund", LAST, encoding=encoding)
    assert len(mission.items) == 2
    path = tmp_path / "m.waypoints"
    rows = path.read_bytes().decode(encoding)
    path.write_bytes(f"# Flugplätze\r\n\r\n{rows}".encode(encoding))  # in front of the line that names the format
    assert read_mission(path, course_only=True) == mission


def test_a_jump_adds_its_leg_back(tmp_path: Path) -> None:
    square = [(48.14, 14.35), (48.14, 14.38), (48.16, 14.38), (48.16, 14.35)]
    rows = [f"{i} 0 3 16 0 0 0 0 {lat} {lon} 100 1" for i, (lat, lon) in enumerate(square, start=1)]
    frame = LocalFrame(48.15, 14.365)

    def closes(mission: Mission) -> bool:
        west_edge = np.array([frame.to_local(48.15, 14.35)])
        return bool(np.hypot(*(mission_route(mission, frame).points_m - west_edge).T).min() < 30.0)

    for jump in (["5 0 0 177 1 3 0 0 0 0 0 1"], ["5 0 0 601 7 3 0 0 0 0 0 1"]):
        tagged = ["1 0 0 600 7 0 0 0 0 0 0 1", *rows] if " 601 " in jump[0] else rows
        assert closes(course(tmp_path, HOME, *tagged, *jump)) and not closes(course(tmp_path, HOME, *tagged))


def test_a_return_after_set_home_goes_to_the_new_home(tmp_path: Path) -> None:
    row = "2 0 0 179 {} 0 0 0 48.2 14.4 300 1"
    back = "3 0 0 20 0 0 0 0 0 0 0 1"
    assert places(course(tmp_path, HOME, FIRST, row.format(0), back))[-1] == (48.2, 14.4)
    assert course(tmp_path, HOME, FIRST, row.format(1), back).items[-1].do is Do.RETURN


def test_positions_in_scaled_integers_are_degrees_and_those_in_metres_are_refused(tmp_path: Path) -> None:
    assert places(course(tmp_path, HOME, "1 0 6 16 0 0 0 0 481450000 143550000 100 1")) == [
        pytest.approx((48.145, 14.355))
    ]
    with pytest.raises(SourceError, match="item 1: its frame 1 counts metres from home, not degrees"):
        course(tmp_path, HOME, "1 0 1 16 0 0 0 0 80 -30 -50 1")
    as_degrees = course(tmp_path, HOME, f"1 0 4 16 0 0 0 0 {PLACE[0]} {PLACE[1]} 100 1")
    assert places(as_degrees) == [PLACE] and "altitude frame 4 is not known" in as_degrees.notes[0]


def test_a_spline_keeps_its_altitude_frame_and_a_loiter_to_altitude_its_circle(tmp_path: Path) -> None:
    rows = ["1 0 10 82 0 0 0 0 48.145 14.355 90 1", "2 0 3 31 0 -120 0 0 48.148 14.358 100 1"]
    spline, loiter = course(tmp_path, HOME, *rows).items
    assert (spline.altitude_frame, spline.height_m, loiter.radius_m) == (AltitudeFrame.GROUND, 90.0, -120.0)


def plan(items: list[Any], **mission: Any) -> str:
    return json.dumps({"fileType": "Plan", "mission": {"items": items} | mission})


def simple(command: int, *params: float | None, **more: Any) -> dict[str, Any]:
    return {"type": "SimpleItem", "command": command, "frame": 3, "params": list(params)} | more


OLD = {"type": "missionItem", "command": 16, "frame": 3, "coordinate": [48.145, 14.355, 100], "autoContinue": True}
PLANS = {
    "spline.plan": plan([simple(82, 0, 0, 0, None, 48.145, 14.355, 50)], plannedHomePosition=[48.14, 14.35, 300]),
    "no home.plan": plan([simple(16, 0, 0, 0, None, 48.145, 14.355, 50)]),
    "null.plan": plan(
        [simple(17, 0, 0, 0, None, None, None, 50), simple(85, 0, 0, 0, None, 48.145, 14.355, 0)],
        plannedHomePosition=[48.14, 14.35, None],
    ),
    "first.plan": plan([simple(16, 0, 0, 0, None, coordinate=[48.145, 14.355, 50])], plannedHomePosition=[48, 14, 0]),
    "old.mission": json.dumps(
        {
            "items": [OLD | {f"param{i}": 0 for i in range(1, 5)}],
            "plannedHomePosition": {"coordinate": [48.14, 14.35, 3]},
        }
    ),
}


@pytest.mark.parametrize("name", PLANS)
def test_plans_of_all_versions_of_qgroundcontrol_are_read(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(PLANS[name], encoding="utf-8")
    assert places(read_mission(tmp_path / name, course_only=True)) == [(48.145, 14.355)]
    assert check_area(read_area(str(tmp_path / name), corridor_km=1.0)) > 3.0


def test_a_jump_of_a_plan_counts_its_jump_ids(tmp_path: Path) -> None:
    square = [(48.14, 14.35), (48.14, 14.38), (48.16, 14.38)]
    items = [simple(16, 0, 0, 0, None, *place, 90, doJumpId=10 + i) for i, place in enumerate(square)]
    path = tmp_path / "m.plan"
    path.write_text(plan([*items, simple(177, 10, 2, 0, 0, 0, 0, 0, doJumpId=13)]), encoding="utf-8")
    assert places(read_mission(path, course_only=True)) == [*square, square[0], square[2]]
