"""The connection: bytes to messages and back, signed where that is asked for, opened again when it was lost."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.config import LinkSection
from terrafix.core.errors import LinkError
from terrafix.link.mavlink.framing import Framer
from terrafix.link.mavlink.signing import Signing, read_key
from terrafix.link.mavlink.transport import PEERS_MAX, Address, Transport, UdpIn, UdpOut, open_transport

REOPEN_NS = 1_000_000_000


class Connection:
    """Never waits, and never raises for what the wire does."""

    def __init__(
        self,
        config: LinkSection,
        transport: Transport | None,
        wall_clock_ns: Callable[[], int],
        *,
        link_id: int = 0,
    ) -> None:
        """``transport`` None: it is opened when it can be. ``link_id``: of the signatures, one for each connection.

        Raises ConfigError: the signing key."""
        self._config = config
        self._transport = transport
        self._wall_clock_ns = wall_clock_ns
        self._signing = Signing(read_key(Path(config.signing_key)), link_id) if config.signing_key else None
        self._mav = mavlink.MAVLink(None, srcSystem=config.sysid, srcComponent=config.compid)  # packs what is sent
        self._framers: dict[Address | None, Framer] = {}  # by sender: half a packet of one is not completed by another
        self._try_ns = 0
        self.heard_bytes = 0
        self.skipped_bytes = 0  # that belonged to no packet
        self.sent = self.sent_bytes = self.dropped = self.reopened = 0
        self.down = ""  # why there is no transport

    @property
    def listens(self) -> bool:
        """Several may speak, each from an address of its own."""
        return self._config.device.startswith("udpin:")

    @property
    def ignored(self) -> tuple[int, Address] | None:
        """Datagrams from elsewhere than the one address that is heard, and the sender of the newest."""
        wire = self._transport
        return (wire.ignored, wire.ignored_from) if isinstance(wire, UdpOut) and wire.ignored_from else None

    @property
    def signed(self) -> bool:
        return self._signing is not None

    @property
    def refused(self) -> int:
        """Packets without the signature that is asked for."""
        return 0 if self._signing is None else self._signing.refused

    def messages(self, now_ns: int) -> Iterator[tuple[Any, Address | None]]:
        """What has come, with its sender on a listening port (None elsewhere); opens again first when there is nothing
        to read from."""
        if self._transport is None:
            self._reopen(now_ns)
        if self._transport is None:
            return
        try:
            chunks = self._transport.read()
        except OSError as error:
            self._lost(error)
            return
        for chunk, sender in chunks:
            for message in self._packets(chunk, sender):
                if self._signing is None or self._signing.accepts(message, self._wall_clock_ns()):
                    yield message, sender

    def _packets(self, chunk: bytes, sender: Address | None) -> Iterator[Any]:
        framer = self._framers.pop(sender, None) or Framer()
        self._framers[sender] = framer  # the newest is the last
        if len(self._framers) > PEERS_MAX:
            del self._framers[next(iter(self._framers))]
        self.heard_bytes += len(chunk)
        skipped = framer.skipped
        yield from framer.packets(chunk)
        self.skipped_bytes += framer.skipped - skipped

    def forget(self, peer: Address | None) -> None:
        """A sender on a listening port that gets nothing of what goes to all."""
        if isinstance(self._transport, UdpIn) and peer is not None:
            self._transport.forget(peer)

    def send(self, message: Any, sender: mavlink.MAVLink | None = None, *, to: Address | None = None) -> None:
        """Packs, signs and sends now, or not at all. ``sender``: somebody else than we (system and component).
        ``to``: see Transport.write."""
        mav = sender or self._mav
        if self._signing is not None:
            self._signing.prepare(mav, self._wall_clock_ns())
        packet = bytes(message.pack(mav))
        mav.seq = (mav.seq + 1) % 256
        if self._transport is None:
            self.dropped += 1
            return
        try:
            if self._transport.write(packet, to):
                self.sent += 1
                self.sent_bytes += len(packet)
            elif self.heard_bytes:  # before anybody was heard there may be nobody to send to
                self.dropped += 1
        except OSError as error:
            self.dropped += 1
            self._lost(error)

    def close(self) -> None:
        if self._transport is not None:
            self._transport.close()
            self._transport = None

    def _lost(self, error: OSError) -> None:
        self.down = f"connection lost ({error.strerror or error}); opening again"
        self.close()

    def _reopen(self, now_ns: int) -> None:
        if now_ns < self._try_ns:
            return
        self._try_ns = now_ns + REOPEN_NS
        try:
            self._transport = open_transport(self._config.device, self._config.baud, wait=False)
        except (OSError, LinkError) as error:  # LinkError: a host name that cannot be resolved just now
            self.down = f"cannot be opened again ({error})"
            return
        self._framers.clear()  # half a packet of the old connection must not swallow one of the new
        self.down = ""
        self.reopened += 1
