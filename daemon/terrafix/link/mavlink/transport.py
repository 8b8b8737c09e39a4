"""Byte transport to an autopilot over UDP, TCP or a serial port; does not block after opening.

pymavlink's own connections are not used in flight: they sleep while reconnecting, resolve names while sending and
print. ``read`` and ``write`` raise OSError when the connection is lost; ``Connection`` then opens it again."""

import contextlib
import errno
import ipaddress
import os
import select
import socket
from functools import cache
from typing import Protocol

import serial

from terrafix.core.errors import LinkError

REOPEN_PERIOD_NS = 1_000_000_000  # between two attempts to open a lost device [tuned]
CONNECT_TIMEOUT_S = 3.0  # for a TCP peer at start [tuned]
MAX_READ_BYTES = 65_536  # bytes per read: bounds the share of a tick that a flood of data can take [tuned]
MAX_DATAGRAMS_PER_READ = 200  # for the same reason [tuned]
MAX_PEERS = 8  # senders that get broadcast packets on a listening port [tuned]
ANY_PORT = 0  # the operating system chooses a free port [spec: bind(2)]
IN_PROGRESS = (errno.EINPROGRESS, errno.EWOULDBLOCK, errno.EALREADY)


Address = tuple[str, int]
Chunk = tuple[bytes, Address | None]  # with the sender on a listening port; None on point-to-point transports


class Transport(Protocol):
    def read(self) -> list[Chunk]:
        """-> received data in order; empty when there is none."""

    def write(self, packet: bytes, to: Address | None = None) -> bool:
        """``to``: one peer of a listening port; None: all of its peers, or the only other end.

        -> False if the buffer is full or there is no peer. The packet is then lost; it is not sent later."""

    def close(self) -> None: ...


def open_at_start(device: str, baud: int) -> Transport:
    """As ``open_transport``, and waits for a TCP peer. Raises LinkError with advice."""
    try:
        return open_transport(device, baud, wait=True)
    except OSError as error:
        advice = {
            "udpin": "is the port taken by another program?",
            "udpout": "is there a network?",
            "tcp": "is the other side listening?",
        }.get(device.partition(":")[0], "is it plugged in, free, and may this user read and write it?")
        why = os.strerror(error.errno) if error.errno else str(error)  # pyserial puts the text into a longer one
        raise LinkError(f"link '{device}' cannot be opened ({why}); {advice}") from None


def open_transport(device: str, baud: int, *, wait: bool) -> Transport:
    """``device``: ``udpin:HOST:PORT``, ``udpout:HOST:PORT``, ``tcp:HOST:PORT`` or the path of a serial device.

    ``wait``: block until a TCP connection is established (at start); otherwise it completes in the background.
    Raises LinkError for a malformed device name or an unknown host, OSError when the device cannot be opened."""
    kind, _, rest = device.partition(":")
    if kind in ("udpin", "udpout", "tcp"):
        address = _address(device, rest)
        if kind == "tcp":
            return Tcp(address, wait=wait)
        return UdpIn(address) if kind == "udpin" else UdpOut(address)
    if not device.startswith("/"):
        raise LinkError(
            f"link '{device}': not understood; write udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or /dev/..."
        )
    return Serial(device, baud)


@cache  # resolved once per run: a name server must not block the link in flight
def _address(device: str, rest: str) -> Address:
    host, _, port = rest.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65_536:
        raise LinkError(f"link '{device}': needs HOST:PORT; write for example {device.split(':')[0]}:127.0.0.1:14550")
    try:
        return socket.gethostbyname(host), int(port)
    except socket.gaierror:
        raise LinkError(f"link '{device}': host '{host}' is not known; check the name or write its address") from None


class _Udp:
    def __init__(self, bind_to: Address | None) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        if bind_to is None:
            return
        try:
            self._socket.bind(bind_to)
        except OSError:
            self._socket.close()
            raise

    def read(self) -> list[Chunk]:
        chunks: list[Chunk] = []
        for _ in range(MAX_DATAGRAMS_PER_READ):
            try:
                data, sender = self._socket.recvfrom(MAX_READ_BYTES)
            except (BlockingIOError, ConnectionRefusedError):
                break
            if (chunk := self._accept(data, sender)) is not None:
                chunks.append(chunk)
        return chunks

    def _accept(self, data: bytes, sender: Address) -> Chunk | None:
        """-> the chunk for a received datagram; None: it is ignored."""
        raise NotImplementedError

    def _send(self, packet: bytes, to: Address) -> bool:
        try:
            return self._socket.sendto(packet, to) == len(packet)
        except OSError:  # no buffer, no route or no listener; UDP has no connection that could be lost
            return False

    def close(self) -> None:
        self._socket.close()


