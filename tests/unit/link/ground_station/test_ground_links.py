"""Ground links: what is sent on them, which messages are accepted from them, loss of a link; the ghost vehicle."""

import socket
import time
from collections.abc import Iterator
from typing import Any, ClassVar

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link_port import Speaker, kinds
from link_rig import estimate
from link_wire import WiredEdge, attitude, heartbeat, station_heartbeat
from terrafix import messages as m
from terrafix.core.config import LinkSection
from terrafix.core.errors import ConfigError, LinkError
from terrafix.link.node import LinkNode
from terrafix_tools.preflight.ground import check_lines

S = 1_000_000_000
GHOST_SYSID = 201
GCS = station_heartbeat()
PLACE = (480_000_000, 110_000_000)
HINT = mavlink.MAVLink_command_int_message(
    1, 197, 0, mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE, 0, 0, 0, 0, 400, 0, *PLACE, 0
)


class UdpStation(Speaker):
    """A ground station on a UDP port."""

    def __init__(self) -> None:
        super().__init__(255, 190)
        self.device = f"udpout:127.0.0.1:{self.address[1]}"


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    yield
    while GroundLinksRig.open:
        GroundLinksRig.open.pop().edge.close()


@pytest.fixture
def station() -> Iterator[UdpStation]:
    with UdpStation() as station:
        yield station


