"""Events of a flight: stored in order, sent once, over reconnections and restarts."""

import asyncio
import sqlite3
from collections.abc import AsyncIterator, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from console_rig import NEW, Console, settings
from terrafix.core.errors import OutputError
from terrafix_tools.console import feed as feed_module
from terrafix_tools.console.compute.observed import FrameOutcome
from terrafix_tools.console.events import EVENTS, Health, ProcessingBlocked, VerdictGiven, name_of
from terrafix_tools.console.feed import Feed
from terrafix_tools.console.payloads import FlightState, Fragment, FrameResult, Hint, InputRequest, NewFlight
from terrafix_tools.console.store import flights
from terrafix_tools.console.store.database import FILE, Database, open_database
from terrafix_tools.console.store.flights import StoredEvent


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    opened = open_database(tmp_path)
    yield opened
    opened.close()


def new_flight(database: Database) -> str:
    with database.write() as db:
        return flights.create(db, NewFlight.model_validate(NEW)).flight_id


def blocked(number: int) -> ProcessingBlocked:
    return ProcessingBlocked(reason=f"reason {number}", frame_id=number)


def add(database: Database, flight_id: str, step: str, *numbers: int) -> None:
    with database.write() as db:
        flights.add_events(db, flight_id, step, [blocked(number) for number in numbers])


def test_names_of_events_are_those_of_the_contract() -> None:
    assert [name_of(kind) for kind in EVENTS] == [
        "frame_processed",
        "frame_refined",
        "waypoints_updated",
        "search_expanded",
        "user_input_needed",
        "processing_blocked",
        "chunk_merged",
        "fragment_changed",
        "recovery_started",
        "recovery_succeeded",
        "user_fix_applied",
        "state_changed",
        "verdict_given",
        "hint_answered",
        "finalise_progress",
        "flight_completed",
        "health",
    ]


def test_a_file_of_the_time_before_versions_keeps_its_flights(database: Database, tmp_path: Path) -> None:
    flight_id = new_flight(database)
    database.close()
    with closing(sqlite3.connect(tmp_path / FILE)) as former:  # as Alembic left it
        former.executescript("PRAGMA user_version = 0; CREATE TABLE alembic_version (version_num VARCHAR(32));")
    for _ in range(2):
        opened = open_database(tmp_path)
        with opened.read() as db:
            assert [flight.flight_id for flight in flights.all_flights(db)] == [flight_id]
        opened.close()


def test_a_file_of_the_version_before_keeps_its_fragments(database: Database, tmp_path: Path) -> None:
    flight_id = new_flight(database)
    database.close()
    with closing(sqlite3.connect(tmp_path / FILE)) as former:
        former.executescript("PRAGMA user_version = 1; ALTER TABLE fragments DROP COLUMN state;")
        former.execute("INSERT INTO fragments VALUES (?, 2, 0, 5, 6, 1, NULL)", (flight_id,))
        former.commit()
    opened = open_database(tmp_path)
    with opened.read() as db:
        (fragment,) = flights.flight_of(db, flight_id).fragments
    assert (fragment.fragment_id, fragment.frames, fragment.state) == (2, 6, "unanchored")
    opened.close()


def test_a_file_with_tables_of_a_later_version_is_refused(database: Database, tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / FILE)) as later:
        later.execute("PRAGMA user_version = 7")
    with pytest.raises(OutputError, match=r"console.sqlite: has tables of version 7, .*; update Terrafix, or name"):
        open_database(tmp_path)


def test_a_file_that_is_no_database_is_refused(tmp_path: Path) -> None:
    (tmp_path / FILE).write_text("no database " * 100)
    with pytest.raises(OutputError, match=r"console.sqlite: cannot be opened .*; name another folder with --data"):
        open_database(tmp_path)


def test_a_step_that_is_computed_again_adds_nothing(database: Database) -> None:
    flight_id = new_flight(database)
    result = FrameResult(frame_id=0, file="a", t_s=0.0)
    outcome = FrameOutcome(
        result=result,
        fragment=Fragment(fragment_id=0, first_frame=0, last_frame=0, frames=1, joined=True),
        events=[blocked(1), blocked(2)],
        state=FlightState.BLOCKED,
        request=InputRequest(request_id="r1", frame_id=0),
    )
    for _ in range(2):
        with database.write() as db:
            flights.store_outcome(db, flight_id, "frame 0", outcome)
    with database.read() as db:
        assert [e.event_id for e in flights.events_after(db, flight_id, 0)] == [1, 2]
        assert flights.results_of(db, flight_id, refined=False, first=0, most=9) == [result]
        flight = flights.flight_of(db, flight_id)
    assert (flight.state, flight.images.processed, flight.last_event_id) == (FlightState.BLOCKED, 1, 2)
    assert flight.request == outcome.request and [f.frames for f in flight.fragments] == [1]


