"""The state of the connection, once a second: for the record, and in the log when it changes in kind."""

import re
from collections.abc import Iterator
from dataclasses import dataclass

from terrafix.core import logs
from terrafix.core.config import LinkSection
from terrafix.link.admission.admission import Admission
from terrafix.link.autopilot.autopilot import AutopilotPeer
from terrafix.link.gnss.source_switch import SourceSwitch
from terrafix.link.ground_station.links import GroundLinks
from terrafix.link.mavlink.bandwidth import LinkBandwidth
from terrafix.link.mavlink.connection import Connection
from terrafix.link.mavlink.diagnosis import Heard, heard_on_ground, why_no_autopilot
from terrafix.link.mavlink.message_rates import Streams
from terrafix.link.mavlink.timesync import TimeSync
from terrafix.link.output.selection import Outputs
from terrafix.link.output.serial_outputs import SideOutput
from terrafix.messages import LinkStatus

NS_PER_S = 1_000_000_000
AGAIN_NS = 10 * NS_PER_S  # between two lines of the log; what changes faster is on record
KNOWN = ("ardupilot", "px4")
START_NS = 4 * NS_PER_S  # so long after the start it is no news that nobody was heard yet


@dataclass(kw_only=True)
class Status:
    """``at`` once a second; it looks at the parts of the edge, and changes none."""

    config: LinkSection
    wire: Connection
    partner: AutopilotPeer
    admission: Admission
    timesync: TimeSync
    streams: Streams
    budget: LinkBandwidth
    outputs: Outputs
    side_outputs: list[SideOutput]
    switch: SourceSwitch
    ground: GroundLinks
    heard: Heard
    heard_view: bool = False  # our second vehicle, on the autopilot's link

    def at(self, now_ns: int) -> LinkStatus:
        connected = self.partner.telemetry.connected(now_ns)
        offset_ns = self.timesync.offset_at(now_ns) if connected else None
        load = self.budget.load(now_ns, self.wire.heard_bytes, self.wire.sent_bytes)
        return LinkStatus(
            t_ns=now_ns,
            connected=connected,
            autopilot=self.partner.firmware if connected else "none",
            sysid=self.partner.sysid if connected else 0,
            sent=self.wire.sent,
            received=self.heard.packets,
            bad=self.wire.skipped_bytes,
            refused=self.wire.refused,
            time_offset_ms=None if offset_ns is None else offset_ns / 1e6,
            detail="; ".join(note for note in (*self._notes(connected, now_ns), load) if note),
        )

    def _notes(self, connected: bool, now_ns: int) -> Iterator[str]:
        wire, outputs = self.wire, self.outputs.names(self.partner.firmware)
        yield wire.down
        if not connected and not wire.down:
            yield self._why_no_autopilot()
        if self.partner.firmware == "px4" and "gps_input" in outputs:
            yield "PX4 does not take GPS_INPUT; empty link.outputs"
        if connected and self.partner.firmware not in KNOWN and not self.config.outputs:
            yield f"{self.partner.firmware} is neither ArduPilot nor PX4; name in link.outputs what it takes"
        yield from (self.outputs.waits_for, self.switch.problem, *(o.problem for o in self.side_outputs))
        yield from self.ground.notes()
        yield from self.admission.notes(now_ns)
        if wire.ignored is not None:
            count, (host, port) = wire.ignored
            yield f"{count} packets ignored, the last from {host}:{port}; {self.config.device} hears that address alone"
        if connected:
            yield self.streams.problem()
        yield self.budget.too_slow(self.streams.wanted_hz, outputs, self.config.rate_hz)
        yield f"{wire.refused} unsigned or wrongly signed packets ignored" if wire.refused else ""
        yield f"{wire.dropped} not sent" if wire.dropped else ""
        yield f"opened again {wire.reopened} times" if wire.reopened else ""
        yield f"autopilot clock restarted {self.timesync.resets} times" if self.timesync.resets else ""

    def _why_no_autopilot(self) -> str:
        device = self.config.device
        self.heard.bytes, self.heard.refused = self.wire.heard_bytes, self.wire.refused
        if self.heard_view:
            return f"system {self.config.view_sysid} on {device} has the id of link.view_sysid; choose another"
        why = why_no_autopilot(self.heard, device, self.config.baud, self.config.autopilot_sysid)
        on_ground = "" if self.heard.autopilots() else heard_on_ground(self.ground.autopilots())
        return on_ground or why or f"no heartbeat of the autopilot on {device} any more"


class StatusLog:
    """``tell`` every LinkStatus."""

    def __init__(self) -> None:
        self._told: tuple[bool, str] | None = None
        self._told_ns = 0
        self._began_ns: int | None = None

    def tell(self, status: LinkStatus) -> None:
        self._began_ns = status.t_ns if self._began_ns is None else self._began_ns
        kind = (status.connected, re.sub(r"[\d.]+", "#", status.detail))
        starting = not status.connected and status.t_ns - self._began_ns < START_NS
        if starting or kind == self._told or (self._told is not None and status.t_ns - self._told_ns < AGAIN_NS):
            return
        self._told, self._told_ns = kind, status.t_ns
        if not status.connected:
            logs.get().warning("no autopilot", why=status.detail)
        elif status.detail:
            logs.get().warning("autopilot", firmware=status.autopilot, sysid=status.sysid, detail=status.detail)
        else:
            logs.get().info("autopilot", firmware=status.autopilot, sysid=status.sysid)
