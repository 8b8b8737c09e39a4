"""The computer in flight: latency by stage, temperature, clocks and power, processes."""

from collections import defaultdict
from collections.abc import Callable

import numpy as np

from terrafix.health.load import ALL
from terrafix.messages import ThermalReading
from terrafix_tools.pages.charts import Band, Chart, Point, stamp, strips
from terrafix_tools.pages.document import kit
from terrafix_tools.report.data import FlightView
from terrafix_tools.report.sections import end_s, spans
from terrafix_tools.report.stage_times import STAGES
from terrafix_tools.report.text import UNPLANNED

BINS = 120  # of the medians over time
STAGE_LINES = ("soft", "age", "refined", "temperature", "error", "claim")  # css classes, by stage
STAGE_KEYS = ("k-soft", "k-vis", "k-good", "k-dead", "k-ink", "k-sat")
EVENT_WIDTH = 0.004  # of a process event, as a share of the time axis
MAX_SERIES = 6  # lines of one chart; a board has dozens of zones, the hottest are shown
LINES = ("temperature", "age", "claim", "refined", "error", "soft")
KEYS = ("k-dead", "k-vis", "k-sat", "k-good", "k-ink", "k-soft")


def computer(view: FlightView) -> str:
    parts = [_latency(view), _frame_rate(view), _load(view), _heat(view), _processes(view)]
    if not any(parts):
        return ""
    return kit.section("Computer", "", *parts)


def _latency(view: FlightView) -> str:
    """Table and chart of the delays by stage; "" for a replay, which has no clock."""
    times = view.stage_times
    if not view.clocked or not any(times.delay_ns.values()):
        return ""
    rows = []
    chart_points: list[tuple[str, list[Point]]] = []
    for stage, css in zip(STAGES, STAGE_LINES, strict=True):
        delays = times.percentiles_ms(stage)
        if not delays:
            continue
        step = times.step_ms(stage)
        rows.append([stage, None if step is None else f"{step:.0f} ms", *(f"{delay:.0f} ms" for delay in delays)])
        chart_points.append((css, medians(times.series(stage, view.zero_ns), end_s(view))))
    values = [value for _, points in chart_points for _, value in points if value is not None]
    chart = Chart(
        x_max=end_s(view), y_min=max(1.0, 0.7 * min(values)), y_max=max(100.0, 1.4 * max(values)), height=220,
        log_y=True, y_unit="ms",
    )  # fmt: skip
    for css, points in chart_points:
        chart.line(points, css)
    keys = [(key, stage) for key, stage in zip(STAGE_KEYS, STAGES, strict=True) if times.delay_ns[stage]]
    return kit.block(
        "Latency by stage",
        kit.quiet(
            'From the exposure of a frame to the reception at the recorder, to 10 ms. "Step": since the stage before. '
            '"estimate": the last one of a frame; "GPS_INPUT": the first one after it.'
        ),
        kit.table(("stage", "step, median", "median", "95 %", "99 %"), rows),
        kit.scroll(chart.svg("Latency by stage over time")),
        kit.legend(keys),
    )


def medians(points: list[tuple[float, float]], end: float) -> list[Point]:
    """Medians of BINS equal parts of the time axis; None where there are no points, so that the line has a gap."""
    parts: defaultdict[int, list[float]] = defaultdict(list)
    for t_s, value in points:
        parts[min(BINS - 1, max(0, int(BINS * t_s / end)))].append(value)
    return [((k + 0.5) * end / BINS, float(np.median(parts[k])) if k in parts else None) for k in range(BINS)]


def _frame_rate(view: FlightView) -> str:
    """When fewer frames were taken than the source offered, as the computer was too slow; "" where all were."""
    slow = [(t_s, rate) for t_s, rate in view.frame_rates if rate.computer_too_slow]
    if not slow:
        return ""
    lowest = min((rate for _, rate in slow), key=lambda rate: rate.taken_hz)
    span = f"{stamp(slow[0][0])} to {stamp(slow[-1][0])}"
    rates = f"running at {lowest.taken_hz:.2g} of {lowest.offered_hz:.2g} Hz at the least"
    return kit.block("Frame rate", kit.quiet(f"The computer was too slow from {span}, {rates}."))


def _load(view: FlightView) -> str:
    """Load of the cores as a whole, and of one core by process; "" where it was not recorded."""
    whole = _lines(view, "All cores", "%", 2.0, lambda r: {k: 100 * v for k, v in r.cpu_load.items() if k == ALL})
    by_process = _lines(view, "By process", "%", 2.0, lambda r: {k: 100 * v for k, v in r.cpu_load.items() if k != ALL})
    if not whole:
        return ""
    about = "Of all cores together, other programs included; of one core by process, so that several threads may "
    return kit.block("Processor load", kit.quiet(f"{about}exceed 100 %."), kit.scroll(whole, by_process))


