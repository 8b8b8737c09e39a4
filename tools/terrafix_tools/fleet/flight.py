"""One flight as a row of the table of flights and rows of the table of frames."""

import hashlib
import math
from collections import Counter
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from pyproj import Geod

from terrafix.core.gate import CHI2_95
from terrafix.messages import Origin, Verdict
from terrafix_tools.estimates import Row
from terrafix_tools.evaluate import read_summary
from terrafix_tools.flight_verdict import flight_verdict
from terrafix_tools.report.data import FlightView, ellipse95
from terrafix_tools.report.gather import read_record
from terrafix_tools.score import longest_gap_s

NS = 1_000_000_000
ID_DIGITS = 16  # hexadecimal; two of a million flights have the same ID with a probability of 3e-8
# Steps of the distance: shorter ones are mostly the noise of the estimate, of a vehicle that hovers in particular.
STEP_M = 5.0
SEASONS = ("winter", "spring", "summer", "autumn")  # meteorological: winter is December to February in the north
ACCEPTED, REFUSED = "accepted", "refused"
_GEOD = Geod(ellps="WGS84")


def flight_id(header: dict[str, Any], origin: Origin) -> str:
    """The same for every copy, part and later state of a record: from configuration, versions and origin, which all of
    its segments repeat, and which name vehicle, time and place of the start."""
    content = msgspec.json.encode([header["config"], header["versions"], origin], order="sorted")
    return hashlib.sha256(content).hexdigest()[:ID_DIGITS]