def test_a_transaction_that_fails_leaves_nothing(database: Database) -> None:
    flight_id = new_flight(database)
    with pytest.raises(ZeroDivisionError), database.write() as db:
        flights.add_events(db, flight_id, "frame 0", [blocked(1)])
        raise ZeroDivisionError
    with database.read() as db:
        assert flights.last_event_id(db, flight_id) == 0


def test_a_hint_belongs_to_the_first_frame_after_it_in_every_later_run(database: Database) -> None:
    flight_id = new_flight(database)
    hint = Hint(lat=1.0, lon=2.0)
    with database.write() as db:
        flights.add_hint(db, flight_id, hint)
        assert flights.hints_before(db, flight_id, 5) == [(1, hint)]
        flights.add_hint(db, flight_id, hint)
        assert flights.hints_before(db, flight_id, 7) == [(2, hint)]
        assert flights.has_hints_before(db, flight_id, 6) is False
        assert flights.hints_before(db, flight_id, 5) == [(1, hint)]  # computed again


def test_events_are_sent_from_the_last_one_that_was_received_over_a_restart(tmp_path: Path) -> None:
    with Console(settings(tmp_path)) as console:
        flight_id = console.create()
        add(console.service.database, flight_id, "a", 1, 2, 3)
        first = console.events(flight_id, 0, 2)
        assert [(i, name, data["frame_id"]) for i, name, data in first] == [
            (1, "processing_blocked", 1),
            (2, "processing_blocked", 2),
        ]
    with Console(settings(tmp_path)) as console:
        add(console.service.database, flight_id, "b", 4)
        assert [i for i, _, _ in console.events(flight_id, 2, 2)] == [3, 4]
        assert [i for i, _, _ in console.events(flight_id, 0, 4)] == [1, 2, 3, 4]


class Source:
    """Events that are stored, and a feed that reads them."""

    def __init__(self) -> None:
        self.stored: list[StoredEvent] = []
        self.feed = Feed("f", self.after)

    def after(self, flight_id: str, after: int) -> list[StoredEvent]:
        return [event for event in self.stored if event.event_id > after][: feed_module.EVENT_PAGE]

    async def add(self, count: int) -> None:
        first = len(self.stored) + 1
        self.stored += [StoredEvent(n, "verdict_given", "{}") for n in range(first, first + count)]
        await self.feed.refresh()


async def ids(stream: AsyncIterator[bytes], count: int) -> list[int]:
    """The ids of the next ``count`` events."""
    found: list[int] = []
    while len(found) < count:
        chunk = await asyncio.wait_for(anext(stream), 5.0)
        found += [int(line[4:]) for line in chunk.decode().splitlines() if line.startswith("id: ")]
    return found


def test_clients_that_come_at_any_time_get_every_event_once() -> None:
    async def run() -> None:
        source = Source()
        await source.add(3)
        early, late = source.feed.stream(0), source.feed.stream(2)
        assert await ids(early, 3) == [1, 2, 3]
        await source.add(feed_module.KEPT + 5)  # more than is kept in memory
        assert await ids(late, 2 + feed_module.KEPT) != []
        assert await ids(early, feed_module.KEPT + 5) == [*range(4, feed_module.KEPT + 9)]
        waiting = asyncio.create_task(ids(early, 1))
        await asyncio.sleep(0.01)
        await source.add(1)
        assert await waiting == [feed_module.KEPT + 9]

    asyncio.run(run())


def test_a_commit_during_the_first_read_of_a_client_is_not_lost() -> None:
    async def run() -> None:
        source = Source()
        await source.add(1)
        reading = source.after
        added: list[bool] = []

        def read_while_another_commits(flight_id: str, after: int) -> list[StoredEvent]:
            page = reading(flight_id, after)
            if not added:
                added.append(True)
                source.stored.append(StoredEvent(2, "verdict_given", "{}"))
                asyncio.run_coroutine_threadsafe(source.feed.refresh(), loop)
            return page

        loop = asyncio.get_running_loop()
        source.feed = Feed("f", read_while_another_commits)
        assert await ids(source.feed.stream(0), 2) == [1, 2]

    asyncio.run(run())


def test_events_without_id_reach_those_that_listen_and_a_closed_feed_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    async def run() -> None:
        source = Source()
        stream = source.feed.stream(0)
        assert (await anext(stream)).startswith(b": ")
        source.feed.pass_on(Health(facts={"a": 1}))
        assert await anext(stream) == b'event: health\ndata: {"facts":{"a":1}}\n\n'
        assert await anext(stream) == b": heartbeat\n\n"
        assert source.feed.clients == 1
        source.feed.close()
        assert [chunk async for chunk in stream] == [] and source.feed.clients == 0

    monkeypatch.setattr(feed_module, "HEARTBEAT_S", 0.05)
    asyncio.run(run())


def test_the_data_of_an_event_is_one_line_of_json() -> None:
    event = VerdictGiven(frame_id=1, measurement="map", verdict="innovation", detail="two\nlines", test_ratio=None)
    assert "\n" not in event.model_dump_json()
