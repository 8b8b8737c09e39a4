"""Compares estimates with ground truth: evaluation.json. docs/outputs.md defines every metric."""

import json
import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import typer
from pyproj import Geod
from rich.console import Console
from rich.table import Table

from terrafix.core.errors import EvaluationError, OutputError
from terrafix.core.toml_file import read_toml
from terrafix.recorder.reader import ReadResult, check_format, is_record, read_flight
from terrafix_tools.estimates import ESTIMATES, Row, RowTable, number, read_rows, read_table
from terrafix_tools.finalised import TABLE as FINALISED
from terrafix_tools.score import FALSE_FIX_ERROR_M, coverage, error_summary, is_false_fix, nees_of

WEIGHTS_FREE = "gradient"  # beginning of MapMatch.matcher of a frame for which no learned model ran
_GEOD = Geod(ellps="WGS84")
# The keys of evaluation.json in words, for the table
WORDS = {
    "within_5m": "frames within 5 m",
    "within_10m": "frames within 10 m",
    "within_20m": "frames within 20 m",
    "within_50m": "frames within 50 m",
    "median_m": "median error",
    "p95_m": "95 % of the errors are below",
    "max_m": "largest error",
    "ellipse95_coverage": "truth in the 95 % ellipse",
    "mean_nees": "mean squared Mahalanobis distance (2: exact claims)",
    "false_fixes": "false fixes: over 50 m wrong, and claimed to be right",
    "anchor_rate": "frames whose own map match was accepted",
    "odometry_rate": "frames registered by odometry",
    "model_rate": "map matches for which the learned model ran",
    "frame_ms_median": "time of a frame, median",
    "frame_ms_p95": "time of a frame, 95 % are below",
    "refined": "frames with a refined position",
    "frames_without_truth": "frames without truth",
    "covariance_invalid": "claims that are no covariance",
    "truth_sigma_m": "error of the truth itself, 1-sigma",
    "ellipse95_coverage_with_truth_sigma": "truth in the 95 % ellipse, with its own error",
}


@dataclass(frozen=True)
class Truth:
    lat_deg: float
    lon_deg: float


@dataclass(frozen=True)
class Compared:
    """One input frame that has ground truth. Errors are estimate minus truth, None where there is no estimate."""

    row: Row
    truth: Truth
    error_e_m: float | None
    error_n_m: float | None
    error_m: float | None
    refined_error_m: float | None  # horizontal distance of the refined position
    mahalanobis2: float | None  # squared, under the reported covariance; inf where that is not positive definite

    def is_false(self, beyond_m: float = FALSE_FIX_ERROR_M) -> bool:
        """A frame without position is not false."""
        if self.error_m is None or self.mahalanobis2 is None:
            return False
        return bool(is_false_fix(np.array(self.error_m), np.array(self.mahalanobis2), beyond_m))


def read_truth(path: Path) -> dict[str, Truth]:
    """Returns the truth by file name. Raises EvaluationError."""
    truth: dict[str, Truth] = {}
    for line, row in read_table(path, ("file", "lat_deg", "lon_deg"), "give the truth.csv of this flight"):
        lat_deg = number(path, line, "lat_deg", row["lat_deg"])
        lon_deg = number(path, line, "lon_deg", row["lon_deg"])
        if lat_deg is None or lon_deg is None:
            continue  # a frame without truth
        if not (-90.0 <= lat_deg <= 90.0 and -180.0 <= lon_deg <= 180.0):
            raise EvaluationError(
                f"{path}, line {line}: {lat_deg}, {lon_deg} is not a valid position; columns swapped?"
            )
        truth[row["file"]] = Truth(lat_deg, lon_deg)
    if not truth:
        raise EvaluationError(f"{path}: no row with a position")
    return truth


def offset_m(truth: Truth, lat_deg: float, lon_deg: float) -> tuple[float, float]:
    """Returns the east and north offset from truth to the position, metres along the WGS84 geodesic."""
    azimuth_deg, _, distance_m = _GEOD.inv(truth.lon_deg, truth.lat_deg, lon_deg, lat_deg)
    azimuth = math.radians(azimuth_deg)
    return distance_m * math.sin(azimuth), distance_m * math.cos(azimuth)


