"""Clients that send or read slowly, and too many of them: others are served meanwhile, and their time ends."""

import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from console_rig import NEW, Console, settings
from terrafix_tools.console import connections, guard
from terrafix_tools.console.events import ProcessingBlocked
from terrafix_tools.console.store import flights
from terrafix_tools.console.store.database import FILE

pytestmark = pytest.mark.real_time
WAIT_S = 20.0
HEAD = b"GET /health HTTP/1.1\r\nHost: localhost\r\n"


@pytest.fixture
def console(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Console]:
    monkeypatch.setattr(connections, "HEAD_S", 0.3)
    monkeypatch.setattr(connections, "STALL_S", 0.3)
    monkeypatch.setattr(guard, "BODY_S", 0.3)
    with Console(settings(tmp_path)) as running:
        yield running


def connected(console: Console) -> socket.socket:
    opened = socket.create_connection(("127.0.0.1", int(console.url.rpartition(":")[2])), timeout=WAIT_S)
    opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return opened


def ended(opened: socket.socket) -> bool:
    """Waits until the service has ended the connection without an answer."""
    try:
        return opened.recv(1) == b""
    except ConnectionResetError:
        return True


@pytest.mark.parametrize("sent", [b"", HEAD])
def test_a_head_that_does_not_come_ends_its_connection(console: Console, sent: bytes) -> None:
    with connected(console) as slow:
        slow.sendall(sent)
        assert console.send("GET", "/health").status == 200
        assert ended(slow)


def test_a_head_of_a_byte_at_a_time_has_no_more_time_than_another(console: Console) -> None:
    with connected(console) as slow:
        slow.settimeout(0.05)
        until_s = time.monotonic() + WAIT_S
        slow.sendall(HEAD)
        while time.monotonic() < until_s:
            try:
                slow.sendall(b"x")
                if slow.recv(1) == b"":
                    break
            except TimeoutError:
                continue
            except ConnectionError:
                break
        assert time.monotonic() < until_s


def test_a_connection_that_is_kept_alive_has_its_time_for_each_head(console: Console) -> None:
    with connected(console) as kept:
        for _ in range(2):
            kept.sendall(HEAD + b"\r\n")
            answer = kept.recv(4096)
            while not answer.endswith(b"}"):  # head and body may come one after the other
                answer += kept.recv(4096)
            assert answer.startswith(b"HTTP/1.1 200")
            time.sleep(0.5)  # idle: longer than a head may take
        kept.sendall(HEAD)
        assert ended(kept)


def test_a_body_that_does_not_come_is_refused(console: Console) -> None:
    with connected(console) as slow:
        head = (
            b"POST /flights HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 99\r\n\r\n"
        )
        slow.sendall(head + b"{")
        assert slow.recv(4096).startswith(b"HTTP/1.1 400")


def test_an_event_stream_that_is_not_read_is_cut_and_leaves_its_place(console: Console) -> None:
    flight_id = str(console.send("POST", "/flights", NEW).json["flight_id"])
    with console.service.database.write() as db:
        blocked = ProcessingBlocked(reason="x" * 50_000, frame_id=None)
        flights.add_events(db, flight_id, "many", [blocked] * 300)  # 15 MB: more than the kernel buffers
    with connected(console) as slow:
        slow.sendall(f"GET /flights/{flight_id}/events HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        until_s = time.monotonic() + WAIT_S
        while console.send("GET", "/health").json["event_clients"] == 0:
            assert time.monotonic() < until_s
        while console.send("GET", "/health").json["event_clients"] == 1:
            assert time.monotonic() < until_s
            time.sleep(0.02)


def test_connections_beyond_the_limit_are_closed(console: Console, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "CONNECTIONS", 2)
    monkeypatch.setattr(connections, "HEAD_S", WAIT_S)
    with connected(console) as first, connected(console), connected(console) as third:
        assert ended(third)
        first.sendall(HEAD + b"\r\n")
        assert first.recv(4096).startswith(b"HTTP/1.1 200")


def test_the_end_of_the_service_closes_the_database_after_its_processes(tmp_path: Path) -> None:
    """SQLite removes its log with the last connection: what the end of a process reads or writes is before that."""
    with Console(settings(tmp_path)) as console:
        service, processes_end = console.service, console.service.workers.stop

        async def stored_at_the_end() -> None:
            await processes_end()
            assert service.flights().flights == []

        service.workers.stop = stored_at_the_end  # type: ignore[method-assign]
    assert (tmp_path / FILE).is_file() and not (tmp_path / f"{FILE}-wal").exists()
