"""MAVLink 2 message signing (mavlink.io/en/guide/message_signing.html): packets without a valid signature are rejected.

A signature is the first 6 bytes of sha256(key, packet up to here), after a link id and a timestamp in units of 10 us
since 2015. The timestamps of a stream increase strictly, which prevents replay. pymavlink's own check is not used: it
stores the timestamp of a packet before it verifies the signature, so one forged packet would block the true sender."""

import hashlib
import hmac
import stat
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.errors import ConfigError
from terrafix.link.mavlink.framing import SIGNATURE_BYTES, SIGNED_FLAG, V2

SIGNING_KEY_BYTES = 32  # [spec: MAVLink 2 message signing]
EPOCH_UNIX_NS = 1_420_070_400 * 1_000_000_000  # 2015-01-01 00:00:00 UTC [spec: MAVLink 2 message signing]
TIMESTAMP_UNIT_NS = 10_000  # [spec: MAVLink 2 message signing]
# Timestamp units (10 us): a new stream may be one minute behind our time. [spec: MAVLink 2 message signing]
NEW_STREAM_MAX_AGE = 6_000_000


def read_key(path: Path) -> bytes:
    """Reads a key file with 64 hexadecimal digits or 32 bytes -> key of 32 bytes.

    Raises ConfigError when the file cannot be read, has other content, or is accessible to other users."""
    try:
        mode, content = path.stat().st_mode, path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: signing key cannot be read ({error.strerror}); check link.signing_key") from None
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise ConfigError(f"{path}: others may read this signing key; do: chmod 600 {path}")
    if len(content) == SIGNING_KEY_BYTES:
        return content
    try:
        key = bytes.fromhex(content.decode("ascii"))
    except ValueError:
        key = b""
    if len(key) != SIGNING_KEY_BYTES:
        raise ConfigError(f"{path}: not a signing key; it must hold 64 hexadecimal digits (32 bytes)")
    return key


def timestamp(unix_ns: int) -> int:
    """Unix time -> signing timestamp in units of 10 us since 2015; 0 before."""
    return max(0, unix_ns - EPOCH_UNIX_NS) // TIMESTAMP_UNIT_NS


class Signing:
    """Signs outgoing and verifies incoming packets with one key."""

    def __init__(self, key: bytes, link_id: int = 0) -> None:
        """``link_id``: one for each of our links, so that each has its own sequence of timestamps."""
        self._key, self._link_id = key, link_id
        self._timestamp = 0  # maximum of our clock and the timestamps of verified packets
        self._streams: dict[tuple[int, int, int], int] = {}  # (link id, system, component) -> newest timestamp
        self.refused = 0

    def sign_next(self, mav: mavlink.MAVLink, unix_ns: int) -> None:
        """Sets up ``mav`` to sign its next packet. The timestamp is ``unix_ns``, or the previous one plus 1 if that is
        later."""
        self._timestamp = max(self._timestamp + 1, timestamp(unix_ns))
        mav.signing.secret_key, mav.signing.link_id, mav.signing.sign_outgoing = self._key, self._link_id, True
        mav.signing.timestamp = self._timestamp

    def accepts(self, message: Any, unix_ns: int) -> bool:
        """True if the message (whose checksum is valid) carries a valid signature and is not a replay."""
        accepted = self._is_valid(
            bytes(message.get_msgbuf()), message.get_srcSystem(), message.get_srcComponent(), unix_ns
        )
        self.refused += not accepted
        return accepted

    def _is_valid(self, packet: bytes, sysid: int, compid: int, unix_ns: int) -> bool:
        if packet[0] != V2 or not packet[2] & SIGNED_FLAG:
            return False
        digest = hashlib.sha256(self._key + packet[:-6]).digest()[:6]
        if not hmac.compare_digest(digest, packet[-6:]):
            return False
        link_id, packet_timestamp = (
            packet[-SIGNATURE_BYTES],
            int.from_bytes(packet[-SIGNATURE_BYTES + 1 : -6], "little"),
        )
        stream = (link_id, sysid, compid)
        newest = self._streams.get(stream)
        oldest = max(self._timestamp, timestamp(unix_ns)) - NEW_STREAM_MAX_AGE if newest is None else newest + 1
        if packet_timestamp < oldest:
            return False
        self._streams[stream] = packet_timestamp
        self._timestamp = max(self._timestamp, packet_timestamp)
        return True
