"""The link's side of the world: MAVLink 2 over UDP, TCP or serial. Decides nothing about position."""

import os
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.config import LinkSection
from terrafix.core.errors import LinkError
from terrafix.link import gps_input, gps_time
from terrafix.link.telemetry import AUTOPILOT_COMPONENT, Telemetry
from terrafix.link.timesync import TimeSync
from terrafix.link.transport import Transport, open_transport
from terrafix.messages import GpsInput, LinkStatus, Message, StatusText, WallClock

NS_PER_S = 1_000_000_000
HEARTBEAT_NS = NS_PER_S
STATUS_NS = NS_PER_S
REOPEN_NS = NS_PER_S
WALL_CLOCK_NS = 10 * NS_PER_S
TIMESYNC_NS = NS_PER_S
TIMESYNC_FAST_NS = 100_000_000  # until the first answers are in
TIMESYNC_FAST_COUNT = 10
STREAM_LOST_NS = 3 * NS_PER_S  # a stream that was asked for and does not come is asked for again, this often
# Attitude at 25 Hz interpolates a turn for the frames; height at 5 Hz follows the barometer; time once a second.
STREAMS_HZ = {
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 25.0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 5.0,  # for relative_alt alone
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
}


def open_edge(config: LinkSection) -> "MavlinkEdge":
    """Opens the device of the configuration. Raises LinkError with what to check."""
    return MavlinkEdge(config, _open(config), time.time_ns)


def _open(config: LinkSection) -> Transport:
    try:
        return open_transport(config.device, config.baud, wait=True)
    except OSError as error:
        advice = {
            "udpin": "is the port taken by another program?",
            "udpout": "is there a network?",
            "tcp": "is the other side listening?",
        }.get(config.device.partition(":")[0], "is it plugged in, free, and may this user read and write it?")
        why = os.strerror(error.errno) if error.errno else str(error)  # pyserial wraps the text into its own
        raise LinkError(f"link '{config.device}' cannot be opened ({why}); {advice}") from None


