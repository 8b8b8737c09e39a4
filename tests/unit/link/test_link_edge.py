"""The edge on real UDP, TCP and pseudo-terminals: all fields of GPS_INPUT, garbage, loss and return of the device."""

import errno
import math
import os
import pty
import socket
import time
from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from typing import Any

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from gps_messages import GPS
from link_port import Speaker, free_port
from link_rig import ALT, MS, S, live
from link_wire import attitude, heartbeat, states, station_heartbeat
from live_flight import LiveFlight
from terrafix import messages as m
from terrafix.core.config import LinkSection
from terrafix.core.errors import LinkError
from terrafix.link.edge import MavlinkEdge, open_edge
from terrafix.link.mavlink.transport import UdpOut, open_transport
from terrafix.link.node import LinkNode
from terrafix.link.output import gps_input
from terrafix.link.output.gps_time import week_and_ms

pytestmark = pytest.mark.real_time

UNIX_NS = 1_795_262_400 * S  # 2026-11-21


@pytest.fixture
def station() -> Iterator[Speaker]:
    """The autopilot's end of a UDP connection."""
    with Speaker(7) as station:
        yield station


def edge_to(station: Speaker, **changes: Any) -> MavlinkEdge:
    config = LinkSection(device=f"udpout:127.0.0.1:{station.address[1]}", **changes)
    return MavlinkEdge(config, open_transport(config.device, config.baud, wait=True), lambda: UNIX_NS)


@pytest.fixture
def edge(station: Speaker) -> Iterator[MavlinkEdge]:
    edge = edge_to(station)
    yield edge
    edge.close()


def polled(edge: MavlinkEdge, now_ns: int) -> list[m.Message]:
    """Polls once, after the packets have had time to arrive."""
    time.sleep(0.005)
    return list(edge.poll(now_ns))


def status(published: list[m.Message]) -> m.LinkStatus:
    return [x for x in published if isinstance(x, m.LinkStatus)][-1]


def test_every_field_of_gps_input_arrives(station: Speaker, edge: MavlinkEdge) -> None:
    edge.on_message(GPS)
    (sent,) = station.received("GPS_INPUT")
    assert sent.get_msgbuf()[0] == mavlink.PROTOCOL_MARKER_V2
    assert (sent.get_srcSystem(), sent.get_srcComponent()) == (1, 197)
    assert sent.to_dict() == {
        "mavpackettype": "GPS_INPUT",
        "time_usec": 123_456_789,
        "gps_id": 0,
        "ignore_flags": 0,
        "time_week_ms": 561_618_250,
        "time_week": 2445,
        "fix_type": 3,
        "lat": 481_234_567,
        "lon": -1_227_654_321,
        "alt": 512.25,
        "hdop": 1.0,
        "vdop": 1.0,
        "vn": -3.5,
        "ve": 12.25,
        "vd": -0.5,
        "speed_accuracy": 0.75,
        "horiz_accuracy": 6.5,
        "vert_accuracy": 4.5,
        "satellites_visible": 6,
        "yaw": 0,
    }


def test_gps_id_comes_from_the_configuration(station: Speaker) -> None:
    edge = edge_to(station, gps_id=1)
    edge.on_message(GPS)
    assert station.received("GPS_INPUT")[0].gps_id == 1
    edge.close()


@given(
    lat=st.floats(-90, 90), lon=st.floats(-180, 180), week=st.integers(0, 65535), alt=st.floats(-500, 10_000, width=32)
)
def test_any_position_can_be_packed_as_gps_input(lat: float, lon: float, week: int, alt: float) -> None:
    gps = msgspec.structs.replace(GPS, lat_deg=lat, lon_deg=lon, time_week=week, alt_amsl_m=alt)
    parser = mavlink.MAVLink(None)
    (back,) = parser.parse_buffer(gps_input.encode(gps, 0).pack(mavlink.MAVLink(None, 1, 197)))
    assert abs(back.lat / 1e7 - lat) < 6e-8
    assert abs(back.lon / 1e7 - lon) < 6e-8
    assert back.alt == alt


