"""`terrafix models bench`: how long a model takes here, beside what does the same without weights in the same run."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import typer
from rich import box
from rich.console import Console
from rich.table import Table

from terrafix.core.errors import OutputError
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_engines.features.keypoints import Keypoints, MutualNearest, unit
from terrafix_engines.manifest import Manifest
from terrafix_engines.providers import CPU, PREFERENCE, short
from terrafix_engines.runtime import Model, default_sizes, noise
from terrafix_engines.store import Stored
from terrafix_tools.bench.flights import spread
from terrafix_tools.bench.run import machine
from terrafix_tools.models.known import fetched, plain_errors
from terrafix_tools.models.listing import opened_whole

MOST_S = 20.0  # of a size: a slow one is timed less often
FEWEST = 3


def bench_all(
    names: list[str], folder: str, out: Path, *, runs: int, pair: tuple[Path, Path] | None, trials: int
) -> None:
    """Prints tables, writes ``out``. Raises ModelError, OutputError, and MapError for the pair."""
    models = fetched(names, folder)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.touch()
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); choose another --out") from None
    result: dict[str, Any] = {"machine": machine(), "models": {}}
    with plain_errors():
        for model in models:
            result["models"][model.manifest.name] = _measure(model, runs)
        _show(result["models"])
        if pair:
            from terrafix_tools.models.pair import measure_pair, show_pair  # needs rasterio, which a vehicle has not

            result["pair"] = measure_pair(models, *pair, trials)
            show_pair(result["pair"])
    out.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    typer.echo(f"written to {out}")


def _measure(model: Stored, runs: int) -> dict[str, Any]:
    m = model.manifest
    best = opened_whole(model)
    rows = _rows(best, m, runs)
    if best.provider != CPU:  # the same on the CPU, to compare
        rows += _rows(opened_whole(model, prefer=PREFERENCE[-1:]), m, runs)
    return {"sha256": best.sha256, "passed_over": [str(one) for one in best.passed_over], "rows": rows}


def _rows(model: Model, manifest: Manifest, runs: int) -> list[dict[str, Any]]:
    rows = []
    inputs = tuple(manifest.inputs)
    for sizes in [preset.sizes for preset in manifest.presets] or [default_sizes(inputs)]:
        tensors = tuple(noise(tensor, sizes) for tensor in inputs)
        row: dict[str, Any] = {"provider": short(model.provider), "sizes": sizes, "input": tensors[0].shape}
        row |= _timed(lambda: model.run(*tensors), runs)  # noqa: B023 - called before the next turn
        if baseline := _baseline(manifest, sizes):
            what, work = baseline
            row["baseline"] = {"what": what, **_timed(work, runs)}
        rows.append(row)
    return rows


def _baseline(manifest: Manifest, sizes: dict[str, int]) -> tuple[str, Callable[[], object]] | None:
    """What does the same work without weights, for an input of the same size; None: nothing does."""
    if manifest.role == "matcher":
        points = [_points(count) for name, count in sorted(sizes.items()) if name != "batch"]
        return "nearest", lambda: MutualNearest().match(points[0], points[-1])
    if manifest.role == "pair":
        return None
    rng = np.random.default_rng(0)
    height, width = (sizes[side] if isinstance(side, str) else side for side in manifest.picture_size())
    image = rng.integers(0, 255, (height, width, 3), np.uint8)
    image = cv2.GaussianBlur(image, (0, 0), 3.0)
    if manifest.role == "dense":
        return "gradients", lambda: GradientDescriber().describe(image)
    return "SIFT", lambda: cv2.SIFT.create(1024).detectAndCompute(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), None)


def _points(count: int) -> Keypoints:
    rng = np.random.default_rng(count)
    xy_px = rng.uniform(0, 640, (count, 2)).astype(np.float32)
    return Keypoints(xy_px, np.ones(count, np.float32), unit(rng.normal(size=(count, 64))), (641, 641))


def _timed(work: Callable[[], object], runs: int) -> dict[str, Any]:
    """Time by the clock, and of all threads of this process: other programs do not lengthen that one."""
    wall_ms: list[float] = []
    cpu_ms: list[float] = []
    began_s = time.perf_counter()
    while len(wall_ms) < runs + 1 and (len(wall_ms) < FEWEST or time.perf_counter() - began_s < MOST_S):
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        work()
        wall_ms.append((time.perf_counter() - wall_s) * 1e3)
        cpu_ms.append((time.process_time() - cpu_s) * 1e3)
    return {"runs": len(wall_ms) - 1, "ms": spread(wall_ms), "cpu_ms": spread(cpu_ms)}


def _show(models: dict[str, Any]) -> None:
    table = Table(title="one answer, milliseconds (median/p95)", title_justify="left", box=box.SIMPLE, pad_edge=False)
    for title in ("model", "input", "by", "time", "cpu", "no weights", "time", "cpu"):
        table.add_column(title, justify="right" if title in ("time", "cpu") else "left", no_wrap=True)
    for name, measured in models.items():
        for row in measured["rows"]:
            size = "x".join(str(size) for size in row["input"][1:])
            base = row.get("baseline")
            beside = (
                (base["what"], f"{base['ms']['median']:.0f}", f"{base['cpu_ms']['median']:.0f}")
                if base
                else ("-", "-", "-")
            )
            cpu = f"{row['cpu_ms']['median']:.0f}"
            table.add_row(name, size, row["provider"], _pair(row["ms"]), cpu, *beside)
    console = Console()
    console.print(table)
    for name, measured in models.items():
        for over in measured["passed_over"]:
            console.print(f"{name}: not by {over}", highlight=False, soft_wrap=True)


def _pair(times: dict[str, float]) -> str:
    return f"{times['median']:.0f}/{times['p95']:.0f}"