def flight_rows(record: Path, summaries: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """-> the row of the table of flights and those of the frames. ``record``: a file, or a folder of record files of
    one flight. ``summaries``: folder that has the summary.json of a replay, if there is one.

    Raises SourceError, EvaluationError."""
    table, _, view = read_record(record)
    origin = view.contents.origin
    assert origin is not None  # the caller has read it
    rows = list(table.rows.values())
    if not view.clocked:
        for row in rows:
            row.process_ms = None
    start = _start(view, origin)
    frames = [
        _frame(frame_id, row, view.map_verdict.get(frame_id), view, origin) for frame_id, row in table.rows.items()
    ]
    flight = {
        "start_utc": start,
        "season": None if start is None else season(start.month, origin.lat_deg),
        "duration_s": view.contents.duration_s,
        "live": view.clocked,
        "vehicle": _vehicle(view),
        "start_lat_deg": origin.lat_deg,
        "start_lon_deg": origin.lon_deg,
        **_map(view, summaries),
        **_camera(view, origin),
        **_software(view),
        **_navigation(rows, frames, view),
        **_record(view),
    }
    return flight, frames


def season(month: int, lat_deg: float) -> str:
    """``month``: 1 to 12."""
    north = month % 12 // 3
    return SEASONS[north if lat_deg >= 0 else (north + 2) % 4]


def distance_m(rows: list[Row]) -> float:
    """Length of the track over the ground, in steps of at least STEP_M."""
    total_m, last = 0.0, None
    for row in rows:
        if row.lat_deg is None or row.lon_deg is None:
            continue
        if last is None:
            last = row
            continue
        _, _, step_m = _GEOD.inv(last.lon_deg, last.lat_deg, row.lon_deg, row.lat_deg)
        if step_m >= STEP_M:
            total_m, last = total_m + step_m, row
    return total_m


def sigma_m(row: Row) -> float | None:
    """1-sigma along the larger axis of the stated horizontal covariance; None without a position."""
    axes = ellipse95(row)
    return None if axes is None else axes[0] / math.sqrt(CHI2_95)


def longest_without_fix_s(times_s: list[float], fixes_s: list[float]) -> float | None:
    """Longest time between two fixes, or between one and the first or last frame; None without a frame."""
    if not times_s:
        return None
    return longest_gap_s(fixes_s, times_s[0], times_s[-1])


def _start(view: FlightView, origin: Origin) -> datetime | None:
    """Time of day of the origin; None where no clock was plausible, as in a replay."""
    if view.contents.unix_offset_ns is None:
        return None
    return datetime.fromtimestamp((origin.t_ns + view.contents.unix_offset_ns) / NS, UTC)


def _frame(frame_id: int, row: Row, verdict: str | None, view: FlightView, origin: Origin) -> dict[str, Any]:
    offset_ns = view.contents.unix_offset_ns
    accepted = verdict == Verdict.ACCEPTED
    return {
        "frame": frame_id,
        "time_utc": None if offset_ns is None else round(row.t_s * 1e3 + offset_ns / 1e6),
        "t_s": round(row.t_s - origin.t_ns / NS, 6),
        "lat_deg": row.lat_deg,
        "lon_deg": row.lon_deg,
        "agl_m": row.agl_m,
        "sigma_m": sigma_m(row),
        "source": row.source_label or None,
        "verdict": None if verdict is None else ACCEPTED if accepted else REFUSED,
        "reason": None if accepted else verdict,
        "anchor_age_ms": row.anchor_age_ms,
        "latency_ms": row.process_ms,
    }


def _vehicle(view: FlightView) -> str | None:
    """Firmware and system ID of the autopilot; None without one."""
    link = view.link
    return f"{link.autopilot} {link.sysid}" if link is not None and link.autopilot not in ("", "none") else None


def _map(view: FlightView, summaries: Path) -> dict[str, Any]:
    """Only what summary or head of the record state: the file at the path of the map may be another one today."""
    stated = (read_summary(summaries).get("map"), view.header.get("map"), view.header["config"].get("map"))
    used = next((found for found in stated if isinstance(found, dict) and found), {})
    return {
        "map": Path(used.get("source") or used.get("path", "")).stem or None,
        "map_checksum": used.get("checksum") or None,
        "map_date": date.fromisoformat(used["date"]) if used.get("date") else None,
    }


def _camera(view: FlightView, origin: Origin) -> dict[str, Any]:
    camera = origin.camera
    named = Path(view.header["config"].get("source", {}).get("camera", "")).stem
    return {
        "camera": named or f"{camera.width} x {camera.height}, f {camera.fx:.0f} px",
        "camera_width_px": camera.width,
        "camera_height_px": camera.height,
        "camera_fx_px": camera.fx,
        "camera_focal_sigma": camera.focal_sigma,
    }


def _software(view: FlightView) -> dict[str, Any]:
    versions = view.header["versions"]
    config = msgspec.json.encode(view.header["config"], order="sorted")
    return {
        "version": versions.get("terrafix") or None,
        "git": versions.get("git") or None,
        "config_sha256": hashlib.sha256(config).hexdigest(),
    }


def _navigation(rows: list[Row], frames: list[dict[str, Any]], view: FlightView) -> dict[str, Any]:
    localised = [row for row in rows if row.localised]
    sigmas_m = [frame["sigma_m"] for frame in frames if frame["sigma_m"] is not None]
    heights_m = [frame["agl_m"] for frame in frames if frame["agl_m"] is not None]
    fixes_s = [frame["t_s"] for frame in frames if frame["verdict"] == ACCEPTED]
    refused = Counter(frame["reason"] for frame in frames if frame["verdict"] == REFUSED)
    verdict = flight_verdict(rows, [(fault.t_ns / NS, fault) for _, fault in view.faults], view.verdicts)
    return {
        "distance_m": distance_m(rows),
        "agl_median_m": float(np.median(heights_m)) if heights_m else None,
        "frames": len(rows),
        "localised": len(localised),
        "fixes": len(fixes_s),
        "refusals": refused.total(),
        "refused": sorted(refused.items()),
        "availability": len(localised) / len(rows) if rows else None,
        "trusted": verdict.share if rows else None,
        "sigma_median_m": float(np.median(sigmas_m)) if sigmas_m else None,
        "sigma_max_m": max(sigmas_m, default=None),
        "longest_without_fix_s": longest_without_fix_s([frame["t_s"] for frame in frames], fixes_s),
        "faults": sorted({fault.quantity for _, fault in view.faults if fault.active}),
    }


def _record(view: FlightView) -> dict[str, Any]:
    result = view.contents.result
    return {
        "dropped": view.dropped.total(),
        "messages": view.contents.counts.total(),
        "truncated": bool(result.truncated_files),
        "damaged": len(result.damaged),
        "undecodable": result.undecodable,
    }
