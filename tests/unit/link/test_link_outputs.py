"""Every output against an independent decoder: pymavlink, the autopilot's arithmetic, published check values."""

import ctypes
import math
import os
import pty
import time
from datetime import UTC, datetime
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

import gps_messages
from autopilot_rig import GOOD, Rig
from link_wire import WiredEdge, attitude, decoded, heartbeat
from terrafix.core.config import LinkSection
from terrafix.core.errors import LinkError
from terrafix.link.integrity.output_predictor import east_north_m, offset
from terrafix.link.output import global_position, gps_time, msp, nmea, odometry
from terrafix.link.output.odometry import GeodeticPoint, VehicleAttitude
from terrafix.link.output.selection import PositionOutputs
from terrafix.link.output.serial_outputs import open_serial_outputs
from terrafix_lab.sim.autopilot.parameters import Kind
from vision_origin import PINHOLE_ORIGIN

S, MS = 1_000_000_000, 1_000_000
WHEN = datetime(2026, 11, 21, 12, 35, 19, 250_000, tzinfo=UTC)
WEEK, WEEK_MS = gps_time.week_and_ms(int(WHEN.timestamp() * 1000) * MS)
PLACE: dict[str, Any] = {"lat_deg": 48.117_300_5, "lon_deg": -11.516_666_7, "alt_amsl_m": 545.4}
GPS = msgspec.structs.replace(gps_messages.GPS, time_week=WEEK, time_week_ms=WEEK_MS, vn_mps=-3.0, ve_mps=4.0, **PLACE)
NO_FIX = msgspec.structs.replace(GPS, fix_type=1, lat_deg=0.0, lon_deg=0.0, satellites_visible=0, time_week=0)
ORIGIN = GeodeticPoint(48.0, -11.5, 500.0)
BANKED = VehicleAttitude(0.4, -0.2, 2.5)


# --- ODOMETRY and VISION_POSITION_ESTIMATE ---


def ardupilot_sigma(covariance: list[float], first: int = 0) -> float:
    """Standard deviation as GCS_Common.cpp computes it (handle_odometry and
    handle_common_vision_position_estimate_data). ``first``: 0 for the position, otherwise the attitude."""
    a, b, c = (0, 6, 11) if first == 0 else (15, 18, 20)
    return (covariance[a] ** 2 + covariance[b] ** 2 + covariance[c] ** 2) ** (1 / 3)


@pytest.mark.parametrize(("sigma", "variance"), [(1.0, 0.577), (5.0, 6.46), (10.0, 18.3)])
def test_fact_the_cube_root_rule_gives_the_true_sigma(sigma: float, variance: float) -> None:
    assert odometry.ardupilot_variance(sigma) == pytest.approx(variance, rel=3e-3)
    gps = msgspec.structs.replace(GPS, horiz_accuracy_m=sigma)
    for encode in (odometry.odometry, odometry.vision_position):
        sent = decoded(encode(gps, ORIGIN, BANKED, ardupilot=True))
        covariance = sent.pose_covariance if sent.get_type() == "ODOMETRY" else sent.covariance
        assert ardupilot_sigma(covariance) == pytest.approx(sigma, rel=1e-5)
        assert ardupilot_sigma(covariance, 15) == pytest.approx(math.pi, rel=1e-5)


def test_other_firmware_gets_plain_variances() -> None:
    sent = decoded(odometry.odometry(GPS, ORIGIN, BANKED, ardupilot=False))
    assert sent.pose_covariance[0] == sent.pose_covariance[6] == pytest.approx(6.5**2)
    assert sent.pose_covariance[11] == pytest.approx(4.5**2)


def test_px4_gets_metres_on_its_sphere_in_the_frame_local_ned() -> None:
    sent = decoded(odometry.odometry(GPS, ORIGIN, BANKED, ardupilot=False))
    assert sent.frame_id == mavlink.MAV_FRAME_LOCAL_NED
    # The inverse: MapProjection::reproject
    x, y = sent.x / 6_371_000.0, sent.y / 6_371_000.0
    c, lat0 = math.hypot(x, y), math.radians(ORIGIN.lat_deg)
    lat = math.asin(math.cos(c) * math.sin(lat0) + x * math.sin(c) * math.cos(lat0) / c)
    east = math.atan2(y * math.sin(c), c * math.cos(lat0) * math.cos(c) - x * math.sin(lat0) * math.sin(c))
    reprojected = math.degrees(lat), ORIGIN.lon_deg + math.degrees(east)
    assert reprojected == pytest.approx((GPS.lat_deg, GPS.lon_deg), abs=2e-7)
    at_origin = msgspec.structs.replace(GPS, lat_deg=ORIGIN.lat_deg, lon_deg=ORIGIN.lon_deg)
    assert odometry.position_ned_m(at_origin, ORIGIN, ardupilot=False)[:2] == (0.0, 0.0)


