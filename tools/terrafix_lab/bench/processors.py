"""The same flights under other kernels, as another processor would choose them: how far rounding alone moves an answer.

python -m terrafix_lab.bench.processors OUT [--row NAME ...] [--flight NAME ...] [--data FOLDER]

A row of ROWS is a set of variables by which OpenBLAS, OpenCV and NumPy use the kernels of a lesser processor. Each
flight is replayed, finalised and evaluated under each row, in processes of their own, into OUT/ROW/FLIGHT; one that is
complete there is not flown again, so a run that was ended goes on. Two flights are simulated, once for all rows, in
OUT/flights. Of each output the table has the error, and for each two rows the distance between their answers; OUT/
processors.json has the same figures. Where two records first differ: terrafix_lab.bench.flips."""

import itertools
import json
import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from terrafix.core.errors import ERROR_OF_EXIT_CODE, OutputError, SourceError, UsageError
from terrafix.core.geodesy import LocalFrame
from terrafix_lab.bench.result_file import write_result
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.flights.make import FlightOptions, make
from terrafix_lab.standalone import run_standalone
from terrafix_tools.estimates import ESTIMATES, read_rows
from terrafix_tools.finalised import SUMMARY, TABLE
from terrafix_tools.timing import machine

RESULT = "processors.json"
EVALUATION = "evaluation.json"  # the last file of a flight: with the finalised figures in it, the flight is complete
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
WIDE = 150  # characters of the tables


@dataclass(frozen=True)
class ProcessorRow:
    """``variables``: of the environment. ``needs``: flags of /proc/cpuinfo, without which the kernels cannot run."""

    variables: dict[str, str] = field(default_factory=dict)
    needs: frozenset[str] = frozenset()


AVX2, AVX512 = frozenset({"avx2", "fma"}), frozenset({"avx512f", "avx512dq", "avx512bw", "avx512vl"})
# Names of OpenCV's as cv2.getCPUFeaturesLine() prints them, of NumPy's as numpy.show_config() does
ROWS = {
    "own": ProcessorRow(),
    "nehalem": ProcessorRow({"OPENBLAS_CORETYPE": "Nehalem"}),
    "sandybridge": ProcessorRow({"OPENBLAS_CORETYPE": "Sandybridge"}, frozenset({"avx"})),
    "haswell": ProcessorRow({"OPENBLAS_CORETYPE": "Haswell"}, AVX2),
    "zen": ProcessorRow({"OPENBLAS_CORETYPE": "Zen"}, AVX2),
    "skylakex": ProcessorRow({"OPENBLAS_CORETYPE": "SkylakeX"}, AVX512),
    "opencv-no-avx512": ProcessorRow({"OPENCV_CPU_DISABLE": "AVX512-SKX"}, AVX512),
    "opencv-no-avx2": ProcessorRow({"OPENCV_CPU_DISABLE": "AVX512-SKX,AVX2,FMA3"}),
    "numpy-no-avx2": ProcessorRow({"NPY_DISABLE_CPU_FEATURES": "X86_V4 X86_V3"}),
    "haswell-no-avx2": ProcessorRow({"OPENBLAS_CORETYPE": "Haswell", "OPENCV_CPU_DISABLE": "AVX2,FMA3"}, AVX2),
    "weakest": ProcessorRow(
        {
            "OPENBLAS_CORETYPE": "Sandybridge",
            "OPENCV_CPU_DISABLE": "AVX512-SKX,AVX2,FMA3",
            "NPY_DISABLE_CPU_FEATURES": "X86_V4 X86_V3",
        },
        frozenset({"avx"}),
    ),
}
DEFAULT_ROWS = ("own", "haswell-no-avx2", "weakest")
RECORDED = ("village-1", "town-a", "seneca-wing")
SIMULATED = {
    "copter": FlightOptions(seed=31, vehicle=Kind.COPTER, duration_s=60.0),
    "plane": FlightOptions(seed=32, vehicle=Kind.PLANE, duration_s=60.0),
}

# of each output: file, and the beginning of its keys in evaluation.json
OUTPUTS = {"immediate": (ESTIMATES, ""), "refined": (ESTIMATES, "refined_"), "finalised": (TABLE, "finalised_")}


