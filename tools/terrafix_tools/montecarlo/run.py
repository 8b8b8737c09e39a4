"""`terrafix montecarlo`: many flights in several processes, a table, JSON and a picture."""

import json
import multiprocessing
import os
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from terrafix.core.errors import OutputError, UsageError
from terrafix.recorder.writer import versions
from terrafix_tools.montecarlo.fault import Fault
from terrafix_tools.montecarlo.flight import Record, run
from terrafix_tools.montecarlo.picture import draw
from terrafix_tools.montecarlo.plan import DURATION_S, plan
from terrafix_tools.montecarlo.statistics import Seen, floors, summary

TABLE_WIDTH = 130  # a narrower terminal breaks lines; so does a file
RESULT, PICTURE = "montecarlo.json", "montecarlo.png"
SHORTEST_S, LONGEST_S = 60.0, 7200.0


@dataclass(frozen=True)
class Wanted:
    """What the command line asks for."""

    out: Path
    flights: int = 100
    first: int = 0
    seed: int = 1
    duration_s: float = DURATION_S
    fault: Fault | None = None
    lie_share: float = 0.0  # probability of each of LIES in a flight
    workers: int | None = None  # None: one for each processor that this program may use


def montecarlo(wanted: Wanted) -> dict[str, Any]:
    """Writes montecarlo.json and montecarlo.png into ``wanted.out``. Raises UsageError, OutputError."""
    _check(wanted)
    began_s = time.perf_counter()
    console = Console(stderr=True)
    try:
        wanted.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{wanted.out}: cannot be made ({error.strerror}); choose another --out") from None
    seen = [Seen.of(record) for record in _flown(wanted, console)]
    result = _result(wanted, seen)
    result["wall_s"] = round(time.perf_counter() - began_s, 1)
    path = wanted.out / RESULT
    try:
        path.write_text(json.dumps(_rounded(result), indent=2) + "\n", encoding="utf-8")
        draw(wanted.out / PICTURE, seen)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another --out") from None
    show(result, Console(width=max(TABLE_WIDTH, console.width)))
    return result


def _check(wanted: Wanted) -> None:
    if wanted.flights < 1 or wanted.first < 0:
        raise UsageError(f"--flights {wanted.flights} --first {wanted.first}: at least one flight, from number 0 on")
    if not SHORTEST_S <= wanted.duration_s <= LONGEST_S:
        raise UsageError(f"--duration {wanted.duration_s:g}: choose {SHORTEST_S:g} to {LONGEST_S:g} seconds")
    if not 0.0 <= wanted.lie_share <= 1.0:
        raise UsageError(f"--lies {wanted.lie_share:g}: a probability is from 0 to 1")
    if wanted.workers is not None and wanted.workers < 1:
        raise UsageError(f"--workers {wanted.workers}: choose at least 1")


def _flown(wanted: Wanted, console: Console) -> list[Record]:
    """In order of their numbers, whoever was ready first."""
    numbers = range(wanted.first, wanted.first + wanted.flights)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    records: dict[int, Record] = {}
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("flights", total=wanted.flights)
        for number, record in _results(wanted, numbers):
            records[number] = record
            progress.advance(task)
    return [records[number] for number in numbers]


def _results(wanted: Wanted, numbers: range) -> Iterator[tuple[int, Record]]:
    workers = min(wanted.workers or len(os.sched_getaffinity(0)), len(numbers))
    one = partial(_one, wanted)
    if workers == 1:
        yield from map(one, numbers)
        return
    # A fresh interpreter for each: GTSAM's threads do not survive a fork.
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        try:
            for done in as_completed([pool.submit(one, number) for number in numbers]):
                yield done.result()
        except BrokenProcessPool:
            raise UsageError("a process of the run was killed, by lack of memory perhaps; try --workers 1") from None


def _one(wanted: Wanted, number: int) -> tuple[int, Record]:
    return number, run(
        plan(wanted.seed, number, fault=wanted.fault, duration_s=wanted.duration_s, lie_share=wanted.lie_share)
    )


def _result(wanted: Wanted, seen: list[Seen]) -> dict[str, Any]:
    groups = {fault: [s for s in seen if fault in {s.record.plan.fault, *s.record.plan.lies}] for fault in Fault}
    total = summary(seen)
    return {
        "seed": wanted.seed,
        "first": wanted.first,
        "duration_s": wanted.duration_s,
        "versions": versions(),
        "floors": floors(total),
        "all": total,
        "by_fault": {str(fault): summary(flights) for fault, flights in groups.items() if flights},
        "flights": [_flight(s) for s in seen],
    }


def _flight(seen: Seen) -> dict[str, Any]:
    p = seen.record.plan
    return {
        "number": p.number,
        "fault": str(p.fault),
        "lies": sorted(map(str, p.lies)),
        "vehicle": str(p.kind),
        "agl_m": p.agl_m,
        "hills_m": p.hills_m,
        "has_dem": p.has_dem,
        "gimbal": p.gimbal,
        "has_imu": p.has_imu,
        "map_sigma_m": p.map_sigma_m,
        "map_offset_m": list(p.map_offset_m),
        "fixes": seen.record.fixes,
        **summary([seen]),
    }


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 4)
    if isinstance(value, dict):
        return {key: _rounded(v) for key, v in value.items()}
    return [_rounded(v) for v in value] if isinstance(value, list) else value


def show(result: dict[str, Any], console: Console) -> None:
    table = Table(title=f"Monte Carlo, seed {result['seed']}", title_justify="left")
    for name in (
        "",
        "flights",
        "median",
        "max",
        "false",
        "to notice",
        "inside 95 %",
        "refined",
        "NEES [band]",
        "on map",
        "velocity",
    ):
        table.add_column(name, justify="left" if not name else "right")
    for name, row in {**result["by_fault"], "all": result["all"]}.items():
        nees, on_map = row["nees"], row["nees_on_map"]
        table.add_row(
            name,
            str(row["flights"]),
            f"{row['median_m']:.1f} m",
            f"{row['max_m']:.0f} m",
            str(row["false_fixes"]),
            "-" if row["notice_s"] is None else f"{row['notice_s']:.0f} s",
            f"{100 * row['coverage']:.1f} %",
            "-" if row["coverage_refined"] is None else f"{100 * row['coverage_refined']:.1f} %",
            f"{nees['mean']:.2f} [{nees['low']:.2f}, {nees['high']:.2f}]",
            f"{on_map['mean']:.2f} [{on_map['low']:.2f}, {on_map['high']:.2f}]",
            f"{100 * row['velocity_coverage']:.0f} %",
        )
    console.print(table)
    total = result["all"]
    drift = "-" if total["drift_median"] is None else f"{100 * total['drift_median']:.2f} %"
    console.print(
        f"drift without a map {drift} of the way (median); estimator {total['cpu_ms_median']:.1f} ms of processor time "
        f"a frame, p99 {total['cpu_ms_p99']:.1f} ms; {total['restarts']} restarts, {total['rebuilds']} rebuilds; "
        f"{result['wall_s']:.0f} s",
        highlight=False,
    )
    shares = ", ".join(f"{name.replace('_', ' and ')} {share:.2f}" for name, share in total["parts"].items())
    console.print(f"squared error over claim, 1 when true: {shares}", highlight=False)
    for floor, holds in result["floors"].items():
        console.print(f"{'holds ' if holds else 'BROKEN'}  {floor}", style="" if holds else "bold red", highlight=False)
