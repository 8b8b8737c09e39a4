"""One MAVLink connection: bytes to messages and back, signing if configured, reopening after a loss."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.config import LinkSection
from terrafix.core.errors import LinkError
from terrafix.link.mavlink.framing import Framer
from terrafix.link.mavlink.signing import Signing, read_key
from terrafix.link.mavlink.transport import (
    MAX_PEERS,
    REOPEN_PERIOD_NS,
    Address,
    Transport,
    UdpIn,
    UdpOut,
    open_transport,
)


class Connection:
    """Reads and writes without blocking. Errors of the transport are not raised: they set ``down`` and lead to a
    reopen."""

    def __init__(
        self, config: LinkSection, transport: Transport | None, wall_clock_ns: Callable[[], int], *, link_id: int = 0
    ) -> None:
        """``transport`` None: ``messages`` opens it. ``link_id``: link id of the signatures, one for each connection.

        Raises ConfigError when the signing key cannot be used."""
        self._config = config
        self._transport = transport
        self._wall_clock_ns = wall_clock_ns
        self._signing = Signing(read_key(Path(config.signing_key)), link_id) if config.signing_key else None
        self._mav = mavlink.MAVLink(None, srcSystem=config.sysid, srcComponent=config.compid)  # packs outgoing messages
        self._framers: dict[Address | None, Framer] = {}  # by sender, so that their bytes are not mixed
        self._next_open_ns = 0
        self.received_bytes = 0
        self.skipped_bytes = 0  # bytes outside of valid packets
        self.sent = self.sent_bytes = self.dropped = self.reopened = 0
        self.down = ""  # reason why there is no transport; empty while it is open

    @property
    def is_listening(self) -> bool:
        """True for a listening UDP port, where several peers may send, each from its own address."""
        return self._config.device.startswith("udpin:")

    @property
    def ignored(self) -> tuple[int, Address] | None:
        """-> (count of datagrams from other addresses than the configured one, sender of the newest); None: none."""
        wire = self._transport
        return (wire.ignored, wire.ignored_from) if isinstance(wire, UdpOut) and wire.ignored_from else None

    @property
    def signed(self) -> bool:
        return self._signing is not None

    @property
    def refused(self) -> int:
        """Number of packets rejected because their signature is missing or wrong."""
        return 0 if self._signing is None else self._signing.refused

    def messages(self, now_ns: int) -> Iterator[tuple[Any, Address | None]]:
        """-> (message, sender) for everything received since the last call. ``sender`` is None unless the transport is
        a listening port. Reopens the transport first if it is down."""
        if self._transport is None:
            self._reopen(now_ns)
        if self._transport is None:
            return
        try:
            chunks = self._transport.read()
        except OSError as error:
            self._on_connection_lost(error)
            return
        for chunk, sender in chunks:
            for message in self._decode(chunk, sender):
                if self._signing is None or self._signing.accepts(message, self._wall_clock_ns()):
                    yield message, sender

    def _decode(self, chunk: bytes, sender: Address | None) -> Iterator[Any]:
        framer = self._framers.pop(sender, None) or Framer()
        self._framers[sender] = framer  # most recently active sender last; the oldest one is dropped
        if len(self._framers) > MAX_PEERS:
            del self._framers[next(iter(self._framers))]
        self.received_bytes += len(chunk)
        skipped = framer.skipped
        yield from framer.packets(chunk)
        self.skipped_bytes += framer.skipped - skipped

    def forget_peer(self, peer: Address | None) -> None:
        """Removes ``peer`` from the peers of a listening port that get broadcast packets."""
        if isinstance(self._transport, UdpIn) and peer is not None:
            self._transport.forget_peer(peer)

    def send(self, message: Any, sender: mavlink.MAVLink | None = None, *, to: Address | None = None) -> None:
        """Packs, signs and sends immediately; a packet that cannot be sent is dropped. ``sender``: packer with another
        system and component id than ours. ``to``: see ``Transport.write``."""
        mav = sender or self._mav
        if self._signing is not None:
            self._signing.sign_next(mav, self._wall_clock_ns())
        packet = bytes(message.pack(mav))
        mav.seq = (mav.seq + 1) % 256
        if self._transport is None:
            self.dropped += 1
            return
        try:
            if self._transport.write(packet, to):
                self.sent += 1
                self.sent_bytes += len(packet)
            elif self.received_bytes:  # before the first reception there may be no peer: not counted as a loss
                self.dropped += 1
        except OSError as error:
            self.dropped += 1
            self._on_connection_lost(error)

    def close(self) -> None:
        if self._transport is not None:
            self._transport.close()
            self._transport = None

    def _on_connection_lost(self, error: OSError) -> None:
        self.down = f"connection lost ({error.strerror or error}); opening again"
        self.close()

    def _reopen(self, now_ns: int) -> None:
        if now_ns < self._next_open_ns:
            return
        self._next_open_ns = now_ns + REOPEN_PERIOD_NS
        try:
            self._transport = open_transport(self._config.device, self._config.baud, wait=False)
        except (OSError, LinkError) as error:  # LinkError: the host name cannot be resolved at present
            self.down = f"cannot be opened again ({error})"
            return
        self._framers.clear()  # an incomplete packet of the old connection must not consume one of the new
        self.down = ""
        self.reopened += 1
