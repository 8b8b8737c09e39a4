"""Key figures of the report, and its list of events as text."""

import math
from dataclasses import dataclass, replace

import numpy as np

from terrafix.link.pilot_text.statustext import fault_text
from terrafix_tools.flight_verdict import FlightVerdict, flight_verdict
from terrafix_tools.lens_report import lens_words
from terrafix_tools.pages.document import Figure
from terrafix_tools.report.data import FlightView, radius95_m

GAP_S = 0.245  # AC-14: an autopilot may notice a longer interval
FIX_3D = 3
UNPLANNED = ("died", "stuck", "gave_up")


@dataclass(frozen=True)
class GpsStats:
    count: int
    rate_hz: float
    interval_p99_s: float
    longest_s: float
    longest_at_s: float
    share_3d: float
    gaps: int


def gps_stats(view: FlightView) -> GpsStats | None:
    """Statistics of GPS_INPUT; None when the record has none."""
    if len(view.gps) < 2:
        return None
    times = np.array([t for t, _ in view.gps])
    steps = np.diff(times)
    worst = int(np.argmax(steps))
    return GpsStats(
        count=len(times),
        rate_hz=(len(times) - 1) / max(float(times[-1] - times[0]), 1e-9),
        interval_p99_s=float(np.percentile(steps, 99)),
        longest_s=float(steps[worst]),
        longest_at_s=float(times[worst]),
        share_3d=sum(g.fix_type >= FIX_3D for _, g in view.gps) / len(view.gps),
        gaps=int((steps > GAP_S).sum()),
    )


def figures(view: FlightView) -> list[Figure]:
    """Returns six to eight figures: errors when there is ground truth, otherwise reported accuracy."""
    times_ms = [r.process_ms for r in view.rows if r.process_ms is not None]
    located = sum(r.localised for r in view.rows)
    shown = [_share("frames localised", located / len(view.rows), 0.99, 0.9)]
    if (metrics := view.evaluation) is not None:
        shown += [
            _share("within 20 m", metrics["within_20m"], 0.8, 0.6),
            _share("within 50 m", metrics["within_50m"], 0.95, 0.8),
        ]
        if metrics["median_m"] is not None:
            shown.append(Figure(f"{metrics['median_m']:.1f}", "m", "median error"))
            coverage = metrics["ellipse95_coverage"]
            mood = "good" if coverage >= 0.9 else "fair" if coverage > 0.85 else "bad"
            shown.append(Figure(f"{100 * coverage:.0f}", "%", "truth inside the 95 % ellipse", mood))
        false = metrics["false_fixes"]
        shown.append(Figure(str(false), "", "false fixes over 50 m", "good" if false == 0 else "bad"))
    else:
        radii = [r for row in view.rows if (r := radius95_m(row)) is not None]
        if radii:
            shown.append(Figure(f"{np.median(radii):.1f}", "m", "reported 95 % radius, median"))
            shown.append(Figure(f"{max(radii):.0f}", "m", "reported 95 % radius, worst"))
    if times_ms:
        name = "delay of an estimate, median" if view.live else "per frame, median"
        shown.append(Figure(f"{np.median(times_ms):.0f}", "ms", name))
    if (gps := gps_stats(view)) is not None:
        shown.append(_share("GPS_INPUT with a 3D fix", gps.share_3d, 0.9, 0.5))
        mood = "good" if gps.longest_s <= GAP_S else "fair" if gps.longest_s <= 2.0 else "bad"
        shown.append(Figure(f"{1000 * gps.longest_s:.0f}", "ms", "longest GPS_INPUT gap", mood))
    return shown


def verdict_of(view: FlightView) -> FlightVerdict:
    """The verdict on the whole flight, with the likely cause of the replay where there is one."""
    verdict = flight_verdict(view.rows, view.faults, view.verdicts)
    cause = view.summary.get("verdict", {}).get("cause", "") if verdict.cause else ""
    return replace(verdict, cause=cause) if cause else verdict


def _share(name: str, value: float, good: float, fair: float) -> Figure:
    digits = 0 if value in (0.0, 1.0) else 1
    return Figure(
        f"{100 * value:.{digits}f}", "%", name, "good" if value >= good else "fair" if value >= fair else "bad"
    )


