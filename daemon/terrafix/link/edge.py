"""The link's side of the world: MAVLink 2 over UDP, TCP or serial. Decides nothing about position."""

import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.config import LinkSection
from terrafix.link.admission.admission import Admission
from terrafix.link.admission.served_autopilot import AUTOPILOT_COMPONENT, Role
from terrafix.link.autopilot.autopilot import AutopilotPeer
from terrafix.link.autopilot.autopilot_prior import AutopilotPrior
from terrafix.link.autopilot.checkpoint import CheckpointWriter
from terrafix.link.autopilot.ekf_dead_reckoning import DeadReckoningRecorder
from terrafix.link.gnss.source_switch import SourceSwitch
from terrafix.link.ground_station.links import GroundLinks
from terrafix.link.ground_station.named_values import NamedValues
from terrafix.link.ground_station.position_prior import Hints
from terrafix.link.mavlink.bandwidth import LinkBandwidth
from terrafix.link.mavlink.connection import Connection
from terrafix.link.mavlink.diagnosis import Heard
from terrafix.link.mavlink.message_rates import STREAMS_HZ, Streams, wanted_of
from terrafix.link.mavlink.timesync import TimeSync
from terrafix.link.mavlink.transport import Address, Transport, open_at_start
from terrafix.link.output import gps_time
from terrafix.link.output.odometry import Place
from terrafix.link.output.selection import Outputs
from terrafix.link.output.serial_outputs import open_side_outputs
from terrafix.link.pilot_text.statustext import WARNING, statustext
from terrafix.link.status import Status, StatusLog
from terrafix.messages import (
    GpsInput,
    LinkStatus,
    MapOffset,
    Message,
    Origin,
    PositionHint,
    PositionSource,
    StatusText,
    WallClock,
)

NS_PER_S = 1_000_000_000
HEARTBEAT_NS = NS_PER_S
STATUS_NS = NS_PER_S
WALL_CLOCK_NS = 10 * NS_PER_S
TIMESYNC_NS = NS_PER_S
TIMESYNC_FAST_NS = 100_000_000  # until the first answers are in
TIMESYNC_FAST_COUNT = 10


def open_edge(config: LinkSection, kept: Path | None = None) -> "MavlinkEdge":
    """Opens the device of the configuration. ``kept``: see AutopilotKeeper. Raises LinkError with what to check,
    ConfigError for a signing key."""
    transport = open_at_start(config.device, config.baud)
    return MavlinkEdge(config, transport, time.time_ns, tell=StatusLog().tell, keeper=CheckpointWriter(kept))


