"""Soak test: hours of flight at real rates by the real processes; does anything grow?

python -m terrafix_lab.bench.soak OUT [--minutes M] [--seed N] [--json FILE]

A copter flies the two legs of the fault matrix forth and back, without end: camera and simulated autopilot as in
`terrafix chaos`. Once in SAMPLE_S memory and open files of each process are read; the delay from image to estimate and
the gaps of GPS_INPUT are those of the record. Slopes are over the second half of the time: in the first, windows
and caches fill (docs/jetson.md has their bounds). Exit code 1: memory of all processes grows by more than 1 % an hour
and more than its own scatter (2 sigma), or open files grow."""

import math
import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from terrafix.messages import GpsInput, NavEstimate
from terrafix.recorder.reader import read_flight
from terrafix_lab.bench.result_file import write_result
from terrafix_lab.chaos.rig import Rig
from terrafix_lab.chaos.scene import Scene
from terrafix_lab.chaos.shuttle import RUN, shuttle_in
from terrafix_lab.chaos.verdict import sigmas
from terrafix_lab.standalone import run_standalone

SAMPLE_S = 10.0
SETTLING_SHARE = 0.5  # of the time, before which growth is not judged
MOST_GROWTH_PER_H = 0.01  # of memory
GROWN = 1  # exit code
MB = 1 << 20


@dataclass
class Samples:
    """By process: memory and open files over time."""

    t_s: list[float] = field(default_factory=list)
    memory_mb: dict[str, list[float]] = field(default_factory=dict)
    files: dict[str, list[int]] = field(default_factory=dict)

    def take(self, rig: Rig, t_s: float) -> None:
        self.t_s.append(t_s)
        found = dict(rig.processes())
        if rig.supervisor_pid is not None:
            found["supervisor"] = rig.supervisor_pid
        for name, pid in found.items():
            memory, files = _memory_mb(pid), _open_files(pid)
            # A process that is new or was away has no value at these times.
            self.memory_mb.setdefault(name, [math.nan] * (len(self.t_s) - 1)).append(memory)
            self.files.setdefault(name, [-1] * (len(self.t_s) - 1)).append(files)


