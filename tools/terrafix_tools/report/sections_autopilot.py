"""GPS_INPUT as sent, and what the autopilot's EKF did with it, over one time axis."""

import math
import re
from collections import Counter
from itertools import pairwise
from typing import Any

from terrafix.core.geodesy import LocalFrame
from terrafix_tools.pages.charts import Band, Chart, Point, stamp, strips
from terrafix_tools.pages.document import kit
from terrafix_tools.report.data import FlightView
from terrafix_tools.report.sections import end_s, spans
from terrafix_tools.report.text import FIX_3D, GAP_S, gps_stats

NUMBER = re.compile(r"\d+(\.\d+)?")  # reasons that differ only in their numbers are counted together
RATIO_FLOOR = 1e-2
MAX_TEXTS = 40
FIXES = {"1": "no fix", "2": "2D fix", "3": "3D fix", "": "no message"}
EKF_ATTITUDE, EKF_VELOCITY_HORIZ, EKF_POS_HORIZ_ABS, EKF_CONST_POS_MODE = 1, 2, 16, 128  # [spec: EKF_STATUS_FLAGS]
# Rows of flags: name, flag, state that is good.
FLAGS = [
    ("position", EKF_POS_HORIZ_ABS, True),
    ("velocity", EKF_VELOCITY_HORIZ, True),
    ("attitude", EKF_ATTITUDE, True),
    ("aided", EKF_CONST_POS_MODE, False),
]


def link(view: FlightView) -> str:
    """GPS_INPUT messages as sent, and the states of the autopilot's EKF."""
    stats = gps_stats(view)
    if stats is None and not view.ekf:
        return ""
    end = end_s(view)
    bands = [Band("fix type", spans(_fixes(view), end, "f-fix", FIXES))] if stats is not None else []
    if view.link_states:
        states = [(t, "good" if state.connected else "bad") for t, state in view.link_states]
        bands.append(Band("link", spans(states, end, "f-", {"good": "connected", "bad": "not connected"})))
    bands += _flag_bands(view, end)
    sent = [] if stats is None else [_accuracies(view, end), _jumps(view, end), _intervals(view, end)]
    return kit.section(
        "GPS_INPUT and the autopilot",
        "Above what was sent, below what the EKF of the autopilot reports of it (its horizontal position and velocity, "
        "its attitude, whether any sensor aids it), over the same time. "
        f"An interval over {1000 * GAP_S:.0f} ms is a gap.",
        kit.scroll(strips(bands, end, "Link over time"), *sent, _ratios(view, end)),
        _tables(view),
        _texts(view),
    )


def _fixes(view: FlightView) -> list[tuple[float, str]]:
    """Returns (time, "1".."3" or "" from where a gap becomes noticeable)."""
    fixes: list[tuple[float, str]] = []
    for t_s, sent in view.gps:
        if fixes and t_s - fixes[-1][0] > GAP_S:
            fixes.append((fixes[-1][0] + GAP_S, ""))
        fixes.append((t_s, str(min(3, max(1, sent.fix_type)))))
    return fixes


def _flag_bands(view: FlightView, end: float) -> list[Band]:
    if not view.ekf:
        return []
    bands = []
    for name, flag, good in FLAGS:
        states = [(t, "good" if bool(status.flags & flag) == good else "bad") for t, status in view.ekf]
        labels = {"good": f"{name} of the EKF: good", "bad": f"{name} of the EKF: not good"}
        bands.append(Band(name, spans(states, end, "f-", labels)))
    return bands


def _accuracies(view: FlightView, end: float) -> str:
    """Stated accuracies while there is a fix."""
    fixed = [(t, sent if sent.fix_type >= FIX_3D else None) for t, sent in view.gps]
    series: list[tuple[str, list[Point]]] = [
        ("claim", [(t, sent.horiz_accuracy_m if sent else None) for t, sent in fixed]),
        ("refined", [(t, sent.vert_accuracy_m if sent else None) for t, sent in fixed]),
    ]
    values = [value for _, points in series for _, value in points if value is not None]
    if not values:
        return ""
    chart = Chart(x_max=end, y_min=0.0, y_max=1.15 * max(values), height=150)
    for css, points in series:
        chart.line(points, css)
    keys = [("k-sat", "horizontal accuracy sent"), ("k-good", "vertical accuracy sent")]
    return kit.block("Accuracy sent", chart.svg("Accuracy sent over time"), kit.legend(keys))


