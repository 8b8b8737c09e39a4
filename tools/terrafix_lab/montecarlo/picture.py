"""The plot of a run: normalised errors against their theoretical densities, and the track of the worst flight."""

import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from terrafix_lab.montecarlo.statistics import FlightResult

PANEL = (560, 420)  # width, height
MARGIN = (52, 34, 16, 42)  # left, top, right, bottom
BACK, INK, FAINT = (255, 255, 255), (40, 40, 40), (205, 205, 205)
BARS, LAW, RED = (214, 176, 120), (40, 40, 40), (40, 40, 220)  # BGR
FONT = cv2.FONT_HERSHEY_SIMPLEX


def draw(path: Path, flights: list[FlightResult]) -> None:
    """Writes the plot. Raises OSError."""
    worst = max(flights, key=lambda f: float(np.percentile(f.nees, 95)))
    panels = [
        _histogram("position / claim, against chi (2)", [np.sqrt(f.nees) for f in flights], _rayleigh),
        _histogram("the same without the map's error", [np.sqrt(f.map_nees) for f in flights], _rayleigh),
        _histogram("refined / claim, against chi (2)", [np.sqrt(f.refined_nees()) for f in flights], _rayleigh),
        _histogram("|velocity| / claim, per axis, half normal", [np.abs(f.velocity_share()) for f in flights], _half),
        _track(worst),
        _growth(worst),
    ]
    rows = [np.hstack(panels[:3]), np.hstack(panels[3:])]
    path.write_bytes(cv2.imencode(".png", np.vstack(rows))[1].tobytes())


def _rayleigh(x: np.ndarray) -> np.ndarray:
    """Density of the root of chi-square with two degrees of freedom."""
    return x * np.exp(-0.5 * x**2)


def _half(x: np.ndarray) -> np.ndarray:
    return math.sqrt(2.0 / math.pi) * np.exp(-0.5 * x**2)


class _Axes:
    """A panel with linear axes."""

    def __init__(self, title: str, x: tuple[float, float], y: tuple[float, float]) -> None:
        self._x, self._y = x, y
        self.image = np.full((PANEL[1], PANEL[0], 3), BACK, np.uint8)
        left, top, right, bottom = MARGIN
        self._box = (left, top, PANEL[0] - right, PANEL[1] - bottom)
        cv2.putText(self.image, title, (left, top - 12), FONT, 0.5, INK, 1, cv2.LINE_AA)
        for value in _ticks(*x):
            at = self.px(value, y[0])
            cv2.line(self.image, at, (at[0], top), FAINT, 1)
            cv2.putText(self.image, f"{value:g}", (at[0] - 10, at[1] + 18), FONT, 0.4, INK, 1, cv2.LINE_AA)
        for value in _ticks(*y):
            at = self.px(x[0], value)
            cv2.line(self.image, at, (self._box[2], at[1]), FAINT, 1)
            cv2.putText(self.image, f"{value:g}", (6, at[1] + 4), FONT, 0.4, INK, 1, cv2.LINE_AA)

    def px(self, x: float, y: float) -> tuple[int, int]:
        left, top, right, bottom = self._box
        u = (min(max(x, self._x[0]), self._x[1]) - self._x[0]) / (self._x[1] - self._x[0])
        v = (min(max(y, self._y[0]), self._y[1]) - self._y[0]) / (self._y[1] - self._y[0])
        return round(left + u * (right - left)), round(bottom - v * (bottom - top))

    def line(self, x: np.ndarray, y: np.ndarray, colour: tuple[int, int, int], width: int = 2) -> None:
        points = np.array([self.px(float(a), float(b)) for a, b in zip(x, y, strict=True)], np.int32)
        cv2.polylines(self.image, [points.reshape(-1, 1, 2)], False, colour, width, cv2.LINE_AA)

    def text(self, row: int, text: str, colour: tuple[int, int, int] = INK) -> None:
        """Line ``row`` of a legend in the upper right corner."""
        width = cv2.getTextSize(text, FONT, 0.45, 1)[0][0]
        at = (self._box[2] - width - 8, self._box[1] + 20 + 18 * row)
        cv2.putText(self.image, text, at, FONT, 0.45, colour, 1, cv2.LINE_AA)


def _histogram(title: str, values: list[np.ndarray], law: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    every = np.concatenate(values)
    every = np.where(np.isfinite(every), every, 99.0)
    edges = np.linspace(0.0, 5.0, 51)
    share, _ = np.histogram(every, edges)
    density = share / max(len(every), 1) / np.diff(edges)
    axes = _Axes(title, (0.0, 5.0), (0.0, max(0.9, 1.1 * float(density.max(initial=0.0)))))
    for low, high, value in zip(edges[:-1], edges[1:], density, strict=True):
        cv2.rectangle(axes.image, axes.px(low, 0.0), axes.px(high, value), BARS, -1)
    x = np.linspace(0.0, 5.0, 200)
    axes.line(x, law(x), LAW)
    axes.text(0, f"{len(every)} frames")
    axes.text(1, f"beyond 5: {100 * (every > 5.0).mean():.2f} %", RED if (every > 5.0).any() else INK)
    return axes.image


def _track(worst: FlightResult) -> np.ndarray:
    record = worst.record
    truth, estimate = record.truth_m, record.truth_m + record.error_m[:, :2]
    centre = 0.5 * (truth.min(0) + truth.max(0))
    half = 0.55 * float(np.ptp(truth, axis=0).max())
    wide = half * (PANEL[0] - MARGIN[0] - MARGIN[2]) / (PANEL[1] - MARGIN[1] - MARGIN[3])
    plan = record.plan
    title = f"worst flight: number {plan.number}, {plan.kind}, {plan.fault}"
    axes = _Axes(title, (centre[0] - wide, centre[0] + wide), (centre[1] - half, centre[1] + half))
    axes.line(truth[:, 0], truth[:, 1], INK, 1)
    axes.line(estimate[:, 0], estimate[:, 1], RED, 1)
    axes.text(0, "truth")
    axes.text(1, "estimate", RED)
    return axes.image


def _growth(worst: FlightResult) -> np.ndarray:
    record = worst.record
    sigma = 2.448 * np.sqrt(np.linalg.eigvalsh(record.cov[:, :2, :2])[:, 1])  # 95 % radius along the worst axis
    top = float(min(max(worst.distance_m.max(), np.percentile(sigma, 95)) * 1.1, 1000.0))
    axes = _Axes("its error and the 95 % that it claims, m over s", (0.0, float(record.t_s[-1])), (0.0, top))
    axes.line(record.t_s, sigma, INK, 1)
    axes.line(record.t_s, worst.distance_m, RED, 1)
    axes.text(0, "claim")
    axes.text(1, "error", RED)
    return axes.image


def _ticks(low: float, high: float) -> list[float]:
    step = 10.0 ** math.floor(math.log10((high - low) / 3.0))
    step *= next(k for k in (5, 2, 1) if k * step * 3.0 <= high - low)
    return [round(i * step, 10) for i in range(math.ceil(low / step), math.floor(high / step) + 1)]