def _memory_mb(pid: int) -> float:
    """Proportional set size: pages that processes share are divided between them."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return math.nan
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("Pss:")), math.nan)


def _open_files(pid: int) -> int:
    try:
        return len(os.listdir(f"/proc/{pid}/fd"))
    except OSError:
        return -1


def slope_per_h(t_s: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """-> least squares slope an hour, and its 1-sigma from the scatter."""
    if len(t_s) < 3:
        return 0.0, math.inf
    hours = (t_s - t_s.mean()) / 3600.0
    spread = float((hours**2).sum())
    slope = float((hours * (values - values.mean())).sum()) / spread
    residual = values - values.mean() - slope * hours
    return slope, math.sqrt(float((residual**2).sum()) / (len(t_s) - 2) / spread)


def growth(samples: Samples) -> dict[str, dict[str, float]]:
    """By process, and "all" together: memory at the end, its slope and 1-sigma [MB/h], open files gained. Samples in
    which a process was away are left out."""
    t_s = np.array(samples.t_s)
    late = t_s >= SETTLING_SHARE * t_s.max()
    memory = {name: np.array(values) for name, values in samples.memory_mb.items() if len(values) == len(t_s)}
    memory["all"] = np.sum(list(memory.values()), axis=0)
    found = {}
    for name, values in memory.items():
        usable = late & np.isfinite(values)
        slope, sigma = slope_per_h(t_s[usable], values[usable])
        files = np.array(samples.files.get(name, [0]))
        opened = files[files >= 0]
        found[name] = {
            "memory_mb": float(np.median(values[usable][-5:])) if usable.any() else math.nan,
            "mb_per_h": slope,
            "mb_per_h_sigma": sigma,
            "files_gained": float(np.median(opened[-5:]) - np.median(opened[len(opened) // 4 :][:5]))
            if len(opened)
            else 0.0,
        }
    return found


def grows(found: dict[str, dict[str, float]]) -> list[str]:
    """What grows, in words."""
    everything = found["all"]
    share_per_h = everything["mb_per_h"] / everything["memory_mb"]
    problems = []
    if share_per_h > MOST_GROWTH_PER_H and everything["mb_per_h"] > 2.0 * everything["mb_per_h_sigma"]:
        problems.append(f"memory by {100 * share_per_h:.1f} % an hour")
    problems += [
        f"open files of {name} by {row['files_gained']:.0f}" for name, row in found.items() if row["files_gained"] > 0
    ]
    return problems


def output_of(record: Path) -> dict[str, float]:
    """Delay and gaps over the first and the last third of the flight."""
    delays: list[tuple[float, float]] = []
    sent_s: list[float] = []
    with_fix = 0
    for _, _, message in read_flight(record):
        if isinstance(message, NavEstimate) and message.emitted_at_ns:
            delays.append((message.t_ns / 1e9, (message.emitted_at_ns - message.t_ns) / 1e6))
        elif isinstance(message, GpsInput):
            sent_s.append(message.t_ns / 1e9)
            with_fix += message.fix_type >= 3
    times, ms = np.array(delays).T
    cut_s = times.min() + np.array([1.0, 2.0]) * (times.max() - times.min()) / 3.0
    gaps = np.diff(np.sort(sent_s))
    return {
        "delay_first_third_ms": float(np.median(ms[times <= cut_s[0]])),
        "delay_last_third_ms": float(np.median(ms[times >= cut_s[1]])),
        "longest_gap_ms": 1e3 * float(gaps.max()),
        "gaps_over_245_ms": int((gaps > 0.245).sum()),
        "fix_share": with_fix / len(sent_s),
    }


def soak(scene: Scene, out: Path, minutes: float, seed: int, console: Console) -> dict[str, Any]:
    """Flies in ``out``, a new folder. Raises SourceError, OSError."""
    samples = Samples()
    with Rig(scene, out, 0.0, seed=seed) as rig:
        rig.take_off()
        began_s = time.monotonic()
        while (t_s := time.monotonic() - began_s) < 60.0 * minutes:
            rig.check()
            samples.take(rig, t_s)
            time.sleep(SAMPLE_S)
        fixes = rig.peer.fixes()
    found = growth(samples)
    worst = max((sigmas(fix) for fix in fixes if fix.horizontal_m), default=math.nan)
    result = {"minutes": minutes, "starts": rig.starts, "growth": found, "grows": grows(found), "worst_sigmas": worst}
    return result | output_of(rig.out)


def show(result: dict[str, Any], console: Console) -> None:
    table = Table(title=f"{result['minutes']:g} minutes", title_justify="left")
    for name in ("process", "memory", "slope", "open files gained"):
        table.add_column(name, justify="right")
    for name, row in result["growth"].items():
        slope = f"{row['mb_per_h']:.1f} ± {row['mb_per_h_sigma']:.1f} MB/h"
        table.add_row(name, f"{row['memory_mb']:.0f} MB", slope, f"{row['files_gained']:.0f}")
    console.print(table)
    shown = {
        "image to estimate": f"{result['delay_first_third_ms']:.0f} ms in the first third",
        "then": f"{result['delay_last_third_ms']:.0f} ms in the last",
        "longest gap of GPS_INPUT": f"{result['longest_gap_ms']:.0f} ms",
        "gaps over 245 ms": result["gaps_over_245_ms"],
        "3D fix": f"{100 * result['fix_share']:.1f} % of the time",
        "worst error": f"{result['worst_sigmas']:.1f} sigma",
        "grows": ", ".join(result["grows"]) or "nothing",
    }
    console.print("; ".join(f"{name} {value}" for name, value in shown.items()), highlight=False)


def main(
    out: Annotated[Path, typer.Argument(help="New folder; the flight in it is generated.")],
    minutes: Annotated[float, typer.Option(help="Of flight.")] = 120.0,
    seed: Annotated[int, typer.Option(help="Seed of the place and of the noise.")] = 1,
    json_file: Annotated[Path | None, typer.Option("--json", help="JSON to write.")] = None,
) -> None:
    console = Console(width=150)
    result = soak(shuttle_in(out, seed), out / RUN, minutes, seed, console)
    show(result, console)
    write_result(json_file, result)
    raise typer.Exit(GROWN if result["grows"] else 0)


if __name__ == "__main__":
    run_standalone("bench.soak", main)