class GroundLinksRig(WiredEdge):
    """The edge with the autopilot on a wire in memory, and ground stations on real ports."""

    open: ClassVar[list["GroundLinksRig"]] = []

    def __init__(self, *devices: str, **changes: Any) -> None:
        self.open.append(self)
        super().__init__(ground_devices=list(devices), **changes)
        self.node = LinkNode(10.0)
        self.now_ns = S

    def run(self, seconds: float, *from_autopilot: Any) -> list[m.Message]:
        published: list[m.Message] = []
        for step in range(round(seconds * 50)):
            self.now_ns += S // 50
            published += self.receives(self.now_ns, *(from_autopilot if step == 0 else ()), sysid=1)
            if self.now_ns % (S // 5) == 0:
                list(self.node.on(estimate(self.now_ns, late_ns=0)))
            for message in self.node.tick(self.now_ns):
                self.edge.on_message(message)
        return published


def test_a_ground_link_gets_texts_values_and_heartbeats_and_the_autopilot_all_messages(station: UdpStation) -> None:
    rig = GroundLinksRig(station.device)
    rig.run(3.0, heartbeat())
    rig.edge.on_message(m.StatusText(t_ns=0, severity=4, text="Terrafix: a text"))
    assert kinds(station.received()) == {"HEARTBEAT", "NAMED_VALUE_FLOAT", "STATUSTEXT"}
    to_autopilot = kinds(rig.wire.take())
    assert {"GPS_INPUT", "TIMESYNC", "COMMAND_LONG", "HEARTBEAT", "NAMED_VALUE_FLOAT", "STATUSTEXT"} <= to_autopilot


def test_an_autopilot_on_a_ground_link_is_neither_served_nor_forwarded(station: UdpStation) -> None:
    rig = GroundLinksRig(station.device)
    rig.run(1.2)
    station.received()
    station.mav.srcSystem, station.mav.srcComponent = 1, 1  # a router that forwards packets of the autopilot
    station.send(heartbeat(), attitude(1000))
    published = rig.run(1.0)
    assert not [x for x in published if isinstance(x, m.VehicleState)]
    status = rig.status()
    assert not status.connected
    assert "is heard on udpout:" in status.detail and "belongs into link.device" in status.detail
    assert kinds(rig.wire.take()) & {"ATTITUDE"} == set()


def test_a_hint_on_two_links_counts_once_and_is_acknowledged_on_both(station: UdpStation) -> None:
    rig = GroundLinksRig(station.device)
    rig.run(1.2)
    station.received()
    station.send(GCS, HINT)
    time.sleep(0.02)
    published = [*rig.receives(rig.now_ns, GCS, HINT, sysid=255, compid=190), *rig.run(0.1)]
    assert len([x for x in published if isinstance(x, m.PositionHint)]) == 1
    acks = (rig.wire.take("COMMAND_ACK"), station.received("COMMAND_ACK"))
    assert [[ack.result for ack in link] for link in acks] == [[mavlink.MAV_RESULT_ACCEPTED]] * 2


def test_a_lost_ground_link_does_not_affect_the_others_and_is_opened_again(station: UdpStation) -> None:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listener.bind(("127.0.0.1", 0))
    listener.listen()
    port = listener.getsockname()[1]
    rig = GroundLinksRig(f"tcp:127.0.0.1:{port}", station.device)
    peer, _ = listener.accept()
    rig.run(1.0, heartbeat())
    assert rig.status().detail.count("ground link") == 0
    peer.close()
    listener.close()
    rig.wire.take()
    rig.run(2.0, heartbeat())
    assert f"ground link tcp:127.0.0.1:{port}: " in rig.status().detail
    assert len(rig.wire.take("GPS_INPUT")) == 20
    assert kinds(station.received())  # the other link is not affected
    again = socket.create_server(("127.0.0.1", port))
    try:
        rig.run(2.5, heartbeat())
        with again.accept()[0] as peer:
            assert peer.recv(10)
        assert "ground link" not in rig.status().detail
    finally:
        again.close()


def test_a_ground_port_in_use_does_not_delay_the_link_to_the_autopilot(station: UdpStation) -> None:
    port = station.socket.getsockname()[1]
    rig = GroundLinksRig(f"udpin:127.0.0.1:{port}")
    rig.run(1.0, heartbeat())
    assert "cannot be opened" in rig.status().detail
    assert len(rig.wire.take("GPS_INPUT")) == 10


# --- ghost vehicle ---


def from_ghost(received: list[Any]) -> list[Any]:
    return [x for x in received if x.get_srcSystem() == GHOST_SYSID]


def test_the_ghost_vehicle_is_sent_to_the_ground_and_not_to_the_autopilot(station: UdpStation) -> None:
    rig = GroundLinksRig(station.device, view_sysid=GHOST_SYSID)
    rig.run(3.0, heartbeat())
    ghost_messages = from_ghost(station.received())
    assert kinds(ghost_messages) == {"HEARTBEAT", "GPS_RAW_INT", "GLOBAL_POSITION_INT"}
    assert {x.get_srcComponent() for x in ghost_messages} == {1}
    beats = [x for x in ghost_messages if x.get_type() == "HEARTBEAT"]
    assert len(beats) == 3
    assert (beats[-1].type, beats[-1].autopilot) == (mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_GENERIC)
    positions = [x for x in ghost_messages if x.get_type() == "GLOBAL_POSITION_INT"]
    assert 4 <= len(positions) <= 7
    (sent,) = [x for x in rig.wire.take("GPS_INPUT") if x.time_usec // 1000 == positions[-1].time_boot_ms]
    assert (positions[-1].lat, positions[-1].lon, positions[-1].vy, positions[-1].hdg) == (
        sent.lat,
        sent.lon,
        2000,
        9000,
    )
    assert from_ghost(rig.wire.take()) == []


def test_without_a_fix_the_ghost_vehicle_has_no_position(station: UdpStation) -> None:
    rig = GroundLinksRig(station.device, view_sysid=GHOST_SYSID)
    rig.node.on = lambda _message: []  # type: ignore[method-assign]
    rig.run(2.0, heartbeat())
    ghost_messages = from_ghost(station.received())
    assert kinds(ghost_messages) == {"HEARTBEAT", "GPS_RAW_INT"}
    assert {(x.fix_type, x.lat, x.lon) for x in ghost_messages if x.get_type() == "GPS_RAW_INT"} == {(1, 0, 0)}
    assert [x for x in ghost_messages if x.get_type() == "HEARTBEAT"][-1].system_status == mavlink.MAV_STATE_CRITICAL


def test_the_ghost_vehicle_rejects_commands_and_an_origin_set_on_it_is_a_hint(station: UdpStation) -> None:
    rig = GroundLinksRig(station.device, view_sysid=GHOST_SYSID)
    rig.run(1.2)
    station.received()
    arm = mavlink.MAVLink_command_long_message(GHOST_SYSID, 1, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, *(0.0,) * 6)
    origin = mavlink.MAVLink_set_gps_global_origin_message(GHOST_SYSID, *PLACE, 0)
    station.send(GCS, arm, origin)
    time.sleep(0.02)
    assert len([x for x in rig.run(0.1) if isinstance(x, m.PositionHint)]) == 1
    acks = [x for x in from_ghost(station.received()) if x.get_type() == "COMMAND_ACK"]
    assert [(x.command, x.result) for x in acks] == [
        (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, mavlink.MAV_RESULT_UNSUPPORTED)
    ]


def test_a_ghost_vehicle_that_a_router_sends_back_is_not_an_autopilot(station: UdpStation) -> None:
    rig = GroundLinksRig(station.device, view_sysid=GHOST_SYSID)
    beat = mavlink.MAVLink_heartbeat_message(1, mavlink.MAV_AUTOPILOT_GENERIC, 0, 0, 4, 3)
    rig.receives(rig.now_ns, beat, sysid=GHOST_SYSID)
    rig.run(0.5)
    assert not rig.status().connected

    assert "has the id of link.view_sysid" in rig.status().detail


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        ({"ground_devices": ["udpout:127.0.0.1:14550"]}, ConfigError, "names the autopilot's device"),
        ({"view_sysid": 201}, ConfigError, "needs a link of its own to the ground"),
        ({"ground_devices": ["udpout:10.0.0.2:1"], "view_sysid": 1}, ConfigError, "is the vehicle's own id"),
        ({"ground_devices": ["udpout:laptop:14550"]}, LinkError, "has a host name: .*; write its IPv4 address"),
        ({"ground_devices": ["udpout:14550"]}, LinkError, "needs HOST:PORT"),
        ({"ground_devices": ["udp:10.0.0.2:14550"]}, LinkError, "not understood"),
    ],
)
def test_an_inconsistent_configuration_of_ground_links_raises(
    changes: dict[str, Any], error: type[Exception], text: str
) -> None:
    with pytest.raises(error, match=text):
        WiredEdge(**changes)


def test_preflight_checks_the_ground_links(station: UdpStation) -> None:
    taken = f"udpin:127.0.0.1:{station.socket.getsockname()[1]}"
    by_status = {
        "ok": {"ground_devices": [station.device], "view_sysid": GHOST_SYSID},
        "warn": {"ground_devices": [taken]},
        "fail": {"view_sysid": GHOST_SYSID},
    }
    for status, changes in by_status.items():
        (line,) = check_lines(LinkSection(**changes))  # type: ignore[arg-type]
        assert line.status == status and bool(line.fix) == (status != "ok")
    assert list(check_lines(LinkSection())) == []
