"""The state of the connection: LinkStatus once a second for the record, and a log line when its kind changes."""

import re
from collections.abc import Iterator
from dataclasses import dataclass

from terrafix.core import logs
from terrafix.core.clock import NS_PER_S
from terrafix.core.config import LinkSection
from terrafix.link.admission.packet_filter import Admission
from terrafix.link.autopilot.packet_decoder import PacketDecoder
from terrafix.link.gnss.source_switch import SourceSwitch
from terrafix.link.ground_station.links import GroundLinks
from terrafix.link.mavlink.bandwidth import LinkBandwidth
from terrafix.link.mavlink.connection import Connection
from terrafix.link.mavlink.diagnosis import ReceivedTraffic, autopilot_on_ground_link, no_autopilot_reason
from terrafix.link.mavlink.message_rates import Streams
from terrafix.link.mavlink.timesync import TimeSync
from terrafix.link.output.selection import PositionOutputs
from terrafix.link.output.serial_outputs import SerialOutput
from terrafix.messages import LinkStatus

LOG_PERIOD_NS = 10 * NS_PER_S  # shortest time between two log lines; the record has every LinkStatus [tuned]
SUPPORTED_FIRMWARE = ("ardupilot", "px4")
START_GRACE_NS = 4 * NS_PER_S  # after the start: a missing autopilot is not logged yet [tuned]


@dataclass(kw_only=True)
class Status:
    """Builds LinkStatus from the parts of the edge, which it only reads."""

    config: LinkSection
    connection: Connection
    autopilot: PacketDecoder
    admission: Admission
    timesync: TimeSync
    streams: Streams
    bandwidth: LinkBandwidth
    outputs: PositionOutputs
    serial_outputs: list[SerialOutput]
    switch: SourceSwitch
    ground: GroundLinks
    traffic: ReceivedTraffic
    ghost_vehicle_received: bool = False  # our own ghost vehicle, on the autopilot's link

    def snapshot(self, now_ns: int) -> LinkStatus:
        """-> the present state. Call it once a second: the load of the line is measured between calls."""
        connected = self.autopilot.telemetry.connected(now_ns)
        offset_ns = self.timesync.offset_at_ns(now_ns) if connected else None
        saturation = self.bandwidth.load_problem(now_ns, self.connection.received_bytes, self.connection.sent_bytes)
        return LinkStatus(
            t_ns=now_ns,
            connected=connected,
            autopilot=self.autopilot.firmware if connected else "none",
            sysid=self.autopilot.sysid if connected else 0,
            sent=self.connection.sent,
            received=self.traffic.packets,
            bad=self.connection.skipped_bytes,
            refused=self.connection.refused,
            time_offset_ms=None if offset_ns is None else offset_ns / 1e6,
            detail="; ".join(note for note in (*self._notes(connected, now_ns), saturation) if note),
        )

    def _notes(self, connected: bool, now_ns: int) -> Iterator[str]:
        """-> texts about problems; empty strings among them."""
        connection, outputs = self.connection, self.outputs.names(self.autopilot.firmware)
        yield connection.down
        if not connected and not connection.down:
            yield self._no_autopilot_reason()
        if self.autopilot.firmware == "px4" and "gps_input" in outputs:
            yield "PX4 does not take GPS_INPUT; empty link.outputs"
        if connected and self.autopilot.firmware not in SUPPORTED_FIRMWARE and not self.config.outputs:
            yield f"{self.autopilot.firmware} is neither ArduPilot nor PX4; name in link.outputs what it takes"
        yield from (self.outputs.missing_input, self.switch.problem, *(o.problem for o in self.serial_outputs))
        yield from self.ground.notes()
        yield from self.admission.notes(now_ns)
        if connection.ignored is not None:
            count, (host, port) = connection.ignored
            device = self.config.device
            yield f"{count} packets ignored, the last from {host}:{port}; {device} receives from that address alone"
        if connected:
            yield self.streams.problem()
        yield self.bandwidth.capacity_problem(self.streams.wanted_hz, outputs, self.config.rate_hz)
        yield f"{connection.refused} unsigned or wrongly signed packets ignored" if connection.refused else ""
        yield f"{connection.dropped} not sent" if connection.dropped else ""
        yield f"opened again {connection.reopened} times" if connection.reopened else ""
        yield f"autopilot clock restarted {self.timesync.resets} times" if self.timesync.resets else ""

    def _no_autopilot_reason(self) -> str:
        device = self.config.device
        self.traffic.bytes, self.traffic.refused = self.connection.received_bytes, self.connection.refused
        if self.ghost_vehicle_received:
            return f"system {self.config.view_sysid} on {device} has the id of link.view_sysid; choose another"
        why = no_autopilot_reason(self.traffic, device, self.config.baud, self.config.autopilot_sysid)
        on_ground = "" if self.traffic.autopilots() else autopilot_on_ground_link(self.ground.autopilots())
        return on_ground or why or f"no heartbeat of the autopilot on {device} any more"


class StatusLog:
    """Logs the connection state when its kind changes: connected or not, and the detail without its numbers."""

    def __init__(self) -> None:
        self._logged: tuple[bool, str] | None = None
        self._logged_ns = 0
        self._first_status_ns: int | None = None

    def log(self, status: LinkStatus) -> None:
        """Call it with every LinkStatus."""
        self._first_status_ns = status.t_ns if self._first_status_ns is None else self._first_status_ns
        kind = (status.connected, re.sub(r"[\d.]+", "#", status.detail))
        starting = not status.connected and status.t_ns - self._first_status_ns < START_GRACE_NS
        too_soon = self._logged is not None and status.t_ns - self._logged_ns < LOG_PERIOD_NS
        if starting or kind == self._logged or too_soon:
            return
        self._logged, self._logged_ns = kind, status.t_ns
        if not status.connected:
            logs.get().warning("no autopilot", why=status.detail)
        elif status.detail:
            logs.get().warning("autopilot", firmware=status.autopilot, sysid=status.sysid, detail=status.detail)
        else:
            logs.get().info("autopilot", firmware=status.autopilot, sysid=status.sysid)
