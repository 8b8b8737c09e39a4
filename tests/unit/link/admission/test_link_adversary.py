"""Forgers beside the real link (node and edge) and the simulated autopilot, in real time and on real sockets."""

from functools import partial

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link_port import Speaker, free_port
from link_rig import MS, live, texts
from link_wire import station_heartbeat
from live_flight import LiveFlight, eastward
from terrafix import messages as m
from terrafix.core.config import LinkSection
from terrafix.link.edge import open_edge
from terrafix.link.node import LinkNode
from terrafix_lab.sim.autopilot.peer import AutopilotPeer

pytestmark = pytest.mark.real_time

SECONDS = 2.0
FORGED_ROLL = 0.4  # rad: 23 degrees, which displaces the optical axis on the ground by half the height


class Forger:
    """Sends every 40 ms a forged roll of the autopilot ``sysid``, and hints as a ground station."""

    def __init__(self, speaker: Speaker, to: tuple[str, int], sysid: int) -> None:
        self._speaker, self._to, self._sysid = speaker, to, sysid
        self._next_ns = 0

    def send_due(self, now_ns: int) -> None:
        if now_ns < self._next_ns:
            return
        self._next_ns = now_ns + 40 * MS
        leaning = mavlink.MAVLink_attitude_message(now_ns // MS % 2**32, FORGED_ROLL, 0.0, 0.0, 0, 0, 0)
        hint = mavlink.MAVLink_set_gps_global_origin_message(self._sysid, 490_000_000, 120_000_000, 0)
        self._speaker.send(leaning, station_heartbeat(), hint, to=self._to)


@pytest.mark.slow
def test_of_two_copters_on_one_port_only_the_served_one_receives_gps_input() -> None:
    port = free_port()
    edge = open_edge(LinkSection(device=f"udpin:127.0.0.1:{port}"))
    ours, theirs, flight = AutopilotPeer(seed=1, sysid=1), AutopilotPeer(seed=2, sysid=2), LiveFlight()
    ours.start(0, eastward, flight.clock, to=port)
    published = live(LinkNode(10.0), edge, 1.5, flight.feed)
    edge.on_message(m.CameraVehicle(t_ns=0, sysid=1))
    theirs.start(0, partial(eastward, north_m=66_000.0), to=port)
    published += live(LinkNode(10.0), edge, SECONDS, flight.feed)
    first, second = ours.stop(), theirs.stop()
    edge.close()
    assert first.gps_input_received > 10 * (SECONDS - 1.0)
    assert second.gps_input_received == 0
    assert second.position_error_max_m is None or second.position_error_max_m < 100.0
    assert [x.text for x in published if isinstance(x, m.StatusText) if "vehicle 2" in x.text] == [
        "Terrafix: vehicle 2 on our port gets nothing"
    ]
    assert "Terrafix: vehicle 2 on our port gets nothing" in first.status_texts


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["udpin", "udpout"])
def test_forged_telemetry_and_hints_have_no_effect(kind: str) -> None:
    peer, flight = AutopilotPeer(seed=3), LiveFlight()
    if kind == "udpin":
        port = free_port()
        peer.start(0, eastward, flight.clock, to=port)
    else:
        port = peer.start(0, eastward, flight.clock)
    edge = open_edge(LinkSection(device=f"{kind}:127.0.0.1:{port}"))
    node, published = LinkNode(10.0), list[m.Message]()
    published += live(node, edge, 1.5, flight.feed)
    own = edge._connection._transport._socket.getsockname()  # type: ignore[union-attr]
    with Speaker(1) as speaker:
        forger = Forger(speaker, ("127.0.0.1", own[1]), 1)

        def feed(now_ns: int) -> list[m.Message]:
            forger.send_due(now_ns)
            return flight.feed(now_ns)

        published += live(node, edge, SECONDS, feed)
        assert speaker.received() == []
    report = peer.stop()
    edge.close()
    rolls = [x.roll_rad for x in published if isinstance(x, m.VehicleState) and x.roll_rad is not None]
    assert len(rolls) > 20 * SECONDS and max(map(abs, rolls)) < 0.1
    assert not [x for x in published if isinstance(x, m.PositionHint)]
    assert report.position_error_max_m is not None and report.position_error_max_m < 10.0
    status = [x for x in published if isinstance(x, m.LinkStatus)][-1]
    if kind == "udpin":
        assert "Terrafix: a second sender is system 1, ignored" in texts(published)
        assert "a second sender of system 1" in status.detail
        assert any(x.measurement == "telemetry" for x in published if isinstance(x, m.MeasurementVerdict))
    else:
        assert "packets ignored, the last from 127.0.0.1" in status.detail
