"""`terrafix bench`: time, memory and accuracy of whole replays, compared with peers on the same frames: SIFT, XFeat and
LighterGlue.

Every measurement runs in its own process, one after the other. Milliseconds depend on the machine and its load; the
ratio of the processor times to those of a peer, measured minutes apart on the same machine, depends on them least."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.table import Table

from terrafix.core.errors import ERROR_OF_EXIT_CODE, OutputError, SourceError, UsageError
from terrafix.core.toml_file import read_toml
from terrafix_lab.bench import flights as bench_run
from terrafix_lab.bench import kernels as bench_kernels
from terrafix_lab.bench import micro as bench_micro
from terrafix_lab.bench import peers as bench_peers
from terrafix_lab.bench import scaling
from terrafix_lab.bench.comparison import percent_text, spread_text
from terrafix_lab.bench.page import comparison_table, stage_table, write_page
from terrafix_lab.sim.flights.folder import FRAME_HZ, plan_flight, write_flight
from terrafix_lab.sim.world import place as world
from terrafix_tools.flight_map import map_cache_dir
from terrafix_tools.mapping.build import build, ensure_package
from terrafix_tools.timing import machine

FLIGHTS = ("village-1", "town-a")
GENERATED = "generated"
GENERATED_S, GENERATED_SEED = 20.0, 3  # seconds of flight; an arbitrary seed
GENERATED_SIZE_M = (1600.0, 1200.0)
WIDE = 150  # characters of the widest tables
WEIGHTS_FREE, XFEAT = "weights-free", "xfeat"


def bench(
    data: Path,
    out: Path,
    *,
    flights: list[str] | None = None,
    frames: int | None = None,
    xfeat: bool = True,
    growing: bool = False,
    page: Path | None = None,
) -> dict[str, Any]:
    """Writes the results to ``out`` (JSON), prints tables, and returns the results.

    ``data``: folder with flights/ and models/. ``flights``: names in it, or "generated"; default: FLIGHTS, or the
    generated one if the data are absent. ``frames``: number of first frames of each flight; None: all. ``xfeat``: also
    with XFeat. ``growing``: also the cost of larger maps and longer flights. ``page``: Markdown to write, with a
    picture in images/ beside it. Raises TerrafixError."""
    if frames is not None and frames < 2:
        raise UsageError(f"--frames {frames}: two frames are the least that can be measured")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.touch()
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); choose another --out") from None
    console = Console(stderr=True)
    missing: list[str] = []
    model = _model(data, missing) if xfeat else None
    names = _present(data, flights or list(FLIGHTS), missing)
    if not names and not flights:
        names = [GENERATED]
    if not names:
        raise SourceError(f"{data / 'flights'}: none of {', '.join(flights or [])} is there; check --data and --flight")
    for what in missing:
        console.print(f"NOT MEASURED: {what}", style="bold yellow", highlight=False, soft_wrap=True)
    result: dict[str, Any] = {"machine": machine(), "missing": missing, "flights": {}, "micro": {}}
    with tempfile.TemporaryDirectory(prefix="terrafix-bench-") as temporary:
        for name in names:
            work = Path(temporary) / name
            flight, package = _prepare(data, name, work, frames, console)
            measured = _flight(flight, package, work, model, console)
            if not result["micro"]:
                result["micro"] = {"flight": name, **_part(bench_micro, flight, package, work / WEIGHTS_FREE, None)}
            result["flights"][name] = measured
        if growing:
            result["growth"] = scaling.measure(Path(temporary), console)
    result["machine"]["load_average_after"] = os.getloadavg()
    try:
        out.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); choose another --out") from None
    _show(result, out)
    if page is not None:
        write_page(page, result)
        typer.echo(f"written to {page}")
    return result


def _model(data: Path, missing: list[str]) -> Path | None:
    path = data / "models" / "xfeat.onnx"
    if path.is_file():
        return path.resolve()
    missing.append(f"XFeat: {path} is not there")
    return None


def _present(data: Path, names: list[str], missing: list[str]) -> list[str]:
    """-> the flights that exist; the others are added to ``missing``."""
    found = [name for name in names if name == GENERATED or (data / "flights" / name / "flight.toml").is_file()]
    missing += [f"flight {name}: not in {data / 'flights'}" for name in names if name not in found]
    return found


def _prepare(data: Path, name: str, work: Path, frames: int | None, console: Console) -> tuple[Path, Path]:
    """-> a flight folder with only the first ``frames`` frames, and the package of its map."""
    work.mkdir()
    if name == GENERATED:
        with console.status("a place and a flight over it"):
            flight, package = _generate(work, GENERATED_S if frames is None else min(GENERATED_S, frames / FRAME_HZ))
    else:
        flight = (data / "flights" / name).resolve()
        table = read_toml(flight / "flight.toml")
        if "map" not in table:
            raise SourceError(f"{flight / 'flight.toml'}: names no map, and the benchmark needs one")
        package = ensure_package(flight / str(table["map"]), map_cache_dir(), progress=True)
    short = work / "flight"
    if frames is None:
        return flight, package.resolve()
    short.mkdir()
    for entry in flight.iterdir():
        if entry.name != "frames.csv":
            (short / entry.name).symlink_to(entry)
    lines = (flight / "frames.csv").read_text(encoding="utf-8").splitlines()
    (short / "frames.csv").write_text("\n".join(lines[: frames + 1]) + "\n", encoding="utf-8")
    return short, package.resolve()


def _generate(work: Path, duration_s: float) -> tuple[Path, Path]:
    place = world.generate(GENERATED_SEED, width_m=GENERATED_SIZE_M[0], height_m=GENERATED_SIZE_M[1])
    world.write_image(work / "map.tif", place, place.render("summer"))
    world.write_dem(work / "dem.tif", place)
    package = build(work / "map.tif", work / "map.gpkg", dem=work / "dem.tif")
    flight = plan_flight(place, place.render("autumn"), duration_s)
    write_flight(work / GENERATED, flight, "../map.gpkg", seed=GENERATED_SEED)
    return work / GENERATED, package


def _flight(flight: Path, package: Path, work: Path, model: Path | None, console: Console) -> dict[str, Any]:
    runs: dict[str, Any] = {}
    for kind in (WEIGHTS_FREE, XFEAT) if model else (WEIGHTS_FREE,):
        with console.status(f"{work.name}: {kind}"):
            runs[kind] = _part(bench_run, flight, package, work / kind, model if kind == XFEAT else None)
    with console.status(f"{work.name}: peers"):
        found = _part(bench_peers, flight, package, work / WEIGHTS_FREE, model.parent if model else None)
    with console.status(f"{work.name}: kernels"):
        floor = _part(bench_kernels, flight, package, work / "kernels", None)
    return {"floor": floor, "runs": runs, **found}


def _part(module: Any, flight: Path, package: Path, out: Path, model: Path | None) -> dict[str, Any]:
    """Runs one measurement in its own process. Raises the TerrafixError of its exit code, with the text of its
    stderr."""
    arguments = [str(path) for path in (flight, package, out, model) if path is not None]
    done = subprocess.run([sys.executable, "-m", module.__name__, *arguments], stderr=subprocess.PIPE, text=True)
    if kind := ERROR_OF_EXIT_CODE.get(done.returncode):
        raise kind(done.stderr.strip())
    if done.returncode != 0:
        raise RuntimeError(f"{module.__name__} failed with exit code {done.returncode}:\n{done.stderr}")
    result: dict[str, Any] = json.loads((out / module.RESULT).read_text(encoding="utf-8"))
    return result


def _show(result: dict[str, Any], out: Path) -> None:
    console, wide, m = Console(), Console(width=WIDE), result["machine"]
    load = "/".join(f"{v:.1f}" for v in (m["load_average_before"][0], m["load_average_after"][0]))
    console.print(f"{m['cpu']}, {m['cores']} cores, load {load} (before/after)", highlight=False)
    for name, flight in result["flights"].items():
        table = Table(title=f"{name}, {flight['frames']} frames", title_justify="left")
        table.add_column("")
        for kind in flight["runs"]:
            table.add_column(kind, justify="right")
        runs = flight["runs"].values()
        for title, key in (("frame, ms (median/p95/p99)", "frame_ms"), ("processor, ms", "cpu_ms")):
            table.add_row(title, *(spread_text(r[key]) for r in runs))
        table.add_row("first frame, ms", *(f"{r['first_frame_ms']:.0f}" for r in runs))
        for key in ("within_20m", "within_50m"):
            table.add_row(key.replace("_", " ").replace("m", " m"), *(percent_text(r["accuracy"][key]) for r in runs))
        medians_m = (r["accuracy"]["median_m"] for r in runs)
        table.add_row("median error", *("-" if error_m is None else f"{error_m:.1f} m" for error_m in medians_m))
        table.add_row("frames a second", *(f"{r['frames_per_s']:.1f}" for r in runs))
        table.add_row("start-up", *(f"{r['start_up_s']:.1f} s" for r in runs))
        table.add_row("peak memory", *(f"{r['peak_memory_mb']:.0f} MB" for r in runs))
        console.print(table)
        for title, rows in (
            ("beside other methods, on the same frames and predictions (ms)", comparison_table(flight)),
            ("stages and their floor (ms)", stage_table(flight)),
        ):
            wide.print(scaling.side_by_side(title, rows))
        for what in flight["missing"]:
            console.print(f"not measured: {what}", highlight=False)
    table = Table(title=f"parts, on {result['micro']['flight']}", title_justify="left")
    table.add_column("")
    table.add_column("ms (median/p95/p99)", justify="right")
    for part, times in result["micro"].items():
        if part != "flight":
            table.add_row(part, spread_text(times))
    console.print(table)
    if "growth" in result:
        scaling.show(result["growth"], console)
    typer.echo(f"written to {out}")
