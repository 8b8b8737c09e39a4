"""Who is served on a link, and who is not heard there: two vehicles, forgers and ground stations on real sockets."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import msgspec
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from gps_input_message import GPS
from link_port import Port, Speaker, armed, free_port, listening, station_heartbeat
from link_rig import MS, S
from link_wire import MemoryWire, attitude, heartbeat, packed, states
from terrafix import messages as m
from terrafix.core.config import LinkSection
from terrafix.link.admission.served_autopilot import FRESH_NS, MOVED_AFTER_NS, OTHER_AFTER_NS, Other, pilot_text
from terrafix.link.autopilot.checkpoint import ArmedAutopilot, CheckpointWriter, load_checkpoint
from terrafix.link.edge import MavlinkEdge, open_edge
from terrafix.link.mavlink.transport import PEERS_MAX, UdpOut

pytestmark = pytest.mark.real_time  # the packets go through the kernel

PLACE = (480_000_000, 110_000_000)
ORIGIN_HERE = mavlink.MAVLink_set_gps_global_origin_message(7, *PLACE, 0)


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


def hints(said: list[m.Message]) -> list[m.PositionHint]:
    return [x for x in said if isinstance(x, m.PositionHint)]


# --- one port, two vehicles ---


def test_the_position_goes_to_the_first_autopilot_alone(port: Port, ours: Speaker, theirs: Speaker) -> None:
    port.receives(1 * S, ours, heartbeat())
    port.receives(2 * S, theirs, heartbeat())
    theirs.heard()
    for tenth in range(21, 50):
        port.receives(tenth * 100 * MS, theirs, heartbeat())
        ours.send(port.address, heartbeat())
        port.edge.heard(GPS)
    assert len(ours.heard("GPS_INPUT")) == 29
    assert theirs.kinds() == set()  # neither position nor texts nor requests


def test_before_an_autopilot_is_heard_nobody_gets_a_position(port: Port, ours: Speaker) -> None:
    with Speaker(255, 190) as station:
        port.receives(1 * S, station, station_heartbeat())
        port.edge.heard(GPS)
        assert "GPS_INPUT" not in station.kinds()


def test_a_second_vehicle_is_warned_of_once_and_again_when_it_comes_back(
    port: Port, ours: Speaker, theirs: Speaker
) -> None:
    for second in range(1, 6):
        port.receives(second * S, ours, heartbeat())
        port.receives(second * S + MS, theirs, heartbeat())
    warning = "Terrafix: vehicle 9 on our port gets nothing"
    assert port.texts() == [warning]
    assert warning in [x.text for x in ours.heard("STATUSTEXT")]
    assert (
        f"7 is served, 9 at 127.0.0.1:{theirs.address[1]} gets nothing" in port.detail()
        and "second sender" not in port.detail()
    )
    for second in range(6, 20):
        port.receives(second * S, ours, heartbeat())
    assert "9 at" not in port.detail()
    port.receives(20 * S, theirs, heartbeat())
    assert port.texts() == [warning, warning]


def test_a_vehicle_behind_the_same_router_is_said_to_get_the_position_too() -> None:
    wire = MemoryWire()
    edge = MavlinkEdge(LinkSection(autopilot_sysid=7), wire, lambda: 0)
    for sysid in (7, 9):
        wire.arrive(packed(heartbeat(), mavlink.MAVLink(None, srcSystem=sysid, srcComponent=1)))
    said = [*edge.poll(1 * S), *edge.poll(2 * S)]
    assert [x.text for x in said if isinstance(x, m.StatusText)] == ["Terrafix: vehicle 9 on our link hears us too"]
    assert (
        "reaches them too; give each a link of its own" in [x for x in said if isinstance(x, m.LinkStatus)][-1].detail
    )


@pytest.mark.parametrize("address", [None, ("10.0.0.7", 14550)])
@pytest.mark.parametrize("sysid", [255, 254])
def test_what_the_pilot_reads_of_others_fits_the_screen(sysid: int, address: tuple[str, int] | None) -> None:
    assert len("Terrafix: " + pilot_text(Other(sysid, address), 255)) <= 50


# --- the system id of the configuration ---


def test_autopilot_sysid_filters_what_is_sent_on_a_port(ours: Speaker, theirs: Speaker) -> None:
    port = listening(autopilot_sysid=9)
    port.receives(1 * S, ours, heartbeat())
    port.edge.heard(GPS)
    port.receives(2 * S, theirs, heartbeat())
    port.edge.heard(GPS)
    port.edge.close()
    assert ours.heard("GPS_INPUT") == []
    assert len(theirs.heard("GPS_INPUT")) == 1


def test_autopilot_sysid_filters_what_is_sent_on_a_wire() -> None:
    wire = MemoryWire()
    edge = MavlinkEdge(LinkSection(autopilot_sysid=9), wire, lambda: 0)
    for sysid, positions in ((7, 0), (9, 1)):
        wire.arrive(packed(heartbeat(), mavlink.MAVLink(None, srcSystem=sysid, srcComponent=1)))
        list(edge.poll(sysid * S))
        edge.heard(GPS)
        assert len(wire.take("GPS_INPUT")) == positions


def test_a_wire_with_one_other_end_gets_the_position_before_anybody_is_heard() -> None:
    """An autopilot that boots must see fix type 1."""
    wire = MemoryWire()
    MavlinkEdge(LinkSection(), wire, lambda: 0).heard(GPS)
    assert len(wire.take("GPS_INPUT")) == 1


# --- silence ---


def test_the_same_vehicle_is_served_at_its_new_address_after_three_seconds(port: Port, ours: Speaker) -> None:
    port.receives(1 * S, ours, armed(), attitude(100_000))
    with Speaker(7) as moved:
        port.receives(1 * S + MOVED_AFTER_NS - MS, moved, armed())
        port.edge.heard(GPS)
        assert moved.heard("GPS_INPUT") == []
        port.receives(1 * S + MOVED_AFTER_NS + MS, moved, armed())
        ours.heard()
        port.edge.heard(GPS)
        assert len(moved.heard("GPS_INPUT")) == 1
        # What the old address said of time and attitude does not count.
        assert len(states(port.receives(2 * S + MOVED_AFTER_NS, moved, attitude(5, yaw=-2.0)))) == 1
    assert ours.heard("GPS_INPUT") == []


@pytest.mark.parametrize("flies", [False, True])
def test_another_vehicle_is_served_after_half_a_minute_and_never_in_flight(
    port: Port, ours: Speaker, theirs: Speaker, flies: bool
) -> None:
    port.receives(1 * S, ours, armed() if flies else heartbeat())
    positions = []
    for at_ns in (1 * S + OTHER_AFTER_NS - MS, 1 * S + OTHER_AFTER_NS + MS):
        port.receives(at_ns, theirs, heartbeat())
        port.edge.heard(GPS)
        positions.append(len(theirs.heard("GPS_INPUT")))
    assert positions == [0, 0 if flies else 1]


def test_a_link_that_is_started_again_serves_the_address_of_before(
    tmp_path: Path, ours: Speaker, theirs: Speaker
) -> None:
    port = free_port()
    config = LinkSection(device=f"udpin:127.0.0.1:{port}")
    before = Port(open_edge(config, tmp_path / "link.checkpoint"), ("127.0.0.1", port))
    before.receives(1 * S, ours, armed())
    before.edge.close()
    found = load_checkpoint(tmp_path / "link.checkpoint")
    assert found is not None and found.peer == ours.address
    ours.heard()
    after = Port(open_edge(config, tmp_path / "link.checkpoint"), ("127.0.0.1", port))
    with Speaker(7) as forger:
        assert states(after.receives(2 * S, forger, armed(), attitude(1000))) == []
    after.receives(3 * S, theirs, heartbeat())
    after.edge.heard(GPS)
    after.edge.close()
    assert len(ours.heard("GPS_INPUT")) == 1 and theirs.heard("GPS_INPUT") == []


def test_one_that_the_configuration_does_not_name_is_not_taken_over(tmp_path: Path) -> None:
    keeper = CheckpointWriter(tmp_path / "link.checkpoint")
    keeper.heard(ArmedAutopilot(7, 3, 1))
    config = LinkSection(autopilot_sysid=9)
    edge = MavlinkEdge(config, MemoryWire(), lambda: 0, keeper=CheckpointWriter(tmp_path / "link.checkpoint"))
    assert not [x for x in edge.poll(S) if isinstance(x, m.LinkStatus)][-1].connected


# --- forgers ---


def test_the_clock_of_another_component_is_not_the_autopilots() -> None:
    wire, offsets = MemoryWire(), []
    edge = MavlinkEdge(LinkSection(), wire, lambda: 0)
    for begin_ns, sender in ((10 * S, 191), (20 * S, 1)):
        mav = mavlink.MAVLink(None, srcSystem=7, srcComponent=sender)
        beat = packed(heartbeat(), mavlink.MAVLink(None, srcSystem=7, srcComponent=1))
        said: list[m.Message] = []
        for i in range(20):
            wire.arrive(*(packed(mavlink.MAVLink_timesync_message(99 * S, t.ts1), mav) for t in wire.take("TIMESYNC")))
            wire.arrive(*([beat] if i == 0 else []))
            said += edge.poll(begin_ns + i * 100 * MS)
        offsets.append([x for x in said if isinstance(x, m.LinkStatus)][-1].time_offset_ms)
    assert offsets[0] is None and offsets[1] is not None


def test_half_a_packet_of_one_sender_swallows_none_of_another(port: Port, ours: Speaker, theirs: Speaker) -> None:
    theirs.socket.sendto(b"\xfd\xff" + bytes(40), port.address)
    said = port.receives(1 * S, ours, heartbeat(), attitude(1000))
    assert len(states(said)) == 1


def test_bytes_that_are_no_packet_are_counted(port: Port, ours: Speaker) -> None:
    ours.socket.sendto(b"garbage", port.address)
    port.receives(1 * S, ours, heartbeat())
    assert [x for x in port.said if isinstance(x, m.LinkStatus)][-1].bad == len(b"garbage")


def test_of_many_senders_the_last_eight_are_answered(port: Port) -> None:
    with ExitStack() as stack:
        speakers = [stack.enter_context(Speaker(255, 190)) for _ in range(PEERS_MAX + 2)]
        for i, speaker in enumerate(speakers):
            port.receives(S + i * MS, speaker, station_heartbeat())
        for speaker in speakers:
            speaker.heard()
        port.edge.heard(m.StatusText(t_ns=0, severity=4, text="Terrafix: a word"))
        heard = [len(speaker.heard("STATUSTEXT")) for speaker in speakers]
    assert heard == [0, 0] + [1] * PEERS_MAX
    assert len(port.edge._connection._framers) == PEERS_MAX


def test_who_asks_for_our_time_alone_is_told(port: Port, ours: Speaker) -> None:
    port.receives(1 * S, ours, heartbeat())
    with Speaker(255, 190) as station:
        ours.heard()
        port.receives(1100 * MS, station, mavlink.MAVLink_timesync_message(0, 777))
        assert [t.ts1 for t in station.heard("TIMESYNC")] == [777]
    assert 777 not in [t.ts1 for t in ours.heard("TIMESYNC")]


def test_a_second_sender_with_our_autopilots_id_is_not_heard_and_gets_nothing(port: Port, ours: Speaker) -> None:
    port.receives(101 * S, ours, heartbeat(), attitude(1000, yaw=1.0))
    ours.heard()
    with Speaker(7) as forger:
        said = port.receives(
            101_100 * MS, forger, attitude(1100, yaw=2.0), heartbeat(), station_heartbeat(), ORIGIN_HERE
        )
        port.edge.heard(GPS)
        assert states(said) == [] and hints(said) == []
        assert forger.kinds() == set()
    assert states(port.receives(101_200 * MS, ours, attitude(1200, yaw=1.0)))
    assert port.texts() == ["Terrafix: a second sender is system 7, ignored"]
    (verdict, *_) = [x for x in port.said if isinstance(x, m.MeasurementVerdict)]
    assert (verdict.measurement, verdict.verdict) == ("telemetry", m.Verdict.IMPLAUSIBLE)
    assert f"127.0.0.1:{forger.address[1]}" in verdict.detail
    port.receives(103 * S, ours, heartbeat())
    assert f"a second sender of system 7 at 127.0.0.1:{forger.address[1]} is ignored" in port.detail()


def test_a_forger_that_has_been_silent_may_be_a_ground_station_again(port: Port, ours: Speaker) -> None:
    port.receives(1 * S, ours, heartbeat())
    with Speaker(7) as forger:
        port.receives(2 * S, forger, attitude(1100))
        forger.mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        assert hints(port.receives(3 * S, forger, station_heartbeat(), ORIGIN_HERE)) == []
        assert len(hints(port.receives(2 * S + FRESH_NS, forger, station_heartbeat(), ORIGIN_HERE))) == 1


def test_udpout_hears_its_address_alone_and_says_whom_it_does_not_hear(ours: Speaker) -> None:
    edge = open_edge(LinkSection(device=f"udpout:127.0.0.1:{ours.address[1]}"))
    port = Port(edge, ("127.0.0.1", 0))
    port.poll(0)
    beat = ours.socket.recvfrom(4096)[1]
    port.address = beat
    with Speaker(7) as forger:
        said = port.receives(1 * S, forger, heartbeat(), attitude(1000), station_heartbeat(), ORIGIN_HERE)
        assert states(said) == [] and hints(said) == []
        assert f"4 packets ignored, the last from 127.0.0.1:{forger.address[1]}" in port.detail()
    assert states(port.receives(2 * S, ours, heartbeat(), attitude(1100)))
    edge.close()


def test_udpout_to_loopback_is_bound_to_loopback() -> None:
    near, far = UdpOut(("127.0.0.1", 9)), UdpOut(("192.0.2.1", 9))
    assert near._socket.getsockname()[0] == "127.0.0.1"
    assert far._socket.getsockname()[0] == "0.0.0.0"
    near.close()
    far.close()


# --- ground stations on the same port ---


def test_a_ground_station_on_the_port_reads_texts_and_sends_hints(port: Port, ours: Speaker) -> None:
    port.receives(1 * S, ours, heartbeat())
    ours.heard()
    with Speaker(255, 190) as station:
        assert len(hints(port.receives(2 * S, station, station_heartbeat(), ORIGIN_HERE))) == 1
        command = mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE
        other_place = (PLACE[0] + 1000, PLACE[1])
        hint = mavlink.MAVLink_command_int_message(1, 197, 0, command, 0, 0, 0, 0, 400, 0, *other_place, 0)
        assert len(hints(port.receives(3 * S, station, hint))) == 1
        port.edge.heard(m.StatusText(t_ns=0, severity=4, text="Terrafix: a word"))
        for half in (4, 6):
            port.edge.heard(msgspec.structs.replace(GPS, t_ns=half * S // 2))
        assert station.kinds() == {"HEARTBEAT", "STATUSTEXT", "NAMED_VALUE_FLOAT", "COMMAND_ACK"}
    assert ours.heard("COMMAND_ACK") == []  # answers go to whoever asked
