"""A short fuzz run on a bad connection: no crash, no wrong GPS_INPUT. See also terrafix_lab.sim.autopilot.fuzz."""

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link_wire import attitude, packed
from terrafix.link.mavlink.framing import Framer
from terrafix_lab.sim.autopilot.fuzz import fuzz
from terrafix_lab.sim.autopilot.fuzz_wire import BadWire


@pytest.mark.parametrize("signed", [False, True])
def test_garbage_and_damaged_packets_do_not_change_gps_input(signed: bool) -> None:
    result = fuzz(BadWire(garbage_bytes=150_000), 20.0, signed=signed)
    assert result.bytes > 150_000
    assert (result.wrong, result.longest_gap_ms) == (0, 100.0)
    assert result.sent_3d >= 190
    # Every true attitude is read between the garbage. With signing, one that arrives after a copy of a later packet is
    # rejected as a replay.
    assert result.states >= (450 if signed else 499)
    assert result.false_states == 0


def test_lost_duplicated_and_reordered_packets_do_not_change_gps_input() -> None:
    result = fuzz(BadWire(loss=0.3, double=0.2, late=0.2), 30.0)
    assert (result.wrong, result.false_states, result.longest_gap_ms) == (0, 0, 100.0)
    assert result.sent_3d >= 290
    assert result.worst_m < 1.0


def stream(count: int) -> list[bytes]:
    mav = mavlink.MAVLink(None, 7, 1)
    return [packed(attitude(i), mav) for i in range(count)]


def test_a_damaged_length_byte_loses_only_its_own_packet() -> None:
    first, *others = stream(12)
    broken = bytearray(first)
    broken[1] = 255
    framer = Framer()
    read = list(framer.packets(bytes(broken) + b"".join(others)))
    assert [m.time_boot_ms for m in read] == list(range(1, 12))
    assert framer.skipped == len(first)


def test_chunk_sizes_do_not_change_the_decoded_packets() -> None:
    data = b"\xfd\xfe\x00" + b"".join(stream(5)) + bytes(300)
    for size in (1, 2, 7, 50, 1000):
        framer = Framer()
        read = [m for i in range(0, len(data), size) for m in framer.packets(data[i : i + size])]
        assert [m.time_boot_ms for m in read] == list(range(5))


def test_the_buffer_of_an_incomplete_packet_is_bounded() -> None:
    framer = Framer()
    for _ in range(2000):
        list(framer.packets(b"\xfd\xff\x00" + bytes(100)))
    assert len(framer._incomplete) <= 300


def test_packets_of_unknown_type_are_rejected() -> None:
    packet = bytearray(stream(1)[0])
    packet[7:10] = (9_999_999).to_bytes(3, "little")
    assert list(Framer().packets(bytes(packet) * 3)) == []
