"""Time and memory of `terrafix fleet build`, and whether a killed worker loses or doubles a flight."""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated

import typer

from terrafix.core.errors import EvaluationError
from terrafix_tools.bench.fleet_records import write_records
from terrafix_tools.fleet.query import query
from terrafix_tools.standalone import run_standalone

POLL_S = 0.02
COUNTS = "SELECT count(*), count(DISTINCT flight), sum(frames), sum(fixes) FROM flights"
FRAMES = "SELECT count(*), count(DISTINCT (flight, frame)) FROM frames"


def worker_processes(build: int) -> list[int]:
    """-> process IDs of the workers of a build: children of the fork server, which is its child."""
    parents: dict[int, int] = {}
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            text = status.read_text()
        except OSError:
            continue  # it has ended
        parents[int(status.parent.name)] = int(text.rpartition(")")[2].split()[1])
    return [pid for pid, parent in parents.items() if parents.get(parent) == build]


def build_command(source: Path, out: Path, workers: int) -> list[str]:
    arguments = ["fleet", "build", str(source), "--out", str(out), "--workers", str(workers)]
    return [sys.executable, "-m", "terrafix_tools.program", *arguments]


def flights_in(out: Path) -> int:
    return len(list((out / "flights").glob("date=*/flight=*/part.parquet")))


def measure(source: Path, out: Path, workers: int, kill_at: int | None) -> tuple[float, float, float]:
    """Builds in a process of its own; kills a worker once ``kill_at`` flights are there.

    -> seconds, and largest resident memory of the build and of a worker [MB]. Raises EvaluationError."""
    began_s = time.monotonic()
    building = subprocess.Popen(build_command(source, out, workers), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    memory = {"build": 0.0, "worker": 0.0}
    killed = kill_at is None
    while building.poll() is None:
        pids = worker_processes(building.pid)
        if kill_at is not None and not killed and pids and flights_in(out) >= kill_at:
            os.kill(pids[0], signal.SIGKILL)
            killed = True
        memory["build"] = max(memory["build"], _peak_mb(building.pid))
        memory["worker"] = max([memory["worker"], *map(_peak_mb, pids)])
        time.sleep(POLL_S)
    if building.returncode or not killed:
        text = building.stderr.read().decode() if building.stderr else ""
        raise EvaluationError(f"the build has exit code {building.returncode}, killed {killed}: {text}")
    return time.monotonic() - began_s, memory["build"], memory["worker"]


def _peak_mb(pid: int) -> float:
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0.0
    return next((int(line.split()[1]) / 1e3 for line in lines if line.startswith("VmHWM")), 0.0)


def bench(
    records: Annotated[int, typer.Option(help="Number of flight records.")] = 500,
    frames: Annotated[int, typer.Option(help="Frames of each.")] = 120,
    workers: Annotated[int, typer.Option(help="Processes.")] = 2,
    keep: Annotated[Path | None, typer.Option(help="Folder to keep records and fleets in.")] = None,
) -> None:
    """Build a fleet of invented records undisturbed, with a worker killed in the middle, and again. Exit code 9: the
    tables differ."""
    work = keep or Path(tempfile.mkdtemp(prefix="terrafix-fleet-"))
    try:
        write_records(work / "records", records, frames)
        answers = {}
        for name, kill_at in (("undisturbed", None), ("a worker killed", records // 3)):
            out = work / name.replace(" ", "-")
            seconds, build_mb, worker_mb = measure(work / "records", out, workers, kill_at)
            answers[name] = [query(out, sql).rows[0] for sql in (COUNTS, FRAMES)]
            typer.echo(f"{name}: {seconds:.1f} s, build {build_mb:.0f} MB, worker {worker_mb:.0f} MB; "
                       f"flights {answers[name][0]}, frames {answers[name][1]}")  # fmt: skip
        seconds, _, _ = measure(work / "records", work / "undisturbed", workers, None)
        typer.echo(f"again, nothing changed: {seconds:.1f} s")
        if len(set(map(str, answers.values()))) != 1 or answers["undisturbed"][0][0] != records:
            raise EvaluationError("the tables differ")
    finally:
        if keep is None:
            shutil.rmtree(work)


if __name__ == "__main__":
    run_standalone("fleet", bench)
