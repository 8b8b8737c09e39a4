"""Lower sections of the report: time per frame, autopilot link, images, provenance."""

import base64
import json
import re
from collections import Counter
from html import escape
from itertools import pairwise
from typing import Any

import numpy as np

from terrafix_tools.report.charts import HALF_WIDTH, Band, Chart, Point, clock, strips
from terrafix_tools.report.data import FlightView, radius95_m
from terrafix_tools.report.sections import LABELS, end_s, spans, table
from terrafix_tools.report.text import FIX_3D, GAP_S, UNPLANNED, gps_stats

MAX_IMAGES = 8
NUMBER = re.compile(r"\d+(\.\d+)?")  # reasons that differ only in their numbers are counted together
BINS = 40


def timing(view: FlightView) -> str:
    times = np.array([r.process_ms for r in view.rows if r.process_ms is not None])
    if len(times) == 0:
        return ""
    median, p95, top = float(np.median(times)), float(np.percentile(times, 95)), float(times.max())
    edges = np.linspace(0.0, max(top, 1.0) * 1.02, BINS + 1)
    counts, _ = np.histogram(times, edges)
    chart = Chart(
        x_max=float(edges[-1]),
        y_min=0.0,
        y_max=float(counts.max()) * 1.18,
        height=240,
        width=HALF_WIDTH,
        x_unit="ms",
        y_unit="",
        follow=False,
    )
    for low, high, count in zip(edges[:-1], edges[1:], counts, strict=True):
        if count:
            chart.bar(float(low), float(high), float(count), "", f"{low:.0f} to {high:.0f} ms: {count} frames")
    chart.vertical_line(median, f"median {median:.0f}")
    chart.vertical_line(p95, f"95 % {p95:.0f}", row=1)
    timing_scope = (
        "From the exposure to the estimate, in the live processes."
        if view.live
        else "From the file to the estimate: decoding, odometry, map match and graph in sequence."
    )
    rows = [("median", f"{median:.0f} ms"), ("95 % below", f"{p95:.0f} ms"), ("slowest", f"{top:.0f} ms")]
    if "peak_memory_mb" in view.summary:
        rows.append(("peak memory", f"{view.summary['peak_memory_mb']:.0f} MB"))
    if "wall_s" in view.summary:
        rows.append(("whole replay", clock(round(view.summary["wall_s"]))))
    return (
        f'<h2>Time per frame</h2><p class="lead">{timing_scope}</p><div class="two">'
        f"<div>{chart.svg('Histogram of times')}</div><div>{table(rows)}</div></div>"
    )


def link(view: FlightView) -> str:
    """GPS_INPUT as sent to the autopilot, and process events."""
    stats = gps_stats(view)
    if stats is None and not view.events:
        return ""
    end = end_s(view)
    parts = ['<h2>Autopilot link and processes</h2><p class="lead">GPS_INPUT messages as sent: fix type, ']
    parts.append(f"interval, and process events. An interval over {1000 * GAP_S:.0f} ms is a gap.</p>")
    bands: list[Band] = []
    if stats is not None:
        fixes = _fixes(view)
        bands.append(
            Band(
                "fix type", spans(fixes, end, "f-fix", {"1": "no fix", "2": "2D fix", "3": "3D fix", "": "no message"})
            )
        )
    by_process: dict[str, list[tuple[float, float, str, str]]] = {}
    for t_s, event in view.events:
        css = "f-bad" if event.event in UNPLANNED else "f-good"
        text = f"{clock(round(max(0, t_s)))}  {event.process} {event.event.replace('_', ' ')} {event.detail}".strip()
        by_process.setdefault(event.process, []).append((t_s, t_s + end * 0.004, css, text))
    bands += [Band(name, spans) for name, spans in by_process.items()]
    parts.append(f'<div class="scroll">{strips(bands, end, "Link and processes over time")}</div>')
    if stats is not None:
        parts.append(_intervals(view, end))
        given = [g.no_fix_reason for _, g in view.gps if g.fix_type < FIX_3D and g.no_fix_reason]
        reasons = Counter(NUMBER.sub("…", reason) for reason in given)
        rows = [
            ("messages", f"{stats.count}"),
            ("rate", f"{stats.rate_hz:.2f} Hz"),
            ("with a 3D fix", f"{100 * stats.share_3d:.1f} %"),
            ("99 % of intervals below", f"{1000 * stats.interval_p99_s:.0f} ms"),
            ("longest gap", f"{1000 * stats.longest_s:.0f} ms at {clock(round(max(0.0, stats.longest_at_s)))}"),
            ("gaps", str(stats.gaps)),
        ]
        rows += [(f"no 3D fix: {reason}", f"{count}") for reason, count in reasons.most_common(6)]
        received = [
            (k.replace("_", " "), f"{round(v, 3):g}" if isinstance(v, float) else str(v))
            for k, v in _scalars(view.peer)
        ]
        second = f"<div><h3>Received by the autopilot</h3>{table(received)}</div>" if received else ""
        parts.append(f'<div class="two" style="margin-top:24px"><div><h3>Sent</h3>{table(rows)}</div>{second}</div>')
    if view.pilot_texts:
        texts = [(clock(round(max(0.0, t))), text.text) for t, text in view.pilot_texts[:40]]
        parts.append(
            f"<details><summary>Texts to the pilot ({len(view.pilot_texts)})</summary>{table(texts)}</details>"
        )
    return "".join(parts)