def events(view: FlightView) -> list[tuple[float | None, str]]:
    """Returns (time or None, sentence), in order of time; events without time come last."""
    entries: list[tuple[float | None, str]] = []
    entries += _positions(view) + _anchors(view) + _errors(view) + _gps(view)
    entries += [(t_s, f"{fault_text(fault).capitalize()}: {fault.detail}.") for t_s, fault in view.faults]
    lens = lens_words(view.origin.camera, view.calibration) if view.origin and view.calibration else None
    if lens is not None:
        entries.append((None, lens))
    entries += [(None, f"Camera: {words}.") for words in view.camera_times.words()]
    for t_s, event in view.events:
        if event.event in UNPLANNED or event.event == "restarted":
            detail = f" ({event.detail})" if event.detail else ""
            entries.append((t_s, f"Process {event.process}: {event.event.replace('_', ' ')}{detail}."))
    if view.dropped:
        total = sum(view.dropped.values())
        worst = ", ".join(name for name, _ in view.dropped.most_common(3))
        were = "message was" if total == 1 else "messages were"
        entries.append((None, f"{total} {were} dropped ({worst})."))
    if view.cut_off:
        entries.append((None, f"{view.cut_off} file(s) of the record are truncated; their readable part is shown."))
    if damaged := view.contents.result.damaged:
        entries.append((None, f"{len(damaged)} damaged part(s) of the record were left out: {damaged[0]}."))
    return sorted(entries, key=lambda m: math.inf if m[0] is None else m[0])


def _positions(view: FlightView) -> list[tuple[float | None, str]]:
    first = next((row for row in view.rows if row.localised), None)
    if first is None:
        return [(None, "No frame was localised.")]
    entries: list[tuple[float | None, str]] = [(first.t_s, "First position.")]
    empty = [row for row in view.rows if not row.localised]
    if empty:
        entries.append((empty[0].t_s, f"{len(empty)} of {len(view.rows)} frames have no position; this is the first."))
    return entries


def _anchors(view: FlightView) -> list[tuple[float | None, str]]:
    first = next((row for row in view.rows if row.anchor_age_ms is not None and row.anchor_age_ms >= 0), None)
    if first is None:
        return [(None, "No map match was accepted: every position is propagated from the start.")]
    entries: list[tuple[float | None, str]] = [(first.t_s, "First accepted map match.")]
    oldest = max(view.rows, key=lambda row: row.anchor_age_ms or 0)
    if (oldest.anchor_age_ms or 0) > 2000:
        age_s = (oldest.anchor_age_ms or 0) / 1000
        begin_s = max(0.0, oldest.t_s - age_s)
        entries.append((begin_s, f"Start of the longest interval without a map match: {age_s:.1f} s."))
    return entries


def _errors(view: FlightView) -> list[tuple[float | None, str]]:
    known = [(error, row) for row in view.rows if (error := view.error_m(row)) is not None]
    if not known:
        return []
    error, row = max(known, key=lambda pair: pair[0])
    radius = radius95_m(row)
    claim = f", reported 95 % radius {radius:.1f} m" if radius is not None else ""
    return [(row.t_s, f"Largest error: {error:.1f} m{claim} ({row.source_label.replace('_', ' ')}).")]


def _gps(view: FlightView) -> list[tuple[float | None, str]]:
    entries: list[tuple[float | None, str]] = []
    stats = gps_stats(view)
    if stats is not None and stats.longest_s > GAP_S:
        entries.append((stats.longest_at_s, f"Longest GPS_INPUT gap: {stats.longest_s:.2f} s."))
    first = next((t for t, g in view.gps if g.fix_type >= FIX_3D), None)
    if first is not None:
        entries.append((first, "First GPS_INPUT with a 3D fix."))
    corrected = [(t, math.hypot(*g.map_offset_m)) for t, g in view.gps if any(g.map_offset_m)]
    if corrected:
        max_m = max(off_m for _, off_m in corrected)
        text = f"GPS_INPUT is corrected for the map offset estimated from a trusted receiver, by {max_m:.1f} m at most."
        entries.append((corrected[0][0], text + " Estimates are not corrected."))
    return entries
