"""Costs that grow with the map or the flight. Each size is measured in its own process, because of its peak memory."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from terrafix_lab.bench import photos
from terrafix_lab.bench.growth import estimator_cost, map_size, merging

AREAS_KM2 = (1.0, 10.0, 100.0)
FLIGHTS_FRAMES = (100, 1000, 3000)
MERGED_KEYFRAMES = 3000


def measure(
    work: Path,
    console: Console,
    *,
    areas_km2: tuple[float, ...] = AREAS_KM2,
    flights_frames: tuple[int, ...] = FLIGHTS_FRAMES,
) -> dict[str, Any]:
    """-> "map": one entry per area, "flight": one per length, "merge": of the submaps of a flight, "photos": first
    position of photos of 26 megapixels."""
    maps, flights = [], []
    for area_km2 in areas_km2:
        folder = work / f"map-{area_km2:g}"
        folder.mkdir()
        with console.status(f"a map of {area_km2:g} km2"):
            built = _run(map_size.__name__, f"{area_km2:g}", str(folder), out=folder / "built.json")
            searched = _run(map_size.__name__, "search", str(folder), out=folder / "searched.json")
        (folder / "map.gpkg").unlink()
        maps.append(built | searched)
    for frames in flights_frames:
        with console.status(f"a flight of {frames} frames"):
            flights.append(_run(estimator_cost.__name__, str(frames), out=work / f"flight-{frames}.json"))
    with console.status(f"a merge of {MERGED_KEYFRAMES} keyframes"):
        merged = _run(merging.__name__, str(MERGED_KEYFRAMES), out=work / "merging.json")
    with console.status("photos of 26 megapixels"):
        large = _run(photos.__name__, out=work / "photos.json")
    return {"map": maps, "flight": flights, "merge": merged, "photos": large}


def map_table(grown: dict[str, Any]) -> list[list[str]]:
    """-> head and rows: a column for each map, a row for each quantity. Processor times if not marked."""
    by_size = []
    for one in grown["map"]:
        correlations = {
            f"correlation, {name}": f"{one['look_cpu_ms'][name]['median']:.0f} ms" for name in map_size.BELIEFS_M
        }
        read_ms = max(window["p95"] for window in one["window_ms"].values())
        by_size.append({
            "": f"{one['area_km2']:g} km2",
            "build": f"{one['build_cpu_s']:.0f} s",
            "by the clock": f"{one['build_s']:.0f} s",
            f"with {map_size.WORKERS} workers": f"{one['build_by_several_s']:.0f} s (x {one['speed_up']:.2f})",
            "size": f"{one['package_mb']:.0f} MB",
            "open, by the clock": f"{one['open_ms']:.0f} ms",
            "window of 1 km, p95 at the slowest scale, by the clock": f"{read_ms:.0f} ms",
            **correlations,
            "memory": f"{one['memory_mb']:.0f} MB",
        })  # fmt: skip
    return _columns(by_size)


def flight_table(grown: dict[str, Any]) -> list[list[str]]:
    """As ``map_table``, a column for each flight. Processor times of the estimator alone."""
    by_length = []
    for one in grown["flight"]:
        queries = {f"covariance: {name}": f"{ms['median']:.2f} ms" for name, ms in one["covariance_cpu_ms"].items()}
        update = one["update_cpu_ms"]
        by_length.append({
            "": f"{one['frames']} frames",
            "one frame": f"{one['frame_cpu_ms']['median']:.1f} ms",
            "graph alone (median/p99)": f"{update['median']:.1f}/{update['p99']:.1f} ms",
            **queries,
            "refinement": f"{one['refine_cpu_s']:.1f} s",
            "memory": f"{one['peak_memory_mb']:.0f} MB",
        })  # fmt: skip
    return _columns(by_length)


def show(grown: dict[str, Any], console: Console) -> None:
    """Prints tables: map, flight, merge; and a line: photos. Times are processor times if not marked."""
    console.print(side_by_side("as the map grows (processor time)", map_table(grown)))
    console.print(side_by_side("as the flight grows (processor time, estimator alone)", flight_table(grown)))
    merging.show(grown["merge"], console)
    one = grown["photos"]
    size, first_s, memory_mb = f"{one['width_px']}x{one['height_px']}", one["first_position_s"], one["peak_memory_mb"]
    console.print(
        f"photos of {size}: first position {first_s:.1f} s after the start of the program, then "
        f"{one['frame_ms']['median']:.0f} ms a photo; {memory_mb:.0f} MB",
        highlight=False,
    )


def _columns(cases: list[dict[str, str]]) -> list[list[str]]:
    return [[name, *(case[name] for case in cases)] for name in cases[0]]


def side_by_side(title: str, rows: list[list[str]]) -> Table:
    """-> a table of head and rows."""
    table = Table(title=title, title_justify="left")
    for i, head in enumerate(rows[0]):
        table.add_column(head, justify="right" if i else "left")
    for row in rows[1:]:
        table.add_row(*row)
    return table


def _run(module: str, *arguments: str, out: Path) -> dict[str, Any]:
    done = subprocess.run([sys.executable, "-m", module, *arguments, str(out)], stderr=subprocess.PIPE, text=True)
    if done.returncode != 0:
        raise RuntimeError(f"{module} failed with exit code {done.returncode}:\n{done.stderr}")
    found: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
    return found