def test_the_edge_sends_a_heartbeat_as_onboard_controller_once_a_second(station: Speaker, edge: MavlinkEdge) -> None:
    for tenth in range(40):
        edge.poll(tenth * 100 * MS)
    heartbeats = station.received("HEARTBEAT")
    assert len(heartbeats) == 4
    assert {b.type for b in heartbeats} == {mavlink.MAV_TYPE_ONBOARD_CONTROLLER}
    assert {b.autopilot for b in heartbeats} == {mavlink.MAV_AUTOPILOT_INVALID}


def test_a_status_text_is_sent_as_statustext(station: Speaker, edge: MavlinkEdge) -> None:
    edge.on_message(m.StatusText(t_ns=0, severity=4, text="Terrafix: no map fix for 15 s"))
    (text,) = station.received("STATUSTEXT")
    assert (text.severity, text.text) == (4, "Terrafix: no map fix for 15 s")


def connect(station: Speaker, edge: MavlinkEdge, now_ns: int = 0, beat: Any = None) -> None:
    polled(edge, now_ns)
    station.received()
    station.send(beat or heartbeat())
    polled(edge, now_ns + MS)


def test_streams_are_requested_and_requested_again_when_they_stop(station: Speaker, edge: MavlinkEdge) -> None:
    connect(station, edge)
    requested = station.received("COMMAND_LONG")
    fives = {(33, 200_000.0), (24, 200_000.0), (124, 200_000.0), (295, 200_000.0)}
    assert {(int(a.param1), a.param2) for a in requested} >= {(30, 40_000.0), (2, 1_000_000.0)} | fives
    assert {(a.command, a.target_system, a.target_component) for a in requested} == {(511, 7, 1)}
    for second in range(1, 5):  # ATTITUDE arrives at its rate, the others do not
        station.send(heartbeat(), *(attitude(second * 1000 + i * 40) for i in range(25)))
        published = polled(edge, second * S)
    requested_again = {int(a.param1) for a in station.received("COMMAND_LONG")}
    assert requested_again == {int(a.param1) for a in requested} - {30, 285, 295}  # optional: AIRSPEED, a gimbal
    assert "GLOBAL_POSITION_INT 0.0 of 5 Hz, SYSTEM_TIME 0.0 of 1 Hz" in status(published).detail
    assert "ATTITUDE" not in status(published).detail


def test_the_gimbal_of_the_served_vehicle_is_read_behind_its_autopilot(station: Speaker, edge: MavlinkEdge) -> None:
    connect(station, edge)
    down = (math.sqrt(0.5), 0.0, -math.sqrt(0.5), 0.0)  # pitch -90
    flags = mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME
    report = mavlink.MAVLink_gimbal_device_attitude_status_message(0, 0, 5, flags, list(down), 0, 0, 0, 0)
    gimbal, other = (mavlink.MAVLink(None, srcSystem=system, srcComponent=154) for system in (7, 8))
    for sender in (gimbal, other):
        station.socket.sendto(bytes(report.pack(sender)), station.peer)
    (found,) = (x for x in polled(edge, 1 * S) if isinstance(x, m.GimbalAttitude))
    assert (found.t_ns, found.device, found.from_north) == (1 * S, 154, False)
    assert found.q == pytest.approx(down)


def test_vehicle_state_contains_attitude_and_recent_relative_height(station: Speaker, edge: MavlinkEdge) -> None:
    connect(station, edge)
    station.send(attitude(1000, yaw=4.0))
    (first,) = states(polled(edge, 1 * S))
    assert first.agl_m is None  # no height received yet
    assert first.yaw_rad is not None
    assert (first.yaw_rad, first.pitch_rad, first.roll_rad) == pytest.approx((4.0 - math.tau, 0.2, 0.1))
    height = mavlink.MAVLink_global_position_int_message(1000, 1, 2, 700_000, 84_500, 100, 200, 300, 0)
    station.send(height, attitude(1040, yaw=4.0))
    (second,) = states(polled(edge, 1_040 * MS))
    assert second.agl_m == 84.5
    assert second.yaw_rad == pytest.approx(4.0 - math.tau)
    assert second.velocity_enu_mps is None  # the EKF's velocity contains ours: not a measurement
    station.send(heartbeat(), attitude(3000))
    (third,) = states(polled(edge, 3 * S))
    assert third.agl_m is None  # the height is 2 s old


