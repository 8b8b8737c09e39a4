"""python -m terrafix_tools.bench.console: how fast the console answers, on loopback, with a service in a process of its
own that computes no flight.

Prints as JSON: the time to create a flight, to upload 50 photos, from a commit to the arrival of its event at 100
clients, and the load of an idle service. Processor time counts beside wall time, because other programs may be busy."""

import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer

from terrafix.core.errors import UsageError
from terrafix_tools import child_process
from terrafix_tools.console.client import ConsoleClient
from terrafix_tools.console.events import ProcessingBlocked
from terrafix_tools.console.payloads import Camera, Hint, NewFlight
from terrafix_tools.console.store import flights
from terrafix_tools.console.store.database import open_database
from terrafix_tools.standalone import run_standalone

START_S = 120.0  # longest wait for the service
STOP_S = 30.0  # ... for its end
CREATIONS, EVENTS = 40, 100
PHOTO_PX, PHOTO_QUALITY = (4000, 3000), 60  # 2 MB each
CLOCK_TICKS = os.sysconf("SC_CLK_TCK")


def bench_console(
    map_package: Annotated[Path, typer.Argument(help="Map package (.gpkg).")],
    clients: Annotated[int, typer.Option(help="Clients of the event stream.")] = 100,
    idle: Annotated[float, typer.Option(help="Seconds for which the idle service is measured.")] = 20.0,
) -> None:
    """Measure the console on loopback."""
    if not map_package.is_file():
        raise UsageError(f"{map_package}: no such map package")
    with tempfile.TemporaryDirectory() as folder, _service(Path(folder), map_package) as (client, process):
        new = NewFlight(camera=Camera(width=PHOTO_PX[0], height=PHOTO_PX[1], fx=3000.0), map=map_package.stem)
        found = {
            "create_ms": _creation_ms(client, new),
            "upload_50_photos": _upload(client, new, Path(folder), process.pid),
            "event_latency_ms": _event_latency_ms(client, new, Path(folder), clients, process.pid),
            "idle_load": _idle_load(process.pid, idle),
        }
    typer.echo(json.dumps(found, indent=2))


@contextmanager
def _service(folder: Path, map_package: Path) -> Iterator[tuple[ConsoleClient, "subprocess.Popen[bytes]"]]:
    port = child_process.free_port()
    words = ["serve", "--data", str(folder / "data"), "--maps", str(map_package.parent), "--port", str(port)]
    # Without processes for flights: those have benches of their own.
    process = subprocess.Popen([sys.executable, "-m", "terrafix_tools.program", *words, "--workers", "0"])
    try:
        end = time.monotonic() + START_S
        while True:
            with socket.socket() as trying:
                if trying.connect_ex(("127.0.0.1", port)) == 0:
                    break
            if time.monotonic() > end or process.poll() is not None:
                raise UsageError("the console does not start")
            time.sleep(0.05)
        yield ConsoleClient(f"http://127.0.0.1:{port}"), process
    finally:
        child_process.end(process, STOP_S)


def _creation_ms(client: ConsoleClient, new: NewFlight) -> dict[str, float]:
    times = []
    for _ in range(CREATIONS):
        began_s = time.perf_counter()
        client.create(new)
        times.append((time.perf_counter() - began_s) * 1e3)
    return {"median": round(statistics.median(times), 1), "worst": round(max(times), 1)}


def _upload(client: ConsoleClient, new: NewFlight, folder: Path, pid: int) -> dict[str, float]:
    rng = np.random.default_rng(1)
    small = rng.integers(0, 256, (PHOTO_PX[1] // 8, PHOTO_PX[0] // 8, 3), np.uint8)
    photo = folder / "photo.jpg"
    cv2.imwrite(str(photo), cv2.resize(small, PHOTO_PX), [cv2.IMWRITE_JPEG_QUALITY, PHOTO_QUALITY])
    flight_id = client.create(new).flight_id
    images = [(f"photo-{number:04d}.jpg", photo) for number in range(1, 51)]
    began_s, began_cpu_s = time.perf_counter(), _cpu_s(pid)
    list(client.upload(flight_id, images))
    return {
        "wall_s": round(time.perf_counter() - began_s, 2),
        "service_cpu_s": round(_cpu_s(pid) - began_cpu_s, 2),
        "mb": round(50 * photo.stat().st_size / 2**20, 1),
    }


def _event_latency_ms(client: ConsoleClient, new: NewFlight, folder: Path, clients: int, pid: int) -> dict[str, float]:
    """Events are committed as the processes of flights do; the service is notified as by their reports."""
    flight_id = client.create(new).flight_id
    database = open_database(folder / "data", durable=False)
    sent_s: dict[int, float] = {}
    latencies_ms: list[float] = []
    ready = threading.Barrier(clients + 1)

    def listen() -> None:
        stream = ConsoleClient(client.url).events(flight_id)
        ready.wait()
        for event in islice(stream, EVENTS):
            latencies_ms.append((time.perf_counter() - sent_s[event.event_id]) * 1e3)

    threads = [threading.Thread(target=listen, daemon=True) for _ in range(clients)]
    for thread in threads:
        thread.start()
    ready.wait()
    time.sleep(3.0)  # until all streams are open
    began_cpu_s = _cpu_s(pid)
    for number in range(1, EVENTS + 1):
        with database.write() as db:
            flights.add_events(db, flight_id, str(number), [ProcessingBlocked(reason="bench", frame_id=number)])
            sent_s[number] = time.perf_counter()
        client.hint(flight_id, Hint(lat=0.0, lon=0.0))
        time.sleep(0.05)
    for thread in threads:
        thread.join(timeout=30.0)
    database.close()
    ordered = sorted(latencies_ms)
    return {
        "clients": clients,
        "received": len(ordered),
        "median": round(statistics.median(ordered), 1),
        "p95": round(ordered[int(0.95 * len(ordered))], 1),
        "service_cpu_ms_an_event": round((_cpu_s(pid) - began_cpu_s) * 1e3 / EVENTS, 1),
    }


def _idle_load(pid: int, seconds: float) -> float:
    """Share of a core."""
    began_s = _cpu_s(pid)
    time.sleep(seconds)
    return round((_cpu_s(pid) - began_s) / seconds, 4)


def _cpu_s(pid: int) -> float:
    """Processor time of a process, s (proc(5), fields 14 and 15)."""
    fields: list[Any] = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / CLOCK_TICKS


if __name__ == "__main__":
    run_standalone("console", bench_console)
