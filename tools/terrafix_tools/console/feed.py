"""Server-sent events: what is stored, in order and once, to any number of clients."""

import asyncio
import json
from collections import deque
from collections.abc import AsyncIterator, Callable

from terrafix_tools.console.events import Event, name_of
from terrafix_tools.console.store.flights import EVENT_PAGE, StoredEvent

HEARTBEAT_S = 15.0  # longest silence of a stream [spec: proxies close idle connections after 30 to 60 s]
KEPT = 2000  # newest events of a flight in memory; a client that is further behind reads the database

ReadAfter = Callable[[str, int], list[StoredEvent]]


def text_of(event: StoredEvent) -> bytes:
    """An event of the stream. ``data`` is JSON on one line."""
    return f"id: {event.event_id}\nevent: {event.name}\ndata: {event.data}\n\n".encode()


def passing_text(event: Event) -> bytes:
    """An event without id, which is not repeated after a reconnection."""
    return f"event: {name_of(type(event))}\ndata: {event.model_dump_json()}\n\n".encode()


class Feed:
    """The events of one flight. All methods run in the event loop."""

    def __init__(self, flight_id: str, read_after: ReadAfter) -> None:
        self._flight_id, self._read_after = flight_id, read_after
        self._recent: deque[tuple[int, bytes]] = deque(maxlen=KEPT)
        self._last_id = -1  # of the newest event that was read; -1: none was
        self._changed = asyncio.Event()
        self._reading = asyncio.Lock()
        self._passing: bytes | None = None
        self._passing_number = 0
        self.clients = 0
        self.closed = False

    async def refresh(self) -> None:
        """Something was committed: reads the new events and wakes the clients."""
        async with self._reading:
            # Before the first client has read the database there is nothing to add to; it reads what is new.
            while self._last_id >= 0 and (
                page := await asyncio.to_thread(self._read_after, self._flight_id, self._last_id)
            ):
                self._recent.extend((event.event_id, text_of(event)) for event in page)
                self._last_id = page[-1].event_id
        self._wake()

    def pass_on(self, event: Event) -> None:
        """To the clients that listen now. One that is slow gets the newest only."""
        self._passing, self._passing_number = passing_text(event), self._passing_number + 1
        self._wake()

    def close(self) -> None:
        """Ends all streams."""
        self.closed = True
        self._wake()

    def _wake(self) -> None:
        changed, self._changed = self._changed, asyncio.Event()
        changed.set()

    async def stream(self, after: int) -> AsyncIterator[bytes]:
        """The events after the id ``after`` (at most that of the newest event), then those to come; a comment when
        there were none for a while."""
        self.clients += 1
        try:
            passed = self._passing_number
            yield f": {json.dumps(self._flight_id)}\n\n".encode()
            while not self.closed:
                changed = self._changed
                page = await self._after(after)
                if page:
                    after = page[-1][0]
                    yield b"".join(text for _, text in page)
                    continue
                if passed != self._passing_number and self._passing is not None:
                    passed = self._passing_number
                    yield self._passing
                    continue
                try:
                    await asyncio.wait_for(changed.wait(), HEARTBEAT_S)
                except TimeoutError:
                    yield b": heartbeat\n\n"
        finally:
            self.clients -= 1

    async def _after(self, after: int) -> list[tuple[int, bytes]]:
        """At most EVENT_PAGE events after an id, with their texts."""
        oldest = self._recent[0][0] if self._recent else self._last_id + 1
        if self._last_id >= 0 and after + 1 >= oldest:
            newer = self._last_id - after
            return [] if newer <= 0 else list(self._recent)[-newer:][:EVENT_PAGE]
        async with self._reading:  # so that `refresh` begins where the first client has read to
            page = await asyncio.to_thread(self._read_after, self._flight_id, after)
            if self._last_id < 0 and len(page) < EVENT_PAGE:
                self._last_id = page[-1].event_id if page else after
        return [(event.event_id, text_of(event)) for event in page]


class Feeds:
    """The feeds of all flights that have clients."""

    def __init__(self, read_after: ReadAfter) -> None:
        self._read_after = read_after
        self._feeds: dict[str, Feed] = {}
        self._closed = False

    @property
    def clients(self) -> int:
        return sum(feed.clients for feed in self._feeds.values())

    def of(self, flight_id: str) -> Feed:
        for idle in [key for key, feed in self._feeds.items() if feed.clients == 0 and key != flight_id]:
            del self._feeds[idle]
        feed = self._feeds.setdefault(flight_id, Feed(flight_id, self._read_after))
        feed.closed = self._closed
        return feed

    async def refresh(self, flight_id: str) -> None:
        if flight_id in self._feeds:
            await self._feeds[flight_id].refresh()

    def pass_on(self, flight_id: str, event: Event) -> None:
        if flight_id in self._feeds:
            self._feeds[flight_id].pass_on(event)

    def drop(self, flight_id: str) -> None:
        """The flight was deleted."""
        if flight_id in self._feeds:
            self._feeds.pop(flight_id).close()

    def close(self) -> None:
        self._closed = True
        for feed in self._feeds.values():
            feed.close()
