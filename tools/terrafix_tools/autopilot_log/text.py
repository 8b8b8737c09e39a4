"""An overlay, and the contents of a log, as lines of text."""

from collections.abc import Iterator
from typing import Any

from terrafix_tools.autopilot_log.structure import AutopilotLog
from terrafix_tools.pages.charts import clock

MAX_MESSAGES = 40  # events that are shown in a terminal


def as_json(log: AutopilotLog) -> dict[str, Any]:
    """Contents of a log."""
    first_s, last_s = log.span_s
    return {
        "path": str(log.path),
        "bytes": log.path.stat().st_size,
        "kind": log.kind,
        "firmware": log.firmware,
        "from_s": round(first_s, 3),
        "to_s": round(last_s, 3),
        "attitude": len(log.attitude.t_s),
        "body_rates": 0 if log.rates is None else len(log.rates.t_s),
        "position": 0 if log.position is None else len(log.position.t_s),
        "origin": None
        if log.origin is None
        else {"lat_deg": log.origin.lat_deg, "lon_deg": log.origin.lon_deg, "alt_amsl_m": log.origin.alt_amsl_m},
        "ekf_cores": sorted({track.core for track in log.ekf} | set(log.ratios) | set(log.innovations)),
        "gps": [{"instance": track.instance, "samples": len(track.t_s)} for track in log.gps],
        "test_ratios": sorted({name for series in log.ratios.values() for name in series.values}),
        "innovations": sorted({name for series in log.innovations.values() for name in series.values}),
        "fused": [fusion.name for fusion in log.fusion],
        "events": len(log.events),
        "skipped_bytes": log.skipped_bytes,
        "notes": log.notes,
        "messages": dict(sorted(log.counts.items())),
    }


def info_lines(log: AutopilotLog) -> Iterator[str]:
    about = as_json(log)
    duration_s = about["to_s"] - about["from_s"]
    yield f"{log.path}: {log.kind}, {about['bytes'] / 1e6:.1f} MB"
    yield f"{log.firmware or 'unknown firmware'}, {duration_s:.1f} s from {about['from_s']:.1f} s of its clock"
    yield f"attitude {about['attitude']}, body rates {about['body_rates']}, position {about['position']}"
    receivers = ", ".join(f"GPS {track['instance'] + 1} {track['samples']}" for track in about["gps"])
    yield f"receivers: {receivers or 'none'}"
    yield f"EKF cores: {', '.join(map(str, about['ekf_cores'])) or 'none'}"
    yield f"test ratios: {', '.join(about['test_ratios']) or 'none'}"
    yield f"{about['events']} modes, events, errors and messages"
    for name, count in about["messages"].items():
        yield f"  {name:<32} {count:>8}  {count / duration_s if duration_s > 0 else 0.0:8.2f} Hz"
    if log.skipped_bytes:
        yield f"{log.skipped_bytes} bytes are damaged or cut off: left out"
    yield from log.notes


def summary(found: dict[str, Any]) -> Iterator[str]:
    """Lines of an overlay for a terminal."""
    of_log = found["log"]
    yield f"{of_log['path']}: {of_log['kind']}, {of_log['firmware'] or 'unknown firmware'}"
    yield from of_log["notes"]
    yield f"covers {found['from_s']:.1f} to {found['to_s']:.1f} s of {found['duration_s']:.1f} s of the record"
    yield clock_line(found["clock"])
    for receiver in found["gps"]:
        yield receiver_line(receiver)
    for fusion in found["fused"]:
        yield f"EKF, {fusion['name']}: {fusion['seconds']:.1f} s, begun {len(fusion['spans'])} times"
    for title, key in (("lane", "lanes"), ("source set", "source_sets")):
        if found[key]:
            yield f"{title}: " + ", ".join(f"{span['value']} from {span['from_s']:.1f} s" for span in found[key])
    for name, ratio in found["test_ratios"].items():
        yield (
            f"test ratio {name}: at most {ratio['max']:.2f} at {ratio['max_at_s']:.1f} s, "
            f"{100 * ratio['above_gate_share']:.1f} % above the gate"
        )
    sent = found["sent_less_ekf"]
    if sent is None:
        yield "GPS_INPUT against the EKF: nothing to compare"
    else:
        yield (
            f"GPS_INPUT against the EKF: horizontal median {sent['median_m']:.2f} m, p95 {sent['p95_m']:.2f} m, "
            f"at most {sent['max_m']:.2f} m at {sent['max_at_s']:.1f} s"
        )
    for event in found["events"][:MAX_MESSAGES]:
        yield f"{event['t_s']:10.3f} s  {event['kind']:<10} {event['text']}"
    if len(found["events"]) > MAX_MESSAGES:
        yield f"and {len(found['events']) - MAX_MESSAGES} more events; --json has all"


def clock_line(about: dict[str, Any]) -> str:
    return (
        f"clocks: log less record {about['offset_s']:.4f} s +- {1e3 * about['offset_sigma_s']:.2f} ms at "
        f"{clock(round(about['at_s']))}, drift {about['drift_ppm']:+.2f} +- {about['drift_sigma_ppm']:.2f} ppm; "
        f"correlation {about['correlation']:.2f}, next {about['next_correlation']:.2f}, "
        f"needed {about['needed_correlation']:.2f}, aligned {about['aligned_correlation']:.2f}"
    )


def receiver_line(receiver: dict[str, Any]) -> str:
    used = receiver["used_share"]
    return (
        f"{receiver['name']}: {receiver['samples']} samples, 3D fix {percent(receiver['fix_3d_share'])}, "
        f"used {'unknown' if used is None else percent(used)}"
    )


def percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.0f} %"