def _jumps(view: FlightView, end: float) -> str:
    """What the EKF sees as a jump: the step from message to message that the velocity sent does not explain."""
    first = next((sent for _, sent in view.gps if sent.fix_type >= FIX_3D), None)
    if first is None:
        return ""
    frame = LocalFrame(first.lat_deg, first.lon_deg)
    points: list[Point] = []
    for (t0, a), (t1, b) in pairwise(view.gps):
        if min(a.fix_type, b.fix_type) < FIX_3D or t1 - t0 > 10 * GAP_S:
            points.append((t1, None))
            continue
        (e0, n0), (e1, n1) = frame.to_local(a.lat_deg, a.lon_deg), frame.to_local(b.lat_deg, b.lon_deg)
        points.append((t1, math.hypot(e1 - e0 - a.ve_mps * (t1 - t0), n1 - n0 - a.vn_mps * (t1 - t0))))
    largest = max((v for _, v in points if v is not None), default=0.0)
    chart = Chart(x_max=end, y_min=0.0, y_max=max(0.5, 1.15 * largest), height=130)
    chart.line(points, "age")
    return kit.block("Steps of the position beyond the velocity sent", chart.svg("Steps of the position sent"))


def _intervals(view: FlightView, end: float) -> str:
    times = [t for t, _ in view.gps]
    steps: list[Point] = [(b, 1000 * (b - a)) for a, b in pairwise(times)]
    top = max(v for _, v in steps if v is not None)
    chart = Chart(x_max=end, y_min=20.0, y_max=max(300.0, top * 1.2), height=150, log_y=True, y_unit="ms")
    chart.level(1000 * GAP_S, f"{1000 * GAP_S:.0f} ms")
    chart.line(steps, "error")
    return kit.block("Interval between messages", chart.svg("Interval of GPS_INPUT"))


def _ratios(view: FlightView, end: float) -> str:
    """Innovations of the EKF over its gates, as it reports them."""
    if not view.ekf:
        return ""
    positions: list[Point] = [(t, status.position_ratio) for t, status in view.ekf]
    velocities: list[Point] = [(t, status.velocity_ratio) for t, status in view.ekf]
    top = max(v for _, v in positions + velocities if v is not None)
    chart = Chart(x_max=end, y_min=RATIO_FLOOR, y_max=max(2.0, 1.3 * top), height=170, log_y=True, y_unit="")
    chart.level(1.0, "gate of the EKF")
    chart.line(velocities, "age")
    chart.line(positions, "error")
    keys = [("k-ink", "position"), ("k-vis", "velocity")]
    return kit.block("Test ratios of the EKF", chart.svg("Test ratios of the EKF over time"), kit.legend(keys))


def _tables(view: FlightView) -> str:
    stats = gps_stats(view)
    sent, used = [], []
    if stats is not None:
        given = [g.no_fix_reason for _, g in view.gps if g.fix_type < FIX_3D and g.no_fix_reason]
        reasons = Counter(NUMBER.sub("…", reason) for reason in given)
        sent = [
            ("messages", f"{stats.count}"),
            ("rate", f"{stats.rate_hz:.2f} Hz"),
            ("with a 3D fix", f"{100 * stats.share_3d:.1f} %"),
            ("99 % of intervals below", f"{1000 * stats.interval_p99_s:.0f} ms"),
            ("longest gap", f"{1000 * stats.longest_s:.0f} ms at {stamp(stats.longest_at_s)}"),
            ("gaps", str(stats.gaps)),
        ]
        sent += [(f"no 3D fix: {reason}", f"{count}") for reason, count in reasons.most_common(6)]
    if view.ekf:
        count = len(view.ekf)
        position = sum(bool(status.flags & EKF_POS_HORIZ_ABS) for _, status in view.ekf)
        beyond = sum(status.position_ratio > 1.0 for _, status in view.ekf)
        used = [
            ("EKF states received", str(count)),
            ("with an absolute horizontal position", f"{100 * position / count:.1f} %"),
            ("position beyond its gate", f"{100 * beyond / count:.1f} %"),
        ]
    peer = [
        (k.replace("_", " "), f"{round(v, 3):g}" if isinstance(v, float) else str(v)) for k, v in _scalars(view.peer)
    ]
    counted = kit.folded("Counted by the autopilot", kit.facts(peer)) if peer else ""
    return kit.two(
        kit.block("Sent", kit.facts(sent)) if sent else "",
        kit.block("Received by the autopilot", kit.facts(used), counted) if used or peer else "",
    )


def _texts(view: FlightView) -> str:
    if not view.pilot_texts:
        return ""
    texts = [(stamp(t), text.text) for t, text in view.pilot_texts[:MAX_TEXTS]]
    count = len(view.pilot_texts)
    shown = f"{count}" if count <= MAX_TEXTS else f"the first {MAX_TEXTS} of {count}"
    return kit.folded(f"Texts to the pilot ({shown})", kit.facts(texts))


def _scalars(peer: dict[str, Any]) -> list[tuple[str, Any]]:
    return [(k, v) for k, v in peer.items() if isinstance(v, int | float | str) and not isinstance(v, bool)]