def impossible(row: ProcessorRow, flags: frozenset[str]) -> str | None:
    """-> why a processor with these flags cannot run the row; None: it can."""
    missing = sorted(row.needs - flags)
    return f"the processor has no {', '.join(missing)}" if missing else None


def processor_flags() -> frozenset[str]:
    """Of the first processor (proc(5)); empty on one that is not x86."""
    for line in Path("/proc/cpuinfo").read_text(encoding="ascii", errors="replace").splitlines():
        if line.startswith("flags"):
            return frozenset(line.partition(":")[2].split())
    return frozenset()


def complete(folder: Path) -> bool:
    """True for a flight that was replayed, finalised and evaluated."""
    path = folder / EVALUATION
    return path.is_file() and "finalised" in json.loads(path.read_text(encoding="utf-8"))


def fly(flight: Path, row: ProcessorRow, out: Path) -> None:
    """Replays, finalises and evaluates ``flight`` in ``out`` with the kernels of ``row``. Raises the TerrafixError of
    the command that failed."""
    for arguments in (
        ["replay", str(flight), "--out", str(out)],
        ["finalise", str(out), "--quiet"],
        ["evaluate", str(out), "--truth", str(flight / "truth.csv"), "--json"],
    ):
        done = subprocess.run(
            [sys.executable, "-m", "terrafix_tools.program", *arguments],
            env=os.environ | ONE_THREAD | row.variables,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        # A replay that does not trust its own flight has exit code 1, and its files are whole.
        if done.returncode not in (0, 1) or (done.returncode == 1 and arguments[0] != "replay"):
            kind = ERROR_OF_EXIT_CODE.get(done.returncode, SourceError)
            last = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise kind(f"{out}: {arguments[0]} failed: {last}")


def figures(folder: Path) -> dict[str, Any]:
    """-> by output median and 95 % of the error [m]; focal length and distance of the map's points [px], before and
    after finalise, None where it has none."""
    evaluation = json.loads((folder / EVALUATION).read_text(encoding="utf-8"))
    flights = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))["flights"]
    changes = {row["what"]: row for flight in flights for row in flight["before_after"]}
    found: dict[str, Any] = {
        name: {key: evaluation[f"{prefix}{key}"] for key in ("median_m", "p95_m")}
        for name, (_, prefix) in OUTPUTS.items()
    }
    for name, what in (("focal_px", "focal length"), ("map_points_px", "map points from the camera's pose, mean")):
        row = changes.get(what)
        found[name] = None if row is None else {key: row[key] for key in ("before", "after", "after_sigma")}
    return found


def distances_m(a: Path, b: Path) -> dict[str, Any]:
    """-> by output: frames that both folders have, and the horizontal distance of their positions [m]."""
    found: dict[str, Any] = {}
    for name, (file, prefix) in OUTPUTS.items():
        one, other = (_positions(folder / file, prefix if file == ESTIMATES else "") for folder in (a, b))
        both = [(one[frame], other[frame]) for frame in one.keys() & other.keys()]
        metres = np.array([np.hypot(*LocalFrame(*p).to_local(*q)) for p, q in both])
        found[name] = {"frames": len(both), "only_one": len(one.keys() ^ other.keys())}
        if both:
            spread = zip(("median_m", "p95_m", "max_m"), np.percentile(metres, (50, 95, 100)), strict=True)
            found[name] |= {key: round(float(value), 4) for key, value in spread}
    return found


def _positions(path: Path, prefix: str) -> dict[str, tuple[float, float]]:
    """Latitude and longitude [degrees] by file of the frames that have them."""
    cells = (
        (row.file, *(getattr(row, f"{prefix}{name}") for name in ("lat_deg", "lon_deg"))) for row in read_rows(path)
    )
    return {file: (lat_deg, lon_deg) for file, lat_deg, lon_deg in cells if lat_deg is not None and lon_deg is not None}


def compare(out: Path, rows: list[str], flights: list[str]) -> dict[str, Any]:
    """-> figures of each complete flight in ``out``, and distances between each two rows."""
    flown = {flight: [row for row in rows if complete(out / row / flight)] for flight in flights}
    return {
        "figures": {flight: {row: figures(out / row / flight) for row in of} for flight, of in flown.items()},
        "distances": {
            flight: {
                f"{a}, {b}": distances_m(out / a / flight, out / b / flight) for a, b in itertools.combinations(of, 2)
            }
            for flight, of in flown.items()
        },
    }


