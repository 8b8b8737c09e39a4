"""Processor time and accuracy of a flight by thermal band: python -m terrafix_tools.bench.heat FLIGHT MAP OUT [XFEAT].

The flight is replayed once in each band, normal first, with the nodes of the daemon. OUT/heat.json has the numbers of
the table: means over the frames after the first. Processor time is that of all threads of a frame, so that other
programs do not lengthen it."""

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from terrafix.core.errors import TerrafixError
from terrafix.core.node import Node, NodeContext
from terrafix.messages import ThermalBand
from terrafix_tools.accept.faults.nodes import HotComputer
from terrafix_tools.accept.measuring.results import Span
from terrafix_tools.bench.flights import WARM_UP_FRAMES, StageTimes, TimedNode, spread
from terrafix_tools.estimates import ESTIMATES, read_rows
from terrafix_tools.evaluate import metrics, read_summary, read_truth, truth_sigma_of
from terrafix_tools.replay import make_nodes, replay

RESULT = "heat.json"
WHOLE_FLIGHT = Span(-math.inf, math.inf, "thermal band")


def measure(flight: Path, map_path: Path, out: Path, xfeat: Path | None) -> dict[str, dict[str, Any]]:
    """-> the numbers of each band. Raises TerrafixError."""
    return {band.value: measure_band(flight, map_path, out / band.value, xfeat, band) for band in ThermalBand}


def measure_band(flight: Path, map_path: Path, out: Path, xfeat: Path | None, band: ThermalBand) -> dict[str, Any]:
    times = StageTimes()

    def nodes(ctx: NodeContext) -> dict[str, Node]:
        made = make_nodes(ctx)
        made["estimator"] = HotComputer(made["estimator"], WHOLE_FLIGHT, band)
        return {name: TimedNode(name, node, times) for name, node in made.items()}

    summary = replay(flight, map_path, out, models=[f"xfeat={xfeat}"] if xfeat else [], nodes=nodes)
    used_ms = times.cpu_ms[WARM_UP_FRAMES:] or times.cpu_ms
    stage_ms = [times.frames[i] for i in range(min(WARM_UP_FRAMES, len(times.frames) - 1), len(times.frames))]
    result: dict[str, Any] = {
        "cpu_ms": {"mean": round(float(np.mean(used_ms)), 2), **spread(times.cpu_ms)},
        "anchor_ms_mean": round(float(np.mean([frame["anchor"] for frame in stage_ms])), 2),
        "estimator_ms_mean": round(float(np.mean([frame["estimator"] for frame in stage_ms])), 2),
        "matcher_verdicts": summary["matcher_verdicts"],
    }
    truth = flight / "truth.csv"
    if truth.is_file():
        found = metrics(read_rows(out / ESTIMATES), read_truth(truth), read_summary(out), truth_sigma_of(truth))
        result |= {key: found[key] for key in ("within_20m", "median_m", "p95_m", "ellipse95_coverage", "false_fixes")}
    return result


def _accuracy(row: dict[str, Any]) -> tuple[str, str, str, str]:
    if "within_20m" not in row:
        return ("-", "-", "-", "-")
    within, inside = (f"{100 * row[key]:.1f} %" for key in ("within_20m", "ellipse95_coverage"))
    return within, f"{row['p95_m']:.1f} m", inside, str(row["false_fixes"])


def show(result: dict[str, dict[str, Any]], console: Console) -> None:
    table = Table(title="Thermal bands", title_justify="left")
    for name in (
        "band",
        "CPU a frame",
        "of normal",
        "anchor",
        "estimator",
        "within 20 m",
        "error p95",
        "inside",
        "false",
    ):
        table.add_column(name, justify="left" if name == "band" else "right")
    normal_ms = result[ThermalBand.NORMAL.value]["cpu_ms"]["mean"]
    for band, row in result.items():
        mean_ms = row["cpu_ms"]["mean"]
        work = (f"{mean_ms:.0f} ms", f"{100 * mean_ms / normal_ms:.0f} %")
        stages = (f"{row['anchor_ms_mean']:.0f} ms", f"{row['estimator_ms_mean']:.1f} ms")
        table.add_row(band, *work, *stages, *_accuracy(row))
    console.print(table)


def main() -> None:
    if len(sys.argv) not in (4, 5):
        typer.echo("usage: python -m terrafix_tools.bench.heat FLIGHT MAP OUT [XFEAT]", err=True)
        sys.exit(2)
    flight, map_path, out, *model = (Path(text) for text in sys.argv[1:])
    try:
        out.mkdir(parents=True, exist_ok=True)
        result = measure(flight, map_path, out, model[0] if model else None)
    except TerrafixError as error:
        typer.echo(str(error), err=True)
        sys.exit(error.exit_code)
    (out / RESULT).write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    show(result, Console(width=130))


if __name__ == "__main__":
    main()
