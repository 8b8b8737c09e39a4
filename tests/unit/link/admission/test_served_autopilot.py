"""The served autopilot among other senders: two vehicles, forgers and ground stations on real sockets."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import msgspec
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from gps_messages import GPS
from link_port import Port, Speaker, free_port, listening
from link_rig import MS, S
from link_wire import WiredEdge, armed, attitude, heartbeat, packed, states, station_heartbeat
from terrafix import messages as m
from terrafix.core.config import LinkSection
from terrafix.link.admission.served_autopilot import (
    ADDRESS_CHANGE_TIMEOUT_NS,
    HEARTBEATS_ONLY_NS,
    OTHER_TIMEOUT_NS,
    VEHICLE_CHANGE_TIMEOUT_NS,
    OtherAutopilot,
    ServedAutopilot,
    change_text,
    pilot_text,
)
from terrafix.link.autopilot.checkpoint import ArmedAutopilot, LinkCheckpointWriter, load_checkpoint
from terrafix.link.autopilot.ekf_dead_reckoning import EkfState, LastFix
from terrafix.link.edge import open_edge
from terrafix.link.mavlink.transport import MAX_PEERS, UdpOut

pytestmark = pytest.mark.real_time  # the packets go through the kernel

PLACE = (480_000_000, 110_000_000)
ORIGIN_HERE = mavlink.MAVLink_set_gps_global_origin_message(7, *PLACE, 0)
CAMERA_ON_7 = m.CameraVehicle(t_ns=0, sysid=7)
LAST_FIX = LastFix(EkfState(1000, 48.0, 11.0, (0.0,) * 3), 48.0, 11.0, (0.0,) * 3, 3.0, 0.3, frozenset())


@pytest.fixture
def port() -> Iterator[Port]:
    port = listening()
    yield port
    port.edge.close()


@pytest.fixture
def ours() -> Iterator[Speaker]:
    with Speaker(7) as speaker:
        yield speaker


@pytest.fixture
def theirs() -> Iterator[Speaker]:
    with Speaker(9) as speaker:
        yield speaker


def hints(published: list[m.Message]) -> list[m.PositionHint]:
    return [x for x in published if isinstance(x, m.PositionHint)]


# --- one port, two vehicles ---


def test_the_position_is_sent_to_the_served_autopilot_only(port: Port, ours: Speaker, theirs: Speaker) -> None:
    port.receives(1 * S, ours, heartbeat())
    port.edge.on_message(CAMERA_ON_7)
    port.receives(2 * S, theirs, heartbeat())
    theirs.received()
    for tenth in range(21, 50):
        port.receives(tenth * 100 * MS, theirs, heartbeat())
        ours.send(heartbeat(), to=port.address)
        port.edge.on_message(GPS)
    assert len(ours.received("GPS_INPUT")) == 29
    assert theirs.kinds() == set()  # no position, text or request


def test_no_position_is_sent_before_an_autopilot_heartbeat(port: Port, ours: Speaker) -> None:
    with Speaker(255, 190) as station:
        port.receives(1 * S, station, station_heartbeat())
        port.edge.on_message(GPS)
        assert "GPS_INPUT" not in station.kinds()


def test_a_second_vehicle_causes_one_warning_and_another_when_it_returns(
    port: Port, ours: Speaker, theirs: Speaker
) -> None:
    port.edge.on_message(CAMERA_ON_7)
    for second in range(1, 6):
        port.receives(second * S, ours, heartbeat())
        port.receives(second * S + MS, theirs, heartbeat())
    warning = "Terrafix: vehicle 9 on our port gets nothing"
    assert port.texts() == [warning]
    assert warning in [x.text for x in ours.received("STATUSTEXT")]
    assert f"7 is served, 9 at 127.0.0.1:{theirs.address[1]} gets nothing" in port.status().detail
    assert "second sender" not in port.status().detail
    for second in range(6, 20):
        port.receives(second * S, ours, heartbeat())
    assert "9 at" not in port.status().detail
    port.receives(20 * S, theirs, heartbeat())
    assert port.texts() == [warning, warning]


def test_a_warning_names_a_vehicle_that_receives_gps_input_over_the_same_wire() -> None:
    link = WiredEdge(autopilot_sysid=7)
    for sysid in (7, 9):
        link.receives(sysid * S, heartbeat(), sysid=sysid)
    assert link.texts() == ["Terrafix: vehicle 9 on our link gets GPS_INPUT"]
    assert "reaches them too; give each a link of its own" in link.status().detail


@pytest.mark.parametrize("address", [None, ("10.0.0.7", 14550)])
@pytest.mark.parametrize("sysid", [255, 254])
def test_texts_about_other_vehicles_fit_into_statustext(sysid: int, address: tuple[str, int] | None) -> None:
    assert len("Terrafix: " + pilot_text(OtherAutopilot(sysid, address), 255)) <= 50
    assert len("Terrafix: " + change_text(sysid, 255)) <= 50


# --- the system id of the configuration ---


def test_autopilot_sysid_selects_the_receiver_of_the_position_on_a_port(ours: Speaker, theirs: Speaker) -> None:
    port = listening(autopilot_sysid=9)
    port.receives(1 * S, ours, heartbeat())
    port.edge.on_message(GPS)
    port.receives(2 * S, theirs, heartbeat())
    port.edge.on_message(GPS)
    port.edge.close()
    assert ours.received("GPS_INPUT") == []
    assert len(theirs.received("GPS_INPUT")) == 1


def test_autopilot_sysid_selects_the_receiver_of_the_position_on_a_wire() -> None:
    link = WiredEdge(autopilot_sysid=9)
    for sysid, positions in ((7, 0), (9, 1)):
        link.receives(sysid * S, heartbeat(), sysid=sysid)
        link.edge.on_message(GPS)
        assert len(link.wire.take("GPS_INPUT")) == positions
        assert link.status().connected == (sysid == 9) != ("has system id 7, not 9" in link.status().detail)
    assert link.status().sysid == 9


def test_a_point_to_point_link_sends_the_position_before_any_reception() -> None:
    """An autopilot that boots must receive fix type 1."""
    link = WiredEdge()
    link.edge.on_message(GPS)
    assert len(link.wire.take("GPS_INPUT")) == 1


# --- silence ---


def test_the_same_vehicle_is_served_at_a_new_address_after_three_seconds_of_silence(port: Port, ours: Speaker) -> None:
    port.receives(1 * S, ours, armed(), attitude(100_000))
    with Speaker(7) as moved:
        port.receives(1 * S + ADDRESS_CHANGE_TIMEOUT_NS - MS, moved, armed())
        port.edge.on_message(GPS)
        assert moved.received("GPS_INPUT") == []
        port.receives(1 * S + ADDRESS_CHANGE_TIMEOUT_NS + MS, moved, armed())
        ours.received()
        port.edge.on_message(GPS)
        assert len(moved.received("GPS_INPUT")) == 1
        # Time and attitude from the old address are not compared with those from the new one.
        assert len(states(port.receives(2 * S + ADDRESS_CHANGE_TIMEOUT_NS, moved, attitude(5, yaw=-2.0)))) == 1
    assert ours.received("GPS_INPUT") == []


@pytest.mark.parametrize(
    ("last", "silent_ns", "positions"),
    [
        pytest.param([heartbeat(), attitude(1000)], VEHICLE_CHANGE_TIMEOUT_NS, [0, 1], id="30 s of one not armed"),
        pytest.param([armed(), attitude(1000)], VEHICLE_CHANGE_TIMEOUT_NS, [0, 0], id="never after one in flight"),
        pytest.param([armed()], HEARTBEATS_ONLY_NS, [0, 1], id="5 s of one that sent heartbeats only"),
    ],
)
def test_another_vehicle_is_served_after_a_silence(
    port: Port, ours: Speaker, theirs: Speaker, last: list[object], silent_ns: int, positions: list[int]
) -> None:
    port.receives(1 * S, ours, *last)
    found = []
    for at_ns in (1 * S + silent_ns - MS, 1 * S + silent_ns + MS):
        port.receives(at_ns, theirs, armed())
        port.edge.on_message(GPS)
        found.append(len(theirs.received("GPS_INPUT")))
    assert found == positions
    change = ["Terrafix: vehicle 9 is served, 7 is not"] if positions[1] else []
    assert port.texts() == ["Terrafix: no fix: camera on vehicle 7, 9?", *change]


@pytest.mark.parametrize(("first", "other", "changes"), [("heartbeats", "all", True), ("all", "all", False)])
def test_a_vehicle_with_telemetry_is_served_instead_of_one_that_sends_heartbeats_only(
    port: Port, ours: Speaker, theirs: Speaker, first: str, other: str, changes: bool
) -> None:
    served, sent = [], []
    for second in range(1, 9):
        port.receives(second * S, theirs, armed(), *([attitude(1000 * second)] if first == "all" else []))
        port.receives(second * S + MS, ours, armed(), *([attitude(1000 * second)] if other == "all" else []))
        port.edge.on_message(msgspec.structs.replace(GPS, t_ns=second * S + 2 * MS))
        served.append([x.sysid for x in port.published if isinstance(x, m.ServedVehicle)][-1])
        sent += [*theirs.received("GPS_INPUT"), *ours.received("GPS_INPUT")]
    assert served == ([9] * 5 + [7] * 3 if changes else [9] * 8)
    assert len(sent) == 0  # which of the two carries the camera is not known


@pytest.mark.parametrize("has_fix", [False, True])
def test_after_a_restart_another_vehicle_is_served_only_if_the_last_one_never_used_a_fix(
    tmp_path: Path, has_fix: bool
) -> None:
    writer = LinkCheckpointWriter(tmp_path / "link.checkpoint")
    writer.on_heartbeat(ArmedAutopilot(9, 3, 1))
    if has_fix:
        writer.on_fix(LAST_FIX, 0.0)
    served = ServedAutopilot(0, is_listening=False, checkpoint=load_checkpoint(tmp_path / "link.checkpoint"))
    mav = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
    for second in (1, 7):
        (beat,) = mavlink.MAVLink(None).parse_buffer(packed(armed(), mav))
        served.classify(beat, None, second * S)
    assert served.sysid == (9 if has_fix else 7)


def test_a_restarted_link_serves_the_address_from_the_checkpoint(
    tmp_path: Path, ours: Speaker, theirs: Speaker
) -> None:
    port = free_port()
    config = LinkSection(device=f"udpin:127.0.0.1:{port}")
    before = Port(open_edge(config, tmp_path / "link.checkpoint"), ("127.0.0.1", port))
    before.receives(1 * S, ours, armed())
    before.edge.close()
    found = load_checkpoint(tmp_path / "link.checkpoint")
    assert found is not None and found.peer == ours.address
    ours.received()
    after = Port(open_edge(config, tmp_path / "link.checkpoint"), ("127.0.0.1", port))
    with Speaker(7) as forger:
        assert states(after.receives(2 * S, forger, armed(), attitude(1000))) == []
    after.edge.on_message(CAMERA_ON_7)
    after.receives(3 * S, theirs, heartbeat())
    after.edge.on_message(GPS)
    after.edge.close()
    assert len(ours.received("GPS_INPUT")) == 1 and theirs.received("GPS_INPUT") == []


def test_a_checkpoint_of_another_system_id_than_configured_is_ignored(tmp_path: Path) -> None:
    LinkCheckpointWriter(tmp_path / "link.checkpoint").on_heartbeat(ArmedAutopilot(7, 3, 1))
    link = WiredEdge(checkpoint=tmp_path / "link.checkpoint", autopilot_sysid=9)
    link.poll(S)
    assert not link.status().connected


# --- forgers ---


def test_timesync_responses_of_another_component_are_ignored() -> None:
    link, offsets = WiredEdge(), []
    for begin_ns, sender in ((10 * S, 191), (20 * S, 1)):
        link.receives(begin_ns, heartbeat())
        for i in range(1, 20):
            replies = [mavlink.MAVLink_timesync_message(99 * S, t.ts1) for t in link.wire.take("TIMESYNC")]
            link.receives(begin_ns + i * 100 * MS, *replies, compid=sender)
        offsets.append(link.status().time_offset_ms)
    assert offsets[0] is None and offsets[1] is not None


def test_an_incomplete_packet_of_one_sender_does_not_consume_packets_of_another(
    port: Port, ours: Speaker, theirs: Speaker
) -> None:
    theirs.socket.sendto(b"\xfd\xff" + bytes(40), port.address)
    published = port.receives(1 * S, ours, heartbeat(), attitude(1000))
    assert len(states(published)) == 1


def test_bytes_outside_of_packets_are_counted(port: Port, ours: Speaker) -> None:
    ours.socket.sendto(b"garbage", port.address)
    port.receives(1 * S, ours, heartbeat())
    assert port.status().bad == len(b"garbage")


def test_broadcasts_go_to_the_eight_most_recent_senders(port: Port) -> None:
    with ExitStack() as stack:
        speakers = [stack.enter_context(Speaker(255, 190)) for _ in range(MAX_PEERS + 2)]
        for i, speaker in enumerate(speakers):
            port.receives(S + i * MS, speaker, station_heartbeat())
        for speaker in speakers:
            speaker.received()
        port.edge.on_message(m.StatusText(t_ns=0, severity=4, text="Terrafix: a text"))
        counts = [len(speaker.received("STATUSTEXT")) for speaker in speakers]
    assert counts == [0, 0] + [1] * MAX_PEERS
    assert len(port.edge._connection._framers) == MAX_PEERS


def test_a_timesync_request_is_answered_to_its_sender_only(port: Port, ours: Speaker) -> None:
    port.receives(1 * S, ours, heartbeat())
    with Speaker(255, 190) as station:
        ours.received()
        port.receives(1100 * MS, station, mavlink.MAVLink_timesync_message(0, 777))
        assert [t.ts1 for t in station.received("TIMESYNC")] == [777]
    assert 777 not in [t.ts1 for t in ours.received("TIMESYNC")]


def test_a_second_sender_with_the_autopilots_id_is_rejected_and_gets_nothing(port: Port, ours: Speaker) -> None:
    port.receives(101 * S, ours, heartbeat(), attitude(1000, yaw=1.0))
    ours.received()
    with Speaker(7) as forger:
        published = port.receives(
            101_100 * MS, forger, attitude(1100, yaw=2.0), heartbeat(), station_heartbeat(), ORIGIN_HERE
        )
        port.edge.on_message(GPS)
        assert states(published) == [] and hints(published) == []
        assert forger.kinds() == set()
    assert states(port.receives(101_200 * MS, ours, attitude(1200, yaw=1.0)))
    assert port.texts() == ["Terrafix: a second sender is system 7, ignored"]
    (verdict, *_) = [x for x in port.published if isinstance(x, m.MeasurementVerdict)]
    assert (verdict.measurement, verdict.verdict) == ("telemetry", m.Verdict.IMPLAUSIBLE)
    assert f"127.0.0.1:{forger.address[1]}" in verdict.detail
    port.receives(103 * S, ours, heartbeat())
    assert f"a second sender of system 7 at 127.0.0.1:{forger.address[1]} is ignored" in port.status().detail


def test_a_rejected_address_is_accepted_as_a_ground_station_after_its_timeout(port: Port, ours: Speaker) -> None:
    port.receives(1 * S, ours, heartbeat())
    with Speaker(7) as forger:
        port.receives(2 * S, forger, attitude(1100))
        forger.mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        assert hints(port.receives(3 * S, forger, station_heartbeat(), ORIGIN_HERE)) == []
        assert len(hints(port.receives(2 * S + OTHER_TIMEOUT_NS, forger, station_heartbeat(), ORIGIN_HERE))) == 1


def test_udpout_receives_from_its_address_only_and_reports_other_senders(ours: Speaker) -> None:
    edge = open_edge(LinkSection(device=f"udpout:127.0.0.1:{ours.address[1]}"))
    port = Port(edge, ("127.0.0.1", 0))
    port.poll(0)
    beat = ours.socket.recvfrom(4096)[1]
    port.address = beat
    with Speaker(7) as forger:
        published = port.receives(1 * S, forger, heartbeat(), attitude(1000), station_heartbeat(), ORIGIN_HERE)
        assert states(published) == [] and hints(published) == []
        assert f"4 packets ignored, the last from 127.0.0.1:{forger.address[1]}" in port.status().detail
    assert states(port.receives(2 * S, ours, heartbeat(), attitude(1100)))
    edge.close()


def test_udpout_to_loopback_binds_to_loopback() -> None:
    near, far = UdpOut(("127.0.0.1", 9)), UdpOut(("192.0.2.1", 9))
    assert near._socket.getsockname()[0] == "127.0.0.1"
    assert far._socket.getsockname()[0] == "0.0.0.0"
    near.close()
    far.close()


# --- ground stations on the same port ---


def test_a_ground_station_on_the_port_receives_texts_and_may_send_hints(port: Port, ours: Speaker) -> None:
    port.receives(1 * S, ours, heartbeat())
    ours.received()
    with Speaker(255, 190) as station:
        assert len(hints(port.receives(2 * S, station, station_heartbeat(), ORIGIN_HERE))) == 1
        command = mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE
        other_place = (PLACE[0] + 1000, PLACE[1])
        hint = mavlink.MAVLink_command_int_message(1, 197, 0, command, 0, 0, 0, 0, 400, 0, *other_place, 0)
        assert len(hints(port.receives(3 * S, station, hint))) == 1
        port.edge.on_message(m.StatusText(t_ns=0, severity=4, text="Terrafix: a text"))
        for half in (4, 6):
            port.edge.on_message(msgspec.structs.replace(GPS, t_ns=half * S // 2))
        assert station.kinds() == {"HEARTBEAT", "STATUSTEXT", "NAMED_VALUE_FLOAT", "COMMAND_ACK"}
    assert ours.received("COMMAND_ACK") == []  # acknowledgements go to the sender of the command
