"""Packets out of a byte stream: only what has a right checksum, and nothing that is whole gets lost behind damage.

pymavlink's own parser believes the length byte of a damaged packet and drops up to 280 bytes with the packets in them;
it also hands out messages of unknown kind, which nothing can check. Here a candidate that fails costs one byte.
Framing as in the MAVLink serialization guide (mavlink.io/en/guide/serialization.html)."""

from collections.abc import Iterator
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

V1, V2 = mavlink.PROTOCOL_MARKER_V1, mavlink.PROTOCOL_MARKER_V2
SIGNED = mavlink.MAVLINK_IFLAG_SIGNED
HEADER = {V1: 6, V2: 10}  # bytes, marker included
CHECKSUM, SIGNATURE = 2, mavlink.MAVLINK_SIGNATURE_BLOCK_LEN


class Framer:
    """``packets`` for each piece of the stream. ``skipped``: bytes that belonged to no packet."""

    def __init__(self) -> None:
        self._rest = b""
        self._decoder = mavlink.MAVLink(None)  # without a key: signatures are checked by signing.py
        self.skipped = 0
        self.heard = 0  # bytes

    def packets(self, data: bytes) -> Iterator[Any]:
        """-> decoded messages, in order. What is not whole yet is kept (at most 280 bytes)."""
        self.heard += len(data)
        data = self._rest + data
        at = 0
        while True:
            start = _next_marker(data, at)
            self.skipped += start - at
            at = start
            length = packet_length(data, at)
            if length is None or at + length > len(data):
                break
            message = self._decode(data[at : at + length]) if length else None
            if message is None:
                self.skipped += 1
                at += 1
            else:
                yield message
                at += length
        self._rest = data[at:]

    def reset(self) -> None:
        """The next byte is the first of another stream."""
        self._rest = b""

    def _decode(self, packet: bytes) -> Any | None:
        if _message_id(packet) not in mavlink.mavlink_map:
            return None  # nothing could check it; and most of what garbage looks like ends here, before its checksum
        try:
            return self._decoder.decode(bytearray(packet))
        except mavlink.MAVError:
            return None


def packet_length(data: bytes, at: int) -> int | None:
    """Bytes of the packet whose marker stands at ``at``; 0: none can begin so; None: too little is there to tell."""
    if len(data) - at < 3:
        return None
    if data[at] == V1:
        return HEADER[V1] + data[at + 1] + CHECKSUM
    flags = data[at + 2]
    if flags & ~SIGNED:  # "a packet with flags that are not understood must be discarded" (the guide)
        return 0
    return HEADER[V2] + data[at + 1] + CHECKSUM + (SIGNATURE if flags & SIGNED else 0)


def _message_id(packet: bytes) -> int:
    return packet[5] if packet[0] == V1 else int.from_bytes(packet[7:10], "little")


def _next_marker(data: bytes, at: int) -> int:
    places = [p for p in (data.find(V1, at), data.find(V2, at)) if p >= 0]
    return min(places, default=len(data))
