"""The edge of the link: MAVLink 2 over UDP, TCP or serial. Converts packets to messages and messages to packets; the
decisions about the position are in node.py."""

import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core import clock
from terrafix.core.clock import NS_PER_S
from terrafix.core.config import LinkSection
from terrafix.core.mavlink.gimbal import GIMBAL_COMPONENTS
from terrafix.core.mavlink.vehicles import AUTOPILOT_COMPONENT
from terrafix.link.admission.packet_filter import Admission
from terrafix.link.admission.served_autopilot import Role
from terrafix.link.autopilot.autopilot_prior import AutopilotPrior
from terrafix.link.autopilot.checkpoint import LinkCheckpointWriter
from terrafix.link.autopilot.ekf_dead_reckoning import DeadReckoningRecorder
from terrafix.link.autopilot.packet_decoder import PacketDecoder
from terrafix.link.autopilot.telemetry import candidate_attitude
from terrafix.link.gnss.previous_source import PreviousSourceFile
from terrafix.link.gnss.source_switch import SourceSwitch
from terrafix.link.ground_station.links import GroundLinks
from terrafix.link.ground_station.named_values import NamedValues
from terrafix.link.ground_station.position_prior import HintReceiver
from terrafix.link.mavlink.bandwidth import LinkBandwidth
from terrafix.link.mavlink.connection import Connection
from terrafix.link.mavlink.diagnosis import ReceivedTraffic
from terrafix.link.mavlink.message_rates import STREAMS_HZ, Streams, streams_of_firmware
from terrafix.link.mavlink.timesync import TimeSync
from terrafix.link.mavlink.transport import Address, Transport, open_at_start
from terrafix.link.output import gps_time
from terrafix.link.output.odometry import GeodeticPoint
from terrafix.link.output.selection import PositionOutputs
from terrafix.link.output.serial_outputs import open_serial_outputs
from terrafix.link.pilot_text.statustext import WARNING, statustext
from terrafix.link.status import Status, StatusLog
from terrafix.messages import (
    CameraVehicle,
    GpsInput,
    LinkStatus,
    MapOffset,
    Message,
    Origin,
    PositionHint,
    PositionSource,
    ServedVehicle,
    StatusText,
    WallClock,
)

# Periods of what the edge sends and publishes.
HEARTBEAT_NS = NS_PER_S
STATUS_NS = NS_PER_S
WALL_CLOCK_NS = 10 * NS_PER_S  # [tuned]
TIMESYNC_NS = NS_PER_S
FAST_TIMESYNC_NS = 100_000_000  # until FAST_TIMESYNC_COUNT responses have arrived [tuned]
FAST_TIMESYNC_COUNT = 10  # [tuned]
# Longest wait for the autopilot at an ordered stop. [spec: runtime/supervisor.py ends it after 5 s]
RESTORE_NS = 2 * NS_PER_S
RESTORE_POLL_S = 0.02  # [spec: tick rate of the link, processes.py]
# Of each further vehicle that may carry the camera: enough for its turns. [measured: docs/decisions/052]
CANDIDATE_STREAMS_HZ = {mavlink.MAVLINK_MSG_ID_ATTITUDE: 10.0}


def open_edge(config: LinkSection, checkpoint_file: Path | None = None, state_dir: Path | None = None) -> "MavlinkEdge":
    """Opens the device of the configuration. ``checkpoint_file``: see ``LinkCheckpointWriter``. ``state_dir``: see
    ``PreviousSourceFile``.

    Raises LinkError with advice when the device cannot be opened, ConfigError when the signing key cannot be used."""
    transport = open_at_start(config.device, config.baud)
    return MavlinkEdge(
        config,
        transport,
        time.time_ns,
        on_status=StatusLog().log,
        checkpoint_writer=LinkCheckpointWriter(checkpoint_file),
        previous_source=PreviousSourceFile(state_dir),
    )


