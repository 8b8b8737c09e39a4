"""MAVLink 2 signing, compared with pymavlink's implementation and the published layout; rejection of other packets."""

import hashlib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link_wire import WiredEdge, attitude, heartbeat, packed, states
from terrafix.core.errors import ConfigError
from terrafix.link.mavlink.framing import Framer
from terrafix.link.mavlink.signing import EPOCH_UNIX_NS, Signing, read_key, timestamp

KEY = bytes(range(32))
S = 1_000_000_000
UNIX_NS = 1_795_262_400 * S  # 2026-11-21


def sender(key: bytes | None = KEY, *, unix_ns: int = UNIX_NS, sysid: int = 7) -> mavlink.MAVLink:
    """A sender that signs with pymavlink's implementation; ``key`` None: it does not sign."""
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


def edge_with(key: Path) -> WiredEdge:
    return WiredEdge(unix_ns=UNIX_NS, signing_key=str(key))


def test_signed_packets_have_the_published_layout_and_pymavlink_accepts_them(tmp_path: Path) -> None:
    link = edge_with(key_file(tmp_path))
    link.poll(0)
    receiver = mavlink.MAVLink(None)
    receiver.signing.secret_key = KEY
    receiver.signing.timestamp = timestamp(UNIX_NS)
    timestamps = []
    for packet in link.wire.sent:
        assert receiver.decode(bytearray(packet)).get_signed()
        assert packet[2] == 1
        assert packet[-6:] == hashlib.sha256(KEY + packet[:-6]).digest()[:6]
        timestamps.append(int.from_bytes(packet[-12:-6], "little"))
    assert len(timestamps) >= 2
    assert timestamps == sorted(set(timestamps))  # strictly increasing
    assert timestamps[0] == (UNIX_NS - EPOCH_UNIX_NS) // 10_000


@pytest.mark.parametrize(
    ("mav", "accepted"),
    [
        (sender(), True),
        (sender(None), False),
        (sender(bytes(32)), False),
        (sender(unix_ns=UNIX_NS - 59 * S), True),
        (sender(unix_ns=UNIX_NS - 61 * S), False),  # replay of an earlier recording
    ],
)
def test_only_packets_signed_with_our_key_and_a_recent_time_are_accepted(mav: mavlink.MAVLink, accepted: bool) -> None:
    signing = Signing(KEY)
    assert signing.accepts(decoded(packed(attitude(1000), mav)), UNIX_NS) is accepted
    assert signing.refused == (not accepted)


def test_a_replayed_packet_is_rejected() -> None:
    signing, mav = Signing(KEY), sender()
    first, second = (decoded(packed(attitude(t), mav)) for t in (1, 2))
    assert signing.accepts(second, UNIX_NS)
    assert not signing.accepts(second, UNIX_NS)
    assert not signing.accepts(first, UNIX_NS)


def test_a_forged_timestamp_does_not_block_the_true_sender() -> None:
    signing, mav = Signing(KEY), sender()
    assert signing.accepts(decoded(packed(attitude(1), mav)), UNIX_NS)
    forged = decoded(packed(attitude(2), sender(bytes(32), unix_ns=UNIX_NS + 10**9 * S)))
    assert not signing.accepts(forged, UNIX_NS)
    assert signing.accepts(decoded(packed(attitude(3), mav)), UNIX_NS)


def test_mavlink_1_packets_are_rejected_because_they_are_unsigned() -> None:
    packet = bytes(attitude(1).pack(mavlink.MAVLink(None, 7, 1), force_mavlink1=True))
    assert not Signing(KEY).accepts(decoded(packet), UNIX_NS)
    signed = b"\xfe" + packed(attitude(1), sender())[1:-6]  # a marker of MAVLink 1 before a body that is signed rightly
    signed += hashlib.sha256(KEY + signed).digest()[:6]
    message = decoded(packet)
    message._msgbuf = signed
    assert not Signing(KEY).accepts(message, UNIX_NS)


def test_without_a_plausible_clock_the_timestamp_of_the_autopilot_is_used(tmp_path: Path) -> None:
    signing = Signing(KEY)
    assert signing.accepts(decoded(packed(attitude(1), sender())), 5 * S)
    mav = mavlink.MAVLink(None, 1, 197)
    signing.sign_next(mav, 5 * S)
    assert mav.signing.timestamp > timestamp(UNIX_NS)


@settings(deadline=None)
@given(place=st.integers(0, 52), bits=st.integers(1, 255))
def test_a_signed_packet_with_any_changed_byte_is_rejected(place: int, bits: int) -> None:
    packet = bytearray(packed(attitude(1000), sender()))
    packet[place % len(packet)] ^= bits
    signing = Signing(KEY)
    assert not any(signing.accepts(m, UNIX_NS) for m in Framer().packets(bytes(packet)))


def test_the_edge_ignores_unsigned_packets_and_reports_them(tmp_path: Path) -> None:
    link, true = edge_with(key_file(tmp_path)), sender()
    assert states(link.receives(0, heartbeat(), attitude(1000))) == []
    assert (link.status().connected, link.status().refused) == (False, 2)
    assert "not signed with link.signing_key" in link.status().detail
    link.wire.arrive(packed(heartbeat(), true) + packed(attitude(1000), true))
    assert len(states(link.receives(S, attitude(1040)))) == 1
    assert link.status().connected
    assert "3 unsigned or wrongly signed packets ignored" in link.status().detail


def test_signing_keys_are_read_in_both_formats_and_invalid_ones_raise(tmp_path: Path) -> None:
    assert read_key(key_file(tmp_path)) == KEY
    assert read_key(key_file(tmp_path, KEY)) == KEY
    with pytest.raises(ConfigError, match="64 hexadecimal digits"):
        read_key(key_file(tmp_path, b"secret\n"))
    with pytest.raises(ConfigError, match="chmod 600"):
        read_key(key_file(tmp_path, mode=0o644))
    with pytest.raises(ConfigError, match=r"link\.signing_key"):
        read_key(tmp_path / "none.key")
