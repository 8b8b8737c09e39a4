"""MAVLink side of the simulated autopilot: packets, streams and their rates, TIMESYNC, parameters, texts.

It has no socket: bytes come in and go out. Messages that it does not handle (GPS_INPUT, commands to the filter) are
returned to the caller.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix_lab.sim.autopilot.streams import RATES_HZ, Snapshot, message

MAX_STREAM_HZ = 50.0  # largest stream rate: one step of the simulation
TEXT_BYTES = 50  # of STATUSTEXT


def heartbeat(sysid: int) -> bytes:
    """The heartbeat of another autopilot (ArduPilot, copter, armed), as one packet."""
    mav = mavlink.MAVLink(None, srcSystem=sysid, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)
    sent = mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR,
        mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
        mavlink.MAV_MODE_FLAG_SAFETY_ARMED,
        0,
        mavlink.MAV_STATE_ACTIVE,
        3,
    )
    return bytes(sent.pack(mav))


@dataclass
class CompanionTraffic:
    """Messages received from the companion other than GPS_INPUT."""

    heartbeats: int = 0
    message_intervals_set: int = 0
    timesync_requests: int = 0
    timesync_answers: int = 0  # to our own requests
    bad_packets: int = 0
    texts: list[tuple[float, str]] = field(default_factory=list)  # (seconds of the flight, text)


class Wire:
    """``receive`` and ``stream`` fill the output buffer, ``take`` empties it."""

    def __init__(self, parameters: dict[str, float], sysid: int, boot_ns: Callable[[float], int]) -> None:
        """``boot_ns``: seconds of the flight -> the autopilot's own clock."""
        self._mav = mavlink.MAVLink(None, srcSystem=sysid, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)
        self._mav.robust_parsing = True
        self._parameters = parameters
        self._boot_ns = boot_ns
        self._rates = dict(RATES_HZ)
        self._next_s: dict[int, float] = {}
        self._out: list[bytes] = []
        self.received = CompanionTraffic()
        self.sent_texts: list[tuple[float, str]] = []  # (seconds of the flight, text)

    def receive(self, packets: bytes, now_s: float) -> list[Any]:
        """Handles packets; returns the others: GPS_INPUT, PARAM_SET, COMMAND_LONG and COMMAND_INT of other commands."""
        unhandled = []
        for packet in self._mav.parse_buffer(packets) or ():
            match packet.get_type():
                case "BAD_DATA":
                    self.received.bad_packets += 1
                case "HEARTBEAT":
                    self.received.heartbeats += 1
                case "STATUSTEXT":
                    self.received.texts.append((now_s, packet.text))
                case "TIMESYNC" if packet.tc1 == 0:
                    self.received.timesync_requests += 1
                    self.send(mavlink.MAVLink_timesync_message(self._boot_ns(now_s), packet.ts1))
                case "TIMESYNC":
                    self.received.timesync_answers += 1
                case "COMMAND_LONG" if packet.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                    self.acknowledge(packet.command, self._set_rate(int(packet.param1), packet.param2))
                case "PARAM_REQUEST_LIST":
                    self.send_parameters(list(self._parameters))
                case "PARAM_REQUEST_READ":
                    self._send_parameter(packet)
                case _:
                    unhandled.append(packet)
        return unhandled

    def send(self, packet: Any) -> None:
        self._out.append(bytes(packet.pack(self._mav)))
        self._mav.seq = (self._mav.seq + 1) % 256

    def take(self) -> bytes:
        """Returns all output since the last call."""
        out, self._out = b"".join(self._out), []
        return out

    def send_text(self, severity: int, text: str, now_s: float) -> None:
        """Sends a STATUSTEXT."""
        self.sent_texts.append((now_s, text))
        self.send(mavlink.MAVLink_statustext_message(severity, text.encode("ascii")[:TEXT_BYTES]))

    def acknowledge(self, command: int, result: int) -> None:
        self.send(mavlink.MAVLink_command_ack_message(command, result))

    def send_parameters(self, names: list[str]) -> None:
        for name in names:
            value, kind = self._parameters[name], mavlink.MAV_PARAM_TYPE_REAL32
            index = list(self._parameters).index(name)
            self.send(mavlink.MAVLink_param_value_message(name.encode(), value, kind, len(self._parameters), index))

    def stream(self, now_s: float, snapshot: Callable[[], Snapshot]) -> None:
        """Sends the streams that are due. ``snapshot`` is called only if there is one."""
        due = [i for i, rate_hz in self._rates.items() if rate_hz > 0 and now_s >= self._next_s.get(i, now_s)]
        if not due:
            return
        now = snapshot()
        for message_id in due:
            period_s = 1.0 / self._rates[message_id]
            self._next_s[message_id] = max(self._next_s.get(message_id, now_s) + period_s, now_s)
            packet = message(message_id, now)
            if packet is not None:
                self.send(packet)

    def _set_rate(self, message_id: int, interval_us: float) -> int:
        """Handles MAV_CMD_SET_MESSAGE_INTERVAL: -1 stops a stream, 0 sets the default rate. Returns MAV_RESULT."""
        if message_id not in RATES_HZ:
            return int(mavlink.MAV_RESULT_DENIED)
        requested_hz = 1e6 / interval_us if interval_us > 0 else RATES_HZ[message_id] if interval_us == 0 else 0.0
        self._rates[message_id] = min(MAX_STREAM_HZ, requested_hz)
        self._next_s.pop(message_id, None)
        self.received.message_intervals_set += 1
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _send_parameter(self, request: Any) -> None:
        names = list(self._parameters)
        if 0 <= request.param_index < len(names):
            self.send_parameters([names[request.param_index]])
        elif request.param_id in names:
            self.send_parameters([request.param_id])
