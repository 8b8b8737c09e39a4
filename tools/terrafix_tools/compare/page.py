"""A comparison as one HTML page without other files."""

from html import escape
from typing import Any

from terrafix_tools.compare.text import divergence, summary
from terrafix_tools.report.charts import Chart, Point, clock
from terrafix_tools.report.document import document, table

MIN_DISTANCE_M = 0.01  # height of the chart where the positions are equal


def page(comparison: dict[str, Any], distances_m: list[tuple[float, float]]) -> str:
    """``distances_m``: (time [s], distance of the two positions [m]) of each frame."""
    a, b = (escape(comparison[name]["path"]) for name in ("a", "b"))
    verdict = next(summary(comparison))
    return document(
        f"{comparison['a']['path']} and {comparison['b']['path']}",
        f'<header><div class="eyebrow">Terrafix, two records of one flight</div><h1>{escape(verdict)}</h1>'
        f"<p>A: {a} · B: {b}</p></header>"
        f"{_distances(comparison, distances_m)}{_differences(comparison)}{_messages(comparison)}"
        f"{_verdicts(comparison)}{_delays(comparison)}{_changes(comparison)}",
    )


def _distances(comparison: dict[str, Any], distances_m: list[tuple[float, float]]) -> str:
    if not distances_m:
        return "<h2>Distance of the positions</h2><p>No frame has a position in both.</p>"
    top = max(MIN_DISTANCE_M, max(metres for _, metres in distances_m))
    chart = Chart(x_max=max(t for t, _ in distances_m), y_min=0.0, y_max=1.1 * top, height=240, follow=False)
    points: list[Point] = list(distances_m)
    chart.line(points, "error")
    first = comparison["first"]
    if first is not None:
        chart.vertical_line(first["t_s"], "first difference")
    return (
        '<h2>Distance of the positions</h2><p class="lead">Horizontal, between the last estimates of each frame.</p>'
        f'<div class="scroll">{chart.svg("Distance of the positions over time")}</div>'
    )


def _differences(comparison: dict[str, Any]) -> str:
    if comparison["equal"]:
        return ""
    items = "".join(
        f"<li><time>{clock(round(found['t_s']))}</time><span>{escape(divergence(found))}</span></li>"
        for found in comparison["first_of_each_message"]
    )
    return f'<h2>First difference of each message</h2><ol class="moments">{items}</ol>'


def _messages(comparison: dict[str, Any]) -> str:
    rows = [[kind, *count.values()] for kind, count in comparison["messages"].items()]
    return f"<h2>Messages</h2>{table(['message', 'equal', 'different', 'only in A', 'only in B'], rows)}"


def _verdicts(comparison: dict[str, Any]) -> str:
    rows = [[f"{row['measurement']}: {row['verdict']}", row["a"], row["b"]] for row in comparison["verdicts"]]
    return f"<h2>Verdicts</h2>{table(['measurement', 'A', 'B'], rows)}" if rows else ""


def _delays(comparison: dict[str, Any]) -> str:
    found = comparison["delay_ms"]
    known = [delays for delays in found.values() if delays is not None]
    if not known:
        return ""
    rows = [[p, *((found[x] or {}).get(p) for x in ("a", "b"))] for p in known[0]]
    return (
        '<h2>Timing</h2><p class="lead">From the exposure of a frame to the publication of its last estimate, ms. '
        f"A replay has no clock: 0.</p>{table(['percentile', 'A', 'B'], rows)}"
    )


def _changes(comparison: dict[str, Any]) -> str:
    rows = [
        [f"{what}: {change['name']}", change["a"], change["b"]]
        for what in ("configuration", "versions")
        for change in comparison[what]
    ]
    return f"<h2>Configuration and versions</h2>{table(['name', 'A', 'B'], rows)}" if rows else ""
