"""Soak test: hours of flight at real rates by the real processes; does anything grow? And what other programs cost.

python -m terrafix_lab.bench.soak OUT [--minutes M] [--seed N] [--fault NAME] [--busy N ...] [--json FILE]

A copter flies the two legs of the fault matrix forth and back, without end: camera and simulated autopilot as in
`terrafix chaos`. Once in SAMPLE_S memory and open files of each process are read; the delay from image to estimate and
the gaps of GPS_INPUT are those of the record. Slopes are over the second half of the time: in the first, windows
and caches fill (docs/jetson.md has their bounds). Exit code 1: memory of all processes grows by more than 1 % an hour
and more than its own scatter (2 sigma), or open files grow; with --fault also if AC-14 is not met.

With --busy there is a flight beside each number of busy processes, and a table instead: frames with an estimate, age of
their images, share of GPS_INPUT with a fix, changes between fix and none a minute, and wrong positions (chaos/verdict),
of which one makes the exit code 1."""

import math
import os
import time
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from terrafix.messages import Frame, FrameRate, GpsInput, NavEstimate
from terrafix.recorder.reader import read_flight
from terrafix_lab.bench.intervals import IntervalStats, lines_of, measure
from terrafix_lab.bench.result_file import write_result
from terrafix_lab.chaos.rig import Rig
from terrafix_lab.chaos.scene import ChaosScene
from terrafix_lab.chaos.shuttle import RUN, shuttle_in
from terrafix_lab.chaos.verdict import sigmas, wrong_fixes
from terrafix_lab.faults.fault import Process
from terrafix_lab.faults.processes import busy as beside
from terrafix_lab.faults.table import fault_named
from terrafix_lab.sim.flights.folder import FRAME_HZ
from terrafix_lab.standalone import run_standalone

