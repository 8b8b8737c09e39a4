"""A bad wire: nothing crashes, nothing wrong goes out. A slice; the whole is terrafix_tools.sim.autopilot.fuzz."""

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link_wire import attitude, packed
from terrafix.link.mavlink.framing import Framer
from terrafix_tools.sim.autopilot.fuzz import fuzz
from terrafix_tools.sim.autopilot.fuzz_wire import BadWire


@pytest.mark.parametrize("signed", [False, True])
def test_garbage_and_damaged_packets_change_nothing_that_is_sent(signed: bool) -> None:
    result = fuzz(BadWire(garbage_bytes=150_000), 20.0, signed=signed)
    assert result.bytes > 150_000
    assert (result.wrong, result.longest_gap_ms) == (0, 100.0)
    assert result.sent_3d >= 190
    # Every true attitude is read between the garbage; signed, one that a copy of a later packet has overtaken is not.
    assert result.states >= (450 if signed else 499)
    assert result.false_states == 0


def test_loss_doubles_and_disorder_change_nothing_that_is_sent() -> None:
    result = fuzz(BadWire(loss=0.3, double=0.2, late=0.2), 30.0)
    assert (result.wrong, result.false_states, result.longest_gap_ms) == (0, 0, 100.0)
    assert result.sent_3d >= 290
    assert result.worst_m < 1.0


def stream(count: int) -> list[bytes]:
    mav = mavlink.MAVLink(None, 7, 1)
    return [packed(attitude(i), mav) for i in range(count)]


def test_a_damaged_length_costs_its_own_packet_only() -> None:
    first, *others = stream(12)
    broken = bytearray(first)
    broken[1] = 255
    framer = Framer()
    read = list(framer.packets(bytes(broken) + b"".join(others)))
    assert [m.time_boot_ms for m in read] == list(range(1, 12))
    assert framer.skipped == len(first)


def test_a_stream_in_any_pieces_is_the_same_stream() -> None:
    data = b"\xfd\xfe\x00" + b"".join(stream(5)) + bytes(300)
    for size in (1, 2, 7, 50, 1000):
        framer = Framer()
        read = [m for i in range(0, len(data), size) for m in framer.packets(data[i : i + size])]
        assert [m.time_boot_ms for m in read] == list(range(5))


def test_what_is_kept_of_an_endless_half_packet_is_bounded() -> None:
    framer = Framer()
    for _ in range(2000):
        list(framer.packets(b"\xfd\xff\x00" + bytes(100)))
    assert len(framer._rest) <= 300


def test_kinds_that_nobody_can_check_are_not_messages() -> None:
    packet = bytearray(stream(1)[0])
    packet[7:10] = (9_999_999).to_bytes(3, "little")
    assert list(Framer().packets(bytes(packet) * 3)) == []
