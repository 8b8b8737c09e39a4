"""What was thought of each GNSS receiver of the autopilot."""

from collections import defaultdict

from terrafix.link.gnss.spoofing_detector import GNSS_AGREEMENT_SIGMAS
from terrafix.messages import GnssReading, GnssVerdict
from terrafix_tools.pages.charts import Band, Chart, Point, stamp, strips
from terrafix_tools.pages.document import kit
from terrafix_tools.report.data import FlightView
from terrafix_tools.report.sections import end_s, spans

LINES = ("error", "claim", "age", "refined")  # of the first receivers
KEYS = ("k-ink", "k-sat", "k-vis", "k-good")
MAX_CHANGES = 40


def gnss(view: FlightView) -> str:
    """States by receiver as coloured bands, the distance from the estimate in metres and in sigmas, and all changes
    with their reasons."""
    if not view.gnss_readings and not view.gnss_verdicts:
        return ""
    end = end_s(view)
    states: defaultdict[int, list[tuple[float, GnssVerdict]]] = defaultdict(list)
    fixes: defaultdict[int, list[tuple[float, GnssReading]]] = defaultdict(list)
    for t_s, verdict in view.gnss_verdicts:
        states[verdict.receiver].append((t_s, verdict))
    for t_s, reading in view.gnss_readings:
        fixes[reading.receiver].append((t_s, reading))
    bands = []
    for receiver in sorted({*states, *fixes}):
        judged = [(t, str(verdict.state)) for t, verdict in states[receiver]]
        bands.append(Band(f"GPS{receiver + 1}", spans(judged, end, "f-gnss-", {})))
        fixed = [(t, str(min(3, max(1, reading.fix_type)))) for t, reading in fixes[receiver]]
        bands.append(Band("its fix", spans(fixed, end, "f-fix", {"1": "no fix", "2": "2D fix", "3": "3D fix"})))
    keys = [
        ("k-good", "trusted"),
        ("k-vis", "disputed"),
        ("k-dead", "spoofed"),
        ("k-soft", "lost"),
        ("k-none", "unknown"),
    ]
    distances = {receiver: [(t, v.distance_m) for t, v in found] for receiver, found in states.items()}
    sigmas = {receiver: [(t, v.sigmas) for t, v in found] for receiver, found in states.items()}
    return kit.section(
        "GNSS receivers",
        "What the judge says of each receiver of the autopilot, and how far its position is from the estimate. No "
        "receiver is fused in flight.",
        kit.scroll(
            strips(bands, end, "State of the receivers over time"),
            kit.legend(keys),
            _chart("Distance from the estimate", "m", distances, end, None),
            _chart("The same in standard deviations of both", "", sigmas, end, GNSS_AGREEMENT_SIGMAS),
        ),
        _changes(states),
    )


def _chart(name: str, unit: str, series: dict[int, list[Point]], end: float, level: float | None) -> str:
    values = [value for points in series.values() for _, value in points if value is not None]
    if not values:
        return ""
    chart = Chart(x_max=end, y_min=0.1, y_max=max(10.0, 1.3 * max(values)), height=160, log_y=True, y_unit=unit)
    if level is not None:
        chart.level(level, f"agrees below {level:g} sigma")
    for i, (_, points) in enumerate(sorted(series.items())):
        chart.line(points, LINES[i % len(LINES)])
    keys = [(KEYS[i % len(KEYS)], f"GPS{receiver + 1}") for i, receiver in enumerate(sorted(series))]
    return kit.block(name, chart.svg(name), kit.legend(keys) if len(keys) > 1 else "")


def _changes(states: dict[int, list[tuple[float, GnssVerdict]]]) -> str:
    rows: list[tuple[float, str, str]] = []
    for receiver, found in states.items():
        last = None
        for t_s, verdict in found:
            if verdict.state is not last:
                text = f"{verdict.state}: {verdict.reason}".rstrip(": ")
                rows.append((t_s, f"{stamp(t_s)}  GPS{receiver + 1}", text))
            last = verdict.state
    rows.sort()
    count = f"{len(rows)}" if len(rows) <= MAX_CHANGES else f"the first {MAX_CHANGES} of {len(rows)}"
    return kit.folded(f"Changes of state ({count})", kit.facts(row[1:] for row in rows[:MAX_CHANGES]))
