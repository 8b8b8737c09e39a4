"""What the daemon costs a small computer: start to ready, imports and memory by process.

python -m terrafix_tools.bench.daemon_cost FLIGHT MAP plays a recorded flight through `terrafix run` in real time.
Memory is the proportional set size (PSS, proc_pid_smaps_rollup(5)): a page that n processes share counts 1/n for
each, so that the sum is what all of them occupy. Libraries that other programs have mapped as well count less.
Imports are the processor time of a process after what the fork server has imported."""

import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from terrafix.core.errors import ERROR_OF_EXIT_CODE, EvaluationError, UsageError
from terrafix.processes import PROCESSES
from terrafix_tools import child_process
from terrafix_tools.bench.result_file import write_result
from terrafix_tools.standalone import run_standalone

READY_LIMIT_S, STOP_LIMIT_S = 120.0, 30.0
SAMPLE_S = 1.0
RING_NAME = "frames"  # of the ring of frames in the run folder (runtime/run_dir.py)
IMPORT_ROUNDS = 3  # the least of them counts
IMPORT = """
import time
import terrafix.runtime.process_main, terrafix.runtime.executor
terrafix.runtime.process_main.import_shared_libraries()
began_s = time.process_time()
import {module}
print(time.process_time() - began_s)
"""


def import_s(module: str) -> float:
    """-> processor time of importing ``module`` after the modules of the fork server, in a new interpreter."""
    command = [sys.executable, "-c", IMPORT.format(module=module)]
    times = [subprocess.run(command, capture_output=True, text=True, check=True).stdout for _ in range(IMPORT_ROUNDS)]
    return round(min(map(float, times)), 3)


def family(pid: int) -> list[int]:
    """-> ``pid`` and the processes below it."""
    children: dict[int, list[int]] = {}
    for file in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(file.read_text().rpartition(")")[2].split()[1])
        except OSError:  # it has just exited
            continue
        children.setdefault(parent, []).append(int(file.parent.name))
    found = [pid]
    for one in found:
        found += children.get(one, [])
    return found


def pss_mb(pids: list[int]) -> dict[str, float]:
    """-> proportional set size by name of the process; processes that have exited are left out."""
    sizes: dict[str, float] = {}
    for number, pid in enumerate(pids):
        try:
            name = Path(f"/proc/{pid}/comm").read_text().strip()
            lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
        except OSError:
            continue
        if name not in {process.name for process in PROCESSES}:
            name = "fork server" if number else "supervisor"
        kb = next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
        sizes[name] = round(sizes.get(name, 0.0) + kb / 1024, 1)
    return sizes


def shared_files_mb(pids: list[int]) -> float:
    """-> files of the run folder in shared memory that no process has mapped: descriptors of the map for an anchor that
    is restarted, checkpoints."""
    for pid in pids:
        try:
            lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
        except OSError:
            continue
        for line in lines:
            if line.endswith("/" + RING_NAME):
                ring = Path(line.split(maxsplit=5)[5])
                files = [file for file in ring.parent.rglob("*") if file.is_file() and file != ring]
                return round(sum(file.stat().st_blocks for file in files) * 512 / 2**20, 1)
    return 0.0


def measure(flight: Path, package: Path, work: Path, seconds: float, configs: list[Path]) -> dict[str, Any]:
    """-> seconds from the command to READY=1 (sd_notify), and the memory after that. ``configs``: as `terrafix run`
    takes them. Raises EvaluationError."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify, (work / "log").open("w+") as log:
        notify.bind(str(work / "notify"))
        command = [
            sys.executable,
            "-m",
            "terrafix_tools.program",
            "run",
            "--source",
            str(flight),
            "--map",
            str(package),
            *(word for config in configs for word in ("--config", str(config))),
        ]
        began_s = time.monotonic()
        daemon = subprocess.Popen(
            [*command, "--out", str(work / "out")],
            env=os.environ | {"NOTIFY_SOCKET": str(work / "notify")},
            stdout=log,
            stderr=log,
        )
        try:
            ready_s = _ready_s(daemon, notify, began_s)
            if ready_s is None:
                log.seek(0)
                raise ERROR_OF_EXIT_CODE.get(daemon.poll() or 0, EvaluationError)(f"not ready: {log.read()[-500:]}")
            samples, files_mb = [], 0.0
            end_s = time.monotonic() + seconds
            while time.monotonic() < end_s and daemon.poll() is None:
                time.sleep(SAMPLE_S)
                pids = family(daemon.pid)
                samples.append(pss_mb(pids))
                files_mb = max(files_mb, shared_files_mb(pids))
        finally:
            child_process.end(daemon, STOP_LIMIT_S)
    sums = sorted(sum(sample.values()) for sample in samples)
    return {
        "ready_s": round(ready_s, 2),
        "pss_mb": samples[-1],
        "shared_files_mb": files_mb,
        "pss_sum_mb": {"median": round(sums[len(sums) // 2], 1), "max": round(sums[-1], 1)},
    }


def _ready_s(daemon: "subprocess.Popen[bytes]", notify: socket.socket, began_s: float) -> float | None:
    notify.settimeout(SAMPLE_S)
    while daemon.poll() is None and time.monotonic() < began_s + READY_LIMIT_S:
        try:
            if b"READY=1" in notify.recv(4096):
                return time.monotonic() - began_s
        except TimeoutError:
            pass
    return None


def show(result: dict[str, Any], console: Console) -> None:
    table = Table(title="Processes of the daemon", title_justify="left")
    for head in ("process", "imports, CPU s", "PSS, MB"):
        table.add_column(head, justify="left" if head == "process" else "right")
    for name, size_mb in result["pss_mb"].items():
        import_time = result["import_s"].get(name)
        table.add_row(name, "-" if import_time is None else f"{import_time:.2f}", f"{size_mb:.1f}")
    sums = result["pss_sum_mb"]
    table.add_row("all: median / most", "", f"{sums['median']:.0f} / {sums['max']:.0f}")
    table.add_row("files in shared memory, most", "", f"{result['shared_files_mb']:.0f}")
    console.print(table)
    console.print(f"ready {result['ready_s']:.1f} s after the command (by the clock; load {os.getloadavg()[0]:.1f})")


def bench(
    flight: Annotated[Path, typer.Argument(help="Flight folder.")],
    package: Annotated[Path, typer.Argument(help="Its map package (.gpkg).")],
    seconds: Annotated[float, typer.Option(help="How long to fly.")] = 60.0,
    config: Annotated[list[Path] | None, typer.Option(help="TOML file for `terrafix run`; several times.")] = None,
    out: Annotated[Path | None, typer.Option(help="JSON file of the results.")] = None,
) -> None:
    """Start to ready, time of the imports and memory of each process of the daemon."""
    if seconds < SAMPLE_S:
        raise UsageError(f"--seconds {seconds:g}: give {SAMPLE_S:g} or more")
    with tempfile.TemporaryDirectory(prefix="terrafix-daemon-") as work:
        result = measure(flight, package, Path(work), seconds, config or [])
    result["import_s"] = {process.name: import_s(process.module) for process in PROCESSES}
    write_result(out, result)
    show(result, Console(width=100))


if __name__ == "__main__":
    run_standalone("daemon_cost", bench)
