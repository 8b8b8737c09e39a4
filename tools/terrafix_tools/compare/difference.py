"""What differs between two records of one flight: messages, positions, verdicts and timing."""

from collections import Counter
from typing import Any

import numpy as np

from terrafix.core.errors import SourceError
from terrafix.core.geodesy import LocalFrame
from terrafix.recorder.reader import ReadResult
from terrafix_tools.compare.alignment import CLOCKED, NS, REPLAYED, ComparedRecord, Key, contents, keyed

MAX_FIELDS = 8  # differing fields of a message that are listed
SAME_START_M = 0.01  # two origins of one flight are equal but for rounding


def compare_records(a: ComparedRecord, b: ComparedRecord) -> dict[str, Any]:
    """-> the comparison as JSON (docs/compare.md). Raises SourceError for records of two flights."""
    _check_same_flight(a, b)
    left_out = () if a.origin.t_ns == b.origin.t_ns else tuple(kind.__name__ for kind in CLOCKED)
    live = _only_live(a, b)
    left_out = (*left_out, *(kind for kind in live if kind not in left_out))
    keys = [key for key in a.digests if key.kind not in left_out]
    differing = [key for key in keys if key in b.digests and a.digests[key] != b.digests[key]]
    only_a = [key for key in keys if key not in b.digests]
    only_b = [key for key in b.digests if key not in a.digests and key.kind not in left_out]
    first = _first_by_kind(a, b, differing, only_a, only_b)
    return {
        "a": _about(a),
        "b": _about(b),
        "equal": not (differing or only_a or only_b),
        "compared": len(keys) + len(only_b),
        "not_compared": list(left_out),
        "only_live": live,
        "first_verdict": _first_verdict(a, b, left_out),
        "first": first[0] if first else None,
        "first_of_each_message": first,
        "messages": _counts(keys, differing, only_a, only_b),
        "positions": positions(a, b),
        "verdicts": verdicts(a, b),
        "delay_ms": {"a": _delays(a), "b": _delays(b)},
        "configuration": _changed(a.result.header.get("config"), b.result.header.get("config")),
        "versions": _changed(a.result.header.get("versions"), b.result.header.get("versions")),
    }


def _only_live(a: ComparedRecord, b: ComparedRecord) -> list[str]:
    """Types of messages that one of the two has, a live record, and that the other, a replay, cannot have."""
    kinds_a, kinds_b = ({key.kind for key in record.digests} for record in (a, b))
    if kinds_a <= REPLAYED or kinds_b <= REPLAYED:
        return sorted((kinds_a | kinds_b) - REPLAYED)
    return []


def _first_verdict(a: ComparedRecord, b: ComparedRecord, left_out: tuple[str, ...]) -> dict[str, Any] | None:
    """The earliest verdict on a measurement that is another one, or in one record alone; None: all are the same."""
    times = _times(a) | _times(b)
    keys = [key for key in a.verdict_of.keys() | b.verdict_of.keys() if key.kind not in left_out]
    changed = [key for key in keys if a.verdict_of.get(key) != b.verdict_of.get(key)]
    if not changed:
        return None
    first = min(changed, key=lambda key: times[key])
    return {
        "measurement": first.measurement,
        "frame_id": first.frame_id,
        "t_s": round(times[first][0], 3),
        "a": a.verdict_of.get(first),
        "b": b.verdict_of.get(first),
    }


def distances_m(a: ComparedRecord, b: ComparedRecord) -> list[tuple[float, float]]:
    """-> (time since the start [s], horizontal distance of the two positions [m]) of each frame that both have."""
    frame = LocalFrame(a.origin.lat_deg, a.origin.lon_deg)
    found = []
    for frame_id, one in a.estimates.items():
        other = b.estimates.get(frame_id)
        if other is not None:
            p, q = (np.array(frame.to_local(e.lat_deg, e.lon_deg)) for e in (one, other))
            found.append((one.t_s, float(np.linalg.norm(p - q))))
    return found


def positions(a: ComparedRecord, b: ComparedRecord) -> dict[str, Any]:
    """Horizontal distance of the last estimates of each frame."""
    points = distances_m(a, b)
    metres = np.array([metres for _, metres in points])
    result: dict[str, Any] = {
        "frames": len(points),
        "only_a": len(a.estimates.keys() - b.estimates.keys()),
        "only_b": len(b.estimates.keys() - a.estimates.keys()),
    }
    if points:
        worst = int(np.argmax(metres))
        result |= {
            "equal": int(np.sum(metres == 0.0)),
            "median_m": round(float(np.median(metres)), 4),
            "p95_m": round(float(np.percentile(metres, 95)), 4),
            "max_m": round(float(metres[worst]), 4),
            "max_at_s": round(points[worst][0], 3),
        }
    return result


