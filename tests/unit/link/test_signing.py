"""MAVLink 2 signing, against pymavlink's own implementation and the published layout; nothing unsigned gets through."""

import hashlib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link_wire import MemoryWire, attitude, heartbeat, packed, states
from terrafix.core.config import LinkSection
from terrafix.core.errors import ConfigError
from terrafix.link.edge import MavlinkEdge
from terrafix.link.mavlink.framing import Framer
from terrafix.link.mavlink.signing import EPOCH_UNIX_NS, Signing, read_key, timestamp
from terrafix.messages import LinkStatus

KEY = bytes(range(32))
S = 1_000_000_000
UNIX_NS = 1_795_262_400 * S  # 2026-11-21


def sender(key: bytes | None = KEY, *, unix_ns: int = UNIX_NS, sysid: int = 7) -> mavlink.MAVLink:
    """pymavlink's signing, the other side."""
    mav = mavlink.MAVLink(None, srcSystem=sysid, srcComponent=1)
    if key is not None:
        mav.signing.secret_key, mav.signing.sign_outgoing, mav.signing.link_id = key, True, 3
        mav.signing.timestamp = timestamp(unix_ns)
    return mav


def decoded(packet: bytes) -> Any:
    (message,) = Framer().packets(packet)
    return message


def key_file(tmp_path: Path, content: bytes = KEY.hex().encode() + b"\n", mode: int = 0o600) -> Path:
    path = tmp_path / "fc.key"
    path.write_bytes(content)
    path.chmod(mode)
    return path


def edge_on(wire: MemoryWire, key: Path) -> MavlinkEdge:
    return MavlinkEdge(LinkSection(signing_key=str(key)), wire, lambda: UNIX_NS)


def test_what_we_sign_pymavlink_accepts_and_layout_is_the_published_one(tmp_path: Path) -> None:
    wire = MemoryWire()
    list(edge_on(wire, key_file(tmp_path)).poll(0))
    ear = mavlink.MAVLink(None)
    ear.signing.secret_key = KEY
    ear.signing.timestamp = timestamp(UNIX_NS)
    times = []
    for packet in wire.sent:
        assert ear.decode(bytearray(packet)).get_signed()
        assert packet[2] == 1
        assert packet[-6:] == hashlib.sha256(KEY + packet[:-6]).digest()[:6]
        times.append(int.from_bytes(packet[-12:-6], "little"))
    assert len(times) >= 2
    assert times == sorted(set(times))  # strictly growing
    assert times[0] == (UNIX_NS - EPOCH_UNIX_NS) // 10_000


@pytest.mark.parametrize(
    ("mav", "accepted"),
    [
        (sender(), True),
        (sender(None), False),
        (sender(bytes(32)), False),
        (sender(unix_ns=UNIX_NS - 59 * S), True),
        (sender(unix_ns=UNIX_NS - 61 * S), False),  # recorded earlier and played again
    ],
)
def test_only_the_key_opens(mav: mavlink.MAVLink, accepted: bool) -> None:
    signing = Signing(KEY)
    assert signing.accepts(decoded(packed(attitude(1000), mav)), UNIX_NS) is accepted
    assert signing.refused == (not accepted)


def test_a_packet_is_heard_once() -> None:
    signing, mav = Signing(KEY), sender()
    first, second = (decoded(packed(attitude(t), mav)) for t in (1, 2))
    assert signing.accepts(second, UNIX_NS)
    assert not signing.accepts(second, UNIX_NS)
    assert not signing.accepts(first, UNIX_NS)


def test_a_forged_time_does_not_shut_the_true_sender_out() -> None:
    signing, mav = Signing(KEY), sender()
    assert signing.accepts(decoded(packed(attitude(1), mav)), UNIX_NS)
    forged = decoded(packed(attitude(2), sender(bytes(32), unix_ns=UNIX_NS + 10**9 * S)))
    assert not signing.accepts(forged, UNIX_NS)
    assert signing.accepts(decoded(packed(attitude(3), mav)), UNIX_NS)


def test_mavlink_1_cannot_be_signed_and_is_not_heard() -> None:
    packet = bytes(attitude(1).pack(mavlink.MAVLink(None, 7, 1), force_mavlink1=True))
    assert not Signing(KEY).accepts(decoded(packet), UNIX_NS)


def test_a_computer_without_a_clock_takes_the_time_of_the_autopilot(tmp_path: Path) -> None:
    signing = Signing(KEY)
    assert signing.accepts(decoded(packed(attitude(1), sender())), 5 * S)
    mav = mavlink.MAVLink(None, 1, 197)
    signing.prepare(mav, 5 * S)
    assert mav.signing.timestamp > timestamp(UNIX_NS)


@settings(deadline=None)
@given(place=st.integers(0, 52), bits=st.integers(1, 255))
def test_no_byte_of_a_signed_packet_can_be_changed(place: int, bits: int) -> None:
    packet = bytearray(packed(attitude(1000), sender()))
    packet[place % len(packet)] ^= bits
    signing = Signing(KEY)
    assert not any(signing.accepts(m, UNIX_NS) for m in Framer().packets(bytes(packet)))


def test_the_edge_ignores_what_is_not_signed_and_says_so(tmp_path: Path) -> None:
    wire = MemoryWire()
    edge = edge_on(wire, key_file(tmp_path))
    unsigned = mavlink.MAVLink(None, 7, 1)
    wire.arrive(packed(heartbeat(), unsigned) + packed(attitude(1000), unsigned))
    said = list(edge.poll(0))
    assert states(said) == []
    (status,) = [m for m in said if isinstance(m, LinkStatus)]
    assert (status.connected, status.refused) == (False, 2)
    assert "not signed with link.signing_key" in status.detail
    true = sender()
    wire.arrive(packed(heartbeat(), true) + packed(attitude(1000), true) + packed(attitude(1040), unsigned))
    said = list(edge.poll(S))
    assert len(states(said)) == 1
    (status,) = [m for m in said if isinstance(m, LinkStatus)]
    assert status.connected
    assert "3 unsigned or wrongly signed packets ignored" in status.detail


def test_keys_in_both_forms_and_what_is_no_key(tmp_path: Path) -> None:
    assert read_key(key_file(tmp_path)) == KEY
    assert read_key(key_file(tmp_path, KEY)) == KEY
    with pytest.raises(ConfigError, match="64 hexadecimal digits"):
        read_key(key_file(tmp_path, b"secret\n"))
    with pytest.raises(ConfigError, match="chmod 600"):
        read_key(key_file(tmp_path, mode=0o644))
    with pytest.raises(ConfigError, match=r"link\.signing_key"):
        read_key(tmp_path / "none.key")
