"""Charts of the report as plain SVG; readable without a library or a script."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from itertools import pairwise

from markupsafe import Markup

from terrafix_tools.pages.series import Span, thin_line, thin_marks, thin_spans

WIDTH = 1000  # of a chart across the whole page, in SVG units
HALF_WIDTH = 540  # of a chart in a column, SVG units
GUTTER = 70  # left margin for the labels of the y axis
RIGHT = 14
TOP = 12
AXIS = 26  # bottom margin for the labels of the x axis
TICKS_X = 9
GAP = 5.0  # intervals of this many times the median are gaps, in which a line would claim what nobody has measured
MARK = 3.0  # SVG units: marks that are nearer to each other are drawn once
MAX_LOG_TICKS = 10  # number of ticks at 1, 2, 5, 10 ...; with more, only powers of ten are labelled

Point = tuple[float, float | None]


@dataclass
class Chart:
    """Axes and marks, drawn in the order of the calls. The y axis is linear or logarithmic, as is x."""

    x_max: float
    y_min: float
    y_max: float
    height: int = 250
    width: int = WIDTH
    x_min: float = 0.0
    log_x: bool = False
    log_y: bool = False
    x_unit: str = "s"
    y_unit: str = "m"
    follow: bool = True  # the pointer's time is marked in this chart
    gutter: int = GUTTER  # left margin, SVG units
    marks: list[str] = field(default_factory=list)

    def x(self, value: float) -> float:
        return self.gutter + (self.width - self.gutter - RIGHT) * _share(value, self.x_min, self.x_max, self.log_x)

    def y(self, value: float) -> float:
        return self.height - AXIS - (self.height - TOP - AXIS) * _share(value, self.y_min, self.y_max, self.log_y)

    def line(self, points: Sequence[Point], css: str) -> None:
        """Draws a line with gaps where a value is None; a point between gaps is a dot."""
        for run in self._runs(points):
            text = " ".join(f"{x:.1f},{y:.1f}" for x, y in (run if len(run) > 1 else 2 * run))
            self.marks.append(f'<polyline class="line {css}" points="{text}"/>')

    def dots(self, points: Sequence[tuple[float, float]], css: str) -> None:
        """Draws a mark at each point, one at most where several would cover each other."""
        self._single_marks(points, f"points {css}", 0, "h0")

    def crosses(self, points: Sequence[tuple[float, float]], css: str) -> None:
        """As ``dots``."""
        self._single_marks(points, f"crosses {css}", 4, "l8 8m0-8l-8 8")

    def _single_marks(self, points: Sequence[tuple[float, float]], css: str, reach: int, shape: str) -> None:
        kept = thin_marks([(self.x(a), self.y(b)) for a, b in points], MARK)
        if kept:
            path = "".join(f"M{x - reach:.1f} {y - reach:.1f}{shape}" for x, y in kept)
            self.marks.append(f'<path class="{css}" d="{path}"/>')

    def area(self, points: Sequence[Point], css: str) -> None:
        """Fills the area between the bottom of the chart and the line."""
        floor = self.height - AXIS
        for run in self._runs(points):
            text = " ".join(f"{x:.1f},{y:.1f}" for x, y in run)
            left, right = run[0][0], run[-1][0]
            self.marks.append(f'<polygon class="area {css}" points="{left:.1f},{floor} {text} {right:.1f},{floor}"/>')

    def _runs(self, points: Sequence[Point]) -> list[list[tuple[float, float]]]:
        """SVG coordinates of the parts between gaps, thinned to what the width shows. A gap is a value None, and on an
        axis of time also an interval of GAP times the usual one."""
        runs: list[list[tuple[float, float]]] = [[]]
        limit = GAP * usual_step([a for a, _ in points]) if self.x_unit == "s" else math.inf
        before = math.inf
        for a, b in points:
            if b is None or a - before > limit:
                runs.append([])
            if b is not None:
                runs[-1].append((self.x(a), self.y(b)))
            before = a
        return [thin_line(run) for run in runs if run]

    def bar(self, x_low: float, x_high: float, value: float, css: str, tip: str) -> None:
        left, right, top = self.x(x_low), self.x(x_high), self.y(value)
        self.marks.append(
            f'<rect class="bar {css}" x="{left + 0.5:.1f}" y="{top:.1f}" width="{max(1.0, right - left - 1):.1f}" '
            f'height="{max(0.0, self.height - AXIS - top):.1f}"><title>{escape(tip)}</title></rect>'
        )

    def band(self, x_low: float, x_high: float, css: str, tip: str) -> None:
        """Marks an interval of the x axis over the full height of the chart."""
        self._block(x_low, x_high, TOP, self.height - AXIS, css, tip)

    def bottom_strip(self, x_low: float, x_high: float, css: str, tip: str, height: int) -> None:
        """Marks an interval of the x axis as a strip at the bottom of the chart."""
        self._block(x_low, x_high, self.height - AXIS - height, self.height - AXIS, css, tip)

    def _block(self, x_low: float, x_high: float, top: int, bottom: int, css: str, tip: str) -> None:
        left, right = self.x(x_low), self.x(x_high)
        self.marks.append(
            f'<rect class="{css}" x="{left:.1f}" y="{top}" width="{max(0.8, right - left):.1f}" '
            f'height="{bottom - top}"><title>{escape(tip)}</title></rect>'
        )

    def vertical_line(self, value: float, text: str, row: int = 0) -> None:
        """Draws a vertical line with a label in the ``row``-th text line; rows separate neighbouring labels."""
        x = self.x(value)
        anchor, dx = ("end", -5) if x > self.width * 0.6 else ("start", 5)
        self.marks.append(
            f'<line class="upright" x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{self.height - AXIS}"/>'
            f'<text class="note" x="{x + dx:.1f}" y="{TOP + 10 + 16 * row}" text-anchor="{anchor}">'
            f"{escape(text)}</text>"
        )

    def level(self, value: float, text: str = "") -> None:
        """Draws a horizontal line with a label at its right end."""
        y = self.y(value)
        self.marks.append(
            f'<line class="level" x1="{self.gutter}" x2="{self.width - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
            f'<text class="note" x="{self.width - RIGHT - 4}" y="{y - 4:.1f}" text-anchor="end">{escape(text)}</text>'
        )

    def svg(self, label: str) -> str:
        return self._svg(self._grid(), "chart", TOP, label)

    def _svg(self, grid: str, css: str, top: int, label: str) -> str:
        """``top``: upper end of the line at the pointer's time."""
        cursor, data = "", ""
        if self.follow:
            cursor = f'<line class="cursor" y1="{top}" y2="{self.height - AXIS}"/>'
            data = f' data-x0="{self.gutter}" data-x1="{self.width - RIGHT}" data-t1="{self.x_max:.3f}"'
        return Markup(
            f'<svg class="{css}" viewBox="0 0 {self.width} {self.height}" role="img"{data} '
            f'aria-label="{escape(label)}">{grid}{"".join(self.marks)}{cursor}</svg>'
        )

    def _grid(self) -> str:
        parts = []
        for value in ticks(self.y_min, self.y_max, 5, self.log_y):
            y = self.y(value)
            parts.append(f'<line class="grid" x1="{self.gutter}" x2="{self.width - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
            text = escape(f"{value:g} {self.y_unit}".strip())
            parts.append(f'<text x="{self.gutter - 8}" y="{y + 4:.1f}" text-anchor="end">{text}</text>')
        return "".join(parts) + self._x_axis()

    def _x_axis(self) -> str:
        y, parts = self.height - AXIS + 18, []
        for value in ticks(self.x_min, self.x_max, TICKS_X * self.width // WIDTH, self.log_x, self.x_unit == "s"):
            text = clock(value) if self.x_unit == "s" else f"{value:g} {self.x_unit}"
            parts.append(f'<text x="{self.x(value):.1f}" y="{y}" text-anchor="middle">{escape(text)}</text>')
        return "".join(parts)


def usual_step(times: Sequence[float]) -> float:
    """Median of the intervals; infinity where there are none."""
    steps = sorted(b - a for a, b in pairwise(times) if b > a)
    return steps[len(steps) // 2] if steps else math.inf


def _share(value: float, low: float, high: float, log: bool) -> float:
    """Where the value is between the ends of its axis, 0 to 1."""
    if log:
        share = math.log10(max(value, low) / low) / math.log10(high / low)
    else:
        share = (value - low) / max(high - low, 1e-9)
    return min(1.0, max(0.0, share))


@dataclass
class Band:
    """One row of a strip chart: (from, to, css class, tooltip)."""

    name: str
    spans: list[Span]


def strips(bands: Sequence[Band], x_max: float, label: str, gutter: int = GUTTER) -> str:
    """Draws rows of coloured intervals over one time axis. ``gutter``: left margin for their names, SVG units."""
    row, gap = 20, 8
    chart = Chart(x_max=x_max, y_min=0, y_max=1, height=len(bands) * (row + gap) + AXIS, gutter=gutter)
    for i, band in enumerate(bands):
        top = i * (row + gap)
        chart.marks += [
            f'<text x="{gutter - 8}" y="{top + 14}" text-anchor="end">{escape(band.name)}</text>',
            f'<rect class="rail" x="{gutter}" y="{top}" width="{WIDTH - gutter - RIGHT}" height="{row}"/>',
        ]
        for low, high, css, tip in thin_spans(band.spans, x_max):
            chart._block(low, high, top, top + row, css, tip)
    return chart._svg(chart._x_axis(), "chart strips", 0, label)


def ticks(low: float, high: float, count: int, log: bool = False, sixties: bool = False) -> list[float]:
    """Returns round values inside [low, high]; ``sixties``: multiples suited to minutes."""
    if log:
        decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        values = [v for d in decades for v in (10.0**d, 2 * 10.0**d, 5 * 10.0**d) if low <= v <= high]
        return values if len(values) <= MAX_LOG_TICKS else [10.0**d for d in decades if low <= 10.0**d <= high]
    span = high - low
    if span <= 0:
        return [low]
    raw = span / count
    power = 10 ** math.floor(math.log10(raw))
    steps = (1, 1.5, 3, 6, 12) if sixties and raw >= 10 else (1, 2, 5, 10)
    step = next(s * power for s in steps if s * power >= raw)
    first = math.ceil(low / step)
    return [round(i * step, 9) for i in range(first, math.floor(high / step + 1e-9) + 1)]


def clock(seconds: float) -> str:
    """Formats seconds: 75 -> 1:15."""
    whole = round(seconds)
    if abs(seconds - whole) > 1e-6 and seconds < 60:
        return f"{seconds:g} s"
    hours, rest = divmod(whole, 3600)
    minutes, rest = divmod(rest, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def stamp(t_s: float | None) -> str:
    """Formats a time of a flight: what was before its beginning is at 0:00, None is ""."""
    return "" if t_s is None else clock(round(max(0.0, t_s)))


def spans_of(samples: Sequence[tuple[float, str]], end: float) -> list[tuple[float, float, str]]:
    """Converts samples of a state to intervals of constant state, each until the next sample."""
    spans: list[tuple[float, float, str]] = []
    for i, (at, state) in enumerate(samples):
        until = samples[i + 1][0] if i + 1 < len(samples) else max(end, at)
        if spans and spans[-1][2] == state and abs(spans[-1][1] - at) < 1e-9:
            spans[-1] = (spans[-1][0], until, state)
        else:
            spans.append((at, until, state))
    return spans
