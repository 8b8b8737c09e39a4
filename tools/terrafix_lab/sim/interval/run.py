"""Interval of GPS_INPUT under full load: ``python -m terrafix_lab.sim.interval.run --minutes 30 --burners 4``.

The real processes fly a generated flight in real time, next to programs that use all processors. The flight is
rendered once and kept in the folder.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import msgspec
import typer
from rich.console import Console

from terrafix.core.errors import UsageError
from terrafix_lab.sim.demo.flight import fly
from terrafix_lab.sim.flights.folder import plan_flight, write_flight
from terrafix_lab.sim.interval.pace import IntervalStats, read_stats
from terrafix_lab.sim.out_folder import prepare_folder, write_json
from terrafix_lab.sim.world import place as world
from terrafix_lab.sim.world.mapped import CAMERA_SEASON, write_map
from terrafix_lab.standalone import run_standalone

MARKER_FILE, RESULT = "interval.json", "pace.json"
MAX_MINUTES = 60.0
BURN = "while True: pass"


def interval(
    minutes: Annotated[float, typer.Option(help="Duration of the flight.")] = 30.0,
    burners: Annotated[int, typer.Option(help="Number of CPU load programs; default: two per core.")] = -1,
    burner_nice: Annotated[int, typer.Option(help="Nice value of the load programs.")] = 0,
    out: Annotated[Path, typer.Option(help="Folder for flight, record and result.")] = Path("out/interval"),
    seed: Annotated[int, typer.Option(help="Seed of the world and of the noise.")] = 1,
) -> None:
    """Measure the interval of GPS_INPUT. Exit code 1: AC-14 is not met, or a process died."""
    if not 0.2 <= minutes <= MAX_MINUTES:
        raise UsageError(f"--minutes {minutes:g}: choose 0.2 to {MAX_MINUTES:g}")
    burner_count = 2 * (os.cpu_count() or 1) if burners < 0 else burners
    console = Console()
    about = {"minutes": minutes, "seed": seed}
    marker = out / MARKER_FILE
    generate = not (out / "flight" / "flight.toml").is_file() or json.loads(marker.read_text(encoding="utf-8")) != about
    if generate:
        prepare_folder(out, MARKER_FILE, about)
    with console.status("generating the place"):
        place = world.generate(seed)
        flight = plan_flight(place, place.render(CAMERA_SEASON), 60.0 * minutes)
    if generate:
        with console.status("writing the map and the images"):
            write_map(place, out / "map.gpkg")
            write_flight(out / "flight", flight, "../map.gpkg", seed=seed, telemetry=False)
    for old in out.glob("flight-*.mcap"):
        old.unlink()
    with _burning(burner_count, burner_nice):
        exit_code, peer = fly(flight, out / "flight", out / "map.gpkg", out, seed=seed, console=console)
    pace = read_stats(out)
    load = {
        "cores": os.cpu_count(),
        "burners": burner_count,
        "burner_nice": burner_nice,
        "load_average": os.getloadavg(),
    }
    write_json(out / RESULT, load | {"record": msgspec.to_builtins(pace), "autopilot": asdict(peer)})
    console.print(
        f"{os.cpu_count()} cores, {burner_count} burners (nice {burner_nice}), load {os.getloadavg()[0]:.1f}",
        highlight=False,
    )
    for line in _lines(pace):
        console.print(line, highlight=False)
    for name, value in (("median", peer.interval_median_ms), ("p99", peer.interval_p99_ms)):
        console.print(f"at the autopilot: {name} {_ms(value)}", highlight=False)
    console.print(f"at the autopilot: longest {_ms(peer.longest_gap_ms)}", highlight=False)
    raise typer.Exit(exit_code or (0 if pace.meets_ac14 and not pace.trouble else 1))


@contextmanager
def _burning(number: int, nice: int) -> Iterator[None]:
    """Runs CPU load programs; ``nice`` 0: at the priority of this program."""
    command = ["nice", "-n", str(nice), sys.executable, "-c", BURN]
    programs = [subprocess.Popen(command) for _ in range(number)]
    try:
        yield
    finally:
        for program in programs:
            program.kill()
            program.wait()


def _lines(pace: IntervalStats) -> Iterator[str]:
    yield f"GPS_INPUT       {pace.gps_inputs} in {pace.duration_s:.0f} s, 3D fix in {pace.fix3_share:.1%}"
    yield f"interval        median {_ms(pace.interval_median_ms)}, p99 {_ms(pace.interval_p99_ms)}"
    over = f"over 120 ms: {pace.over_p99_floor}, over 245 ms: {pace.over_gap_floor}"
    yield f"longest gap     {_ms(pace.longest_gap_ms)}; {over}"
    yield f"image to first GPS_INPUT   median {_ms(pace.first_age_median_ms)}, p95 {_ms(pace.first_age_p95_ms)}"
    yield f"age of the image behind GPS_INPUT   p95 {_ms(pace.age_p95_ms)}"
    yield f"processes       {', '.join(pace.trouble) or 'none died or hung'}"


def _ms(value: float | None) -> str:
    return "no data" if value is None else f"{value:.1f} ms"


if __name__ == "__main__":
    run_standalone("terrafix interval", interval)