def verdicts(a: ComparedRecord, b: ComparedRecord) -> list[dict[str, Any]]:
    """Number of verdicts by measurement, in both records."""
    pairs = sorted(a.verdicts.keys() | b.verdicts.keys())
    return [
        {"measurement": name, "verdict": verdict, "a": a.verdicts[name, verdict], "b": b.verdicts[name, verdict]}
        for name, verdict in pairs
    ]


def _check_same_flight(a: ComparedRecord, b: ComparedRecord) -> None:
    frame = LocalFrame(a.origin.lat_deg, a.origin.lon_deg)
    apart_m = float(np.hypot(*frame.to_local(b.origin.lat_deg, b.origin.lon_deg)))
    if apart_m > SAME_START_M:
        raise SourceError(
            f"{a.path} and {b.path} are of different flights: their starts are {apart_m:.0f} m apart; give two "
            "records of one flight"
        )
    if a.origin.camera != b.origin.camera:
        raise SourceError(
            f"{a.path} and {b.path} are of different flights: their cameras differ; give two records of one flight"
        )


def _first_by_kind(
    a: ComparedRecord, b: ComparedRecord, differing: list[Key], only_a: list[Key], only_b: list[Key]
) -> list[dict[str, Any]]:
    """The earliest difference of each message type, earliest first."""
    earliest: dict[str, Key] = {}
    times = _times(a) | _times(b)
    candidates = sorted([*differing, *only_a, *only_b], key=lambda key: times[key])
    for key in candidates:
        earliest.setdefault(key.kind, key)
    wanted = set(earliest.values())
    of_a, of_b = _contents_of(a, wanted), _contents_of(b, wanted)
    return [_divergence(key, times[key], of_a.get(key), of_b.get(key)) for key in earliest.values()]


def _times(record: ComparedRecord) -> dict[Key, tuple[float, int]]:
    """-> (time since the start [s], place in the record) of each message; of a frame's messages, that of the frame."""
    return {
        key: (record.frame_t_s[key.frame_id] if key.frame_id >= 0 else key.t_ns / NS, place)
        for place, key in enumerate(record.digests)
    }


def _contents_of(record: ComparedRecord, wanted: set[Key]) -> dict[Key, dict[str, Any]]:
    """The contents of single messages, by a second pass over the record."""
    if not wanted:
        return {}
    return {
        key: contents(message, record.origin.t_ns) for key, message in keyed(record.path, ReadResult()) if key in wanted
    }


def _divergence(
    key: Key, time: tuple[float, int], of_a: dict[str, Any] | None, of_b: dict[str, Any] | None
) -> dict[str, Any]:
    found: dict[str, Any] = {"message": key.kind, "t_s": round(time[0], 3)}
    if key.frame_id >= 0:
        found["frame_id"] = key.frame_id
    if key.measurement:
        found["measurement"] = key.measurement
    if of_a is None or of_b is None:
        return found | {"only_in": "b" if of_a is None else "a"}
    names = [name for name in {**of_a, **of_b} if of_a.get(name) != of_b.get(name)]
    return found | {
        "fields": [{"field": name, "a": of_a.get(name), "b": of_b.get(name)} for name in names[:MAX_FIELDS]],
        "more_fields": max(0, len(names) - MAX_FIELDS),
    }


def _counts(keys: list[Key], differing: list[Key], only_a: list[Key], only_b: list[Key]) -> dict[str, dict[str, int]]:
    total, different, a, b = (Counter(key.kind for key in group) for group in (keys, differing, only_a, only_b))
    return {
        kind: {
            "equal": total[kind] - different[kind] - a[kind],
            "different": different[kind],
            "only_a": a[kind],
            "only_b": b[kind],
        }
        for kind in sorted(total | b)
    }


def _delays(record: ComparedRecord) -> dict[str, float] | None:
    """Delay from exposure to publication of the last estimate of each frame; None without estimates."""
    delays = [estimate.delay_ms for estimate in record.estimates.values()]
    if not delays:
        return None
    return {f"p{p}": round(float(np.percentile(delays, p)), 2) for p in (50, 95, 99)}


def _about(record: ComparedRecord) -> dict[str, Any]:
    return {
        "path": str(record.path),
        "files": [file.name for file in record.result.files],
        "cut_off": [file.name for file in record.result.truncated_files],
        "undecodable": record.result.undecodable,
        "messages": len(record.digests),
    }


def _changed(a: Any, b: Any, prefix: str = "") -> list[dict[str, Any]]:
    """-> the leaves of two nested dicts that differ, each with its dotted name."""
    if isinstance(a, dict) and isinstance(b, dict):
        changes = []
        for name in sorted(a.keys() | b.keys()):
            changes += _changed(a.get(name), b.get(name), f"{prefix}.{name}" if prefix else name)
        return changes
    return [] if a == b else [{"name": prefix, "a": a, "b": b}]
