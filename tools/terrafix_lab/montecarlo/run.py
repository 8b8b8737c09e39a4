"""`terrafix montecarlo`: many flights in several processes; a table, JSON and a plot."""

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
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from terrafix.core.errors import OutputError, UsageError
from terrafix.recorder.provenance import versions
from terrafix_lab.faults.fault import check_flown_by, lacking
from terrafix_lab.faults.table import FAULTS
from terrafix_lab.montecarlo.fault import DrawnFault
from terrafix_lab.montecarlo.flight import Record, run
from terrafix_lab.montecarlo.picture import draw
from terrafix_lab.montecarlo.plan import DURATION_S, plan
from terrafix_lab.montecarlo.statistics import FlightResult, floors, summary
from terrafix_tools.progress import LineProgress

COMMAND = "terrafix montecarlo --fault"  # of terrafix_lab.faults.fault.CAMPAIGNS
FLYABLE = [name for name, fault in FAULTS.items() if not lacking(COMMAND, fault)]
WORDS = {True: "holds", False: "BROKEN", None: "too few to judge"}  # of a floor
TABLE_WIDTH = 130  # characters, also where the terminal is narrower or the output is a file
RESULT, PICTURE = "montecarlo.json", "montecarlo.png"
MIN_DURATION_S, MAX_DURATION_S = 60.0, 7200.0


@dataclass(frozen=True)
class RunOptions:
    """Options of the command line."""

    out: Path
    flights: int = 100
    first: int = 0
    seed: int = 1
    duration_s: float = DURATION_S
    fault: str | None = None  # as of ``fault_of``
    lie_share: float = 0.0  # probability of each of LIES in a flight
    workers: int | None = None  # None: one per available processor


def fault_of(name: str) -> str:
    """A DrawnFault, or the name of a row of the table of faults. Raises UsageError."""
    if name in list(DrawnFault):
        return DrawnFault(name)
    if name not in FAULTS:
        raise UsageError(f"--fault '{name}': no such fault; known: {', '.join((*DrawnFault, *FLYABLE))}")
    check_flown_by(COMMAND, FAULTS[name])
    return name


def montecarlo(options: RunOptions) -> dict[str, Any]:
    """Writes montecarlo.json and montecarlo.png into ``wanted.out``. Raises UsageError, OutputError."""
    _check(options)
    start_s = time.perf_counter()
    console = Console(stderr=True)
    try:
        options.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{options.out}: cannot be made ({error.strerror}); choose another --out") from None
    flights = [FlightResult.of(record) for record in _fly_all(options, console)]
    result = _result(options, flights)
    result["wall_s"] = round(time.perf_counter() - start_s, 1)
    path = options.out / RESULT
    try:
        path.write_text(json.dumps(_rounded(result), indent=2) + "\n", encoding="utf-8")
        draw(options.out / PICTURE, flights)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another --out") from None
    show(result, Console(width=max(TABLE_WIDTH, console.width)))
    return result


def _check(options: RunOptions) -> None:
    if options.flights < 1 or options.first < 0:
        raise UsageError(f"--flights {options.flights} --first {options.first}: at least one flight, from number 0 on")
    if not MIN_DURATION_S <= options.duration_s <= MAX_DURATION_S:
        raise UsageError(f"--duration {options.duration_s:g}: choose {MIN_DURATION_S:g} to {MAX_DURATION_S:g} seconds")
    if not 0.0 <= options.lie_share <= 1.0:
        raise UsageError(f"--lies {options.lie_share:g}: a probability is from 0 to 1")
    if options.workers is not None and options.workers < 1:
        raise UsageError(f"--workers {options.workers}: choose at least 1")


def _fly_all(options: RunOptions, console: Console) -> list[Record]:
    """Sorted by the number of the flight."""
    numbers = range(options.first, options.first + options.flights)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    records: dict[int, Record] = {}
    with LineProgress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("flights", total=options.flights)
        for number, record in _results(options, numbers):
            records[number] = record
            progress.advance(task)
    return [records[number] for number in numbers]


def _results(options: RunOptions, numbers: range) -> Iterator[tuple[int, Record]]:
    workers = min(options.workers or len(os.sched_getaffinity(0)), len(numbers))
    one = partial(_fly_one, options)
    if workers == 1:
        yield from map(one, numbers)
        return
    # "spawn" starts a new interpreter: GTSAM's threads do not survive a fork.
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        try:
            for done in as_completed([pool.submit(one, number) for number in numbers]):
                yield done.result()
        except BrokenProcessPool:
            raise UsageError("a process of the run was killed, by lack of memory perhaps; try --workers 1") from None


def _fly_one(options: RunOptions, number: int) -> tuple[int, Record]:
    return number, run(
        plan(options.seed, number, fault=options.fault, duration_s=options.duration_s, lie_share=options.lie_share)
    )


def _result(options: RunOptions, flights: list[FlightResult]) -> dict[str, Any]:
    faults = dict.fromkeys((*DrawnFault, *(s.record.plan.fault for s in flights)))
    groups = {fault: [s for s in flights if fault in {s.record.plan.fault, *s.record.plan.lies}] for fault in faults}
    total = summary(flights)
    return {
        "seed": options.seed,
        "first": options.first,
        "duration_s": options.duration_s,
        "versions": versions(),
        "floors": floors(total),
        "all": total,
        "by_fault": {str(fault): summary(group) for fault, group in groups.items() if group},
        "flights": [_flight_row(s) for s in flights],
    }


def _flight_row(flight: FlightResult) -> dict[str, Any]:
    p = flight.record.plan
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
        "fixes": flight.record.fixes,
        **summary([flight]),
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
        "late",
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
            str(row["late_false_fixes"]),
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
    criteria = (f"{name}: {value}" for name, value in total["criteria"].items())
    console.print("; ".join(criteria), highlight=False)
    shares = ", ".join(f"{name.replace('_', ' and ')} {share:.2f}" for name, share in total["parts"].items())
    console.print(f"squared error over claim, 1 when true: {shares}", highlight=False)
    for floor, holds in result["floors"].items():
        style = "bold red" if holds is False else ""
        console.print(f"{WORDS[holds]:17}  {floor}", style=style, highlight=False)
