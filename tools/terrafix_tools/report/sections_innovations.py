"""Innovations of each measurement against its gate, and whether they have the distribution that is stated."""

import math
from collections import Counter

import numpy as np

from terrafix_tools.estimates import NS
from terrafix_tools.pages.charts import HALF_WIDTH, Chart, Point
from terrafix_tools.pages.document import kit, macros
from terrafix_tools.report.data import FlightView
from terrafix_tools.report.innovations import NORMAL_OUTSIDE, Innovations, spread_of
from terrafix_tools.report.sections import end_s

OWN = macros("terrafix_tools/report.html")
FLOOR, MIN_TOP = 1e-3, 3.0  # of the axis of test ratios
SIGMAS, BINS = 4.0, 32  # of the histogram; what is outside counts in the last bin
MIN_HISTOGRAM = 8  # innovations; fewer have no distribution to look at
ONLY_REJECTED = ("attitude", "height")  # of these only rejections have a verdict


def innovations(view: FlightView) -> str:
    found = {name: one for name, one in view.innovations.items() if one.tested}
    if not found:
        return ""
    keys = [("k-sat dot", "accepted"), ("k-dead dot", "rejected"), ("k-ink", "N(0, 1)")]
    return kit.section(
        "Innovations and gates",
        "Left: test ratio of each measurement over time; above 1 it is beyond its gate. Right: accepted innovations "
        "over their stated 1-sigma, all components. They should have the distribution N(0, 1): wider means that stated "
        "sigmas are too small.",
        *(_block(view, name, one) for name, one in found.items()),
        kit.legend(keys),
    )


def _block(view: FlightView, name: str, one: Innovations) -> str:
    values = one.normalised()
    histogram = _histogram(name, values.ravel()) if values.size >= MIN_HISTOGRAM else ""
    rejected, ratios = _rejected(view, name), _ratios(view, name, one)
    return OWN.innovation(name.replace("_", " "), rejected, ratios, histogram, _words(values))


def _ratios(view: FlightView, name: str, one: Innovations) -> str:
    top = max([MIN_TOP, *(1.3 * tested.test_ratio for tested in one.tested)])
    chart = Chart(
        x_max=end_s(view), y_min=FLOOR, y_max=top, height=210, width=HALF_WIDTH, log_y=True, y_unit="", follow=True
    )
    chart.level(1.0, "gate")
    points = [((tested.t_ns - view.zero_ns) / NS, tested.test_ratio, tested.accepted) for tested in one.tested]
    chart.dots([(t, ratio) for t, ratio, accepted in points if accepted], "accepted")
    chart.crosses([(t, ratio) for t, ratio, accepted in points if not accepted], "rejected")
    return chart.svg(f"Test ratio of {name} over time")


def _histogram(name: str, values: np.ndarray) -> str:
    edges = np.linspace(-SIGMAS, SIGMAS, BINS + 1)
    counts, _ = np.histogram(np.clip(values, -SIGMAS, SIGMAS), edges)
    density = counts / (len(values) * (edges[1] - edges[0]))
    top = max(0.45, float(density.max()) * 1.1)
    chart = Chart(
        x_min=-SIGMAS, x_max=SIGMAS, y_min=0.0, y_max=top, height=210, width=HALF_WIDTH, x_unit="σ", y_unit="",
        follow=False,
    )  # fmt: skip
    for low, high, value, count in zip(edges[:-1], edges[1:], density, counts, strict=True):
        if count:
            chart.bar(float(low), float(high), float(value), "", f"{low:g} to {high:g} sigma: {count}")
    normal: list[Point] = [
        (float(x), math.exp(-(x**2) / 2) / math.sqrt(2 * math.pi)) for x in np.linspace(-SIGMAS, SIGMAS, 81)
    ]
    chart.line(normal, "normal")
    return chart.svg(f"Normalised innovations of {name}")


def _rejected(view: FlightView, name: str) -> str:
    counts = view.verdicts.get(name, Counter())
    total = sum(counts.values())
    rejected = total - counts.get("accepted", 0)
    if name in ONLY_REJECTED:
        return f"{rejected} rejected; accepted ones are not recorded"
    return f"{rejected} of {total} rejected ({100 * rejected / max(total, 1):.1f} %)"


def _words(values: np.ndarray) -> str:
    if (pooled := spread_of(values.ravel())) is None:
        return "No accepted innovation with a stated variance."
    parts = [
        f"{pooled.count} values: mean {pooled.mean:+.2f} (0), standard deviation {pooled.deviation:.2f} (1), "
        f"beyond 2 sigma {100 * pooled.outside:.1f} % ({100 * NORMAL_OUTSIDE:.1f} %)."
    ]
    if values.shape[1] > 1:
        spreads = [spread_of(values[:, k]) for k in range(values.shape[1])]
        columns = ", ".join(f"{one.mean:+.2f} ± {one.deviation:.2f}" for one in spreads if one is not None)
        parts.append(f"By component, mean ± deviation: {columns}.")
    return " ".join(parts)
