"""Lower sections of the report: time per frame, images, provenance."""

import json

import numpy as np

from terrafix_tools.before_after import HEADER, Change, kept_line
from terrafix_tools.pages.charts import HALF_WIDTH, Chart, clock
from terrafix_tools.pages.document import kit, macros
from terrafix_tools.pages.pictures import data_uri
from terrafix_tools.report.data import FlightView, radius95_m
from terrafix_tools.report.sections import LABELS

OWN = macros("terrafix_tools/report.html")
IMAGE_KEYS = {"satellite_anchored": "k-sat", "visual_propagated": "k-vis", "dead_reckoned": "k-dead"}
MAX_IMAGES = 8
BINS = 40


def finalised(view: FlightView) -> str:
    """What the smoother after landing has changed; empty where it did not run."""
    changes = [row for flight in view.finalised_flights for row in flight.get("before_after", [])]
    rows: list[list[object]] = [[*Change(**row).cells()] for row in changes]
    lines = [kit.line(line) for line in map(kept_line, view.finalised_flights) if line]
    return kit.section("Finalised after landing", "", *lines, kit.table(HEADER, rows)) if rows else ""


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
    return kit.section("Time per frame", timing_scope, kit.two(chart.svg("Histogram of times"), kit.facts(rows)))


def picture_rows(view: FlightView) -> list[int]:
    """Rows whose pictures are shown under "Camera images": evenly over the flight, and the one with the largest
    error."""
    count = len(view.rows)
    rows = sorted({round(k) for k in np.linspace(0, count - 1, min(MAX_IMAGES, count))})
    worst = _worst_row(view)
    if worst is not None and worst not in rows:
        if len(rows) > 2:
            rows.remove(min(rows[1:-1], key=lambda i: abs(i - worst)))
        rows.append(worst)
    return sorted(rows)


def _worst_row(view: FlightView) -> int | None:
    errors = [(error, i) for i, row in enumerate(view.rows) if (error := view.error_m(row)) is not None]
    return max(errors)[1] if errors else None


def camera_images(view: FlightView) -> str:
    """Returns a few frames, evenly over the flight, and the one with the largest error."""
    with_picture = [i for i, frame_id in enumerate(view.frame_ids[: len(view.rows)]) if frame_id in view.thumbnails]
    if not with_picture:
        return ""
    chosen = {min(with_picture, key=lambda i: abs(i - wanted)) for wanted in picture_rows(view)}
    worst = _worst_row(view)
    parts = []
    for i in sorted(chosen):
        row = view.rows[i]
        data = data_uri("image/jpeg", view.thumbnails[view.frame_ids[i]])
        error, radius = view.error_m(row), radius95_m(row)
        facts = (
            f"{error:.1f} m error" if error is not None else "",
            f"95 % radius {radius:.1f} m" if radius is not None else "",
            f"{row.agl_m:.0f} m high" if error is None and row.agl_m is not None else "",
        )
        about = ", ".join(fact for fact in facts if fact)
        source = LABELS.get(row.source_label, "") + (" (largest error)" if i == worst else "")
        parts.append(
            (i, row.file, data, IMAGE_KEYS.get(row.source_label, "k-none"), clock(round(row.t_s)), source, about)
        )
    return kit.section("Camera images", "Select an image to see its position on the map.", OWN.images(parts))


def provenance(view: FlightView) -> str:
    """Versions, map, what the source says of itself, and configuration."""
    versions = view.header.get("versions", {}) or view.summary.get("versions", {})
    rows = [(name, str(value)) for name, value in versions.items() if value]
    chart = view.summary.get("map", {})
    rows += [(f"map {key}", str(chart[key])) for key in ("path", "date", "gsd_m", "checksum") if chart.get(key)]
    rows += [(f"source, {topic}", text) for topic, text in view.header.get("source", [])]
    config = json.dumps(view.header.get("config", view.summary.get("config", {})), indent=2)
    about = kit.folded("Versions, map, source and configuration", kit.facts(rows), kit.pre(config))
    return kit.section("Provenance", "", about)
