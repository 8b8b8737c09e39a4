"""MAVLink 2 signing (mavlink.io/en/guide/message_signing.html): who has not the key is not heard.

A signature is the first 6 bytes of sha256(key, packet up to here), after a link id and a time in units of 10 us
since 2015. The time of a stream only grows, so that a packet cannot be played again. Checked here and not by
pymavlink: it notes the time of a packet before it has checked the signature, so one forged packet would shut a true
sender out."""

import hashlib
import hmac
import stat
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.errors import ConfigError
from terrafix.link.mavlink.framing import SIGNATURE, SIGNED, V2

KEY_BYTES = 32
EPOCH_UNIX_NS = 1_420_070_400 * 1_000_000_000  # 2015-01-01 00:00:00 UTC
UNIT_NS = 10_000
NEW_STREAM_BEHIND = 6_000_000  # a stream not heard before may be this far behind our time: one minute (the guide)


def read_key(path: Path) -> bytes:
    """64 hexadecimal digits, or 32 bytes. Raises ConfigError: no key there, or one that everybody can read."""
    try:
        mode, content = path.stat().st_mode, path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: signing key cannot be read ({error.strerror}); check link.signing_key") from None
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise ConfigError(f"{path}: others may read this signing key; do: chmod 600 {path}")
    if len(content) == KEY_BYTES:
        return content
    try:
        key = bytes.fromhex(content.decode("ascii"))
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES:
        raise ConfigError(f"{path}: not a signing key; it must hold 64 hexadecimal digits (32 bytes)")
    return key


def timestamp(unix_ns: int) -> int:
    """Unix time -> units of 10 us since 2015; 0 before."""
    return max(0, unix_ns - EPOCH_UNIX_NS) // UNIT_NS


class Signing:
    """One key: ``prepare`` what sends, ask ``accepts`` for what has come."""

    def __init__(self, key: bytes, link_id: int = 0) -> None:
        """``link_id``: each of our links has its own, and with it its own stream of times."""
        self._key, self._link_id = key, link_id
        self._time = 0  # the latest of our clock and of what true packets have said
        self._streams: dict[tuple[int, int, int], int] = {}  # (link id, system, component) -> newest time
        self.refused = 0

    def prepare(self, mav: mavlink.MAVLink, unix_ns: int) -> None:
        """The next packet of ``mav`` is signed, with the time of now or, if that is later, the one after the last."""
        self._time = max(self._time + 1, timestamp(unix_ns))
        mav.signing.secret_key, mav.signing.link_id, mav.signing.sign_outgoing = self._key, self._link_id, True
        mav.signing.timestamp = self._time

    def accepts(self, message: Any, unix_ns: int) -> bool:
        """Whether a message with a right checksum was signed with our key, and is not an old one again."""
        good = self._check(bytes(message.get_msgbuf()), message.get_srcSystem(), message.get_srcComponent(), unix_ns)
        self.refused += not good
        return good

    def _check(self, packet: bytes, sysid: int, compid: int, unix_ns: int) -> bool:
        if packet[0] != V2 or not packet[2] & SIGNED:
            return False
        digest = hashlib.sha256(self._key + packet[:-6]).digest()[:6]
        if not hmac.compare_digest(digest, packet[-6:]):
            return False
        link_id, time = packet[-SIGNATURE], int.from_bytes(packet[-SIGNATURE + 1 : -6], "little")
        stream = (link_id, sysid, compid)
        newest = self._streams.get(stream)
        oldest = max(self._time, timestamp(unix_ns)) - NEW_STREAM_BEHIND if newest is None else newest + 1
        if time < oldest:
            return False
        self._streams[stream] = time
        self._time = max(self._time, time)
        return True
