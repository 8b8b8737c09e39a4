"""A mission as MAVSDK uploads it: commands, frames and parameters with the numbers of MAVLink's common.xml."""

import pytest

from terrafix_tools.mission.items import AltitudeFrame, Do, Item, Mission

pytest.importorskip("mavsdk", reason="mavsdk is not installed (pip install 'terrafix[sim]')")

from terrafix_lab.sim.sitl.ground_side import items  # imports mavsdk

MISSION = Mission(
    "test",
    48.1,
    14.2,
    (
        Item(Do.TAKE_OFF, height_m=60.0),
        Item(Do.WAYPOINT, 1, 48.1234567, -14.7654321, 120.0),
        Item(Do.SPEED, 2, amount=15.0),
        Item(Do.LOITER_TURNS, 3, 48.2, 14.3, 100.0, AltitudeFrame.GROUND, 2.0, -80.0),
        Item(Do.LAND, 4, 48.1, 14.2, 0.0),
    ),
)


def test_mission_items_have_the_numbers_of_mavlink() -> None:
    made = items(MISSION)
    assert [item.seq for item in made] == [0, 1, 2, 3, 4, 5]
    assert [item.command for item in made[1:]] == [22, 16, 178, 18, 21]
    assert [item.frame for item in made[1:]] == [3, 3, 3, 10, 3]
    assert sum(item.current for item in made) == 1 and all(item.autocontinue for item in made)
    assert (made[0].x, made[0].y) == (481000000, 142000000)
    assert (made[2].x, made[2].y, made[2].z) == (481234567, -147654321, 120.0)
    assert (made[3].param1, made[3].param2) == (1.0, 15.0)  # ground speed
    assert (made[4].param1, made[4].param3) == (2.0, -80.0)
