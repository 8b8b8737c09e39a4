"""Connections of slow clients are bounded in number and in time; uvicorn itself bounds only idle ones.

The head of a request has HEAD_S to arrive. Of an answer the kernel has to take some within STALL_S; a client that reads
nothing, an event stream that nobody looks at included, is cut then and holds no more than one buffer until then."""

import asyncio
from typing import cast

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

CONNECTIONS = 512  # at once; twice the event streams [spec: docs/console.md]
HEAD_S = 10.0  # [spec: docs/console.md]
STALL_S = 60.0  # [spec: docs/console.md]


class BoundedProtocol(H11Protocol):
    """The protocol of one connection."""

    _head: asyncio.TimerHandle | None = None  # runs while a head is awaited
    _stall: asyncio.TimerHandle | None = None  # runs while the client does not read

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(cast(asyncio.Transport, transport))
        if len(self.connections) > CONNECTIONS:
            self.transport.abort()
            return
        self._await_head()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if self.conn.their_state is h11.IDLE:
            self._await_head()
        else:
            self._stop_head()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_head()
        self.resume_writing()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        super().pause_writing()
        self._stall = self.loop.call_later(STALL_S, self.transport.abort)

    def resume_writing(self) -> None:
        if self._stall is not None:
            self._stall.cancel()
            self._stall = None
        super().resume_writing()

    def _await_head(self) -> None:
        """A head that has begun keeps its time, however often a part of it comes."""
        if self._head is None:
            self._head = self.loop.call_later(HEAD_S, self.transport.abort)

    def _stop_head(self) -> None:
        if self._head is not None:
            self._head.cancel()
            self._head = None
