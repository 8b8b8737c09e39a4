"""The MAVLink side of the simulated autopilot: packets, streams and their rates, TIMESYNC, parameters, texts.

No socket: bytes come in and go out. What is not answered here (GPS_INPUT, commands to the filter) is handed on."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix_tools.sim.autopilot.streams import RATES_HZ, Snapshot, message

FASTEST_HZ = 50.0  # of a stream: one step of the simulation
TEXT_BYTES = 50  # of STATUSTEXT


@dataclass
class Heard:
    """What the companion has sent besides GPS_INPUT."""

    heartbeats: int = 0
    message_intervals_set: int = 0
    timesync_requests: int = 0
    timesync_answers: int = 0  # to our own requests
    bad_packets: int = 0
    texts: list[str] = field(default_factory=list)


class Wire:
    """``receive`` and ``stream`` fill what ``take`` empties."""

    def __init__(self, parameters: dict[str, float], sysid: int, boot_ns: Callable[[float], int]) -> None:
        """``boot_ns``: seconds of the flight -> the autopilot's own clock."""
        self._mav = mavlink.MAVLink(None, srcSystem=sysid, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)
        self._mav.robust_parsing = True
        self._parameters = parameters
        self._boot_ns = boot_ns
        self._rates = dict(RATES_HZ)
        self._next_s: dict[int, float] = {}
        self._out: list[bytes] = []
        self.heard = Heard()
        self.said: list[tuple[float, str]] = []  # (seconds of the flight, text)

    def receive(self, packets: bytes, now_s: float) -> list[Any]:
        """-> what was not answered here: GPS_INPUT, PARAM_SET, COMMAND_LONG and COMMAND_INT of other commands."""
        left = []
        for heard in self._mav.parse_buffer(packets) or ():
            match heard.get_type():
                case "BAD_DATA":
                    self.heard.bad_packets += 1
                case "HEARTBEAT":
                    self.heard.heartbeats += 1
                case "STATUSTEXT":
                    self.heard.texts.append(heard.text)
                case "TIMESYNC" if heard.tc1 == 0:
                    self.heard.timesync_requests += 1
                    self.send(mavlink.MAVLink_timesync_message(self._boot_ns(now_s), heard.ts1))
                case "TIMESYNC":
                    self.heard.timesync_answers += 1
                case "COMMAND_LONG" if heard.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                    self.acknowledge(heard.command, self._set_rate(int(heard.param1), heard.param2))
                case "PARAM_REQUEST_LIST":
                    self.tell_parameters(list(self._parameters))
                case "PARAM_REQUEST_READ":
                    self._tell_one(heard)
                case _:
                    left.append(heard)
        return left

    def send(self, packet: Any) -> None:
        self._out.append(bytes(packet.pack(self._mav)))
        self._mav.seq = (self._mav.seq + 1) % 256

    def take(self) -> bytes:
        """Everything since the last call."""
        out, self._out = b"".join(self._out), []
        return out

    def say(self, severity: int, text: str, now_s: float) -> None:
        """STATUSTEXT."""
        self.said.append((now_s, text))
        self.send(mavlink.MAVLink_statustext_message(severity, text.encode("ascii")[:TEXT_BYTES]))

    def acknowledge(self, command: int, result: int) -> None:
        self.send(mavlink.MAVLink_command_ack_message(command, result))

    def tell_parameters(self, names: list[str]) -> None:
        for name in names:
            value, kind = self._parameters[name], mavlink.MAV_PARAM_TYPE_REAL32
            index = list(self._parameters).index(name)
            self.send(mavlink.MAVLink_param_value_message(name.encode(), value, kind, len(self._parameters), index))

    def stream(self, now_s: float, snapshot: Callable[[], Snapshot]) -> None:
        """Says what is due. ``snapshot`` is asked for only when something is."""
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
        """-> MAV_RESULT. As MAV_CMD_SET_MESSAGE_INTERVAL has it: -1 stops, 0 is the default rate."""
        if message_id not in RATES_HZ:
            return int(mavlink.MAV_RESULT_DENIED)
        wanted_hz = 1e6 / interval_us if interval_us > 0 else RATES_HZ[message_id] if interval_us == 0 else 0.0
        self._rates[message_id] = min(FASTEST_HZ, wanted_hz)
        self._next_s.pop(message_id, None)
        self.heard.message_intervals_set += 1
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _tell_one(self, asked: Any) -> None:
        names = list(self._parameters)
        if 0 <= asked.param_index < len(names):
            self.tell_parameters([names[asked.param_index]])
        elif asked.param_id in names:
            self.tell_parameters([asked.param_id])