class MavlinkEdge:
    """Polled by the live shell; see core/node.py. Does not block, and does not raise for errors of the transport."""

    def __init__(
        self,
        config: LinkSection,
        transport: Transport,
        wall_clock_ns: Callable[[], int],
        *,
        on_status: Callable[[LinkStatus], None] = lambda _: None,
        checkpoint_writer: LinkCheckpointWriter | None = None,
        previous_source: PreviousSourceFile | None = None,
    ) -> None:
        """``wall_clock_ns``: Unix time of this computer. ``on_status`` is called with every LinkStatus, for the log."""
        self._checkpoint = checkpoint_writer or LinkCheckpointWriter(None)
        self._restore_pending = self._checkpoint.restored is not None
        self._config = config
        self._on_status = on_status
        self._wall_clock_ns = wall_clock_ns
        self._connection = Connection(config, transport, wall_clock_ns)
        self._timesync = TimeSync()
        self._autopilot = PacketDecoder(self._timesync)
        checkpoint = self._checkpoint.restored
        self._admission = Admission(config, is_listening=self._connection.is_listening, checkpoint=checkpoint)
        self._served = self._admission.served
        self._heights_of = (self._served.sysid, 0)  # vehicle and number of its reboot whose heights the telemetry has
        baud = config.baud if config.device.startswith("/") else None
        self._bandwidth = LinkBandwidth(baud, signed=self._connection.signed)
        self._streams = Streams(self._bandwidth.limit_rates(STREAMS_HZ))
        self._candidate_streams: dict[int, Streams] = {}  # of the other vehicles that may carry the camera
        self._reported_vehicle: ServedVehicle | None = None
        self._outputs = PositionOutputs(config.outputs, config.gps_id)
        self._serial_outputs = open_serial_outputs(config)
        self._hints = HintReceiver(config.sysid, config.compid)
        self._ground = GroundLinks(config, wall_clock_ns, self._hints)
        self._switch = SourceSwitch(config.gps_id, previous_source)
        self._autopilot_prior = AutopilotPrior()
        self._dead_reckoning = DeadReckoningRecorder(
            None if checkpoint is None else checkpoint.last, self._autopilot.telemetry.measured_ns
        )
        self._named_values = NamedValues()
        self._flight_origin: GeodeticPoint | None = None  # start of the flight, for firmware without an origin
        self._traffic = ReceivedTraffic()
        self.status = Status(
            config=config,
            connection=self._connection,
            autopilot=self._autopilot,
            admission=self._admission,
            timesync=self._timesync,
            streams=self._streams,
            bandwidth=self._bandwidth,
            outputs=self._outputs,
            serial_outputs=self._serial_outputs,
            switch=self._switch,
            ground=self._ground,
            traffic=self._traffic,
        )
        self._due_ns: dict[str, int] = {}
        self._timesync_responses = 0
        self._known_reopened = 0  # reopened connections on which the streams were requested

    def poll(self, now_ns: int) -> Iterable[Message]:
        """Processes received packets and sends what is due -> messages for node and bus."""
        messages: list[Message] = []
        if self._restore_pending and self._checkpoint.restored is not None:
            self._restore_pending = False
            if self._served.sysid == self._checkpoint.restored.autopilot.sysid:
                self._autopilot.telemetry.restore(self._checkpoint.restored, now_ns)
        for message, sender in self._connection.messages(now_ns):
            messages += self._on_packet(message, sender, now_ns)
        messages += self._admission.rejections(now_ns)
        messages += [self._send_warning(text, now_ns) for text in self._admission.pilot_texts(now_ns)]
        messages += self._ground.poll(now_ns, self._served.sysid)
        if self._connection.reopened != self._known_reopened:  # on a new connection all streams are requested again
            self._known_reopened = self._connection.reopened
            self._streams.restart()
        if self._due("heartbeat", HEARTBEAT_NS, now_ns):
            self._heartbeat()
        fast = self._timesync_responses < FAST_TIMESYNC_COUNT
        if self._due("timesync", FAST_TIMESYNC_NS if fast else TIMESYNC_NS, now_ns):
            self._send(mavlink.MAVLink_timesync_message(0, self._timesync.request(now_ns)))
        messages += self._served_vehicle(now_ns)
        self._request_attitudes(now_ns)
        if self._autopilot.telemetry.connected(now_ns):
            for request in self._requests(now_ns):
                self._send(request)
        if self._due("wall clock", WALL_CLOCK_NS, now_ns):
            messages.append(self._wall_clock(now_ns))
        if self._due("status", STATUS_NS, now_ns):
            status = self.status.snapshot(now_ns)
            self._on_status(status)
            messages.append(status)
        return messages

    def on_message(self, message: Message) -> None:
        """Sends a message of the node or bus as MAVLink, and updates the checkpoint."""
        match message:
            case GpsInput():
                self._send_position(message)
                self._autopilot_prior.on_gps_input(message)
                self._dead_reckoning.on_gps_input(message)
                telemetry = self._autopilot.telemetry
                # Without a last fix a successor first listens for other vehicles, see ServedAutopilot.
                last = None if self._served.candidates(message.t_ns) else self._dead_reckoning.last
                self._checkpoint.on_fix(last, telemetry.home_moved_m, telemetry.pressure_zero_m)
                unix_ms = gps_time.unix_ms(message.time_week, message.time_week_ms)
                self._checkpoint.on_gps_time(None if unix_ms is None else unix_ms * 1_000_000 - message.t_ns)
            case CameraVehicle():
                self._served.confirm(message.sysid)
            case Origin():
                if message.ground_amsl_m is not None:
                    self._flight_origin = GeodeticPoint(message.lat_deg, message.lon_deg, message.ground_amsl_m)
            case MapOffset():
                self._checkpoint.on_map_offset(message)
            case PositionSource():
                self._switch.set_target(message, self._outputs.names(self._autopilot.firmware))
            case StatusText():
                text = message.text.encode("ascii", "replace")
                self._send_to_all(mavlink.MAVLink_statustext_message(message.severity, text))

    def close(self) -> None:
        self._restore_source()
        self._connection.close()
        self._ground.close()
        for output in self._serial_outputs:
            output.close()

    def _restore_source(self) -> None:
        """Before an ordered stop: the autopilot gets back what it navigated by before it was switched to us. What it
        does not confirm in RESTORE_S is left to the next start."""
        if not self._switch.switched:
            return
        begun_ns = clock.now_ns()
        self._switch.set_target(PositionSource(t_ns=begun_ns, vision=False, receiver=0), ())
        while self._switch.switched and (now_ns := clock.now_ns()) - begun_ns < RESTORE_NS:
            for request in self._switch.requests(self._served.sysid, now_ns):
                self._send(request)
            time.sleep(RESTORE_POLL_S)
            for message, sender in self._connection.messages(now_ns):
                if self._admission.classify(message, sender, now_ns) is Role.AUTOPILOT:
                    self._switch.on_message(message)

    def _due(self, task: str, period_ns: int, now_ns: int) -> bool:
        """True if the periodic task is due; it is then due again after ``period_ns``."""
        if now_ns < self._due_ns.get(task, now_ns):
            return False
        self._due_ns[task] = now_ns + period_ns
        return True

    # --- received ---

    def _on_packet(self, message: Any, sender: Address | None, now_ns: int) -> Iterator[Message]:
        """Processes one packet of the autopilot's link. ``sender``: see ``Connection.messages``."""
        self._traffic.packets += 1
        if self._config.view_sysid and message.get_srcSystem() == self._config.view_sysid:
            self.status.ghost_vehicle_received = True
            return  # our ghost vehicle, looped back by a router
        self._traffic.add(message)
        role = self._admission.classify(message, sender, now_ns)
        if role is Role.REJECTED:
            self._connection.forget_peer(sender)
        if role in (Role.REJECTED, Role.INCONSISTENT):
            return
        kind = message.get_type()
        if kind == "ATTITUDE" and role in (Role.AUTOPILOT, Role.CANDIDATE) and self._served.is_contested(now_ns):
            yield from self._on_candidate_attitude(message, now_ns)
            return
        if kind == "TIMESYNC":
            self._on_timesync(message, sender, role, now_ns)
            return
        for hint_or_reply in self._hints.on_message(message, now_ns, {self._served.sysid} - {0}):
            if isinstance(hint_or_reply, PositionHint):
                yield hint_or_reply
            else:
                self._connection.send(hint_or_reply, to=sender)
        if role is Role.AUTOPILOT:
            yield from self._on_autopilot_packet(message, now_ns)
        elif message.get_srcSystem() == self._served.sysid and sender == self._served.address:
            yield from self._on_gimbal_packet(message, now_ns)

    def _on_gimbal_packet(self, message: Any, now_ns: int) -> Iterator[Message]:
        """Processes one packet of another component of the served vehicle, behind its autopilot."""
        if message.get_srcComponent() not in GIMBAL_COMPONENTS or self._served.is_contested(now_ns):
            return
        self._streams.on_message(message.get_msgId())
        if (gimbal := self._autopilot.telemetry.on_gimbal(message, now_ns)) is not None:
            yield gimbal

    def _on_autopilot_packet(self, message: Any, now_ns: int) -> Iterator[Message]:
        """Processes one packet of the served autopilot."""
        kind = message.get_type()
        contested, heights_of = self._served.is_contested(now_ns), (self._served.sysid, self._admission.reboots)
        if self._heights_of != heights_of:
            if self._heights_of[0] != self._served.sysid:
                self._streams.restart()
            self._heights_of = heights_of
            self._autopilot.telemetry.on_reboot()
        if not contested or kind == "HEARTBEAT":  # a vehicle without this camera must not reach the estimator
            yield from self._autopilot.on_message(message, now_ns, self._own_receiver())
        if kind == "HEARTBEAT":
            self._checkpoint.on_heartbeat(self._autopilot.telemetry.armed_autopilot, self._served.address)
            firmware = self._autopilot.firmware
            self._streams.set_firmware(firmware, self._bandwidth.limit_rates(streams_of_firmware(firmware)))
        self._streams.on_message(message.get_msgId())
        if contested:
            return
        self._switch.on_message(message)
        hint = self._autopilot_prior.on_message(message, now_ns)
        if hint is not None:
            yield hint
        yield from self._dead_reckoning.on_message(message, now_ns, self._own_receiver())
        if kind == "COMMAND_ACK" and message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            self._streams.on_command_ack(message.result)

    def _on_candidate_attitude(self, message: Any, now_ns: int) -> Iterator[Message]:
        """ATTITUDE of one of the vehicles that may carry the camera."""
        streams = self._candidate_streams.get(message.get_srcSystem(), self._streams)
        streams.on_message(message.get_msgId())
        attitude = candidate_attitude(message, now_ns)
        if attitude is not None:
            yield attitude

    def _served_vehicle(self, now_ns: int) -> Iterator[ServedVehicle]:
        """-> which vehicle is served, when that has changed or is due."""
        served = self._served
        candidates = sorted(served.candidates(now_ns))
        by_turns = served.confirmed == served.sysid != 0
        confirmed = not candidates and (by_turns or bool(self._config.autopilot_sysid))
        state = ServedVehicle(t_ns=now_ns, sysid=served.sysid, confirmed=confirmed, candidates=candidates)
        before, self._reported_vehicle = self._reported_vehicle, state
        changed = before is None or msgspec.structs.replace(before, t_ns=now_ns) != state
        if self._due("served vehicle", STATUS_NS, now_ns) or changed:
            yield state

    def _own_receiver(self) -> int | None:
        """-> index of the autopilot's GPS instance that carries our GPS_INPUT; None if that is not an output."""
        return self._config.gps_id if "gps_input" in self._outputs.names(self._autopilot.firmware) else None

    def _on_timesync(self, message: Any, sender: Address | None, role: Role, now_ns: int) -> None:
        if message.tc1 == 0:
            self._connection.send(mavlink.MAVLink_timesync_message(now_ns, message.ts1), to=sender)
        elif role is Role.AUTOPILOT:
            self._timesync_responses += 1
            self._timesync.on_response(message.tc1, message.ts1, now_ns)

    # --- sent ---

    def _send(self, message: Any) -> None:
        """Sends to the served autopilot only."""
        if self._served.reachable:
            self._connection.send(message, to=self._served.address)

    def _send_to_all(self, message: Any) -> None:
        """Sends to all peers and ground links. Ground stations receive it through the autopilot, on the same port, or
        on their own link."""
        self._connection.send(message)
        self._ground.broadcast(message)

    def _send_warning(self, text: str, now_ns: int) -> StatusText:
        """Sends a STATUSTEXT -> the same as a message, for the record."""
        message = statustext(now_ns, WARNING, text)
        self.on_message(message)
        return message

    def _send_position(self, gps: GpsInput) -> None:
        """Sends the position to the autopilot first, so that no other output delays it."""
        if not self._served.candidates(gps.t_ns):
            for packet in self._outputs.messages(gps, self._autopilot.snapshot(gps.t_ns)):
                self._send(packet)
        for output in self._serial_outputs:
            output.send(gps, gps.t_ns, self._autopilot.firmware)
        connected = self._autopilot.telemetry.connected(gps.t_ns)
        for value in self._named_values.messages(gps) if connected or len(self._ground) else ():
            if connected:
                self._connection.send(value)
            self._ground.broadcast(value)
        self._ground.send_ghost_position(gps)

    def _requests(self, now_ns: int) -> Iterator[Any]:
        """-> all requests to the autopilot that are due."""
        sysid = self._served.sysid
        yield from self._streams.requests(sysid, AUTOPILOT_COMPONENT, now_ns)
        if self._served.candidates(now_ns):
            return
        yield from self._outputs.requests(self._flight_origin, self._autopilot.snapshot(now_ns), now_ns)
        yield from self._switch.requests(sysid, now_ns)
        yield from self._dead_reckoning.requests(sysid, AUTOPILOT_COMPONENT, now_ns)

    def _request_attitudes(self, now_ns: int) -> None:
        """Requests ATTITUDE of the other vehicles that may carry the camera."""
        candidates = self._served.candidates(now_ns)
        others = candidates.keys() - {self._served.sysid}
        self._candidate_streams = {
            sysid: self._candidate_streams.get(sysid) or Streams(CANDIDATE_STREAMS_HZ) for sysid in others
        }
        for sysid, streams in self._candidate_streams.items():
            for request in streams.requests(sysid, AUTOPILOT_COMPONENT, now_ns):
                self._connection.send(request, to=candidates[sysid])

    def _heartbeat(self) -> None:
        self._ground.send_ghost_heartbeat(self._autopilot.telemetry.vehicle_type)
        self._send_to_all(
            mavlink.MAVLink_heartbeat_message(
                type=mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
                autopilot=mavlink.MAV_AUTOPILOT_INVALID,
                base_mode=0,
                custom_mode=0,
                system_status=mavlink.MAV_STATE_ACTIVE,
                mavlink_version=3,
            )
        )

    # --- wall clock ---

    def _wall_clock(self, now_ns: int) -> WallClock:
        """-> Unix time of this computer if it is plausible, else the autopilot's. A board without a clock battery
        starts in 1970."""
        for source, unix_ns in (
            ("system", self._wall_clock_ns()),
            ("autopilot", self._autopilot.telemetry.unix_ns(now_ns)),
        ):
            if unix_ns is not None and gps_time.is_plausible(unix_ns):
                return WallClock(t_ns=now_ns, unix_ns=unix_ns, source=source)
        self._due_ns["wall clock"] = now_ns + STATUS_NS  # retry soon: the autopilot may get the time
        return WallClock(t_ns=now_ns, unix_ns=None, source="none")
