"""The bad wire of the link's fuzz test, and the telemetry on it: a vehicle that flies east."""

import math
import random
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.link.mavlink.signing import timestamp

MS = 1_000_000
UNIX_NS = 1_795_262_400 * 1000 * MS  # 2026-11-21
YAW, PITCH, ROLL = math.pi / 2, 0.02, 0.0
KEY = bytes(range(32))
BOOT_AHEAD_NS = 77_000 * MS


@dataclass(frozen=True)
class BadWire:
    garbage_bytes: int = 0  # total: random bytes, and packets with changed bytes
    loss: float = 0.0  # share of valid packets
    double: float = 0.0
    late: float = 0.0  # arrives after the packets of the next step


class FuzzedAutopilot:
    """True telemetry of a vehicle that flies east."""

    def __init__(self, signed: bool) -> None:
        self._mav = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
        if signed:
            self._mav.signing.secret_key, self._mav.signing.sign_outgoing = KEY, True
            self._mav.signing.timestamp = timestamp(UNIX_NS)
        self._parser = mavlink.MAVLink(None)
        self.examples: list[bytes] = []  # packets from which garbage is made

    def packets(self, step: int, now_ns: int, requests: bytes) -> list[bytes]:
        boot_ms = (now_ns + BOOT_AHEAD_NS) // MS
        due: list[Any] = []
        if step % 50 == 0:
            kind, firmware = mavlink.MAV_TYPE_FIXED_WING, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
            due.append(mavlink.MAVLink_heartbeat_message(kind, firmware, 128, 0, mavlink.MAV_STATE_ACTIVE, 3))
            due.append(mavlink.MAVLink_system_time_message(UNIX_NS // 1000, boot_ms))
        if step % 2 == 0:
            due.append(mavlink.MAVLink_attitude_message(boot_ms, ROLL, PITCH, YAW, 0, 0, 0))
        if step % 10 == 0:
            due.append(mavlink.MAVLink_global_position_int_message(boot_ms, 1, 2, 3, 120_000, 4, 5, 6, 7))
            due.append(mavlink.MAVLink_gps_raw_int_message(boot_ms * 1000, 1, 0, 0, 0, 9999, 9999, 0, 0, 0))
        for message in self._parser.parse_buffer(requests) or ():
            if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                due.append(mavlink.MAVLink_timesync_message(now_ns + BOOT_AHEAD_NS, message.ts1))
        packets = []
        for message in due:
            packets.append(bytes(message.pack(self._mav)))
            self._mav.seq = (self._mav.seq + 1) % 256
        self.examples = (self.examples + packets)[-20:]
        return packets


def transmit(
    wire: BadWire, packets: list[bytes], delayed: list[bytes], rng: random.Random
) -> tuple[list[bytes], list[bytes]]:
    """-> (what arrives now, what comes with the next step)."""
    arriving: list[bytes] = []
    later: list[bytes] = []
    for packet in packets:
        if rng.random() < wire.loss:
            continue
        (later if rng.random() < wire.late else arriving).append(packet)
        if rng.random() < wire.double:
            arriving.append(packet)
    return arriving + delayed, later


def add_garbage(packets: list[bytes], garbage: int, examples: list[bytes], rng: random.Random) -> bytes:
    """Inserts ``garbage`` bytes between whole packets; half of them are damaged packets."""
    pieces = list(packets)
    while garbage > 0:
        piece = _damaged(rng.choice(examples), rng) if examples and rng.random() < 0.5 else rng.randbytes(40)
        pieces.insert(rng.randint(0, len(pieces)), piece[:garbage])
        garbage -= len(piece[:garbage])
    return b"".join(pieces)


def _damaged(packet: bytes, rng: random.Random) -> bytes:
    """Flips bits, replaces bytes, truncates, or inserts a part of the packet."""
    data = bytearray(packet)
    match rng.randrange(4):
        case 0:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        case 1:
            for _ in range(rng.randint(1, 8)):
                data[rng.randrange(len(data))] = rng.randrange(256)
        case 2:
            del data[rng.randrange(1, len(data)) :]
        case _:
            at = rng.randrange(len(data))
            data[at:at] = data[: rng.randrange(1, len(data))]
    return bytes(data) if bytes(data) != packet else bytes(data[:-1])


def split(chunk: bytes, rng: random.Random) -> list[bytes]:
    """Splits at a random position, as a serial port delivers."""
    at = rng.randint(0, len(chunk))
    return [piece for piece in (chunk[:at], chunk[at:]) if piece]