class MavlinkEdge:
    """Polled by the live shell; see core/node.py. Never waits, and in flight never raises for what the wire does."""

    def __init__(self, config: LinkSection, transport: Transport, wall_clock_ns: Callable[[], int]) -> None:
        self._config = config
        self._transport: Transport | None = transport
        self._wall_clock_ns = wall_clock_ns
        self._mav = self._new_mav()
        self._timesync = TimeSync()
        self._telemetry = Telemetry(self._timesync)
        self._due_ns: dict[str, int] = {}
        self._asked_ns: dict[int, int] = {}
        self._refused: set[int] = set()
        self._answers = 0
        self._sent = self._received = self._bad = self._dropped = self._reopened = 0
        self._down = ""  # why there is no transport

    def poll(self, now_ns: int) -> Iterable[Message]:
        if self._transport is None:
            self._reopen(now_ns)
        said = list(self._read(now_ns))
        if self._due("heartbeat", HEARTBEAT_NS, now_ns):
            self._heartbeat()
        fast = self._answers < TIMESYNC_FAST_COUNT
        if self._due("timesync", TIMESYNC_FAST_NS if fast else TIMESYNC_NS, now_ns):
            self._send(mavlink.MAVLink_timesync_message(0, self._timesync.request(now_ns)))
        if self._telemetry.connected(now_ns):
            self._ask_for_streams(now_ns)
        if self._due("wall clock", WALL_CLOCK_NS, now_ns):
            said.append(self._wall_clock(now_ns))
        if self._due("status", STATUS_NS, now_ns):
            said.append(self._status(now_ns))
        return said

    def heard(self, message: Message) -> None:
        match message:
            case GpsInput():
                self._send(gps_input.encode(message, self._config.gps_id))
            case StatusText():
                self._send(
                    mavlink.MAVLink_statustext_message(message.severity, message.text.encode("ascii", "replace"))
                )

    def close(self) -> None:
        if self._transport is not None:
            self._transport.close()
            self._transport = None

    def _new_mav(self) -> mavlink.MAVLink:
        mav = mavlink.MAVLink(None, srcSystem=self._config.sysid, srcComponent=self._config.compid)
        mav.robust_parsing = True  # what is damaged comes out as BAD_DATA and is counted
        return mav

    def _due(self, what: str, period_ns: int, now_ns: int) -> bool:
        if now_ns < self._due_ns.get(what, now_ns):
            return False
        self._due_ns[what] = now_ns + period_ns
        return True

    # --- in ---

    def _read(self, now_ns: int) -> Iterator[Message]:
        if self._transport is None:
            return
        try:
            chunks = self._transport.read()
        except OSError as error:
            self._lost(error)
            return
        for chunk in chunks:
            for message in self._mav.parse_buffer(chunk) or ():
                yield from self._take(message, now_ns)

    def _take(self, message: Any, now_ns: int) -> Iterator[Message]:
        kind = message.get_type()
        if kind == "BAD_DATA":
            self._bad += 1
            return
        self._received += 1
        if kind == "TIMESYNC":
            self._take_timesync(message, now_ns)
        elif kind == "COMMAND_ACK" and message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            if message.result not in (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS):
                self._refused.add(message.result)
        else:
            state = self._telemetry.take(message, now_ns)
            if state is not None:
                yield state

    def _take_timesync(self, message: Any, now_ns: int) -> None:
        if message.tc1 == 0:
            self._send(mavlink.MAVLink_timesync_message(now_ns, message.ts1))
        elif message.get_srcSystem() == self._telemetry.sysid and message.get_srcComponent() == AUTOPILOT_COMPONENT:
            self._answers += 1
            self._timesync.answer(message.tc1, message.ts1, now_ns)

    # --- out ---

    def _send(self, message: Any) -> None:
        """Packs and sends now, or not at all."""
        packet = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        if self._transport is None:
            self._dropped += 1
            return
        try:
            if self._transport.write(packet):
                self._sent += 1
            else:
                self._dropped += 1
        except OSError as error:
            self._dropped += 1
            self._lost(error)

    def _heartbeat(self) -> None:
        self._send(
            mavlink.MAVLink_heartbeat_message(
                type=mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
                autopilot=mavlink.MAV_AUTOPILOT_INVALID,
                base_mode=0,
                custom_mode=0,
                system_status=mavlink.MAV_STATE_ACTIVE,
                mavlink_version=3,
            )
        )

    def _ask_for_streams(self, now_ns: int) -> None:
        for message_id, rate_hz in STREAMS_HZ.items():
            last_ns = max(self._telemetry.seen_ns.get(message_id, 0), self._asked_ns.get(message_id, 0))
            # The first time at once, even if it already comes: its rate is another's choice.
            if message_id in self._asked_ns and now_ns - last_ns < STREAM_LOST_NS:
                continue
            self._asked_ns[message_id] = now_ns
            self._send(
                mavlink.MAVLink_command_long_message(
                    self._telemetry.sysid,
                    AUTOPILOT_COMPONENT,
                    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
                    0,
                    float(message_id),
                    1e6 / rate_hz,
                    *(0.0,) * 5,
                )
            )

    # --- the connection and its state ---

    def _lost(self, error: OSError) -> None:
        self._down = f"connection lost ({error.strerror or error}); opening again"
        self.close()

    def _reopen(self, now_ns: int) -> None:
        if not self._due("reopen", REOPEN_NS, now_ns):
            return
        try:
            self._transport = open_transport(self._config.device, self._config.baud, wait=False)
        except (OSError, LinkError) as error:  # LinkError: a host name that cannot be resolved just now
            self._down = f"cannot be opened again ({error})"
            return
        self._mav = self._new_mav()  # half a packet of the old connection must not swallow one of the new
        self._asked_ns.clear()
        self._down = ""
        self._reopened += 1

    def _wall_clock(self, now_ns: int) -> WallClock:
        """Ours when it can be right, else the autopilot's: a board without a battery wakes up in 1970."""
        for source, unix_ns in (("system", self._wall_clock_ns()), ("autopilot", self._telemetry.unix_ns(now_ns))):
            if unix_ns is not None and gps_time.plausible(unix_ns):
                return WallClock(t_ns=now_ns, unix_ns=unix_ns, source=source)
        self._due_ns["wall clock"] = now_ns + STATUS_NS  # the autopilot may know soon
        return WallClock(t_ns=now_ns, unix_ns=None, source="none")

    def _status(self, now_ns: int) -> LinkStatus:
        connected = self._telemetry.connected(now_ns)
        offset_ns = self._timesync.offset_at(now_ns) if connected else None
        return LinkStatus(
            t_ns=now_ns,
            connected=connected,
            autopilot=self._telemetry.autopilot if connected else "none",
            sysid=self._telemetry.sysid if connected else 0,
            sent=self._sent,
            received=self._received,
            bad=self._bad,
            time_offset_ms=None if offset_ns is None else offset_ns / 1e6,
            detail=self._detail(connected),
        )

    def _detail(self, connected: bool) -> str:
        notes = [self._down] if self._down else []
        if not connected and not self._down:
            notes.append(f"no heartbeat of an autopilot on {self._config.device}")
        if connected and self._telemetry.autopilot == "px4":
            notes.append("PX4 does not take GPS_INPUT")
        if self._refused:
            notes.append(f"message rates refused (MAV_RESULT {', '.join(map(str, sorted(self._refused)))})")
        if self._dropped:
            notes.append(f"{self._dropped} not sent")
        if self._reopened:
            notes.append(f"opened again {self._reopened} times")
        if self._timesync.resets:
            notes.append(f"autopilot clock restarted {self._timesync.resets} times")
        return "; ".join(notes)
