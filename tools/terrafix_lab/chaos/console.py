"""A console beside the flight, and clients that flood it.

python -m terrafix_lab.chaos.console PORT: opens EVENT_CLIENTS event streams of the live flight that it never reads,
and asks for everything else as fast as it can, until it is killed."""

import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

from terrafix.core.errors import SourceError, TerrafixError
from terrafix_lab.standalone import run_standalone
from terrafix_tools import child_process
from terrafix_tools.console.client import ConsoleClient

EVENT_CLIENTS, ASKING_CLIENTS = 200, 8
READY_S = 30.0  # longest wait of the clients for the service


class Console:
    """`terrafix serve` beside a live flight, until ``end``."""

    def __init__(self, run_folder: Path, folder: Path) -> None:
        """``run_folder``: of the flight; data and log of the console are in ``folder``."""
        self._folder = folder
        self._port = child_process.free_port()
        options = ["--bus", str(run_folder), "--port", str(self._port), "--data", str(folder / "console")]
        self._serve = self._start("terrafix_tools.program", "serve", *options)
        self._clients: list[subprocess.Popen[bytes]] = []

    def signal(self, number: signal.Signals) -> None:
        self._serve.send_signal(number)

    def flood(self) -> None:
        self._clients.append(self._start("terrafix_lab.chaos.console", str(self._port)))

    def end_flood(self) -> None:
        for clients in self._clients:
            clients.kill()
            clients.wait()

    def end(self) -> None:
        self.end_flood()
        self._serve.kill()
        self._serve.wait()

    def _start(self, *module: str) -> subprocess.Popen[bytes]:
        with (self._folder / "console.log").open("ab") as log:
            return subprocess.Popen([sys.executable, "-m", *module], stdin=subprocess.DEVNULL, stdout=log, stderr=log)


def flood(port: int) -> None:
    """Does not end. Raises SourceError: the console shows no flight within READY_S."""
    client = ConsoleClient(f"http://127.0.0.1:{port}")
    until_s = time.monotonic() + READY_S
    while not (flights := _flights(client)):
        if time.monotonic() > until_s:
            raise SourceError(f"port {port}: the console shows no flight after {READY_S:g} s; see its log")
        time.sleep(0.1)
    streams = [_unread(port, f"/flights/{flights[0]}/events") for _ in range(EVENT_CLIENTS)]
    for _ in range(ASKING_CLIENTS):
        threading.Thread(target=_ask, args=(port, flights[0]), daemon=True).start()
    while streams:
        time.sleep(1.0)


def _flights(client: ConsoleClient) -> list[str]:
    with suppress(TerrafixError):  # it starts
        return [flight.flight_id for flight in client.flights()]
    return []


def _unread(port: int, path: str) -> socket.socket:
    stream = socket.create_connection(("127.0.0.1", port), timeout=READY_S)
    stream.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
    return stream


def _ask(port: int, flight_id: str) -> None:
    paths = ["/health", "/config", "/maps", "/flights", f"/flights/{flight_id}/results?limit=1000"]
    while True:
        for path in paths:
            with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=READY_S) as asking:
                asking.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode())
                while asking.recv(1 << 16):
                    pass


def main(port: int) -> None:
    """Flood the console on PORT of this computer."""
    flood(port)


if __name__ == "__main__":
    run_standalone("chaos.console", main)