def body_to_ned(a: VehicleAttitude) -> np.ndarray:
    cr, sr, cp, sp, cy, sy = (f(x) for x in (a.roll_rad, a.pitch_rad, a.yaw_rad) for f in (math.cos, math.sin))
    x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return z @ y @ x


def test_odometry_has_frames_velocity_and_position_as_ardupilot_reads_them() -> None:
    sent = decoded(odometry.odometry(GPS, ORIGIN, BANKED, ardupilot=True))
    assert (sent.frame_id, sent.child_frame_id) == (mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_FRD)
    w, x, y, z = sent.q
    r_ned_b = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    assert r_ned_b == pytest.approx(body_to_ned(BANKED), abs=1e-6)
    assert r_ned_b @ [sent.vx, sent.vy, sent.vz] == pytest.approx([-3.0, 4.0, -0.5], abs=1e-5)
    assert sent.time_usec == 123_456_789
    assert (sent.quality, sent.reset_counter) == (100, 0)
    # The inverse: Location::offset_latlng, degrees per metre on ArduPilot's plane
    inverse = 89.83204953368922e-7
    lat = ORIGIN.lat_deg + sent.x * inverse
    lon = ORIGIN.lon_deg + sent.y * inverse / math.cos(math.radians((lat + ORIGIN.lat_deg) / 2))
    assert (lat, lon) == pytest.approx((GPS.lat_deg, GPS.lon_deg), abs=2e-8)
    assert sent.z == pytest.approx(-45.4)


def test_local_positions_are_continuous_across_the_date_line() -> None:
    gps = msgspec.structs.replace(GPS, lat_deg=0.0, lon_deg=-179.999)
    origin = GeodeticPoint(0.0, 179.999, 0.0)
    assert odometry.position_ned_m(gps, origin, ardupilot=True)[:2] == pytest.approx((0.0, 222.6), abs=0.1)
    assert odometry.position_ned_m(gps, origin, ardupilot=False)[:2] == pytest.approx((0.0, 222.4), abs=0.1)


# --- GLOBAL_POSITION_SENSOR and EXTERNAL_POSITION_ESTIMATE ---


def test_every_field_of_global_position_sensor() -> None:
    sent = decoded(global_position.global_position_sensor(GPS, 7)).to_dict()
    assert math.isnan(sent.pop("alt_ellipsoid"))
    assert sent.pop("alt") == pytest.approx(545.4)
    assert sent == {
        "mavpackettype": "GLOBAL_POSITION_SENSOR",
        "target_system": 7,
        "target_component": 1,
        "id": 1,
        "time_usec": 123_456_789,
        "processing_time": 0,
        "source": 2,
        "flags": 0,
        "lat": 481_173_005,
        "lon": -115_166_667,
        "eph": 6.5,
        "epv": 4.5,
    }


@pytest.mark.parametrize("kind", list(Kind))
def test_fact_external_position_moves_a_filter_that_has_no_gps_and_no_other(kind: Kind) -> None:
    rig = Rig(kind)
    rig.fly(5.0, GOOD)
    lat, lon = rig.autopilot._frame.to_wgs84(*map(float, rig.truth(7.0)[:2]))
    gps = msgspec.structs.replace(GPS, lat_deg=lat + 0.001, lon_deg=lon, t_ns=7 * S)  # 111 m north
    message = global_position.external_position_estimate(gps, 1)
    assert (message.param2, message.param3) == (0.0, 6.5)
    (rejected,) = rig.request(message, "COMMAND_ACK")
    assert rejected.result == mavlink.MAV_RESULT_FAILED
    rig.fly(2.0)
    (accepted,) = rig.request(message, "COMMAND_ACK")
    assert accepted.result == mavlink.MAV_RESULT_ACCEPTED
    assert rig.north_m() == pytest.approx(111.2, abs=1.0)


# --- NMEA ---


def fields(line: bytes) -> list[str]:
    """Fields of a sentence, with an independent checksum: exclusive or of all characters between $ and *."""
    body, _, checksum = line.decode("ascii").strip().lstrip("$").partition("*")
    total = 0
    for character in body:
        total ^= ord(character)
    assert total == int(checksum, 16)
    return body.split(",")


