"""Latency of a live flight by the rate of its camera, from the exposure of a frame to GPS_INPUT.

python -m terrafix_tools.bench.latency OUT [--rate HZ ...] [--duration S] [--seed N] [--cores N] [--json FILE]

For each rate the flight of `terrafix demo` is generated with such a camera and flown by the real processes beside the
simulated autopilot, in OUT/HZ, which must not exist. The stages are those of the report: "prediction" is the first
estimate of a frame, which odometry alone gives; "estimate" the last one, with its map match if it has one; GPS_INPUT
the first message after that. "anchored GPS_INPUT": the first one after an estimate that has the map match of the frame,
also if newer frames have come meanwhile. ``--cores``: all of it runs on so many cores."""

import os
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from terrafix.core.errors import OutputError, SourceError, UsageError
from terrafix.messages import OVERTAKEN, Frame, GpsInput, MapMatch, Message, NavEstimate, Verdict
from terrafix.recorder.reader import ReadResult, check_format, read_received
from terrafix_tools.bench.result_file import write_result
from terrafix_tools.report.stage_times import PERCENTILES, STAGES, StageTimes
from terrafix_tools.sim.demo.command import generate
from terrafix_tools.sim.demo.flight import fly
from terrafix_tools.standalone import run_standalone

DEFAULT_RATES_HZ = (2.0, 10.0)
ANCHORED = "anchored GPS_INPUT"
MS = 1_000_000  # ns


class AnchoredOutput:
    """Delay of the first GPS_INPUT that contains the map match of a frame, since the exposure. ``delays_ns``: of the
    frames with an accepted map match."""

    def __init__(self) -> None:
        self.delays_ns: list[int] = []
        self._matched_ns: list[int] = []  # exposures whose map match is in no estimate yet ...
        self._estimated_ns: list[int] = []  # ... in an estimate, and in no GPS_INPUT yet

    def take(self, received_ns: int, message: Message) -> None:
        match message:
            case MapMatch() if message.verdict is Verdict.ACCEPTED:
                self._matched_ns.append(message.t_ns)
            case NavEstimate():
                self._estimated_ns += self._matched_ns
                self._matched_ns.clear()
            case GpsInput():
                self.delays_ns += [received_ns - exposed_ns for exposed_ns in self._estimated_ns]
                self._estimated_ns.clear()
            case _:
                pass


def measure(record: Path) -> dict[str, Any]:
    """-> frames, those that vision skipped, those with a map match, and by stage the median, 95th and 99th percentile
    of the delay [ms]. Raises SourceError."""
    result, times, anchored = ReadResult(), StageTimes(), AnchoredOutput()
    frames = dropped = 0
    for _, _, received_ns, message in read_received(record, result):
        times.take(received_ns, message)
        anchored.take(received_ns, message)
        frames += isinstance(message, Frame)
        dropped += isinstance(message, Frame) and message.error == OVERTAKEN
    check_format(record, result)
    delays = {stage: [round(ms) for ms in times.percentiles_ms(stage)] for stage in STAGES}
    found_ns = anchored.delays_ns
    delays[ANCHORED] = [round(float(ns) / MS) for ns in np.percentile(found_ns, PERCENTILES)] if found_ns else []
    return {"frames": frames, "dropped": dropped, "matched": len(found_ns), "delay_ms": delays}


def fly_at(rate_hz: float, out: Path, *, seed: int, duration_s: float, console: Console) -> dict[str, Any]:
    """Generates and flies one flight in ``out``, a new folder. Raises OutputError, SourceError."""
    if out.exists():
        raise OutputError(f"{out}: exists; give a new folder")
    out.mkdir(parents=True)
    generated = generate(out, seed, duration_s, console, rate_hz)
    exit_code, _ = fly(generated.flight, generated.folder, generated.map_path, out, seed=seed, console=console)
    if exit_code != 0:
        raise SourceError(f"{out}: the flight ended with exit code {exit_code}; see {out / 'terrafix.log'}")
    return measure(out)


def show(rows: dict[float, dict[str, Any]], console: Console) -> None:
    names = ", ".join(f"{q} %" for q in PERCENTILES)
    table = Table(title=f"Delay since the exposure in ms: {names}", title_justify="left")
    for name in ("camera", "frames", "skipped", "matched", *STAGES, ANCHORED):
        table.add_column(name, justify="right")
    for rate_hz, row in rows.items():
        delays = (", ".join(str(ms) for ms in row["delay_ms"][stage]) or "-" for stage in (*STAGES, ANCHORED))
        table.add_row(f"{rate_hz:g} Hz", *(str(row[key]) for key in ("frames", "dropped", "matched")), *delays)
    console.print(table)


def use_cores(count: int) -> None:
    """This process, and those that it starts, run on ``count`` of the cores. Raises UsageError: there are fewer."""
    available = sorted(os.sched_getaffinity(0))
    if not 1 <= count <= len(available):
        raise UsageError(f"--cores {count}: choose 1 to {len(available)}")
    os.sched_setaffinity(0, available[:count])


def main(
    out: Annotated[Path, typer.Argument(help="Folder for the flights.")],
    rate: Annotated[list[float] | None, typer.Option(help="Frames per second; may be given several times.")] = None,
    duration: Annotated[float, typer.Option(help="Seconds of each flight.")] = 60.0,
    seed: Annotated[int, typer.Option(help="Seed of the world and of the noise.")] = 1,
    cores: Annotated[int | None, typer.Option(help="Cores for all processes; default: all.")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="JSON to write.")] = None,
) -> None:
    if cores is not None:
        use_cores(cores)
    console = Console(width=170)
    rows = {
        hz: fly_at(hz, out / f"{hz:g}", seed=seed, duration_s=duration, console=console)
        for hz in rate or DEFAULT_RATES_HZ
    }
    show(rows, console)
    write_result(json_file, {f"{hz:g}": row for hz, row in rows.items()})


if __name__ == "__main__":
    run_standalone("bench.latency", main)
