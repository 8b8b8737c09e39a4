"""Blocking MAVLink client of an autopilot on the ground: identity, parameters, rates, mission. Not for flight."""

import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.config import LinkSection
from terrafix.core.errors import LinkError
from terrafix.core.mavlink.vehicles import ARDUPILOT_TYPES
from terrafix.link.mavlink.bandwidth import LinkBandwidth
from terrafix.link.mavlink.diagnosis import ReceivedTraffic, no_autopilot_reason
from terrafix.link.mavlink.framing import Framer
from terrafix.link.mavlink.message_rates import STREAMS_HZ, Streams
from terrafix.link.mavlink.signing import Signing, read_key
from terrafix.link.mavlink.transport import Transport, open_at_start
from terrafix_tools.preflight.lines import number

HEARTBEAT_S = 1.0
POLL_S = 0.005  # polling interval of the transport
CONNECT_S = 8.0
OTHERS_S = 1.5  # waiting time for further autopilots after the first
ROUNDS, QUIET_S = 4, 0.7  # requests per parameter; a round ends after this time without a reply
BATCH = 8  # requests in flight: a slow line has a short queue
ANSWER_S = 2.0
TRIPS = 10
RATES_S = 6.5  # two windows of Streams: in the first one the streams start
AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1


class Autopilot:
    """MAVLink connection to one autopilot; a context manager. Call ``connect`` first."""

    def __init__(
        self, config: LinkSection, transport: Transport | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Raises LinkError: the device cannot be opened; ConfigError: the signing key."""
        self._config, self._clock = config, clock
        self._signing = Signing(read_key(Path(config.signing_key))) if config.signing_key else None
        self._transport = transport or open_at_start(config.device, config.baud)
        self._mav = mavlink.MAVLink(None, srcSystem=config.sysid, srcComponent=config.compid)
        self._framer, self._traffic = Framer(), ReceivedTraffic()
        self._beat_s = -HEARTBEAT_S
        self._types: dict[str, int] = {}
        self.sysid = 0
        self.plane = False
        self.armed = False
        self.newest: dict[tuple[str, int], Any] = {}  # (message type, system id) -> last message

    def __enter__(self) -> "Autopilot":
        return self

    def __exit__(self, *_: object) -> None:
        self._transport.close()

    def connect(self, wait_s: float | None = None) -> None:
        """Waits for the autopilot. Raises LinkError with a remedy: no autopilot, several, another system id, not
        ArduPilot.
        """
        wait_s = CONNECT_S if wait_s is None else wait_s
        until_s = self._clock() + wait_s
        for _ in self._listen(wait_s):
            autopilots = self._traffic.autopilots()
            if autopilots and (self._config.autopilot_sysid in (0, *autopilots)):
                until_s = min(until_s, self._clock() + OTHERS_S)
            if self._clock() >= until_s:
                break
        self._traffic.bytes = self._framer.received_bytes
        self._traffic.refused = 0 if self._signing is None else self._signing.refused
        device = self._config.device
        reason = no_autopilot_reason(self._traffic, device, self._config.baud, self._config.autopilot_sysid)
        if reason:
            raise LinkError(reason)
        autopilots = self._traffic.autopilots()
        if len(autopilots) > 1 and not self._config.autopilot_sysid:
            raise LinkError(
                f"{len(autopilots)} autopilots on {device}, system ids {', '.join(map(str, autopilots))}; "
                "name yours in link.autopilot_sysid"
            )
        self.sysid = self._config.autopilot_sysid or next(iter(autopilots))
        if autopilots[self.sysid] != "ardupilot":
            raise LinkError(
                f"the autopilot on {device} is {autopilots[self.sysid]}, not ArduPilot; "
                "preflight supports only ArduPilot's parameters, docs/autopilot.md says what other firmware takes"
            )
        beat = self.newest["HEARTBEAT", self.sysid]
        self.plane = beat.type in ARDUPILOT_TYPES["ArduPlane"]
        self.armed = bool(beat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)

    def read(self, names: list[str]) -> dict[str, float]:
        """Returns those parameters of ``names`` that exist. Raises LinkError when there is no reply at all."""
        found: dict[str, float] = {}
        for _ in range(ROUNDS):
            missing = [name for name in names if name not in found]
            for first in range(0, len(missing), BATCH):
                for name in missing[first : first + BATCH]:
                    self._send(mavlink.MAVLink_param_request_read_message(self.sysid, AUTOPILOT, name.encode(), -1))
                self._collect_values(found, set(missing[first : first + BATCH]))
            if not missing:
                break
        if names and not found:
            raise LinkError(
                f"the autopilot on {self._config.device} does not answer requests for parameters; "
                "is the link one way, or is a router in between that does not forward them?"
            )
        return {name: found[name] for name in names if name in found}

    def write(self, name: str, value: float) -> None:
        """Sets a parameter. Raises LinkError when the autopilot does not confirm the value."""
        for _ in range(ROUNDS):
            kind = self._types.get(name, mavlink.MAV_PARAM_TYPE_REAL32)
            self._send(mavlink.MAVLink_param_set_message(self.sysid, AUTOPILOT, name.encode(), value, kind))
            found: dict[str, float] = {}
            self._collect_values(found, {name})
            if name in found and abs(found[name] - value) <= 1e-6 * max(1.0, abs(value)):
                return
        raise LinkError(
            f"{name} could not be set to {number(value)}; is the autopilot armed, or the parameter read-only?"
        )

    def request_message(self, message_id: int, kind: str) -> Any | None:
        """Requests one message; None when it does not arrive."""
        no = (0.0,) * 6
        request = mavlink.MAV_CMD_REQUEST_MESSAGE
        self._send(mavlink.MAVLink_command_long_message(self.sysid, AUTOPILOT, request, 0, float(message_id), *no))
        return next((m for m in self._listen(ANSWER_S) if m is not None and m.get_type() == kind), None)

    def round_trip_ms(self) -> float | None:
        """Returns the median of TRIPS TIMESYNC round trips; None when there is no reply."""
        trips = []
        for _ in range(TRIPS):
            sent_s = self._clock()
            stamp = round(sent_s * 1e9)
            self._send(mavlink.MAVLink_timesync_message(0, stamp))
            for message in self._listen(ANSWER_S / TRIPS):
                if message is not None and message.get_type() == "TIMESYNC" and message.ts1 == stamp and message.tc1:
                    trips.append((self._clock() - sent_s) * 1e3)
                    break
        return statistics.median(trips) if trips else None

    def rates(self) -> Streams:
        """Requests the streams of the link and counts them for RATES_S."""
        baud = self._config.baud if self._config.device.startswith("/") else None
        budget = LinkBandwidth(baud, signed=self._signing is not None)
        streams = Streams(budget.limit_rates(STREAMS_HZ))
        for message in self._listen(RATES_S):
            if message is not None:
                streams.on_message(message.get_msgId())
                if message.get_type() == "COMMAND_ACK" and message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                    streams.on_command_ack(message.result)
            for request in streams.requests(self.sysid, AUTOPILOT, round(self._clock() * 1e9)):
                self._send(request)
        return streams

    def mission(self) -> list[Any]:
        """Returns MISSION_ITEM_INT of the mission on board, home first; empty when there is none. Raises LinkError."""
        self._send(mavlink.MAVLink_mission_request_list_message(self.sysid, AUTOPILOT))
        count = next((m.count for m in self._listen(ANSWER_S) if m is not None and m.get_type() == "MISSION_COUNT"), 0)
        return [self._mission_item(seq) for seq in range(count)]

    def _mission_item(self, seq: int) -> Any:
        for _ in range(ROUNDS):
            self._send(mavlink.MAVLink_mission_request_int_message(self.sysid, AUTOPILOT, seq))
            for message in self._listen(ANSWER_S):
                if message is not None and message.get_type() == "MISSION_ITEM_INT" and message.seq == seq:
                    return message
        raise LinkError(f"item {seq} of the mission cannot be read from the autopilot; try again")

    def _collect_values(self, found: dict[str, float], wanted: set[str]) -> None:
        """Collects PARAM_VALUE until all of ``wanted`` have arrived, or none arrives for QUIET_S."""
        last_s = self._clock()
        for message in self._listen(ANSWER_S):
            if message is not None and message.get_type() == "PARAM_VALUE":
                found[message.param_id] = message.param_value
                self._types[message.param_id] = message.param_type
                last_s = self._clock()
            if wanted <= found.keys() or self._clock() - last_s > QUIET_S:
                return

    def _listen(self, seconds: float) -> Iterator[Any | None]:
        """Yields the autopilot's messages for ``seconds``; None in between, so that the caller can check the time."""
        until_s = self._clock() + seconds
        while self._clock() < until_s:
            if self._clock() >= self._beat_s + HEARTBEAT_S:
                self._beat_s = self._clock()
                kind, no = mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID
                self._send(mavlink.MAVLink_heartbeat_message(kind, no, 0, 0, mavlink.MAV_STATE_ACTIVE, 3))
            yield from self._received()
            yield None
            time.sleep(POLL_S)

    def _received(self) -> Iterator[Any]:
        try:
            chunks = self._transport.read()
        except OSError as error:
            raise LinkError(f"{self._config.device}: connection lost ({error.strerror or error}); try again") from None
        for chunk, _ in chunks:
            for message in self._framer.packets(chunk):
                if self._signing is not None and not self._signing.accepts(message, time.time_ns()):
                    continue
                self._traffic.packets += 1
                self._traffic.add(message)
                if message.get_srcComponent() == AUTOPILOT:
                    self.newest[message.get_type(), message.get_srcSystem()] = message
                    if self.sysid in (0, message.get_srcSystem()):
                        yield message

    def _send(self, message: Any) -> None:
        if self._signing is not None:
            self._signing.sign_next(self._mav, time.time_ns())
        packet = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        try:
            self._transport.write(packet)
        except OSError as error:
            raise LinkError(f"{self._config.device}: connection lost ({error.strerror or error}); try again") from None