def test_the_nmea_decoder_of_this_test_reads_the_published_example() -> None:
    read = fields(b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n")
    assert len(read) == 15


def test_nmea_sentences_field_by_field() -> None:
    gga, rmc, gst = nmea.sentences(GPS).splitlines(keepends=True)
    assert all(line.endswith(b"\r\n") and len(line) <= 82 for line in (gga, rmc, gst))
    place = ["4807.038030", "N", "01131.000002", "W"]
    assert fields(gga) == ["GPGGA", "123519.25", *place, "1", "06", "1.0", "545.40", "M", "", "M", "", ""]
    speed = f"{5.0 * 3600 / 1852:.3f}"
    assert fields(rmc) == ["GPRMC", "123519.25", "A", *place, speed, "126.87", "211126", "", "", "A"]
    assert fields(gst) == ["GPGST", "123519.25", "", "6.50", "6.50", "", "6.50", "6.50", "4.50"]


def test_nmea_without_fix_and_clock_has_empty_position_and_time() -> None:
    gga, rmc, gst = (fields(line) for line in nmea.sentences(NO_FIX).splitlines())
    assert gga == ["GPGGA", "", "", "", "", "", "0", "00", "", "", "M", "", "M", "", ""]
    assert rmc == ["GPRMC", "", "V", *[""] * 9, "N"]
    assert set(gst[1:]) == {""}


@settings(deadline=None)
@given(lat=st.floats(-90, 90), lon=st.floats(-180, 180))
def test_nmea_angles_are_decoded_to_the_same_position(lat: float, lon: float) -> None:
    read = fields(nmea.sentences(msgspec.structs.replace(GPS, lat_deg=lat, lon_deg=lon)).splitlines()[0])
    for value, hemisphere, digits, expected in ((read[2], read[3], 2, lat), (read[4], read[5], 3, lon)):
        minutes = float(value[digits:])
        assert minutes < 60.0
        degrees = (int(value[:digits]) + minutes / 60) * (-1 if hemisphere in "SW" else 1)
        assert degrees == pytest.approx(expected, abs=1e-8)


# --- MSP ---


class SensorGps(ctypes.LittleEndianStructure):
    """mspSensorGpsDataMessage_t of iNav's msp_protocol_v2_sensor_msg.h, as a C compiler lays it out."""

    _pack_ = 1
    _layout_ = "ms"
    _fields_ = (
        ("instance", ctypes.c_uint8),
        ("gpsWeek", ctypes.c_uint16),
        ("msTOW", ctypes.c_uint32),
        ("fixType", ctypes.c_uint8),
        ("satellitesInView", ctypes.c_uint8),
        ("horizontalPosAccuracy", ctypes.c_uint16),
        ("verticalPosAccuracy", ctypes.c_uint16),
        ("horizontalVelAccuracy", ctypes.c_uint16),
        ("hdop", ctypes.c_uint16),
        ("longitude", ctypes.c_int32),
        ("latitude", ctypes.c_int32),
        ("mslAltitude", ctypes.c_int32),
        ("nedVelNorth", ctypes.c_int32),
        ("nedVelEast", ctypes.c_int32),
        ("nedVelDown", ctypes.c_int32),
        ("groundCourse", ctypes.c_uint16),
        ("trueYaw", ctypes.c_uint16),
        ("year", ctypes.c_uint16),
        ("month", ctypes.c_uint8),
        ("day", ctypes.c_uint8),
        ("hour", ctypes.c_uint8),
        ("min", ctypes.c_uint8),
        ("sec", ctypes.c_uint8),
    )


def test_msp_checksum_has_the_published_check_value() -> None:
    assert msp.crc8_dvb_s2(b"123456789") == 0xBC  # catalogue of parametrised CRC algorithms, CRC-8/DVB-S2


def test_msp_frame_field_by_field() -> None:
    frame = msp.frame(GPS)
    assert frame[:8] == b"$X<\x00\x03\x1f" + (52).to_bytes(2, "little")
    assert ctypes.sizeof(SensorGps) == 52
    read = SensorGps.from_buffer_copy(frame[8:-1])
    assert {name: getattr(read, name) for name, _ in SensorGps._fields_} == {
        "instance": 0,
        "gpsWeek": WEEK,
        "msTOW": WEEK_MS,
        "fixType": 3,
        "satellitesInView": 6,
        "horizontalPosAccuracy": 650,
        "verticalPosAccuracy": 450,
        "horizontalVelAccuracy": 75,
        "hdop": 100,
        "longitude": -115_166_667,
        "latitude": 481_173_005,
        "mslAltitude": 54_540,
        "nedVelNorth": -300,
        "nedVelEast": 400,
        "nedVelDown": -50,
        "groundCourse": 12_687,
        "trueYaw": 65_535,
        "year": 2026,
        "month": 11,
        "day": 21,
        "hour": 12,
        "min": 35,
        "sec": 19,
    }


def test_accuracies_of_msp_are_as_the_firmware_that_is_heard_reads_them() -> None:
    """iNav divides by 10 and has centimetres (src/main/io/gps_msp.c), ArduPilot multiplies by 0.01 (AP_GPS_MSP.cpp)."""
    inav, ardupilot = (SensorGps.from_buffer_copy(f(GPS)[8:-1]) for f in (msp.inav_frame, msp.frame))
    assert (inav.horizontalPosAccuracy // 10, inav.verticalPosAccuracy // 10) == (650, 450)  # its eph and epv, cm
    assert ardupilot.horizontalPosAccuracy * 0.01 == pytest.approx(GPS.horiz_accuracy_m)
    differing = {name for name, _ in SensorGps._fields_ if getattr(inav, name) != getattr(ardupilot, name)}
    assert differing == {"horizontalPosAccuracy", "verticalPosAccuracy"}
    huge = SensorGps.from_buffer_copy(msp.inav_frame(msgspec.structs.replace(GPS, horiz_accuracy_m=1000.0))[8:-1])
    assert huge.horizontalPosAccuracy == 65_535
    master, slave = pty.openpty()
    link = WiredEdge(msp_device=os.ttyname(slave))
    link.receives(0, heartbeat())
    link.edge.on_message(GPS)
    time.sleep(0.01)
    assert os.read(master, 4096) == msp.frame(GPS)
    link.edge.close()


@pytest.mark.parametrize(
    ("north_mps", "east_mps", "course"),
    [
        (10.0, -1e-9, "0.00"),
        (10.0, -8e-4, "0.00"),
        (10.0, -2e-3, "359.99"),
        (10.0, 0.0, "0.00"),
        (0.0, -10.0, "270.00"),
        (-10.0, -1e-9, "180.00"),
    ],
)
def test_the_nmea_course_is_below_360(north_mps: float, east_mps: float, course: str) -> None:
    moving = msgspec.structs.replace(GPS, vn_mps=north_mps, ve_mps=east_mps)
    rmc = next(line for line in nmea.sentences(moving).decode().split("\r\n") if line[3:6] == "RMC")
    assert rmc.split(",")[8] == course


def test_msp_without_fix_and_clock() -> None:
    read = SensorGps.from_buffer_copy(msp.frame(NO_FIX)[8:-1])
    assert (read.gpsWeek, read.fixType, read.satellitesInView, read.year) == (0xFFFF, 1, 0, 0)


@settings(deadline=None)
@given(unix_ms=st.integers(1_000_000_000_000, 4_000_000_000_000))
def test_gps_week_and_unix_time_are_inverse(unix_ms: int) -> None:
    assert gps_time.unix_ms(*gps_time.week_and_ms(unix_ms * MS)) == unix_ms


# --- selection and timing ---


@pytest.mark.parametrize(
    ("firmware", "configured", "sent"),
    [
        ("ardupilot", [], ("gps_input",)),
        ("none", [], ("gps_input",)),
        ("px4", [], ("global_position",)),
        ("px4", ["odometry"], ("odometry",)),
        ("ardupilot", ["gps_input", "external_position"], ("gps_input", "external_position")),
    ],
)
def test_outputs_are_those_of_the_configuration_otherwise_of_the_firmware(
    firmware: str, configured: Any, sent: tuple[str, ...]
) -> None:
    assert PositionOutputs(configured, 0).names(firmware) == sent


def test_px4_gets_global_position_sensor_with_a_fix_and_no_gps_input() -> None:
    link = WiredEdge()
    link.receives(0, heartbeat(mavlink.MAV_AUTOPILOT_PX4))
    link.wire.take()
    link.edge.on_message(GPS)
    (sent,) = link.wire.take()
    assert (sent.get_type(), sent.target_system) == ("GLOBAL_POSITION_SENSOR", 7)
    link.edge.on_message(NO_FIX)
    assert link.wire.take() == []  # PX4 takes any message for a position


def test_local_frame_outputs_wait_for_the_origin_and_stop_without_a_fix() -> None:
    link = WiredEdge(outputs=["odometry", "vision_position"])
    edge, wire = link.edge, link.wire
    edge.on_message(msgspec.structs.replace(PINHOLE_ORIGIN, lat_deg=48.0, lon_deg=-11.5, ground_amsl_m=500.0))
    link.receives(GPS.t_ns - 4 * S, heartbeat(), attitude(1))
    requested = [a for a in wire.take("COMMAND_LONG") if a.command == mavlink.MAV_CMD_REQUEST_MESSAGE]
    assert [a.param1 for a in requested] == [49.0]  # GPS_GLOBAL_ORIGIN
    edge.on_message(GPS)
    assert wire.take() == []
    link.receives(GPS.t_ns - S, heartbeat())
    assert "waits for the autopilot's origin" in link.status().detail
    (set_origin,) = wire.take("SET_GPS_GLOBAL_ORIGIN")  # the autopilot has none: it gets the start of the flight
    assert (set_origin.latitude, set_origin.longitude, set_origin.altitude) == (480_000_000, -115_000_000, 500_000)
    origin = mavlink.MAVLink_gps_global_origin_message(480_000_000, -115_000_000, 500_000)
    link.receives(GPS.t_ns, origin, attitude(2))
    wire.take()
    edge.on_message(GPS)
    assert [x.get_type() for x in wire.take()] == ["ODOMETRY", "VISION_POSITION_ESTIMATE"]
    edge.on_message(NO_FIX)
    assert wire.take() == []


def test_external_positions_are_sent_every_five_seconds_with_a_good_accuracy_only() -> None:
    link = WiredEdge(outputs=["external_position"])
    for tenth in range(100):
        link.edge.on_message(msgspec.structs.replace(GPS, t_ns=tenth * 100 * MS))
    assert len(link.wire.take("COMMAND_INT")) == 2
    link.edge.on_message(msgspec.structs.replace(GPS, t_ns=20 * S, horiz_accuracy_m=31.0))
    link.edge.on_message(msgspec.structs.replace(NO_FIX, t_ns=30 * S))
    assert link.wire.take() == []


@pytest.mark.parametrize("uptime_days", [0.01, 1.0, 10.0, 49.0, 200.0])
def test_an_external_position_is_at_the_time_that_its_float32_field_represents(uptime_days: float) -> None:
    began_ns = round(uptime_days * 86_400 * S)
    for step in range(200):
        t_ns = began_ns + step * 137 * MS
        elapsed_s = (t_ns - began_ns) / S
        lat, lon = offset(48.0, 11.0, 20.0 * elapsed_s, -10.0 * elapsed_s)
        gps = msgspec.structs.replace(GPS, t_ns=t_ns, lat_deg=lat, lon_deg=lon, ve_mps=20.0, vn_mps=-10.0)
        sent = decoded(global_position.external_position_estimate(gps, 1))
        field_s = sent.param1 - began_ns / S
        assert 0.0 <= elapsed_s - field_s < 2.0 * np.spacing(np.float32(began_ns / S))
        east_m, north_m = east_north_m((48.0, 11.0), (sent.x / 1e7, sent.y / 1e7))
        assert (east_m, north_m) == pytest.approx((20.0 * field_s, -10.0 * field_s), abs=0.05)


def test_an_accepted_jump_changes_the_reset_counter_of_local_poses() -> None:
    for resets, counter in ((0, 0), (3, 3), (256, 0), (259, 3)):
        gps = msgspec.structs.replace(GPS, resets=resets)
        for encode in (odometry.odometry, odometry.vision_position):
            assert decoded(encode(gps, ORIGIN, BANKED, ardupilot=True)).reset_counter == counter


def test_nmea_and_msp_are_sent_on_their_own_devices_and_one_may_be_lost() -> None:
    masters, names = [], []
    for _ in range(2):
        master, slave = pty.openpty()
        masters.append(master)
        names.append(os.ttyname(slave))
        os.close(slave)
    link = WiredEdge(nmea_device=names[0], nmea_baud=9600, msp_device=names[1])
    link.edge.on_message(GPS)
    time.sleep(0.01)
    assert os.read(masters[0], 4096) == nmea.sentences(GPS)
    assert os.read(masters[1], 4096) == msp.inav_frame(GPS)  # no ArduPilot is heard
    os.close(masters[0])
    link.edge.on_message(GPS)
    link.poll(0)
    assert f"{names[0]}: connection lost" in link.status().detail
    time.sleep(0.01)
    assert os.read(masters[1], 4096) == msp.inav_frame(GPS)  # no ArduPilot is heard
    link.edge.close()
    os.close(masters[1])


def test_a_serial_output_that_cannot_be_opened_raises_with_a_remedy() -> None:
    with pytest.raises(LinkError, match=r"/dev/none.*plugged in"):
        open_serial_outputs(LinkSection(nmea_device="/dev/none"))
