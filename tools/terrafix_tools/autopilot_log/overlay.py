"""The autopilot's log on the time base of a flight record, as plain data: what text, JSON and page show."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from terrafix.core.autopilot_log.alignment import Alignment, align
from terrafix.link.integrity.output_predictor import metres_per_degree
from terrafix_tools.autopilot_log.flight import FlightSide, Sent
from terrafix_tools.autopilot_log.structure import (
    AutopilotLog,
    Fusion,
    GlobalTrack,
    GpsTrack,
    Series,
    Steps,
    steps,
    value_at,
)

MAX_POINTS = 1000  # of a series: one for each column of pixels of a chart
MAX_GAP_S = 1.0  # between positions of the EKF: none is interpolated in a longer gap
OURS_SHARE = 0.5  # of the positions of a GPS instance that were sent by us, for it to be ours [tuned]
FIX_3D = 3
GATE = 1.0  # limit of a test ratio


def overlay(flight: FlightSide, log: AutopilotLog) -> dict[str, Any]:
    """Aligns the clocks and transfers the log. All times are seconds of the record; what lies outside of it is left
    out. Raises EvaluationError when the log is of another flight."""
    clock = align(flight.attitude, log.attitude)
    first_s, last_s = clock.to_record(np.array(log.span_s))
    from_s, to_s = max(0.0, float(first_s)), min(flight.end_s, float(last_s))
    ours = our_instance(flight.sent, log.gps)
    window = _Window(clock, from_s, to_s)
    return {
        "record": str(flight.path),
        "log": {"path": str(log.path), "kind": log.kind, "firmware": log.firmware, "notes": log.notes},
        "duration_s": round(flight.end_s, 3),
        "from_s": round(from_s, 3),
        "to_s": round(to_s, 3),
        "clock": _clock(clock),
        "gps": [_receiver(track, track.instance == ours, window) for track in log.gps],
        "fused": [_fused(fusion, ours, window) for fusion in log.fusion],
        "lanes": _spans_of_steps(log.primary, window),
        "source_sets": _spans_of_steps(log.source_set, window),
        "modes": _modes(log, window),
        "test_ratios": _ratios(_of_primary(log.ratios, log.primary), window),
        "innovations": _innovations(_of_primary(log.innovations, log.primary), window),
        "sent_less_ekf": _sent_less_ekf(flight.sent, log.position, clock, window),
        "events": _events(flight, log, window),
    }


class _Window:
    """Part of the record that the log covers."""

    def __init__(self, clock: Alignment, from_s: float, to_s: float) -> None:
        self.clock, self.from_s, self.to_s = clock, from_s, to_s
        self.bin_s = max((to_s - from_s) / MAX_POINTS, 1e-3)

    def times(self, log_s: np.ndarray) -> np.ndarray:
        return self.clock.to_record(log_s)

    def inside(self, t_s: np.ndarray) -> np.ndarray:
        return (t_s >= self.from_s) & (t_s <= self.to_s)

    def thinned(self, t_s: np.ndarray, value: np.ndarray) -> list[list[float]]:
        """-> [time, value] of the sample that is farthest from 0 in each of MAX_POINTS intervals."""
        keep = self.inside(t_s) & np.isfinite(value)
        t_s, value = t_s[keep], value[keep]
        if not t_s.size:
            return []
        number = ((t_s - self.from_s) / self.bin_s).astype(int)
        order = np.lexsort((-np.abs(value), number))
        chosen = np.sort(order[np.concatenate([[True], np.diff(number[order]) > 0])])
        return [[round(float(t), 3), float(f"{v:.6g}")] for t, v in zip(t_s[chosen], value[chosen], strict=True)]

    def spans(self, log_s: np.ndarray, value: np.ndarray) -> Iterator[tuple[float, float, float]]:
        """-> (from, to, value) of each stretch of one value, until the next sample, within the window."""
        changed = steps(self.times(log_s), value)
        if changed is None:
            return
        ends = np.append(changed.t_s[1:], self.to_s)
        for begin, end, held in zip(changed.t_s, ends, changed.value, strict=True):
            begin_s, end_s = max(float(begin), self.from_s), min(float(end), self.to_s)
            if end_s > begin_s:
                yield round(begin_s, 3), round(end_s, 3), float(held)


def our_instance(sent: Sent, gps: list[GpsTrack]) -> int | None:
    """The GPS instance whose positions are those that we sent, to the last digit of GPS_INPUT (1e-7 degree)."""
    ours = set(_places(sent))
    shares = {}
    for track in gps:
        places = _places(track)
        shares[track.instance] = sum(place in ours for place in places) / max(1, len(places))
    best = max(shares, key=shares.__getitem__, default=None)
    return best if best is not None and shares[best] > OURS_SHARE else None


def _places(of: Sent | GpsTrack) -> list[tuple[float, float]]:
    """Latitude and longitude of the positions with a 3D fix, in units of 1e-7 degree."""
    known = (of.fix_type >= FIX_3D) & np.isfinite(of.lat_deg) & np.isfinite(of.lon_deg)
    return list(zip(np.rint(of.lat_deg[known] * 1e7).tolist(), np.rint(of.lon_deg[known] * 1e7).tolist(), strict=True))


def _clock(clock: Alignment) -> dict[str, Any]:
    return {
        "offset_s": round(clock.offset_s, 6),
        "offset_sigma_s": round(clock.offset_sigma_s, 6),
        "at_s": round(clock.middle_s, 3),
        "drift_ppm": round(1e6 * clock.drift, 3),
        "drift_sigma_ppm": round(1e6 * clock.drift_sigma, 3),
        "correlation": round(clock.correlation, 3),
        "next_correlation": round(clock.second, 3),
        "needed_correlation": round(clock.needed, 3),
        "aligned_correlation": round(clock.matched, 3),
        "windows": clock.windows,
        "scatter_s": round(clock.scatter_s, 6),
        "attitude_deg": round(float(np.degrees(clock.attitude_rad)), 4),
    }


def name_of(instance: int, ours: bool) -> str:
    return f"GPS {instance + 1}" + (" (Terrafix)" if ours else "")


def _receiver(track: GpsTrack, ours: bool, window: _Window) -> dict[str, Any]:
    keep = window.inside(window.times(track.t_s))
    used = None if track.used is None else track.used[keep]
    accuracy = track.horizontal_m[keep]
    count = int(keep.sum())
    return {
        "instance": track.instance,
        "name": name_of(track.instance, ours),
        "terrafix": ours,
        "samples": count,
        "fix_3d_share": _share(track.fix_type[keep] >= FIX_3D),
        "used_share": None if used is None else _share(used),
        "satellites_median": float(np.median(track.satellites[keep])) if count else None,
        "accuracy_median_m": float(np.nanmedian(accuracy)) if np.isfinite(accuracy).any() else None,
        "fixes": list(window.spans(track.t_s, track.fix_type)),
        "used": [] if track.used is None else _true_spans(window, track.t_s, track.used),
    }


def _share(values: np.ndarray) -> float | None:
    return round(float(np.mean(values)), 4) if values.size else None


def _true_spans(window: _Window, log_s: np.ndarray, value: np.ndarray) -> list[tuple[float, float]]:
    return [(begin, end) for begin, end, held in window.spans(log_s, value.astype(float)) if held]


def _fused(fusion: Fusion, ours: int | None, window: _Window) -> dict[str, Any]:
    is_ours = ours is not None and fusion.name == name_of(ours, False)
    spans = _true_spans(window, fusion.t_s, fusion.fused)
    return {
        "name": fusion.name + (" (Terrafix)" if is_ours else ""),
        "seconds": round(sum(end - begin for begin, end in spans), 3),
        "spans": spans,
    }


def _spans_of_steps(found: Steps | None, window: _Window) -> list[dict[str, float]]:
    if found is None:
        return []
    spans = window.spans(found.t_s, found.value)
    return [{"from_s": begin, "to_s": end, "value": int(value)} for begin, end, value in spans]


def _modes(log: AutopilotLog, window: _Window) -> list[dict[str, Any]]:
    modes = [event for event in log.events if event.kind == "mode"]
    times = np.array([event.t_s for event in modes])
    spans = window.spans(times, np.arange(len(modes), dtype=float))
    return [{"from_s": begin, "to_s": end, "name": modes[int(number)].text} for begin, end, number in spans]


def _of_primary(cores: dict[int, Series], primary: Steps | None) -> Series | None:
    """The quantities of the core that was primary at each time; without that of the first core."""
    if not cores:
        return None
    if primary is None:
        return cores[min(cores)]
    parts = [(series, value_at(primary, series.t_s) == core) for core, series in cores.items()]
    names = sorted(set.intersection(*(set(series.values) for series, _ in parts)))
    t_s = np.concatenate([series.t_s[keep] for series, keep in parts])
    order = np.argsort(t_s, kind="stable")
    values = {name: np.concatenate([s.values[name][keep] for s, keep in parts])[order] for name in names}
    return Series(t_s[order], values)


def _ratios(series: Series | None, window: _Window) -> dict[str, Any]:
    """Of each: largest value and its time, share of the samples above the gate, thinned series."""
    found = {}
    for name, values in ({} if series is None else series.values).items():
        t_s = window.times(series.t_s) if series is not None else np.zeros(0)
        keep = window.inside(t_s) & np.isfinite(values)
        if np.any(values[keep] != 0.0):  # a sensor that is not there has a ratio of 0
            at = int(np.argmax(np.where(keep, values, -np.inf)))
            found[name] = {
                "max": round(float(values[at]), 3),
                "max_at_s": round(float(t_s[at]), 3),
                "above_gate_share": _share(values[keep] > GATE),
                "series": window.thinned(t_s, values),
            }
    return found


def _innovations(series: Series | None, window: _Window) -> dict[str, Any]:
    """Of each: root mean square, largest magnitude and its time, thinned series."""
    found = {}
    for name, values in ({} if series is None else series.values).items():
        t_s = window.times(series.t_s) if series is not None else np.zeros(0)
        keep = window.inside(t_s) & np.isfinite(values)
        if np.any(values[keep] != 0.0):
            at = int(np.argmax(np.where(keep, np.abs(values), -np.inf)))
            found[name] = {
                "rms": round(float(np.sqrt(np.mean(values[keep] ** 2))), 4),
                "extreme": round(float(values[at]), 4),
                "extreme_at_s": round(float(t_s[at]), 3),
                "series": window.thinned(t_s, values),
            }
    return found


def _sent_less_ekf(
    sent: Sent, position: GlobalTrack | None, clock: Alignment, window: _Window
) -> dict[str, Any] | None:
    """GPS_INPUT with a 3D fix less the position that the autopilot navigated by at that time: north, east, down [m].

    None: nothing was sent, or the log has no position."""
    if position is None or not sent.t_s.size:
        return None
    at_s = clock.to_log(sent.t_s)
    after = np.clip(np.searchsorted(position.t_s, at_s), 1, max(1, position.t_s.size - 1))
    if position.t_s.size < 2:
        return None
    near = position.t_s[after] - position.t_s[after - 1] <= MAX_GAP_S
    keep = (sent.fix_type >= FIX_3D) & near & window.inside(sent.t_s)
    keep &= (at_s >= position.t_s[0]) & (at_s <= position.t_s[-1])
    if not keep.any():
        return None
    t_s, at_s = sent.t_s[keep], at_s[keep]
    lat, lon, alt = (
        np.interp(at_s, position.t_s, values) for values in (position.lat_deg, position.lon_deg, position.alt_amsl_m)
    )
    meridian_m, parallel_m = metres_per_degree(float(np.median(lat)))
    north = meridian_m * (sent.lat_deg[keep] - lat)
    east = parallel_m * (sent.lon_deg[keep] - lon)
    down = alt - sent.alt_amsl_m[keep]
    horizontal = np.hypot(north, east)
    at = int(np.argmax(horizontal))
    return {
        "samples": int(keep.sum()),
        "median_m": round(float(np.median(horizontal)), 3),
        "p95_m": round(float(np.quantile(horizontal, 0.95)), 3),
        "max_m": round(float(horizontal[at]), 3),
        "max_at_s": round(float(t_s[at]), 3),
        "north_m": window.thinned(t_s, north),
        "east_m": window.thinned(t_s, east),
        "down_m": window.thinned(t_s, down),
    }


def _events(flight: FlightSide, log: AutopilotLog, window: _Window) -> list[dict[str, Any]]:
    times = window.times(np.array([event.t_s for event in log.events]))
    found = [
        {"t_s": round(float(t), 3), "kind": event.kind, "text": event.text}
        for t, event in zip(times, log.events, strict=True)
        if window.from_s <= t <= window.to_s
    ]
    found += [{"t_s": round(event.t_s, 3), "kind": event.kind, "text": event.text} for event in flight.events]
    return sorted(found, key=lambda event: float(event["t_s"]))
