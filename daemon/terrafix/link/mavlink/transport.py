"""Bytes to and from an autopilot over UDP, TCP or a serial port; never blocks after opening.

pymavlink's own connections are not used in flight: they sleep while reconnecting, resolve names while sending and
print. ``read`` and ``write`` raise OSError when the other side is gone; the edge then opens again."""

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

CONNECT_S = 3.0  # a TCP peer that does not answer at start
READ_MAX = 65_536  # bytes taken per look: a flood costs its share of a tick, not the tick
DATAGRAMS_MAX = 200
PEERS_MAX = 8  # who is answered on a listening port
ANY_PORT = 0
IN_PROGRESS = (errno.EINPROGRESS, errno.EWOULDBLOCK, errno.EALREADY)


Address = tuple[str, int]
Chunk = tuple[bytes, Address | None]  # the sender on a listening port; None where there is one other end only


class Transport(Protocol):
    def read(self) -> list[Chunk]:
        """What has come, in order; empty when there is nothing."""
        ...

    def write(self, packet: bytes, to: Address | None = None) -> bool:
        """``to``: one peer of a listening port; None: all that it answers, or the other end.

        False: there was no room (or nobody to send to) and the packet is lost; it is never sent late."""
        ...

    def close(self) -> None: ...


def open_at_start(device: str, baud: int) -> Transport:
    """As ``open_transport``, waiting for a TCP peer. Raises LinkError with what to check."""
    try:
        return open_transport(device, baud, wait=True)
    except OSError as error:
        advice = {
            "udpin": "is the port taken by another program?",
            "udpout": "is there a network?",
            "tcp": "is the other side listening?",
        }.get(device.partition(":")[0], "is it plugged in, free, and may this user read and write it?")
        why = os.strerror(error.errno) if error.errno else str(error)  # pyserial wraps the text into its own
        raise LinkError(f"link '{device}' cannot be opened ({why}); {advice}") from None


def open_transport(device: str, baud: int, *, wait: bool) -> Transport:
    """``udpin:HOST:PORT``, ``udpout:HOST:PORT``, ``tcp:HOST:PORT`` or the path of a serial device.

    ``wait``: at start a TCP connection is waited for, in flight it completes in the background.
    Raises LinkError for what cannot be understood, OSError for what cannot be opened."""
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


@cache  # once per run, so that nothing in flight waits for a name server
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
        for _ in range(DATAGRAMS_MAX):
            try:
                data, sender = self._socket.recvfrom(READ_MAX)
            except (BlockingIOError, ConnectionRefusedError):
                break
            if (chunk := self._from(data, sender)) is not None:
                chunks.append(chunk)
        return chunks

    def _from(self, data: bytes, sender: Address) -> Chunk | None:
        """What becomes of a datagram; None: it is not for us."""
        raise NotImplementedError

    def _send(self, packet: bytes, to: Address) -> bool:
        try:
            return self._socket.sendto(packet, to) == len(packet)
        except OSError:  # no buffer, no route, nobody listening: UDP has no connection to lose
            return False

    def close(self) -> None:
        self._socket.close()


class UdpOut(_Udp):
    """To one address, and heard from that one only; a loopback address is spoken to from loopback.

    The socket is not connected: it would be tied to the address that this computer has now, and a network that is
    not there yet would be an error. ``ignored``: datagrams of other senders, ``ignored_from`` the newest of them."""

    def __init__(self, address: Address) -> None:
        super().__init__(("127.0.0.1", ANY_PORT) if ipaddress.ip_address(address[0]).is_loopback else None)
        self._to = address
        self.ignored = 0
        self.ignored_from: Address | None = None

    def _from(self, data: bytes, sender: Address) -> Chunk | None:
        if sender == self._to:
            return data, None
        self.ignored, self.ignored_from = self.ignored + 1, sender
        return None

    def write(self, packet: bytes, to: Address | None = None) -> bool:
        return self._send(packet, self._to)


class UdpIn(_Udp):
    """Listens, and answers who has spoken (the last few of them), less those that are to be forgotten."""

    def __init__(self, address: Address) -> None:
        super().__init__(address)
        self._peers: dict[Address, None] = {}

    def _from(self, data: bytes, sender: Address) -> Chunk | None:
        self._peers.pop(sender, None)
        self._peers[sender] = None
        while len(self._peers) > PEERS_MAX:
            del self._peers[next(iter(self._peers))]
        return data, sender

    def forget(self, peer: Address) -> None:
        """It gets nothing until it speaks again."""
        self._peers.pop(peer, None)

    def write(self, packet: bytes, to: Address | None = None) -> bool:
        return any([self._send(packet, peer) for peer in (self._peers if to is None else (to,))])


class _Stream:
    """A byte stream: the rest of a packet that went out in part goes first, or the receiver would lose its place."""

    def __init__(self) -> None:
        self._rest = b""

    def write(self, packet: bytes, to: Address | None = None) -> bool:
        if self._rest:
            self._rest = self._rest[self._put(self._rest) :]
            if self._rest:
                return False
        sent = self._put(packet)
        self._rest = packet[sent:] if sent else b""
        return sent > 0

    def _put(self, data: bytes) -> int:
        raise NotImplementedError


class Tcp(_Stream):
    def __init__(self, address: Address, *, wait: bool) -> None:
        super().__init__()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # 10 Hz of small packets, each at once
        self._connected = wait
        try:
            if wait:
                self._socket.settimeout(CONNECT_S)
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
            self._connected = True  # or refused: then receiving says so
        try:
            data = self._socket.recv(READ_MAX)
        except BlockingIOError:
            return []
        if not data:
            raise ConnectionResetError(errno.ECONNRESET, "the other side has closed")
        return [(data, None)]

    def _put(self, data: bytes) -> int:
        try:
            return self._socket.send(data)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.ENOTCONN, *IN_PROGRESS):
                return 0
            raise

    def close(self) -> None:
        self._socket.close()


class Serial(_Stream):
    """pyserial sets the port up; reading and writing go to its descriptor, since pyserial's write can wait."""

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
            data = os.read(self._fd, READ_MAX)
            if not data:  # ready, yet empty: a USB converter that was pulled
                raise OSError(errno.EIO, "the device is gone")
            return [(data, None)]
        return []

    def _put(self, data: bytes) -> int:
        try:
            return os.write(self._fd, data)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        with contextlib.suppress(OSError):  # a port that is gone cannot be closed in order
            self._port.close()