def _heat(view: FlightView) -> str:
    end = end_s(view)
    if view.thermal and any(reading.zones for _, reading in view.thermal):
        heat = _lines(view, "Temperature", "°C", 3.0, lambda r: {z.name: z.temperature_c for z in r.zones})
    else:
        heat = _line("Temperature", "°C", 3.0, [(t, health.temperature_c) for t, health in view.health], view)
    clocks = _lines(
        view, "Clock limit", "%", 5.0, lambda r: {c.name: 100 * c.limit_mhz / c.max_mhz for c in r.clocks if c.max_mhz}
    )
    rails = _lines(view, "Power by rail", "W", 0.5, lambda r: {rail.name: rail.power_w for rail in r.rails})
    power = rails or _line("Power", "W", 1.0, [(t, health.power_w) for t, health in view.health], view)
    if not (heat or clocks or power or view.health):
        return ""
    bands = []
    if view.health:
        labels = {"normal": "normal", "hot": "hot", "critical": "critical"}
        bands.append(Band("thermal", spans([(t, str(health.band)) for t, health in view.health], end, "f-", labels)))
        limited = [(t, "hot" if health.throttled else "normal") for t, health in view.health]
        bands.append(Band("throttled", spans(limited, end, "f-", {"hot": "throttled", "normal": "not throttled"})))
    causes = list(dict.fromkeys(health.cause for _, health in view.health if health.cause))
    said = kit.quiet("; ".join(causes[:4])) if causes else ""
    strip = strips(bands, end, "Thermal band over time") if bands else ""
    return kit.block("Heat and power", said, kit.scroll(strip, heat, clocks, power))


def _lines(
    view: FlightView, name: str, unit: str, margin: float, values_of: Callable[[ThermalReading], dict[str, float]]
) -> str:
    series: defaultdict[str, list[Point]] = defaultdict(list)
    for t_s, reading in view.thermal:
        for key, value in values_of(reading).items():
            series[key].append((t_s, value))
    largest = sorted(series, key=lambda key: -max(v for _, v in series[key] if v is not None))[:MAX_SERIES]
    if not largest:
        return ""
    chart = _chart(name, unit, margin, [(series[key], css) for key, css in zip(largest, LINES, strict=False)], view)
    return chart + kit.legend(zip(KEYS, largest, strict=False))


def _line(name: str, unit: str, margin: float, points: list[Point], view: FlightView) -> str:
    return _chart(name, unit, margin, [(points, name.lower())], view)


def _chart(name: str, unit: str, margin: float, series: list[tuple[list[Point], str]], view: FlightView) -> str:
    values = [v for points, _ in series for _, v in points if v is not None]
    if not values:
        return ""
    chart = Chart(x_max=end_s(view), y_min=min(values) - margin, y_max=max(values) + margin, height=150, y_unit=unit)
    for points, css in series:
        chart.line(points, css)
    return kit.chart(name, chart.svg(name))


def _processes(view: FlightView) -> str:
    """Starts and ends of processes, and messages that a queue lost."""
    if not view.events and not view.losses:
        return ""
    end = end_s(view)
    by_process: defaultdict[str, list[tuple[float, float, str, str]]] = defaultdict(list)
    for t_s, event in view.events:
        css = "f-bad" if event.event in UNPLANNED else "f-good"
        text = f"{stamp(t_s)}  {event.process} {event.event.replace('_', ' ')} {event.detail}".strip()
        by_process[event.process].append((t_s, t_s + end * EVENT_WIDTH, css, text))
    for t_s, loss in view.losses:
        text = f"{stamp(t_s)}  {loss.process} lost {loss.count} {loss.message}"
        by_process[loss.process].append((t_s, t_s + end * EVENT_WIDTH, "f-hot", text))
    bands = [Band(name, sorted(found)) for name, found in by_process.items()]
    keys = [("k-good", "started, stopped"), ("k-dead", "died, stuck, given up")]
    keys += [("k-vis", "messages lost")] if view.losses else []
    lost = [(name, str(count)) for name, count in view.dropped.most_common(8)]
    return kit.block(
        "Processes",
        kit.scroll(strips(bands, end, "Processes over time")),
        kit.legend(keys),
        kit.folded("Messages lost", kit.facts(lost)) if lost else "",
    )