def mahalanobis2(row: Row, e_m: float, n_m: float, extra_sigma_m: float = 0.0) -> float:
    """Squared Mahalanobis distance of (e_m, n_m) under the row's reported 2x2 covariance (plus ``extra_sigma_m``^2 on
    the diagonal); inf when that is not positive definite, or not reported.
    """
    if row.sigma_e_m is None or row.sigma_n_m is None or row.cov_en_m2 is None:
        return math.inf
    extra_m2, across_m2 = extra_sigma_m**2, row.cov_en_m2
    cov = np.array([[row.sigma_e_m**2 + extra_m2, across_m2], [across_m2, row.sigma_n_m**2 + extra_m2]])
    return float(nees_of(np.array([[e_m, n_m]]), cov[None])[0])


def compare(rows: list[Row], truth: dict[str, Truth]) -> list[Compared]:
    """Returns the input frames that have truth, in input order."""
    compared = []
    for row in rows:
        if (true := truth.get(row.file)) is None:
            continue
        e_m = n_m = error_m = refined_m = distance2 = None
        if row.lat_deg is not None and row.lon_deg is not None:
            e_m, n_m = offset_m(true, row.lat_deg, row.lon_deg)
            error_m = math.hypot(e_m, n_m)
            distance2 = mahalanobis2(row, e_m, n_m)
        if row.refined_lat_deg is not None and row.refined_lon_deg is not None:
            refined_m = math.hypot(*offset_m(true, row.refined_lat_deg, row.refined_lon_deg))
        compared.append(Compared(row, true, e_m, n_m, error_m, refined_m, distance2))
    return compared


def _odometry_rate(summary: dict[str, Any]) -> float | None:
    """Share of the frames that odometry registered; the first frame cannot be registered and does not count."""
    registered, frames = summary.get("odometry_frames"), summary.get("frames")
    if not isinstance(registered, int) or not isinstance(frames, int) or frames < 2:
        return None
    return min(1.0, registered / (frames - 1))


def _model_rate(summary: dict[str, Any]) -> float | None:
    """Share of the map matches, made or tried, for which the learned model ran."""
    matched_by = summary.get("matched_by")
    if not matched_by:
        return None
    return sum(count for by, count in matched_by.items() if not by.startswith(WEIGHTS_FREE)) / sum(matched_by.values())


def metrics(
    rows: list[Row], truth: dict[str, Truth], summary: dict[str, Any], truth_sigma_m: float | None
) -> dict[str, Any]:
    """Computes the metrics of evaluation.json. Raises EvaluationError if ``rows`` and ``truth`` share no file name."""
    compared = compare(rows, truth)
    if not compared:
        here, there = (rows[0].file if rows else "nothing"), next(iter(truth))
        raise EvaluationError(f"no frame in common: estimates have '{here}' ..., truth has '{there}' ...; same flight?")
    frames = len(compared)
    located = [c for c in compared if c.error_m is not None]
    errors_m = [c.error_m for c in compared if c.error_m is not None]
    refined_m = [c.refined_error_m for c in compared if c.refined_error_m is not None]
    nees = np.array([c.mahalanobis2 for c in located], dtype=np.float64)
    valid = nees[np.isfinite(nees)]
    times_ms = [r.process_ms for r in rows if r.process_ms is not None]
    result: dict[str, Any] = {"frames": frames, "localised": len(located)}
    result |= error_summary(errors_m, frames) | error_summary(refined_m, frames, "refined_")
    result |= {
        "ellipse95_coverage": coverage(nees),
        "mean_nees": float(np.mean(valid)) if len(valid) else None,
        "false_fixes": sum(c.is_false() for c in located),
        "anchor_rate": sum(c.row.anchor_age_ms == 0 for c in compared) / frames,
        "odometry_rate": _odometry_rate(summary),
        "model_rate": _model_rate(summary),
        "frame_ms_median": float(np.median(times_ms)) if times_ms else None,
        "frame_ms_p95": float(np.percentile(times_ms, 95)) if times_ms else None,
        # Additional to the specified metrics:
        "refined": len(refined_m),
        "frames_without_truth": len(rows) - frames,
        "covariance_invalid": len(located) - len(valid),
    }
    if truth_sigma_m is not None:
        inflated = [mahalanobis2(c.row, c.error_e_m or 0.0, c.error_n_m or 0.0, truth_sigma_m) for c in located]
        result["truth_sigma_m"] = truth_sigma_m
        result["ellipse95_coverage_with_truth_sigma"] = coverage(np.array(inflated))
    return {key: round(value, 6) if isinstance(value, float) else value for key, value in result.items()}