class UdpOut(_Udp):
    """Sends to one address and accepts datagrams from it only. Binds to loopback if that address is a loopback one.

    The socket is not connected: it would be bound to the present address of this computer, and a network that is
    not up yet would be an error. ``ignored``: number of datagrams of other senders; ``ignored_from``: the newest."""

    def __init__(self, address: Address) -> None:
        super().__init__(("127.0.0.1", ANY_PORT) if ipaddress.ip_address(address[0]).is_loopback else None)
        self._to = address
        self.ignored = 0
        self.ignored_from: Address | None = None

    def _accept(self, data: bytes, sender: Address) -> Chunk | None:
        if sender == self._to:
            return data, None
        self.ignored, self.ignored_from = self.ignored + 1, sender
        return None

    def write(self, packet: bytes, to: Address | None = None) -> bool:
        return self._send(packet, self._to)


class UdpIn(_Udp):
    """Listens on one port. Its peers are the ``MAX_PEERS`` most recent senders, without those removed by
    ``forget_peer``."""

    def __init__(self, address: Address) -> None:
        super().__init__(address)
        self._peers: dict[Address, None] = {}

    def _accept(self, data: bytes, sender: Address) -> Chunk | None:
        self._peers.pop(sender, None)
        self._peers[sender] = None
        while len(self._peers) > MAX_PEERS:
            del self._peers[next(iter(self._peers))]
        return data, sender

    def forget_peer(self, peer: Address) -> None:
        """Removes the peer until it sends again."""
        self._peers.pop(peer, None)

    def write(self, packet: bytes, to: Address | None = None) -> bool:
        return any([self._send(packet, peer) for peer in (self._peers if to is None else (to,))])


class _Stream:
    """A byte stream. The remainder of a partially written packet is sent first; otherwise the receiver would lose
    synchronisation."""

    def __init__(self) -> None:
        self._unsent = b""

    def write(self, packet: bytes, to: Address | None = None) -> bool:
        if self._unsent:
            self._unsent = self._unsent[self._write_some(self._unsent) :]
            if self._unsent:
                return False
        sent = self._write_some(packet)
        self._unsent = packet[sent:] if sent else b""
        return sent > 0

    def _write_some(self, data: bytes) -> int:
        """-> number of bytes written without blocking."""
        raise NotImplementedError


class Tcp(_Stream):
    """TCP client."""

    def __init__(self, address: Address, *, wait: bool) -> None:
        super().__init__()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # small packets at 10 Hz, without delay
        self._connected = wait
        try:
            if wait:
                self._socket.settimeout(CONNECT_TIMEOUT_S)
                self._socket.connect(address)
            self._socket.setblocking(False)
            code = 0 if wait else self._socket.connect_ex(address)
            if code not in (0, *IN_PROGRESS):
                raise OSError(code, os.strerror(code))
        except OSError:
            self._socket.close()
            raise

    def read(self) -> list[Chunk]:
        if not self._connected:
            if not select.select([], [self._socket], [], 0)[1]:
                return []
            self._connected = True  # or refused: then recv raises
        try:
            data = self._socket.recv(MAX_READ_BYTES)
        except BlockingIOError:
            return []
        if not data:
            raise ConnectionResetError(errno.ECONNRESET, "the other side has closed")
        return [(data, None)]

    def _write_some(self, data: bytes) -> int:
        try:
            return self._socket.send(data)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.ENOTCONN, *IN_PROGRESS):
                return 0
            raise

    def close(self) -> None:
        self._socket.close()


class Serial(_Stream):
    """Serial port. pyserial configures it; reads and writes use its file descriptor, because pyserial's write can
    block."""

    def __init__(self, device: str, baud: int) -> None:
        super().__init__()
        try:
            self._port = serial.Serial(device, baud, timeout=0, exclusive=True)  # SerialException is an OSError
        except ValueError:
            raise LinkError(f"link '{device}': the port does not take {baud} baud; set link.baud") from None
        self._fd = self._port.fileno()
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)

    def read(self) -> list[Chunk]:
        for _, events in self._poll.poll(0):
            if events & (select.POLLHUP | select.POLLERR | select.POLLNVAL):
                raise OSError(errno.EIO, "the device is gone")
            data = os.read(self._fd, MAX_READ_BYTES)
            if not data:  # readable but empty: a USB converter was unplugged
                raise OSError(errno.EIO, "the device is gone")
            return [(data, None)]
        return []

    def _write_some(self, data: bytes) -> int:
        try:
            return os.write(self._fd, data)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        with contextlib.suppress(OSError):  # closing an unplugged port fails
            self._port.close()