def test_telemetry_of_other_vehicles_and_ground_stations_is_ignored(station: Speaker, edge: MavlinkEdge) -> None:
    connect(station, edge)
    station.mav.srcSystem = 9
    station.send(heartbeat(), attitude(5000, yaw=2.0))
    station.mav.srcSystem, station.mav.srcComponent = 7, 190
    station.send(station_heartbeat(), attitude(5000, yaw=2.0))
    station.mav.srcComponent = 1
    station.send(attitude(5000, yaw=math.nan), attitude(5000, yaw=1e9))
    published = polled(edge, 1 * S)
    assert states(published) == []
    assert (status(published).sysid, status(published).autopilot) == (7, "ardupilot")


def test_attitude_is_stamped_with_its_measurement_time_by_timesync(station: Speaker, edge: MavlinkEdge) -> None:
    boot_ahead_ns = 1000 * S  # the autopilot booted earlier
    connect(station, edge)
    for tenth in range(1, 30):
        now_ns = tenth * 100 * MS
        if tenth % 5 == 0:
            station.send(heartbeat())
        polled(edge, now_ns)
        for request in station.received("TIMESYNC"):
            assert request.tc1 == 0
            station.send(mavlink.MAVLink_timesync_message(request.ts1 + MS + boot_ahead_ns, request.ts1))
        polled(edge, now_ns + 2 * MS)
    station.send(attitude(1_003_000))  # measured at local time 3.000 s, arrives 60 ms later
    published = polled(edge, 3_060 * MS)
    assert states(published)[0].t_ns == pytest.approx(3 * S, abs=MS)
    station.send(heartbeat())
    offset_ms = status(polled(edge, 4_100 * MS)).time_offset_ms
    assert offset_ms == pytest.approx(1e6, abs=1.0)


def test_the_edge_responds_to_timesync_requests_of_the_autopilot(station: Speaker, edge: MavlinkEdge) -> None:
    connect(station, edge)
    station.send(mavlink.MAVLink_timesync_message(0, 777))
    polled(edge, 5 * S)
    assert (5 * S, 777) in [(t.tc1, t.ts1) for t in station.received("TIMESYNC")]


def test_link_status_has_the_connection_and_packet_counts(station: Speaker, edge: MavlinkEdge) -> None:
    before = status(polled(edge, 0))
    assert (before.connected, before.autopilot, before.time_offset_ms) == (False, "none", None)
    assert "nothing heard" in before.detail
    connect(station, edge, 100 * MS)
    there = status(polled(edge, 1100 * MS))
    assert (there.connected, there.autopilot, there.sysid) == (True, "ardupilot", 7)
    assert there.received == 1
    assert there.sent > 3
    assert not status(polled(edge, 6 * S)).connected


def test_px4_is_identified_and_gps_input_to_it_is_reported(station: Speaker) -> None:
    edge = edge_to(station, outputs=["gps_input"])
    connect(station, edge, beat=heartbeat(autopilot=mavlink.MAV_AUTOPILOT_PX4))
    published = status(polled(edge, 1100 * MS))
    edge.close()
    assert published.autopilot == "px4"
    assert "does not take GPS_INPUT" in published.detail


