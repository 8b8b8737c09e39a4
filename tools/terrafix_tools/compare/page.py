"""A comparison as one HTML page without other files."""

from typing import Any

from terrafix_tools.compare.text import divergence, summary
from terrafix_tools.pages.charts import Chart, Point, stamp
from terrafix_tools.pages.document import kit

MIN_DISTANCE_M = 0.01  # height of the chart where the positions are equal


def page(comparison: dict[str, Any], distances_m: list[tuple[float, float]]) -> str:
    """``distances_m``: (time [s], distance of the two positions [m]) of each frame."""
    a, b = (comparison[name]["path"] for name in ("a", "b"))
    return kit.document(
        f"{a} and {b}",
        "",
        kit.header("Terrafix, two records of one flight", _verdict(comparison), f"A: {a} · B: {b}"),
        _distances(comparison, distances_m),
        _differences(comparison),
        _messages(comparison),
        _verdicts(comparison),
        _delays(comparison),
        _changes(comparison),
    )


def _verdict(comparison: dict[str, Any]) -> str:
    lines = list(summary(comparison))
    return "; ".join(lines[: 3 if comparison["first_verdict"] else 2])


def _distances(comparison: dict[str, Any], distances_m: list[tuple[float, float]]) -> str:
    if not distances_m:
        return kit.section("Distance of the positions", "No frame has a position in both.")
    top = max(MIN_DISTANCE_M, max(metres for _, metres in distances_m))
    chart = Chart(x_max=max(t for t, _ in distances_m), y_min=0.0, y_max=1.1 * top, height=240, follow=False)
    points: list[Point] = list(distances_m)
    chart.line(points, "error")
    first = comparison["first"]
    if first is not None:
        chart.vertical_line(max(0.0, first["t_s"]), "first difference")
    return kit.section(
        "Distance of the positions",
        "Horizontal, between the last estimates of each frame.",
        kit.scroll(chart.svg("Distance of the positions over time")),
    )


def _differences(comparison: dict[str, Any]) -> str:
    if comparison["equal"]:
        return ""
    rows = ((stamp(found["t_s"]), divergence(found)) for found in comparison["first_of_each_message"])
    return kit.section("First difference of each message", "", kit.timeline(rows))


def _messages(comparison: dict[str, Any]) -> str:
    rows = [[kind, *count.values()] for kind, count in comparison["messages"].items()]
    return kit.section("Messages", "", kit.table(["message", "equal", "different", "only in A", "only in B"], rows))


def _verdicts(comparison: dict[str, Any]) -> str:
    rows = [[f"{row['measurement']}: {row['verdict']}", row["a"], row["b"]] for row in comparison["verdicts"]]
    return kit.section("Verdicts", "", kit.table(["measurement", "A", "B"], rows)) if rows else ""


def _delays(comparison: dict[str, Any]) -> str:
    found = comparison["delay_ms"]
    known = [delays for delays in found.values() if delays is not None]
    if not known:
        return ""
    rows = [[p, *((found[x] or {}).get(p) for x in ("a", "b"))] for p in known[0]]
    return kit.section(
        "Timing",
        "From the exposure of a frame to the publication of its last estimate, ms. A replay has no clock: 0.",
        kit.table(["percentile", "A", "B"], rows),
    )


def _changes(comparison: dict[str, Any]) -> str:
    rows = [
        [f"{what}: {change['name']}", change["a"], change["b"]]
        for what in ("configuration", "versions")
        for change in comparison[what]
    ]
    return kit.section("Configuration and versions", "", kit.table(["name", "A", "B"], rows)) if rows else ""