def _fixes(view: FlightView) -> list[tuple[float, str]]:
    """Returns (time, "1".."3" or "" from where a gap becomes noticeable)."""
    fixes: list[tuple[float, str]] = []
    for t_s, sent in view.gps:
        if fixes and t_s - fixes[-1][0] > GAP_S:
            fixes.append((fixes[-1][0] + GAP_S, ""))
        fixes.append((t_s, str(min(3, max(1, sent.fix_type)))))
    return fixes


def _intervals(view: FlightView, end: float) -> str:
    times = [t for t, _ in view.gps]
    steps: list[Point] = [(b, 1000 * (b - a)) for a, b in pairwise(times)]
    top = max(v for _, v in steps if v is not None)
    chart = Chart(x_max=end, y_min=20.0, y_max=max(300.0, top * 1.2), height=170, log_y=True, y_unit="ms")
    chart.level(1000 * GAP_S, f"{1000 * GAP_S:.0f} ms")
    chart.line(steps, "error")
    return f'<div class="scroll" style="margin-top:18px">{chart.svg("Interval of GPS_INPUT")}</div>'


def camera_images(view: FlightView) -> str:
    """Returns a few frames, evenly over the flight, and the one with the largest error."""
    with_thumbnail = [
        (i, row) for i, row in enumerate(view.rows) if i < len(view.frame_ids) and view.frame_ids[i] in view.thumbnails
    ]
    if not with_thumbnail:
        return ""
    chosen = {
        with_thumbnail[round(k)][0]
        for k in np.linspace(0, len(with_thumbnail) - 1, min(MAX_IMAGES, len(with_thumbnail)))
    }
    with_error = [(error, i) for i, row in with_thumbnail if (error := view.error_m(row)) is not None]
    worst = max(with_error)[1] if with_error else None
    if worst is not None and worst not in chosen and len(chosen) > 2:
        chosen.discard(min(sorted(chosen)[1:-1], key=lambda i: abs(i - worst)))
        chosen.add(worst)
    parts = []
    for i in sorted(chosen):
        row = view.rows[i]
        data = base64.b64encode(view.thumbnails[view.frame_ids[i]]).decode()
        error, radius = view.error_m(row), radius95_m(row)
        facts = [
            f"{error:.1f} m error" if error is not None else "",
            f"95 % radius {radius:.1f} m" if radius is not None else "",
            f"{row.agl_m:.0f} m high" if error is None and row.agl_m is not None else "",
        ]
        colour = {"satellite_anchored": "sat", "visual_propagated": "vis", "dead_reckoned": "dead"}.get(
            row.source_label, "none"
        )
        parts.append(
            f'<figure data-i="{i}"><img alt="{escape(row.file)}" loading="lazy" src="data:image/jpeg;base64,{data}">'
            f'<figcaption><i class="k-{colour}"></i><b>{clock(round(row.t_s))}</b> {LABELS.get(row.source_label, "")}'
            f"{' (largest error)' if i == worst else ''}<br>{', '.join(f for f in facts if f)}</figcaption></figure>"
        )
    return (
        '<h2>Camera images</h2><p class="lead">Select an image to see its position on the map.</p>'
        f'<div class="strip">{"".join(parts)}</div>'
    )


def provenance(view: FlightView) -> str:
    """Versions, map and configuration."""
    versions = view.header.get("versions", {}) or view.summary.get("versions", {})
    rows = [(name, str(value)) for name, value in versions.items() if value]
    chart = view.summary.get("map", {})
    rows += [(f"map {key}", str(chart[key])) for key in ("path", "date", "gsd_m", "checksum") if chart.get(key)]
    config = json.dumps(view.header.get("config", view.summary.get("config", {})), indent=2)
    return (
        f"<h2>Provenance</h2><details><summary>Versions, map and configuration</summary>{table(rows)}"
        f"<pre>{escape(config)}</pre></details>"
    )


def _scalars(peer: dict[str, Any]) -> list[tuple[str, Any]]:
    return [(k, v) for k, v in peer.items() if isinstance(v, int | float | str) and not isinstance(v, bool)]