def test_wall_clock_is_from_the_system_the_autopilot_or_none(station: Speaker) -> None:
    config = LinkSection(device=f"udpout:127.0.0.1:{station.address[1]}")
    for ours, source in ((UNIX_NS, "system"), (5 * S, "none")):
        edge = MavlinkEdge(config, open_transport(config.device, 0, wait=True), partial(int, ours))
        (clock,) = [x for x in edge.poll(3 * S) if isinstance(x, m.WallClock)]
        assert (clock.t_ns, clock.source, clock.unix_ns) == (3 * S, source, UNIX_NS if source == "system" else None)
        edge.close()
    edge = MavlinkEdge(config, open_transport(config.device, 0, wait=True), lambda: 5 * S)
    connect(station, edge)
    station.send(mavlink.MAVLink_system_time_message(UNIX_NS // 1000, 1000))
    (clock,) = [x for x in polled(edge, 1 * S) if isinstance(x, m.WallClock)]
    assert (clock.t_ns, clock.source, clock.unix_ns) == (1 * S, "autopilot", UNIX_NS)
    edge.close()


# --- garbage ---


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    chunks=st.lists(st.binary(max_size=400), max_size=6),
    magic=st.sampled_from([b"", b"\xfd", b"\xfe", b"\xfd\x09\x00"]),
)
def test_garbage_bytes_do_not_raise(station: Speaker, chunks: list[bytes], magic: bytes) -> None:
    edge = edge_to(station)
    polled_at = 0
    edge.poll(polled_at)
    station.received()
    for chunk in chunks:
        station.socket.sendto(magic + chunk, station.peer)
        edge.poll(polled_at := polled_at + S)
    edge.on_message(GPS)
    edge.close()


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_packet_does_not_hide_the_following_packets(station: Speaker, data: st.DataObject) -> None:
    edge = edge_to(station)
    connect(station, edge)
    packet = bytearray(attitude(1000).pack(station.mav))
    cut = data.draw(st.integers(1, len(packet)), label="cut")
    flip = data.draw(st.integers(0, len(packet) - 1), label="flip")
    packet[flip] ^= data.draw(st.integers(1, 255), label="bits")
    station.socket.sendto(bytes(packet[:cut]), station.peer)
    for i in range(12):  # at most the 280 bytes of a wrong length are lost
        station.send(attitude(2000 + i))
    published = states(polled(edge, 2 * S))
    assert published
    assert all(s.yaw_rad == 1.0 and s.roll_rad == pytest.approx(0.1) for s in published[-3:])
    edge.close()


# --- devices that are lost and return ---


@pytest.mark.parametrize(
    ("device", "expected"),
    [
        ("udpin:nonsense", "needs HOST:PORT"),
        ("udpout:127.0.0.1:99999", "needs HOST:PORT"),
        ("tcp:127.0.0.1:1", "is the other side listening?"),
        ("udpout:no.such.host.invalid:14550", "is not known"),
        ("serial:ttyUSB0:57600", "not understood"),
        ("ttyUSB0", "not understood"),
        ("/dev/no-such-device", "is it plugged in"),
        ("/dev/null", "is it plugged in"),
    ],
)
def test_a_device_that_cannot_be_opened_at_start_raises_one_line_with_advice(device: str, expected: str) -> None:
    with pytest.raises(LinkError, match=expected) as caught:
        open_edge(LinkSection(device=device))
    assert device in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_udp_port_in_use_raises_with_advice(station: Speaker) -> None:
    with pytest.raises(LinkError, match="taken by another program"):
        open_edge(LinkSection(device=f"udpin:127.0.0.1:{station.address[1]}"))


def test_udpin_sends_to_the_sender_of_the_first_packet(station: Speaker) -> None:
    port = free_port()
    edge = open_edge(LinkSection(device=f"udpin:127.0.0.1:{port}"))
    edge.on_message(GPS)  # no peer yet: dropped without being counted
    station.send(heartbeat(), to=("127.0.0.1", port))
    published = polled(edge, 2 * S)
    assert "not sent" not in status(published).detail
    edge.on_message(GPS)
    assert len(station.received("GPS_INPUT")) == 1
    edge.close()


def test_a_serial_port_works_both_ways_and_reopens_after_unplugging(tmp_path: Any) -> None:
    master, slave = pty.openpty()
    device = tmp_path / "ttyFC"
    device.symlink_to(os.ttyname(slave))
    edge = open_edge(LinkSection(device=str(device), baud=115_200))
    autopilot = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
    os.write(master, heartbeat().pack(autopilot) + attitude(1000).pack(autopilot))
    assert len(states(polled(edge, 1 * S))) == 1
    edge.on_message(GPS)
    time.sleep(0.01)
    ours = mavlink.MAVLink(None)
    ours.robust_parsing = True
    assert "GPS_INPUT" in [x.get_type() for x in ours.parse_buffer(os.read(master, 4096))]

    os.close(slave)
    os.close(master)  # unplugged
    gone = polled(edge, 3 * S)
    edge.on_message(GPS)
    assert "connection lost" in status(gone).detail
    device.unlink()
    assert "cannot be opened again" in status(polled(edge, 5 * S)).detail

    master, slave = pty.openpty()
    device.symlink_to(os.ttyname(slave))
    polled(edge, 7 * S)
    os.write(master, heartbeat().pack(autopilot) + attitude(9000).pack(autopilot))
    back = polled(edge, 8 * S)
    assert len(states(back)) == 1
    assert "opened again 1 times" in status(back).detail
    edge.close()
    os.close(slave)
    os.close(master)


def test_a_full_serial_buffer_neither_blocks_nor_corrupts_packets() -> None:
    master, slave = pty.openpty()
    edge = open_edge(LinkSection(device=os.ttyname(slave)))
    began = time.monotonic()
    for _ in range(2000):  # the other end does not read
        edge.on_message(GPS)
    assert time.monotonic() - began < 2.0
    os.set_blocking(master, False)
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True
    kinds: list[str] = []
    for _ in range(50):
        try:
            kinds += [x.get_type() for x in parser.parse_buffer(os.read(master, 65536)) or []]
        except OSError as error:
            assert error.errno == errno.EAGAIN
        edge.on_message(GPS)
    assert len(kinds) > 50
    assert set(kinds) == {"GPS_INPUT"}
    edge.close()
    os.close(slave)
    os.close(master)


def test_tcp_reconnects_without_blocking() -> None:
    server = socket.create_server(("127.0.0.1", 0))
    address = server.getsockname()
    edge = open_edge(LinkSection(device=f"tcp:127.0.0.1:{address[1]}"))
    peer, _ = server.accept()
    autopilot = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
    peer.sendall(heartbeat().pack(autopilot) + attitude(1000).pack(autopilot))
    assert len(states(polled(edge, 1 * S))) == 1
    peer.close()
    server.close()
    for second in range(2, 6):  # every attempt to connect is refused
        began = time.monotonic()
        published = polled(edge, second * S)
        edge.on_message(GPS)
        assert time.monotonic() - began < 0.2
    assert not status(published).connected
    server = socket.create_server(address)
    polled(edge, 7 * S)
    peer, _ = server.accept()
    peer.sendall(heartbeat().pack(autopilot) + attitude(9000).pack(autopilot))
    assert len(states(polled(edge, 8 * S))) == 1
    edge.on_message(GPS)
    peer.settimeout(2.0)
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True
    edge.close()  # ends what is read
    received = b"".join(iter(lambda: peer.recv(4096), b""))
    assert "GPS_INPUT" in [x.get_type() for x in parser.parse_buffer(received)]
    peer.close()
    server.close()


def test_node_and_edge_together_send_10_hz_with_week_and_position(station: Speaker, edge: MavlinkEdge) -> None:
    live(LinkNode(10.0), edge, 1.5, LiveFlight().feed)
    sent = station.received("GPS_INPUT")
    assert 5 <= len(sent) <= 17
    good = [g for g in sent if g.fix_type == 3]
    assert len(good) >= len(sent) - 3
    assert all(g.alt == pytest.approx(ALT) and g.ve == 20.0 and g.satellites_visible == 6 for g in good)
    assert {g.time_week for g in sent} == {week_and_ms(UNIX_NS)[0]}
    for a, b in pairwise(sent):  # GPS time advances with the clock of the prediction
        assert b.time_week_ms - a.time_week_ms == pytest.approx((b.time_usec - a.time_usec) / 1e3, abs=1.0)


def test_udp_send_without_a_listener_does_not_raise() -> None:
    transport = UdpOut(("127.0.0.1", 9))
    assert transport.write(b"x")
    time.sleep(0.01)
    assert transport.write(b"x")  # ICMP has reported that no socket listens
    assert transport.read() == []
    transport.close()


def test_the_link_imports_neither_gtsam_nor_onnxruntime_nor_opencv() -> None:
    import subprocess
    import sys

    code = (
        "import sys, terrafix.link.node, terrafix.link.edge;"
        "print([n for n in ('gtsam', 'onnxruntime', 'cv2', 'faiss') if n in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
