"""Cost of a report of a long flight: python -m terrafix_tools.bench.report OUT [--minutes 60] [--frames-hz 10].

Writes a synthetic live record (bench/long_record.py) and a map into OUT, runs `terrafix report` on them in a process of
its own, and compares size, time and memory with their limits. OUT/bench-report.json has the numbers of the table. Exit
code 1: a limit is exceeded."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from terrafix.core.errors import OutputError
from terrafix_tools.bench.long_flight import Rates
from terrafix_tools.bench.long_record import draw_map, write_long_record
from terrafix_tools.mapping.build import build
from terrafix_tools.report.page import NAME
from terrafix_tools.standalone import run_standalone

RESULT = "bench-report.json"
LIMITS = {"page_mb": 25.0, "wall_s": 60.0, "peak_memory_mb": 1024.0}  # of an hour, on two cores
MIB = 2**20
EXCEEDED = 1  # exit code


def measure(out: Path, duration_s: float, rates: Rates) -> dict[str, Any]:
    """-> size, time and memory of the report. Raises OutputError: the report failed."""
    out.mkdir(parents=True, exist_ok=True)
    draw_map(out / "map.tif")
    build(out / "map.tif", out / "map.gpkg")
    size = write_long_record(out, duration_s, rates)
    command = [sys.executable, "-m", "terrafix_tools.program", "report", str(out), "--map", str(out / "map.gpkg")]
    began_s = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    wall_s = time.monotonic() - began_s
    process.returncode = os.waitstatus_to_exitcode(status)  # Popen would wait for the process again
    if process.returncode != 0:
        raise OutputError(f"{out}: 'terrafix report' ended with exit code {process.returncode}; see its message above")
    return {
        "duration_s": duration_s,
        "frames": round(duration_s * rates.frames),
        "record_mb": round(size / MIB, 1),
        "page_mb": round((out / NAME).stat().st_size / MIB, 2),
        "wall_s": round(wall_s, 1),
        "cpu_s": round(usage.ru_utime + usage.ru_stime, 1),
        "peak_memory_mb": round(usage.ru_maxrss / 1024, 1),  # Linux counts in KiB
        "limits": LIMITS,
    }


def exceeded(result: dict[str, Any]) -> list[str]:
    return [name for name, limit in LIMITS.items() if result[name] > limit]


def show(result: dict[str, Any], console: Console) -> None:
    table = Table(title="Report of a long flight", title_justify="left")
    for name in ("quantity", "value", "limit"):
        table.add_column(name, justify="left" if name == "quantity" else "right")
    for name, value in result.items():
        if name != "limits":
            table.add_row(name, f"{value:g}", f"{LIMITS[name]:g}" if name in LIMITS else "")
    console.print(table)


def bench_report(
    out: Annotated[Path, typer.Argument(help="Folder for record, map, page and numbers.")],
    minutes: Annotated[float, typer.Option(help="Length of the flight.")] = 60.0,
    frames_hz: Annotated[float, typer.Option(help="Frames a second.")] = Rates.frames,
) -> None:
    """Measure size, time and memory of the report of a long flight."""
    result = measure(out, 60.0 * minutes, Rates(frames=frames_hz))
    (out / RESULT).write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    show(result, Console(width=80))
    if exceeded(result):
        raise typer.Exit(EXCEEDED)


if __name__ == "__main__":
    run_standalone("bench.report", bench_report)