class MavlinkEdge:
    """Polled by the live shell; see core/node.py. Never waits, and in flight never raises for what the wire does."""

    def __init__(
        self,
        config: LinkSection,
        transport: Transport,
        wall_clock_ns: Callable[[], int],
        *,
        tell: Callable[[LinkStatus], None] = lambda _: None,
        keeper: CheckpointWriter | None = None,
    ) -> None:
        """``tell`` gets every LinkStatus, for the log."""
        self._keeper = keeper or CheckpointWriter(None)
        self._takes_over = self._keeper.found is not None
        self._config = config
        self._tell = tell
        self._wall_clock_ns = wall_clock_ns
        self._connection = Connection(config, transport, wall_clock_ns)
        self._timesync = TimeSync()
        self._partner = AutopilotPeer(self._timesync)
        found = self._keeper.found
        self._admission = Admission(config, listens=self._connection.listens, found=found)
        self._served = self._admission.served
        self._reboots = 0  # that telemetry knows of
        baud = config.baud if config.device.startswith("/") else None
        self._budget = LinkBandwidth(baud, signed=self._connection.signed)
        self._streams = Streams(self._budget.fitting(STREAMS_HZ))
        self._outputs = Outputs(config.outputs, config.gps_id)
        self._side_outputs = open_side_outputs(config)
        self._hints = Hints(config.sysid, config.compid)
        self._ground = GroundLinks(config, wall_clock_ns, self._hints)
        self._switch = SourceSwitch(config.gps_id)
        self._resume = AutopilotPrior()
        self._coast = DeadReckoningRecorder(None if found is None else found.last, self._partner.telemetry.measured_ns)
        self._named_values = NamedValues()
        self._start: Place | None = None  # of the flight
        self._heard = Heard()
        self.status = Status(
            config=config,
            wire=self._connection,
            partner=self._partner,
            admission=self._admission,
            timesync=self._timesync,
            streams=self._streams,
            budget=self._budget,
            outputs=self._outputs,
            side_outputs=self._side_outputs,
            switch=self._switch,
            ground=self._ground,
            heard=self._heard,
        )
        self._due_ns: dict[str, int] = {}
        self._answers = 0
        self._opened = 0  # connections that the streams were asked on, besides the first

    def poll(self, now_ns: int) -> Iterable[Message]:
        said: list[Message] = []
        if self._takes_over and self._keeper.found is not None:
            self._takes_over = False
            if self._served.sysid == self._keeper.found.autopilot.sysid:
                self._partner.telemetry.served(self._keeper.found, now_ns)
        for message, sender in self._connection.messages(now_ns):
            said += self._take(message, sender, now_ns)
        said += self._admission.verdicts(now_ns)
        said += [self._warn(text, now_ns) for text in self._admission.pilot_texts(now_ns)]
        said += self._ground.poll(now_ns, self._served.sysid)
        if self._connection.reopened != self._opened:  # a new connection: everything is asked for again
            self._opened = self._connection.reopened
            self._streams.restart()
        if self._due("heartbeat", HEARTBEAT_NS, now_ns):
            self._heartbeat()
        fast = self._answers < TIMESYNC_FAST_COUNT
        if self._due("timesync", TIMESYNC_FAST_NS if fast else TIMESYNC_NS, now_ns):
            self._send(mavlink.MAVLink_timesync_message(0, self._timesync.request(now_ns)))
        if self._partner.telemetry.connected(now_ns):
            for request in self._requests(now_ns):
                self._send(request)
        if self._due("wall clock", WALL_CLOCK_NS, now_ns):
            said.append(self._wall_clock(now_ns))
        if self._due("status", STATUS_NS, now_ns):
            status = self.status.at(now_ns)
            self._tell(status)
            said.append(status)
        return said

    def heard(self, message: Message) -> None:
        match message:
            case GpsInput():
                self._send_position(message)
                self._resume.said(message)
                self._coast.sent(message)
                telemetry = self._partner.telemetry
                self._keeper.flies(self._coast.last, telemetry.home_moved_m, telemetry.pressure_zero_m)
                unix_ms = gps_time.unix_ms(message.time_week, message.time_week_ms)
                self._keeper.timed(None if unix_ms is None else unix_ms * 1_000_000 - message.t_ns)
            case Origin():
                if message.ground_amsl_m is not None:
                    self._start = Place(message.lat_deg, message.lon_deg, message.ground_amsl_m)
            case MapOffset():
                self._keeper.learnt(message)
            case PositionSource():
                self._switch.order(message, self._outputs.names(self._partner.firmware))
            case StatusText():
                text = message.text.encode("ascii", "replace")
                self._say_to_people(mavlink.MAVLink_statustext_message(message.severity, text))

    def close(self) -> None:
        self._connection.close()
        self._ground.close()
        for output in self._side_outputs:
            output.close()

    def _due(self, what: str, period_ns: int, now_ns: int) -> bool:
        if now_ns < self._due_ns.get(what, now_ns):
            return False
        self._due_ns[what] = now_ns + period_ns
        return True

    # --- in ---

    def _take(self, message: Any, sender: Address | None, now_ns: int) -> Iterator[Message]:
        self._heard.packets += 1
        if self._config.view_sysid and message.get_srcSystem() == self._config.view_sysid:
            self.status.heard_view = True
            return  # our own view, by way of some router: not an autopilot
        self._heard.take(message)
        role = self._admission.take(message, sender, now_ns)
        if role is Role.REFUSED:
            self._connection.forget(sender)
        if role in (Role.REFUSED, Role.CONTRADICTS):
            return
        kind = message.get_type()
        if kind == "TIMESYNC":
            self._take_timesync(message, sender, role, now_ns)
            return
        for said in self._hints.take(message, now_ns, {self._served.sysid} - {0}):
            if isinstance(said, PositionHint):
                yield said
            else:
                self._connection.send(said, to=sender)
        if role is Role.AUTOPILOT:
            yield from self._take_telemetry(message, now_ns)

    def _take_telemetry(self, message: Any, now_ns: int) -> Iterator[Message]:
        """Of the autopilot that is served."""
        kind = message.get_type()
        if self._admission.reboots != self._reboots:
            self._reboots = self._admission.reboots
            self._partner.telemetry.rebooted()
        yield from self._partner.take(message, now_ns, self._our_receiver())
        if kind == "HEARTBEAT":
            self._keeper.heard(self._partner.telemetry.armed_autopilot, self._served.address)
            firmware = self._partner.firmware
            self._streams.serve(firmware, self._budget.fitting(wanted_of(firmware)))
        self._streams.heard(message.get_msgId())
        self._switch.heard(message)
        hint = self._resume.take(message, now_ns)
        if hint is not None:
            yield hint
        yield from self._coast.take(message, now_ns, self._our_receiver())
        if kind == "COMMAND_ACK" and message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            self._streams.answered(message.result)

    def _our_receiver(self) -> int | None:
        """Which of the autopilot's receivers we are."""
        return self._config.gps_id if "gps_input" in self._outputs.names(self._partner.firmware) else None

    def _take_timesync(self, message: Any, sender: Address | None, role: Role, now_ns: int) -> None:
        if message.tc1 == 0:
            self._connection.send(mavlink.MAVLink_timesync_message(now_ns, message.ts1), to=sender)
        elif role is Role.AUTOPILOT:
            self._answers += 1
            self._timesync.answer(message.tc1, message.ts1, now_ns)

    # --- out ---

    def _send(self, message: Any) -> None:
        """To the autopilot that is served, and to nobody else."""
        if self._served.reachable:
            self._connection.send(message, to=self._served.address)

    def _say_to_people(self, message: Any) -> None:
        """The autopilot hands it on to its ground stations; others are on the same port; ours have their own links."""
        self._connection.send(message)
        self._ground.say(message)

    def _warn(self, text: str, now_ns: int) -> StatusText:
        """-> what was sent to the pilot, for the record."""
        said = statustext(now_ns, WARNING, text)
        self.heard(said)
        return said

    def _send_position(self, gps: GpsInput) -> None:
        """First of all to the autopilot: nothing may delay it."""
        for packet in self._outputs.messages(gps, self._partner.now(gps.t_ns)):
            self._send(packet)
        for output in self._side_outputs:
            output.send(gps, gps.t_ns)
        connected = self._partner.telemetry.connected(gps.t_ns)
        for value in self._named_values.messages(gps) if connected or len(self._ground) else ():
            if connected:
                self._connection.send(value)
            self._ground.say(value)
        self._ground.position(gps)

    def _requests(self, now_ns: int) -> Iterator[Any]:
        sysid = self._served.sysid
        yield from self._streams.requests(sysid, AUTOPILOT_COMPONENT, now_ns)
        yield from self._outputs.requests(self._start, self._partner.now(now_ns), now_ns)
        yield from self._switch.requests(sysid, now_ns)
        yield from self._coast.requests(sysid, AUTOPILOT_COMPONENT, now_ns)

    def _heartbeat(self) -> None:
        self._ground.heartbeat(self._partner.telemetry.vehicle_type)
        self._say_to_people(
            mavlink.MAVLink_heartbeat_message(
                type=mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
                autopilot=mavlink.MAV_AUTOPILOT_INVALID,
                base_mode=0,
                custom_mode=0,
                system_status=mavlink.MAV_STATE_ACTIVE,
                mavlink_version=3,
            )
        )

    # --- the state of it ---

    def _wall_clock(self, now_ns: int) -> WallClock:
        """Ours when it can be right, else the autopilot's: a board without a battery wakes up in 1970."""
        for source, unix_ns in (
            ("system", self._wall_clock_ns()),
            ("autopilot", self._partner.telemetry.unix_ns(now_ns)),
        ):
            if unix_ns is not None and gps_time.plausible(unix_ns):
                return WallClock(t_ns=now_ns, unix_ns=unix_ns, source=source)
        self._due_ns["wall clock"] = now_ns + STATUS_NS  # the autopilot may know soon
        return WallClock(t_ns=now_ns, unix_ns=None, source="none")
