"""Cost of recording to the process that hands its messages over.

python -m terrafix_tools.bench.recorder RECORD OUT [--speed N] [--stall S] [--json FILE]

The messages of RECORD are handed to the recorder of a live run, N times as fast as in flight, and recorded in OUT, a
new folder. ``--stall``: each synchronisation with the disk takes S seconds longer, as with a slow card. The table has
the time of a call in milliseconds (median, 99th percentile, maximum), the processor time of both threads per second of
flight, and the dropped messages."""

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from terrafix.core.config import Config
from terrafix.core.errors import OutputError
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.node import NodeContext
from terrafix.messages import Dropped, Message
from terrafix.recorder.node import make_edge
from terrafix.recorder.reader import ReadResult, check_format, read_received
from terrafix.recorder.writer import FlightWriter
from terrafix_tools.bench.result_file import write_result
from terrafix_tools.standalone import run_standalone

MS = 1e3
NS = 1e9


@dataclass(frozen=True)
class Cost:
    messages: int
    flight_s: float
    call_ms_median: float
    call_ms_p99: float
    call_ms_max: float
    cpu_ms_per_s: float  # of flight
    dropped: int


def measure(record: Path, out: Path, *, speed: float, stall_s: float) -> Cost:
    """Raises SourceError, OutputError."""
    result = ReadResult()
    received = [(received_ns, message) for _, _, received_ns, message in read_received(record, result)]
    check_format(record, result)
    if out.exists():
        raise OutputError(f"{out}: exists; give a new folder")
    flight_s = (received[-1][0] - received[0][0]) / NS
    _stall(stall_s)
    cpu_s = time.process_time()
    calls_ms = _hand_over(received, out, speed)
    return Cost(
        messages=len(received),
        flight_s=round(flight_s, 1),
        call_ms_median=round(float(np.median(calls_ms)), 4),
        call_ms_p99=round(float(np.percentile(calls_ms, 99)), 4),
        call_ms_max=round(float(calls_ms.max()), 4),
        cpu_ms_per_s=round(MS * (time.process_time() - cpu_s) / flight_s, 2),
        dropped=sum(message.count for _, _, _, message in read_received(out) if isinstance(message, Dropped)),
    )


def _hand_over(received: list[tuple[int, Message]], out: Path, speed: float) -> np.ndarray:
    """-> milliseconds of each call (N,)."""
    edge = make_edge(NodeContext(Config(), MemoryFrameStore(1), None, out))
    calls_ms = np.empty(len(received))
    began_s, first_ns = time.perf_counter(), received[0][0]
    for i, (received_ns, message) in enumerate(received):
        ahead_s = (received_ns - first_ns) / NS / speed - (time.perf_counter() - began_s)
        if ahead_s > 0.0:
            time.sleep(ahead_s)
        edge.poll(received_ns)
        called_s = time.perf_counter()
        edge.on_message(message)
        calls_ms[i] = MS * (time.perf_counter() - called_s)
    edge.close()
    return calls_ms


def _stall(stall_s: float) -> None:
    """Makes each FlightWriter.sync of this program take longer."""
    sync = FlightWriter.sync

    def stalled(writer: FlightWriter) -> None:
        time.sleep(stall_s)
        sync(writer)

    FlightWriter.sync = stalled  # type: ignore[assignment, method-assign]


def bench(
    record: Annotated[Path, typer.Argument(help="Record, or folder of replay or run.")],
    out: Annotated[Path, typer.Argument(help="New folder for the copy.")],
    speed: Annotated[float, typer.Option(help="Times as fast as in flight.")] = 10.0,
    stall: Annotated[float, typer.Option(help="Seconds by which each synchronisation takes longer.")] = 0.0,
    json_path: Annotated[Path | None, typer.Option("--json", help="File for the numbers of the table.")] = None,
) -> None:
    """Measure what recording costs the process that hands its messages over."""
    cost = asdict(measure(record, out, speed=speed, stall_s=stall))
    write_result(json_path, cost)
    for name, value in cost.items():
        typer.echo(f"{name:16}{value}")


if __name__ == "__main__":
    run_standalone("recorder", bench)
