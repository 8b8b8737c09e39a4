"""MAVLink output of the simulated autopilot, decoded as by a ground station."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from autopilot_rig import FRAME, GOOD, HEIGHT_M, HOME_M, LAT, LON, Rig, at_5_hz, changed, real_fix
from terrafix.core.errors import UsageError
from terrafix_lab.sim.autopilot.parameters import BESIDE_A_RECEIVER, FIRMWARE, Kind, parameters_of
from terrafix_lab.sim.closed_loop.loopback import Loopback

STREAMS = (
    "HEARTBEAT",
    "ATTITUDE",
    "GLOBAL_POSITION_INT",
    "VFR_HUD",
    "GPS_RAW_INT",
    "GPS2_RAW",
    "EKF_STATUS_REPORT",
    "RAW_IMU",
    "SCALED_PRESSURE",
    "AIRSPEED",
    "SYSTEM_TIME",
    "TIMESYNC",
)


def interval(name: str, microseconds: float) -> Any:
    number = getattr(mavlink, f"MAVLINK_MSG_ID_{name}")
    return mavlink.MAVLink_command_long_message(1, 1, 511, 0, number, microseconds, *(0.0,) * 5)


def count(rig: Rig, name: str, seconds: float) -> int:
    rig.received.clear()
    rig.fly(seconds, GOOD)
    return sum(m.get_type() == name for m in rig.received)


def test_every_stream_is_sent_and_matches_the_vehicle() -> None:
    rig = Rig(
        Kind.PLANE, parameters={**BESIDE_A_RECEIVER, "GPS1_TYPE": 1.0}, real_gps=at_5_hz(lambda _: real_fix(fix_type=1))
    )
    rig.fly(11.0, changed(gps_id=1))
    assert {m.get_type() for m in rig.received} >= set(STREAMS)
    assert rig.last("HEARTBEAT").type == mavlink.MAV_TYPE_FIXED_WING
    assert rig.last("ATTITUDE").yaw == pytest.approx(rig.yaw, abs=1e-3)
    hud = rig.last("VFR_HUD")
    assert (hud.airspeed, hud.groundspeed) == pytest.approx((rig.airspeed, 22.0), abs=1.0)
    imu = rig.last("RAW_IMU")
    assert imu.zacc == pytest.approx(-1000, abs=60)  # milli-g, down is positive
    # 620 m in the standard atmosphere: 941.0 hPa (ICAO Doc 7488, table by interpolation).
    assert rig.last("SCALED_PRESSURE").press_abs == pytest.approx(941.0, abs=0.3)
    assert rig.last("AIRSPEED").airspeed == pytest.approx(rig.airspeed, abs=1.0)
    raw = rig.last("GPS2_RAW")
    assert (raw.fix_type, raw.satellites_visible, raw.h_acc) == (3, 10, 1000)
    assert rig.last("SYSTEM_TIME").time_unix_usec == 0  # no GPS week was sent


def test_the_sent_position_is_the_navigation_solution_and_not_the_truth() -> None:
    rig = Rig(Kind.COPTER)
    rig.fly(10.0, GOOD)
    rig.fly(30.0, changed(north_m=30.0, hacc=5.0))
    message = rig.last("GLOBAL_POSITION_INT")
    navigation_lat_lon = FRAME.to_wgs84(*(float(v) for v in rig.autopilot.navigation().p_b_in_w_m[:2]))  # type: ignore[union-attr]
    assert (message.lat * 1e-7 - LAT) * 111_200.0 == pytest.approx(rig.north_m(), abs=0.7)
    assert rig.north_m() > 10.0
    assert (navigation_lat_lon[0] - LAT) * 111_200.0 == pytest.approx(rig.north_m(), abs=0.1)
    assert message.relative_alt / 1e3 == pytest.approx(HEIGHT_M - HOME_M, abs=1.0)


def test_streams_have_the_requested_rates() -> None:
    rig = Rig(Kind.COPTER)
    assert count(rig, "ATTITUDE", 4.0) == pytest.approx(16, abs=1)
    for microseconds, rate_hz in ((40_000.0, 25), (20_000.0, 50), (0.0, 4), (-1.0, 0)):
        (ack,) = rig.request(interval("ATTITUDE", microseconds), "COMMAND_ACK")
        assert ack.result == mavlink.MAV_RESULT_ACCEPTED
        assert count(rig, "ATTITUDE", 4.0) == pytest.approx(4 * rate_hz, abs=1)
    (ack,) = rig.request(interval("ODOMETRY", 1e5), "COMMAND_ACK")
    assert ack.result == mavlink.MAV_RESULT_DENIED
    unknown = mavlink.MAVLink_command_long_message(1, 1, 400, 0, *(0.0,) * 7)
    assert rig.request(unknown, "COMMAND_ACK")[0].result == mavlink.MAV_RESULT_UNSUPPORTED


def test_parameters_can_be_read_set_and_listed() -> None:
    rig = Rig(Kind.COPTER)
    everything = rig.request(mavlink.MAVLink_param_request_list_message(1, 1), "PARAM_VALUE")
    assert {m.param_id for m in everything} == set(FIRMWARE)
    (one,) = rig.request(mavlink.MAVLink_param_request_read_message(1, 1, b"GPS_PRIMARY", -1), "PARAM_VALUE")
    assert (one.param_id, one.param_value) == ("GPS_PRIMARY", 0.0)
    (by_index,) = rig.request(mavlink.MAVLink_param_request_read_message(1, 1, b"", 0), "PARAM_VALUE")
    assert by_index.param_id == everything[0].param_id
    put = mavlink.MAVLink_param_set_message(1, 1, b"GPS_PRIMARY", 1.0, mavlink.MAV_PARAM_TYPE_REAL32)
    assert rig.request(put, "PARAM_VALUE")[0].param_value == 1.0
    assert rig.request(mavlink.MAVLink_param_request_read_message(1, 1, b"NONSENSE", -1), "PARAM_VALUE") == []
    with pytest.raises(UsageError, match="NONSENSE"):
        parameters_of(Kind.COPTER, {"NONSENSE": 1.0})


def test_timesync_uses_the_autopilots_own_clock() -> None:
    rig = Rig(Kind.COPTER)
    rig.fly(10.0, GOOD)
    (answer,) = rig.request(mavlink.MAVLink_timesync_message(0, 123), "TIMESYNC")
    assert answer.ts1 == 123
    assert abs(answer.tc1 * 1e-9 - rig.t_s) > 5.0
    rig.fly(10.0, GOOD)
    (later,) = rig.request(mavlink.MAVLink_timesync_message(0, 124), "TIMESYNC")
    assert (later.tc1 - answer.tc1) * 1e-9 == pytest.approx(10.0, rel=1e-4)


def test_a_gps_week_sets_the_autopilots_wall_clock() -> None:
    rig = Rig(Kind.COPTER)
    week, ms = 2400, 123_000
    packet = rig._message(GOOD)
    packet.time_week, packet.time_week_ms = week, ms
    rig.send(packet)
    rig.fly(2.0, GOOD)
    # GPS epoch 1980-01-06, 18 leap seconds.
    expected_s = 315_964_800 + week * 604_800 + ms / 1e3 - 18 + rig.t_s
    assert rig.last("SYSTEM_TIME").time_unix_usec * 1e-6 == pytest.approx(expected_s, abs=1.1)


def test_damaged_bytes_are_counted_and_ignored() -> None:
    rig = Rig(Kind.COPTER)
    rng = np.random.default_rng(1)
    for _ in range(50):
        rig.autopilot.receive(rng.integers(0, 256, 60, dtype=np.uint8).tobytes(), rig.t_s)
    assert rig.autopilot.wire.received.bad_packets > 0
    rig.fly(20.0, GOOD)
    assert rig.autopilot.counts.accepted > 80


def test_the_same_flight_gives_the_same_bytes() -> None:
    def message() -> list[str]:
        rig = Rig(Kind.PLANE, seed=5)
        rig.fly(20.0, GOOD)
        return [str(m) for m in rig.received]

    assert message() == message()


def test_a_take_off_arms_the_autopilot_without_a_command() -> None:
    """A vehicle in the air counts as armed."""
    rig = Rig(Kind.COPTER, flying=False)
    rig.fly(30.0, GOOD)
    assert not rig.autopilot.armed
    readings = rig._readings()
    rig.autopilot.step(rig.t_s, replace(readings, baro_amsl_m=HEIGHT_M + 5.0))
    assert rig.autopilot.armed and rig.autopilot.flying


def test_the_loopback_keeps_order_and_separates_directions() -> None:
    wire = Loopback()
    assert wire.write(b"a") and wire.write(b"b")
    wire.to_companion(b"1")
    wire.to_companion(b"")
    wire.to_companion(b"2")
    assert (wire.take(), wire.take()) == (b"ab", b"")
    assert (wire.read(), wire.read()) == ([(b"1", None), (b"2", None)], [])


def test_positions_far_from_the_origin_are_correct() -> None:
    rig = Rig(Kind.PLANE)
    rig.fly(10.0, GOOD)
    assert math.dist(rig.truth(rig.t_s)[:2], (0.0, 0.0)) > 200.0
    assert rig.error_m() < 1.0
    assert rig.last("GLOBAL_POSITION_INT").lon * 1e-7 > LON


def test_an_acceleration_beyond_the_sensor_range_is_clipped(monkeypatch: pytest.MonkeyPatch) -> None:
    """A flight that starts in mid-air gains its speed within one step."""
    rig = Rig(Kind.PLANE)
    shown = rig._readings
    monkeypatch.setattr(rig, "_readings", lambda: replace(shown(), accel_b_mps2=np.array([2400.0, 0.0, -2400.0])))
    rig.fly(0.5)
    assert (rig.last("RAW_IMU").xacc, rig.last("RAW_IMU").zacc) == (32767, -32768)


def test_steps_of_2_s_leave_the_height_where_the_barometer_has_it() -> None:
    """As of a simulation on an overloaded computer."""
    rig = Rig(Kind.COPTER)
    rig.fly(1.0)
    for _ in range(20):
        rig.t_s += 2.0
        rig.autopilot.step(rig.t_s, rig._readings())
    rig.fly(1.0)
    assert rig.last("GLOBAL_POSITION_INT").relative_alt == pytest.approx(1000 * (HEIGHT_M - HOME_M), abs=5000)


@pytest.mark.parametrize(("stated_m", "sent_mm"), [(1e7, 0x7FFF_FFFF), (-1e7, -0x8000_0000)])
def test_heights_and_accuracies_beyond_their_fields_are_clipped(stated_m: float, sent_mm: int) -> None:
    rig = Rig(Kind.COPTER)
    rig.fly(1.0, GOOD)
    gps = rig._message(changed(hacc=1e7, vacc=1e7))
    gps.alt = stated_m
    rig.send(gps)
    rig.fly(0.5)
    raw = rig.last("GPS_RAW_INT")
    assert (raw.alt, raw.h_acc, raw.v_acc) == (sent_mm, 0xFFFF_FFFF, 0xFFFF_FFFF)
