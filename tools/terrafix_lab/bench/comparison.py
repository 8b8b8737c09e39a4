"""Rows of the benchmark's tables that the screen and the page share."""

from dataclasses import dataclass
from typing import Any

MATCHING = "the map matching of it"


@dataclass(frozen=True)
class Row:
    """One method on a flight. ``found`` of ``frames`` are within 20 m. ``cpu_ms``: spread of a frame's processor time;
    ``kept_ms``: the same without the points of the map; None: not a method of points. ``model_rate``: share of the
    frames for which a model ran; None: all or none by the method."""

    name: str
    found: int
    frames: int
    cpu_ms: dict[str, float] | None
    kept_ms: dict[str, float] | None = None
    model_rate: float | None = None
    ratio: tuple[float, float] | None = None  # of our processor times to those of a peer: median and 95 %
    ours: bool = False


def compared(flight: dict[str, Any]) -> list[Row]:
    """``flight``: its entry in bench.json -> ours, each followed by its map matching alone, and the peers."""
    rows = []
    for kind, run in flight["runs"].items():
        accuracy = run["accuracy"]
        frames = accuracy["frames"]
        found, rate = round(frames * accuracy["within_20m"]), accuracy["model_rate"]
        rows.append(Row(f"Terrafix, {kind}", found, frames, run["cpu_ms"], None, rate, ours=True))
        rows.append(Row(f"... {MATCHING}", found, frames, run["stage_cpu_ms"]["anchor"], None, rate, ours=True))
    ours_ms = next(iter(flight["runs"].values()))["cpu_ms"]
    for name, peer in flight["peers"].items():
        found, ms = round(flight["frames"] * (peer["accuracy"]["within_20m"] or 0.0)), peer["cpu_ms"]
        ratio = (ours_ms["median"] / ms["median"], ours_ms["p95"] / ms["p95"]) if ms else None
        rows.append(Row(name, found, flight["frames"], ms, peer["cpu_ms_with_map_points_kept"], None, ratio))
    return rows


def spread_text(times_ms: dict[str, float] | None) -> str:
    """Median, 95th and 99th percentile."""
    if not times_ms:
        return "-"
    return "/".join(f"{times_ms[key]:.{0 if times_ms['median'] >= 9.95 else 1}f}" for key in ("median", "p95", "p99"))


def percent_text(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.0f} %"
