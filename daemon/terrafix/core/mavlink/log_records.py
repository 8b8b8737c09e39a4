"""Records of a telemetry log (.tlog), found by the checksum of their packets.

A record is 8 bytes, big endian, microseconds since 1970, followed by one packet (MAVLink 1 or 2), as Mission Planner,
QGroundControl and MAVProxy write it. The time stamp is that of the logging computer, which may be wrong
(``log_clock``), so it does not decide whether a record begins."""

from binascii import crc_hqx
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

STAMP = 8  # bytes of the time stamp
MAX_TIME_US = 4_102_444_800_000_000  # 2100-01-01; a later stamp is damaged
_V1, _V2, _SIGNED = 0xFE, 0xFD, 1  # first byte of a packet of MAVLink 1, of MAVLink 2, and its flag of a signature
_MIN_PACKET = 8  # bytes of a packet without payload [spec: MAVLink 1]
# MAVLink's checksum (CRC-16/MCRF4XX) works from the lowest bit on, binascii's from the highest: bits are turned round.
_TURNED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


@dataclass(frozen=True)
class Records:
    """``packets`` and ``stamps_us`` in the order of the file; ``skipped_bytes``: damaged or cut off."""

    packets: list[bytes]
    stamps_us: list[int]
    skipped_bytes: int


def record(t_us: int, packets: bytes) -> bytes:
    """Encodes complete packets that arrived together at ``t_us`` (UNIX microseconds) as records."""
    records, offset = [], 0
    while offset < len(packets):
        length = packet_length(packets, offset)
        records.append(t_us.to_bytes(STAMP, "big") + packets[offset : offset + length])
        offset += length
    return b"".join(records)


def read_records(data: bytes, crc_extra: Mapping[int, int]) -> Records:
    """``crc_extra``: the byte of each message that is known, which enters its checksum. A message that is not known is
    taken where its stamp is a time and the next record begins behind it. Without records, or where most stamps are no
    time (a stream of packets without stamps), all lists are empty."""
    packets: list[bytes] = []
    stamps_us: list[int] = []
    skipped = 0
    for skipped_before, start, end in _found(data, crc_extra):
        skipped += skipped_before
        if end:
            stamps_us.append(int.from_bytes(data[start : start + STAMP], "big"))
            packets.append(data[start + STAMP : end])
    if 2 * sum(t_us < MAX_TIME_US for t_us in stamps_us) <= len(stamps_us):
        return Records([], [], len(data))
    return Records(packets, stamps_us, skipped)


def _found(data: bytes, crc_extra: Mapping[int, int]) -> Iterator[tuple[int, int, int]]:
    """(bytes skipped before it, start, end) of each record; the last one has the end 0 and no record."""
    at, behind = 0, 0  # where to look, and the end of the last record
    while at + STAMP + _MIN_PACKET <= len(data):
        end = _record_end(data, at, crc_extra)
        if end:
            yield at - behind, at, end
            at = behind = end
        else:
            at += 1
    yield len(data) - behind, behind, 0


def _record_end(data: bytes, at: int, crc_extra: Mapping[int, int]) -> int:
    """End of the record that begins at ``at``; 0: none does."""
    start = at + STAMP
    length = packet_length(data, start)
    end = start + length
    if length == 0 or end > len(data):
        return 0
    known = crc_extra.get(address(data[start : start + 10])[2])
    if known is not None:
        return end if checksum_fits(data[start:end], known) else 0
    has_time = int.from_bytes(data[at:start], "big") < MAX_TIME_US
    follows = end == len(data) or (end + STAMP < len(data) and data[end + STAMP] in (_V1, _V2))
    return end if has_time and follows else 0


def checksum_fits(packet: bytes, crc_extra: int) -> bool:
    """Whether the checksum of a complete packet is right. From the MAVLink serialisation guide."""
    end = (10 if packet[0] == _V2 else 6) + packet[1]
    covered = packet[1:end] + bytes([crc_extra])
    turned = crc_hqx(covered.translate(_TURNED), 0xFFFF)
    return packet[end : end + 2] == bytes([_TURNED[turned >> 8], _TURNED[turned & 0xFF]])


def packet_length(data: bytes, offset: int) -> int:
    """Length of the packet at ``offset`` in bytes; 0: no packet begins there. From the MAVLink serialisation guide."""
    if data[offset] == _V2 and offset + 2 < len(data) and data[offset + 2] in (0, _SIGNED):
        return 12 + data[offset + 1] + (13 if data[offset + 2] else 0)
    return 8 + data[offset + 1] if data[offset] == _V1 and offset + 1 < len(data) else 0


def address(packet: bytes) -> tuple[int, int, int]:
    """(system id, component id, message id) from the first 10 bytes of a packet."""
    if packet[0] == _V2:
        return packet[5], packet[6], int.from_bytes(packet[7:10], "little")
    return packet[3], packet[4], packet[5]


def sequence(packet: bytes) -> int:
    """Number of a packet by its sender, 0 to 255."""
    return packet[4] if packet[0] == _V2 else packet[2]


def payload(packet: bytes) -> bytes:
    """Payload; MAVLink 2 leaves out zeros at its end."""
    begin = 10 if packet[0] == _V2 else 6
    return packet[begin : begin + packet[1]]