def main(
    out: Annotated[Path, typer.Argument(help="Folder of the flights; those complete in it are not flown again.")],
    row: Annotated[list[str] | None, typer.Option(help=f"Of {', '.join(ROWS)}; repeatable.")] = None,
    flight: Annotated[list[str] | None, typer.Option(help=f"Of {', '.join((*RECORDED, *SIMULATED))}.")] = None,
    data: Annotated[Path, typer.Option(help="Folder with flights/.")] = Path("../shared/data"),
) -> None:
    rows = _known("--row", row or list(DEFAULT_ROWS), ROWS)
    flights = _known("--flight", flight or [*RECORDED, *SIMULATED], (*RECORDED, *SIMULATED))
    left_out = {name: why for name in rows if (why := impossible(ROWS[name], processor_flags()))}
    left_out |= {
        name: "not in --data" for name in flights if name in RECORDED and not _is_flight(_recorded(data, name))
    }
    console = Console(width=WIDE)
    for name, why in left_out.items():
        console.print(f"NOT FLOWN: {name}: {why}", highlight=False)
    rows, flights = ([name for name in names if name not in left_out] for names in (rows, flights))
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); choose another folder") from None
    for name, kernels in itertools.product(flights, rows):
        if not complete(out / kernels / name):
            typer.echo(f"{name} with {kernels}", err=True)
            fly(
                _simulated(out, name) if name in SIMULATED else _recorded(data, name),
                ROWS[kernels],
                out / kernels / name,
            )
    result = {"machine": machine(), "left_out": left_out, **compare(out, rows, flights)}
    write_result(out / RESULT, result)
    for table in tables(result):
        console.print(table)


def _known(option: str, names: list[str], known: dict[str, ProcessorRow] | tuple[str, ...]) -> list[str]:
    for name in names:
        if name not in known:
            raise UsageError(f"{option} {name}: unknown; one of {', '.join(known)}")
    return list(dict.fromkeys(names))


def _is_flight(folder: Path) -> bool:
    return (folder / "flight.toml").is_file()


def _recorded(data: Path, name: str) -> Path:
    return data / "flights" / name


def _simulated(out: Path, name: str) -> Path:
    folder = out / "flights" / name
    if not (folder / "truth.csv").is_file():
        make(folder, SIMULATED[name], progress=False)
    return folder


def tables(result: dict[str, Any]) -> list[Table]:
    """Figures and distances as tables, in metres but for focal length and points."""
    errors = _table("Error, median / 95 %, m", "row", *OUTPUTS, "focal length after, px", "map points, px")
    for flight, rows in result["figures"].items():
        for name, found in rows.items():
            cells = [f"{found[output]['median_m']:.1f} / {found[output]['p95_m']:.1f}" for output in OUTPUTS]
            errors.add_row(flight, name, *cells, _focal(found["focal_px"]), _points(found["map_points_px"]))
    apart = _table("Distance between two answers, median / 95 % / largest, m", "rows", *OUTPUTS)
    for flight, pairs in result["distances"].items():
        for name, found in pairs.items():
            apart.add_row(flight, name, *(_spread(found[output]) for output in OUTPUTS))
    return [errors, apart]


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column("flight")
    for name in columns:
        table.add_column(name, justify="right")
    return table


def _focal(found: dict[str, Any] | None) -> str:
    if found is None:
        return "-"
    sigma_px = found["after_sigma"]
    return f"{found['after']:.0f}" if sigma_px is None else f"{found['after']:.0f} ± {sigma_px:.0f}"


def _points(found: dict[str, Any] | None) -> str:
    return (
        "-"
        if found is None or None in (found["before"], found["after"])
        else f"{found['before']:.1f} -> {found['after']:.1f}"
    )


def _spread(found: dict[str, Any]) -> str:
    if not found["frames"]:
        return "-"
    alone = f" ({found['only_one']} alone)" if found["only_one"] else ""
    return " / ".join(f"{found[key]:.2f}" for key in ("median_m", "p95_m", "max_m")) + alone


if __name__ == "__main__":
    run_standalone("bench.processors", main)