SAMPLE_S = 10.0
SETTLING_SHARE = 0.5  # of the time, before which growth is not judged
MOST_GROWTH_PER_H = 0.01  # of memory
GROWN = 1  # exit code


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
    """Proportional set size of anonymous and shared memory: pages that processes share are divided between them. Pages
    of files are no growth: their share rises when another program that has mapped the same libraries ends."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return math.nan
    kb = [int(line.split()[1]) for line in lines if line.startswith(("Pss_Anon:", "Pss_Shmem:"))]
    return sum(kb) / 1024 if kb else math.nan


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


def output_of(record: Path) -> dict[str, Any]:
    """Median delay from image to estimate by minute; images offered, taken and with an estimate a second; intervals of
    GPS_INPUT, and how often a minute it changed between a fix and none, from the first one on."""
    messages = [message for _, _, message in read_flight(record)]
    has_fix = [m.fix_type >= 3 for m in messages if isinstance(m, GpsInput)]
    has_fix = has_fix[has_fix.index(True) :] if True in has_fix else []
    intervals = measure(messages)
    estimates = [m for m in messages if isinstance(m, NavEstimate) and m.emitted_at_ns]
    times, ms = np.array([(m.t_ns / 1e9, (m.emitted_at_ns - m.t_ns) / 1e6) for m in estimates]).T
    minutes, span_s = (times - times.min()) // 60.0, max(float(np.ptp(times)), 1.0)
    offered_hz = [m.offered_hz for m in messages if isinstance(m, FrameRate)]
    return {
        "delay_by_minute_ms": [float(np.median(ms[minutes == minute])) for minute in np.unique(minutes)],
        "offered_per_s": float(np.mean(offered_hz)) if offered_hz else None,
        "taken_per_s": sum(isinstance(m, Frame) and not m.error for m in messages) / span_s,
        "frames_per_s": len({m.frame_id for m in estimates}) / span_s,
        "changes_per_min": 60.0 * sum(a != b for a, b in pairwise(has_fix)) / max(intervals.duration_s, 1.0),
        "gps_input": msgspec.to_builtins(intervals),
    }


def soak(scene: ChaosScene, out: Path, minutes: float, seed: int, process: Process) -> dict[str, Any]:
    """Flies in ``out``, a new folder, with a fault of the processes from the take-off on. Raises SourceError,
    OSError."""
    samples = Samples()
    with Rig(scene, out, 0.0, seed=seed) as rig:
        rig.take_off()
        began_s = time.monotonic()
        process.begin(rig)
        while (t_s := time.monotonic() - began_s) < 60.0 * minutes:
            rig.check()
            process.during(rig, t_s)
            samples.take(rig, t_s)
            time.sleep(SAMPLE_S)
        fixes = rig.peer.fixes()
    found = growth(samples)
    off = [sigmas(fix) for fix in fixes if fix.horizontal_m]
    result = {"minutes": minutes, "starts": rig.starts, "growth": found, "grows": grows(found), "fixes": len(off)}
    result |= {"worst_sigmas": max(off, default=math.nan), "over_3_sigmas": sum(sigma > 3.0 for sigma in off)}
    return result | {"wrong": len(wrong_fixes(fixes)), "load": os.getloadavg()[0]} | output_of(rig.out)


def show(result: dict[str, Any], console: Console) -> None:
    table = Table(title=f"{result['minutes']:g} minutes", title_justify="left")
    for name in ("process", "memory", "slope", "open files gained"):
        table.add_column(name, justify="right")
    for name, row in result["growth"].items():
        slope = f"{row['mb_per_h']:.1f} ± {row['mb_per_h_sigma']:.1f} MB/h"
        table.add_row(name, f"{row['memory_mb']:.0f} MB", slope, f"{row['files_gained']:.0f}")
    console.print(table)
    shown = {
        "images a second": f"{result['offered_per_s'] or math.nan:.1f}, taken {result['taken_per_s']:.1f}",
        "image to estimate by minute": ", ".join(f"{ms:.0f}" for ms in result["delay_by_minute_ms"]) + " ms",
        **lines_of(msgspec.convert(result["gps_input"], IntervalStats)),
        "worst error": f"{result['worst_sigmas']:.1f} sigma, {result['over_3_sigmas']} of {result['fixes']} above 3",
        "grows": ", ".join(result["grows"]) or "nothing",
    }
    console.print("; ".join(f"{name} {value}" for name, value in shown.items()), highlight=False)


def load_table(results: dict[int, dict[str, Any]]) -> Table:
    """``results``: of ``soak``, by the number of busy processes."""
    table = Table(title="beside busy processes", title_justify="left")
    for name in ("busy", "load", "frames a second", "age of an image, p95", "fix", "changes a minute", "wrong"):
        table.add_column(name, justify="right")
    for number, one in results.items():
        stats = msgspec.convert(one["gps_input"], IntervalStats)
        figures = f"{one['frames_per_s']:.2f}", f"{stats.age_p95_ms or math.nan:.0f} ms", f"{stats.fix3_share:.0%}"
        table.add_row(str(number), f"{one['load']:.1f}", *figures, f"{one['changes_per_min']:.1f}", str(one["wrong"]))
    return table


def main(
    out: Annotated[Path, typer.Argument(help="New folder; the flight in it is generated.")],
    minutes: Annotated[float, typer.Option(help="Of flight.")] = 120.0,
    seed: Annotated[int, typer.Option(help="Seed of the place and of the noise.")] = 1,
    camera_hz: Annotated[float, typer.Option(help="Images a second, a multiple of 2.")] = FRAME_HZ,
    fault: Annotated[
        str, typer.Option(help="Fault of the processes during all of the flight, as 'processor: saturated'.")
    ] = "none",
    busy: Annotated[list[int] | None, typer.Option(help="Busy processes; may be given several times.")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="JSON to write.")] = None,
) -> None:
    console, scene = Console(width=150), shuttle_in(out, seed, camera_hz)
    if busy:
        results = {number: soak(scene, out / RUN / str(number), minutes, seed, beside(number)) for number in busy}
        console.print(load_table(results))
        write_result(json_file, {str(number): one for number, one in results.items()})
        raise typer.Exit(1 if any(one["wrong"] for one in results.values()) else 0)
    process = fault_named(fault).process or Process()
    result = soak(scene, out / RUN, minutes, seed, process)
    show(result, console)
    write_result(json_file, result)
    intervals = msgspec.convert(result["gps_input"], IntervalStats)
    raise typer.Exit(GROWN if result["grows"] or (fault != "none" and not intervals.meets_ac14) else 0)


if __name__ == "__main__":
    run_standalone("bench.soak", main)
