"""An overlay as one HTML page without other files."""

import math
from typing import Any

from terrafix_tools.autopilot_log.text import clock_line, percent
from terrafix_tools.pages.charts import Band, Chart, Point, stamp, strips
from terrafix_tools.pages.document import Figure, kit

COLOURS = (
    ("claim", "k-sat"),
    ("age", "k-vis"),
    ("temperature", "k-dead"),
    ("refined", "k-good"),
)  # classes of line and key
NAME_WIDTH = 200  # SVG units for the name of a strip
MAX_GAP_S = 5.0  # a line has a gap where samples are further apart [tuned]
SPAN_COLOURS = ("f-accepted", "f-visual_propagated", "f-dead_reckoned", "f-good")  # of consecutive lanes, sets, modes
MIN_RATIO_AXIS = 1.2  # so that the gate is in the chart
CHARTS = (  # of innovations: title, unit, names
    ("Position", "m", ("position_n_m", "position_e_m", "position_d_m")),
    ("Velocity", "m/s", ("velocity_n_mps", "velocity_e_mps", "velocity_d_mps")),
    ("Magnetic field", "G", ("mag_x_gauss", "mag_y_gauss", "mag_z_gauss")),
    ("Yaw", "rad", ("yaw_rad",)),
)
AXES = {"n": "north", "e": "east", "d": "down", "x": "forward", "y": "right", "z": "down"}


def page(found: dict[str, Any]) -> str:
    """``found``: what ``overlay`` returns."""
    log = found["log"]
    name = log["path"].rsplit("/", 1)[-1]
    about = f"{log['kind']} · {log['firmware'] or 'unknown firmware'} · record {found['record']}"
    return kit.document(
        f"{name} - autopilot's log",
        "",
        kit.header("Terrafix, log of the autopilot on the time of a record", name, about),
        _figures(found),
        _events(found),
        _states(found),
        _ratios(found),
        _sent(found),
        _innovations(found),
        _receivers(found),
        _clock(found["clock"]),
    )


def _figures(found: dict[str, Any]) -> str:
    clock, ratios, sent = found["clock"], found["test_ratios"], found["sent_less_ekf"]
    tiles = [
        Figure(f"{found['to_s'] - found['from_s']:.0f}", "s", "of the record are in the log"),
        Figure(f"{1e3 * clock['offset_sigma_s']:.1f}", "ms", "standard error of the clocks' offset"),
        Figure(f"{clock['aligned_correlation']:.2f}", "", "correlation of the body rates"),
    ]
    if ratios:
        name, worst = max(ratios.items(), key=lambda item: item[1]["max"])
        mood = "good" if worst["max"] <= 1.0 else "bad"
        tiles.append(Figure(f"{worst['max']:.2f}", "", f"largest test ratio ({name})", mood))
    if sent is not None:
        tiles.append(Figure(f"{sent['median_m']:.1f}", "m", "GPS_INPUT from the EKF, median"))
    return kit.figures(tiles)


def _events(found: dict[str, Any]) -> str:
    rows = [(stamp(event["t_s"]), _event(event)) for event in found["events"]]
    return kit.section("Events", "", kit.timeline(rows)) if rows else kit.section("Events", "None.")


def _event(event: dict[str, Any]) -> str:
    """Its kind, unless the text begins with that: "mode: auto", "lane 0 -> 1"."""
    text, kind = str(event["text"]), str(event["kind"])
    return text if text.lower().startswith(kind) else f"{kind}: {text}"


def _states(found: dict[str, Any]) -> str:
    """Strips: receivers, what was fused, lanes, source sets, modes."""
    bands = [Band("mode", _coloured([(s["from_s"], s["to_s"], s["name"]) for s in found["modes"]]))]
    for receiver in found["gps"]:
        fixes = [
            (a, b, f"f-fix{min(3, int(fix))}" if fix > 0 else "f-fixnone", f"fix type {int(fix)}")
            for a, b, fix in receiver["fixes"]
        ]
        bands.append(Band(f"{receiver['name']} fix", fixes))
        if receiver["used_share"] is not None:
            bands.append(Band(f"{receiver['name']} used", [(a, b, "f-accepted", "used") for a, b in receiver["used"]]))
    for fusion in found["fused"]:
        bands.append(Band(f"EKF: {fusion['name']}", [(a, b, "f-accepted", "fused") for a, b in fusion["spans"]]))
    for title, key in (("lane", "lanes"), ("source set", "source_sets")):
        if found[key]:
            spans = [(s["from_s"], s["to_s"], str(s["value"])) for s in found[key]]
            bands.append(Band(title, _coloured(spans)))
    shown = [band for band in bands if band.name != "mode" or band.spans]
    if not shown:
        return ""
    return kit.section(
        "Receivers and what is fused",
        "Fix: green is 3D, orange 2D, red none. Used: what the autopilot has selected. EKF: what its primary core "
        "fuses or is. The pointer on a stretch shows its name.",
        kit.scroll(strips(shown, found["duration_s"], "Receivers and fusion", NAME_WIDTH)),
    )


