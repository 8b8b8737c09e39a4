"""Height above take-off when a ground station moves home in flight."""

import math
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from gps_messages import NO_FIX, S
from link_wire import WiredEdge, armed, attitude, packed, states
from terrafix.core.mavlink.home_altitude import TakeOffHeight
from terrafix.core.mavlink.tlog import read_tlog, record

GROUND_M, BOAT_M = 400.0, 365.0


def test_height_above_take_off_is_continuous_when_home_is_moved_in_flight() -> None:
    height = TakeOffHeight()
    heights = [50.0, 52.0, 54.0, 56.0, 58.0]
    homes = [GROUND_M, GROUND_M, BOAT_M, BOAT_M, GROUND_M + 20.0]
    takeoff_heights = [
        height.update(GROUND_M + h - home, GROUND_M + h, True) for h, home in zip(heights, homes, strict=True)
    ]
    assert takeoff_heights == pytest.approx(heights)
    assert height.home_rise_m == pytest.approx(20.0)


def test_a_jump_of_the_height_above_sea_level_is_not_a_move_of_home() -> None:
    """An autopilot that takes off without a position and receives one in flight."""
    height = TakeOffHeight()
    assert [height.update(50.0 + i, amsl, True) for i, amsl in enumerate((50.0, 51.0, 452.0))] == [50.0, 51.0, 52.0]


def test_before_arming_home_is_the_position_of_the_vehicle() -> None:
    height = TakeOffHeight()
    assert height.update(3.0, GROUND_M + 3.0, False) == 3.0  # the barometer has drifted
    assert height.update(0.0, GROUND_M + 3.0, False) == 0.0  # and it is armed
    assert height.update(0.1, GROUND_M + 3.1, True) == pytest.approx(0.1)


def test_without_height_above_sea_level_the_height_above_home_is_used() -> None:
    height = TakeOffHeight()
    assert [height.update(h, math.nan, True) for h in (50.0, 85.0)] == [50.0, 85.0]


def position(boot_ms: int, above_ground_m: float, home_m: float) -> mavlink.MAVLink_global_position_int_message:
    amsl_m = GROUND_M + above_ground_m
    place = (480_000_000, 110_000_000, round(1e3 * amsl_m), round(1e3 * (amsl_m - home_m)))
    return mavlink.MAVLink_global_position_int_message(boot_ms, *place, 0, 0, 0, 0)


def test_a_restarted_link_keeps_the_height_above_take_off(tmp_path: Path) -> None:
    def heights(link: WiredEdge, at_s: int, home_m: float) -> list[float | None]:
        telemetry = (position(1000 * at_s, 50.0 + at_s, home_m), attitude(1000 * at_s))
        return [state.agl_m for state in states(link.receives(at_s * S, *telemetry))]

    link = WiredEdge(checkpoint=tmp_path / "link.checkpoint")
    link.receives(0, armed())
    assert heights(link, 1, GROUND_M) == pytest.approx([51.0])
    assert heights(link, 2, BOAT_M) == pytest.approx([52.0])
    link.edge.on_message(NO_FIX)
    assert heights(WiredEdge(checkpoint=tmp_path / "link.checkpoint"), 8, BOAT_M) == pytest.approx([58.0])


def test_a_telemetry_log_gives_height_above_take_off_when_home_is_moved(tmp_path: Path) -> None:
    mav = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
    homes = [GROUND_M, GROUND_M, BOAT_M]
    log = [record(1_700_000_000_000_000, packed(armed(), mav))]
    for second, home_m in enumerate(homes):
        log.append(record(1_700_000_000_000_000 + second * 1_000_000, packed(position(0, 50.0, home_m), mav)))
    (tmp_path / "flight.tlog").write_bytes(b"".join(log))
    assert [state.agl_m for state in read_tlog(tmp_path / "flight.tlog")] == pytest.approx([50.0] * 3)