def finalised_metrics(rows: list[Row], truth: dict[str, Truth]) -> dict[str, Any]:
    """The same metrics of finalised.csv, where they are defined; every key begins with ``finalised``."""
    whole = metrics(rows, truth, {}, None)
    metric_names = ("median_m", "p95_m", "max_m", "ellipse95_coverage", "mean_nees", "false_fixes")
    names = [name for name in whole if name.startswith("within_") or name in metric_names]
    return {"finalised": whole["localised"], **{f"finalised_{name}": whole[name] for name in names}}


def truth_sigma_of(truth_path: Path) -> float | None:
    """Reads [truth] sigma_m of the flight.toml next to truth.csv; None when there is none."""
    try:
        table = read_toml(truth_path.parent / "flight.toml")
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError):
        return None
    section = table.get("truth")
    sigma_m = section.get("sigma_m") if isinstance(section, dict) else None
    return float(sigma_m) if isinstance(sigma_m, int | float) and sigma_m >= 0 else None


def read_summary(folder: Path) -> dict[str, Any]:
    """Reads summary.json; an empty dict when it does not exist."""
    path = folder / "summary.json"
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise EvaluationError(f"{path}: cannot be read ({error})") from None
    if not isinstance(summary, dict):
        raise EvaluationError(f"{path}: not a summary of a replay; run 'terrafix replay' again")
    return summary


def flight_rows(folder: Path) -> list[Row]:
    """-> the rows of estimates.csv, or of the record where there is none (a live run).

    Raises EvaluationError, SourceError."""
    if (folder / ESTIMATES).is_file() or not is_record(folder):
        return read_rows(folder / ESTIMATES)
    table = RowTable()
    result = ReadResult()
    for _, _, message in read_flight(folder, result):
        table.take(message)
    check_format(folder, result)
    return list(table.rows.values())


def evaluate(folder: Path, truth_path: Path, *, json_only: bool = False) -> dict[str, Any]:
    """Writes FOLDER/evaluation.json and prints it. Raises EvaluationError, OutputError."""
    rows = flight_rows(folder)
    truth = read_truth(truth_path)
    result = metrics(rows, truth, read_summary(folder), truth_sigma_of(truth_path))
    if (folder / FINALISED).is_file():
        result |= finalised_metrics(read_rows(folder / FINALISED), truth)
    text = json.dumps(result, indent=2, allow_nan=False)
    try:
        (folder / "evaluation.json").write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{folder / 'evaluation.json'}: cannot be written ({error.strerror})") from None
    if json_only:
        typer.echo(text)
    else:
        Console().print(_table(result, folder))
    return result


def _format(key: str, value: float | int | None) -> str:
    if value is None:
        return "-"
    if "within" in key or key.endswith("_rate") or "coverage" in key:
        return f"{100 * value:.1f} %"
    if key.endswith("_m"):
        return f"{value:.1f} m"
    if key.endswith(("_ms", "_median", "_p95")):
        return f"{value:.0f} ms"
    return f"{value:.2f}" if isinstance(value, float) else str(value)


def _table(result: dict[str, Any], folder: Path) -> Table:
    table = Table(title=f"{folder}: {result['localised']} of {result['frames']} frames localised", title_justify="left")
    table.add_column("")
    stages = [stage for stage in ("refined", "finalised") if stage == "refined" or stage in result]
    for stage in ("immediate", *stages):
        table.add_column(stage, justify="right")
    for key, value in result.items():
        if key.startswith(("refined_", "finalised")) or key in ("frames", "localised"):
            continue
        others = [f"{stage}_{key}" for stage in stages]
        table.add_row(
            WORDS.get(key, key), _format(key, value), *(_format(o, result[o]) if o in result else "" for o in others)
        )
    return table