def _coloured(spans: list[tuple[float, float, str]]) -> list[tuple[float, float, str, str]]:
    """One colour for each name."""
    names = list(dict.fromkeys(name for _, _, name in spans))
    return [(a, b, SPAN_COLOURS[names.index(name) % len(SPAN_COLOURS)], name) for a, b, name in spans]


def _ratios(found: dict[str, Any]) -> str:
    ratios = found["test_ratios"]
    if not ratios:
        return kit.section("Test ratios", "The log has none.")
    shown = [name for name in ("velocity", "position", "height", "mag") if name in ratios] or list(ratios)[:4]
    top = max(MIN_RATIO_AXIS, *(ratios[name]["max"] for name in shown))
    chart = Chart(found["duration_s"], 0.0, 1.1 * top, y_unit="", follow=False)
    chart.level(1.0, "gate")
    for name, (css, _) in zip(shown, COLOURS, strict=False):
        chart.line(_with_gaps(ratios[name]["series"]), css)
    rows = [
        [name, ratio["max"], f"{ratio['max_at_s']:.1f} s", f"{100 * ratio['above_gate_share']:.1f} %"]
        for name, ratio in ratios.items()
    ]
    return kit.section(
        "Test ratios",
        "Innovation over the limit of its gate, primary core: above 1 the EKF rejects the measurement.",
        _legend(shown),
        kit.scroll(chart.svg("Test ratios over time")),
        kit.table(["measurement", "largest", "at", "above the gate"], rows),
    )


def _innovations(found: dict[str, Any]) -> str:
    innovations = found["innovations"]
    parts = []
    for title, unit, names in CHARTS:
        shown = [name for name in names if name in innovations]
        if shown:
            series = [(name, innovations[name]["series"]) for name in shown]
            labels = [AXES.get(name.split("_")[1], "yaw") for name in shown]
            parts.append(kit.block(title, _legend(labels), _lines(found, series, unit, f"{title} innovations")))
    return kit.section("Innovations", "Of the primary core of the EKF." if parts else "The log has none.", *parts)


def _sent(found: dict[str, Any]) -> str:
    sent = found["sent_less_ekf"]
    if sent is None:
        return kit.section("GPS_INPUT against the EKF", "Nothing was sent, or the log has no position.")
    series = [(name, sent[f"{name}_m"]) for name in ("north", "east", "down")]
    return kit.section(
        "GPS_INPUT against the EKF",
        "Position that was sent less the position that the autopilot navigated by at that time. Horizontal distance: "
        f"median {sent['median_m']:.2f} m, 95 % {sent['p95_m']:.2f} m, at most {sent['max_m']:.2f} m "
        f"at {sent['max_at_s']:.1f} s.",
        _legend([name for name, _ in series]),
        _lines(found, series, "m", "GPS_INPUT less EKF"),
    )


def _lines(found: dict[str, Any], series: list[tuple[str, list[list[float]]]], unit: str, label: str) -> str:
    """Chart of up to four series about 0."""
    top = max((abs(value) for _, points in series for _, value in points), default=0.0) or 1.0
    chart = Chart(found["duration_s"], -1.1 * top, 1.1 * top, height=220, y_unit=unit, follow=False)
    chart.level(0.0)
    for (_, points), (css, _) in zip(series, COLOURS, strict=False):
        chart.line(_with_gaps(points), css)
    return kit.scroll(chart.svg(label))


def _with_gaps(points: list[list[float]]) -> list[Point]:
    found: list[Point] = []
    for t_s, value in points:
        if found and t_s - found[-1][0] > MAX_GAP_S:
            found.append((t_s, None))
        found.append((t_s, value))
    return found


def _legend(names: list[str]) -> str:
    return kit.legend((css, name) for name, (_, css) in zip(names, COLOURS, strict=False))


def _receivers(found: dict[str, Any]) -> str:
    rows = [
        [
            receiver["name"],
            receiver["samples"],
            percent(receiver["fix_3d_share"]),
            percent(receiver["used_share"]),
            _number(receiver["satellites_median"], ""),
            _number(receiver["accuracy_median_m"], " m"),
        ]
        for receiver in found["gps"]
    ]
    columns = ["receiver", "samples", "3D fix", "used", "satellites, median", "stated accuracy, median"]
    return kit.section("Receivers", "", kit.table(columns, rows)) if rows else ""


def _number(value: float | None, unit: str) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.3g}{unit}"


def _clock(about: dict[str, Any]) -> str:
    return kit.section(
        "Clocks",
        f"{clock_line(about).removeprefix('clocks: ')}. Line through the offsets of {about['windows']} windows, which "
        f"scatter by {1e3 * about['scatter_s']:.1f} ms; the attitudes differ by {about['attitude_deg']:.2f} degrees "
        "(median).",
    )
