"""`terrafix models bench`: run time of each model on this computer, next to a baseline without weights in the same
run.
"""

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

from terrafix.anchor.matching.fft import cross_correlation, spectra, template_spectra, transform_shape
from terrafix.core.errors import OutputError
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_engines.features.keypoints import Keypoints, MutualNearestMatcher, unit_rows
from terrafix_engines.manifest import Manifest
from terrafix_engines.providers import CPU, PREFERENCE, short_name
from terrafix_engines.runtime import Model, default_sizes, noise
from terrafix_engines.store import StoredModel
from terrafix_tools.models.known import as_model_errors, fetched_models
from terrafix_tools.models.listing import open_complete
from terrafix_tools.timing import machine, spread

MAX_TIME_S = 20.0  # time limit per input size: a slow model gets fewer runs
MIN_RUNS = 3


def bench_all(names: list[str], folder: str, out: Path, *, runs: int) -> None:
    """Prints a table, writes ``out``. Raises ModelError, OutputError."""
    models = fetched_models(names, folder)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.touch()
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); choose another --out") from None
    result: dict[str, Any] = {"machine": machine(), "models": {}}
    with as_model_errors():
        for model in models:
            result["models"][model.manifest.name] = _measure(model, runs)
        _show(result["models"])
    out.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    typer.echo(f"written to {out}")


def _measure(model: StoredModel, runs: int) -> dict[str, Any]:
    m = model.manifest
    best = open_complete(model)
    rows = _rows(best, m, runs)
    if best.provider != CPU:  # also on the CPU, for comparison
        rows += _rows(open_complete(model, prefer=PREFERENCE[-1:]), m, runs)
    return {"sha256": best.sha256, "passed_over": [str(one) for one in best.rejected_providers], "rows": rows}


def _rows(model: Model, manifest: Manifest, runs: int) -> list[dict[str, Any]]:
    rows = []
    inputs = tuple(manifest.inputs)
    for sizes in [preset.sizes for preset in manifest.presets] or [default_sizes(inputs)]:
        tensors = tuple(noise(tensor, sizes) for tensor in inputs)
        row: dict[str, Any] = {"provider": short_name(model.provider), "sizes": sizes, "input": tensors[0].shape}
        row |= _time_runs(lambda: model.run(*tensors), runs)  # noqa: B023 - called before the next iteration
        if baseline := _baseline(manifest, sizes):
            what, call = baseline
            row["baseline"] = {"what": what, **_time_runs(call, runs)}
        rows.append(row)
    return rows


def _baseline(manifest: Manifest, sizes: dict[str, int]) -> tuple[str, Callable[[], object]] | None:
    """Returns name and call of a method without weights for the same task and input size; None: there is none."""
    if manifest.role == "matcher":
        points = [_points(count) for name, count in sorted(sizes.items()) if name != "batch"]
        return "nearest", lambda: MutualNearestMatcher().match(points[0], points[-1])
    if manifest.role == "correlation":
        return "OpenCV", lambda: _correlated_by_opencv(manifest, sizes["templates"])
    if manifest.role in ("pair", "global"):
        return None
    rng = np.random.default_rng(0)
    height, width = (sizes[side] if isinstance(side, str) else side for side in manifest.image_size())
    image = rng.integers(0, 255, (height, width, 3), np.uint8)
    image = cv2.GaussianBlur(image, (0, 0), 3.0)
    if manifest.role == "dense":
        return "gradients", lambda: GradientDescriber().describe(image)
    return "SIFT", lambda: cv2.SIFT.create(1024).detectAndCompute(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), None)


def _correlated_by_opencv(manifest: Manifest, count: int) -> None:
    """The same correlation by the transforms that fly on a processor."""
    _, channels, height, width = (size for size in manifest.inputs[0].shape)
    assert isinstance(channels, int) and isinstance(height, int) and isinstance(width, int)
    shape = transform_shape(height, width)
    images = spectra(np.ones((channels, height, width), np.float32), shape)
    for _ in range(count):
        cross_correlation(images, template_spectra(np.ones((channels, height, width), np.float32), shape))


def _points(count: int) -> Keypoints:
    rng = np.random.default_rng(count)
    xy_px = rng.uniform(0, 640, (count, 2)).astype(np.float32)
    return Keypoints(xy_px, np.ones(count, np.float32), unit_rows(rng.normal(size=(count, 64))), (641, 641))


def _time_runs(call: Callable[[], object], runs: int) -> dict[str, Any]:
    """Returns wall time and CPU time of all threads of this process; other programs do not affect the CPU time."""
    wall_ms: list[float] = []
    cpu_ms: list[float] = []
    began_s = time.perf_counter()
    while len(wall_ms) < runs + 1 and (len(wall_ms) < MIN_RUNS or time.perf_counter() - began_s < MAX_TIME_S):
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        call()
        wall_ms.append((time.perf_counter() - wall_s) * 1e3)
        cpu_ms.append((time.process_time() - cpu_s) * 1e3)
    return {"runs": len(wall_ms) - 1, "ms": spread(wall_ms), "cpu_ms": spread(cpu_ms)}


def _show(models: dict[str, Any]) -> None:
    table = Table(
        title="one inference, milliseconds (median/p95)", title_justify="left", box=box.SIMPLE, pad_edge=False
    )
    for title in ("model", "input", "by", "time", "cpu", "no weights", "time", "cpu"):
        table.add_column(title, justify="right" if title in ("time", "cpu") else "left", no_wrap=True)
    for name, measured in models.items():
        for row in measured["rows"]:
            size = "x".join(str(size) for size in row["input"][1:])
            base = row.get("baseline")
            baseline_cells = (
                (base["what"], f"{base['ms']['median']:.0f}", f"{base['cpu_ms']['median']:.0f}")
                if base
                else ("-", "-", "-")
            )
            cpu = f"{row['cpu_ms']['median']:.0f}"
            table.add_row(name, size, row["provider"], _pair(row["ms"]), cpu, *baseline_cells)
    console = Console()
    console.print(table)
    for name, measured in models.items():
        for rejected in measured["passed_over"]:
            console.print(f"{name}: not run by {rejected}", highlight=False, soft_wrap=True)


def _pair(times: dict[str, float]) -> str:
    return f"{times['median']:.0f}/{times['p95']:.0f}"
