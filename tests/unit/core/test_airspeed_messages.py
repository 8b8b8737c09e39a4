"""Airspeed from MAVLink, live and from a log: from one healthy sensor only."""

import math
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link_rig import MS, S
from link_wire import armed, attitude, decoded, packed, states
from terrafix.core.mavlink.airspeed import UNHEALTHY, USED, AirspeedReader
from terrafix.core.mavlink.tlog import read_tlog, record
from terrafix.link.autopilot.telemetry import TelemetryDecoder
from terrafix.link.mavlink.timesync import TimeSync
from terrafix.messages import VehicleState

T0_US = 1_700_000_000_000_000
VFR_HUD = mavlink.MAVLink_vfr_hud_message(31.0, 25.0, 90, 50, 100.0, 0.0)


def airspeed(mps: float, sensor: int = 0, flags: int = USED) -> Any:
    return mavlink.MAVLink_airspeed_message(sensor, mps, 1500, 200.0, flags)


def published(messages: list[tuple[int, Any]]) -> list[VehicleState]:
    """(arrival time, message) -> published vehicle states."""
    telemetry = TelemetryDecoder(TimeSync())
    answers = [telemetry.on_message(decoded(message), now_ns) for now_ns, message in [(0, armed()), *messages]]
    return states(answer for answer in answers if answer is not None)


def test_airspeed_flags_equal_those_of_the_mavlink_dialect() -> None:
    assert (UNHEALTHY, USED) == (mavlink.AIRSPEED_SENSOR_UNHEALTHY, mavlink.AIRSPEED_SENSOR_USING)


def test_one_airspeed_sensor_is_used_until_it_fails() -> None:
    reader = AirspeedReader()
    assert reader.take(airspeed(20.0)) == 20.0
    assert reader.take(airspeed(25.0, sensor=1)) is None  # not the selected sensor: its scale differs
    assert reader.take(airspeed(20.0, flags=UNHEALTHY)) is None  # repeats the last valid value
    assert reader.take(airspeed(25.0, sensor=1)) == 25.0
    assert reader.take(airspeed(20.0)) is None


def test_a_sensor_that_the_autopilot_has_deselected_is_not_used() -> None:
    reader = AirspeedReader()
    assert reader.take(airspeed(20.0, flags=0)) == 20.0  # ARSPD_USE 0: never used by the autopilot, but valid
    assert reader.take(airspeed(20.0)) == 20.0
    assert reader.take(airspeed(1.0, flags=0)) is None  # a blocked tube, still reported as healthy
    assert reader.take(airspeed(20.0)) == 20.0


@pytest.mark.parametrize("mps", [math.nan, math.inf, -1.0, 900.0])
def test_an_implausible_airspeed_is_rejected(mps: float) -> None:
    assert AirspeedReader().take(airspeed(mps)) is None


def test_the_link_publishes_fresh_sensor_airspeed_and_ignores_vfr_hud() -> None:
    moments = [(0, attitude(0)), (100 * MS, airspeed(21.0)), (200 * MS, VFR_HUD), (200 * MS, attitude(200))]
    found = published([*moments, (2 * S, attitude(2000))])
    assert [state.airspeed_mps for state in found] == [None, pytest.approx(21.0), None]


def test_airspeed_is_read_from_a_telemetry_log(tmp_path: Path) -> None:
    log = tmp_path / "telemetry.tlog"
    messages = [armed(), attitude(0), airspeed(21.0), VFR_HUD, airspeed(21.5), attitude(100)]
    mav = mavlink.MAVLink(None, 1, 1)
    log.write_bytes(b"".join(record(T0_US + 50_000 * i, packed(m, mav)) for i, m in enumerate(messages)))
    found = [(state.t_ns // MS, state.airspeed_mps) for state in read_tlog(log) if state.airspeed_mps is not None]
    assert found == [(100, pytest.approx(21.0)), (200, pytest.approx(21.5))]
