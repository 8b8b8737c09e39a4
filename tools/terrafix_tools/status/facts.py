"""Facts of a status as plain values: what the screen shows, and the JSON of `terrafix status --json`."""

from typing import Any

import msgspec
import numpy as np

from terrafix import messages as m
from terrafix.core.gate import CHI2_95
from terrafix_tools.report.sections_autopilot import EKF_POS_HORIZ_ABS
from terrafix_tools.report.text import FIX_3D
from terrafix_tools.status.processes import ProcessState
from terrafix_tools.status.state import RATED, Status

SILENT_S = 2.0  # age of GPS_INPUT or LinkStatus from which the link is silent [spec: GPS_INPUT 10, status 1 Hz]


def facts(status: Status, processes: list[ProcessState], now_ns: int) -> dict[str, Any]:
    """-> source, position, autopilot, processes, rates, computer and log; None: not known (yet)."""
    source, rate = status.last(m.SourceFacts), status.last(m.FrameRate)
    return {
        "source": None if source is None else [fact._asdict() for fact in source.facts],
        "position": _position(status, now_ns),
        "autopilot": _autopilot(status, now_ns),
        "processes": [_process(status, process) for process in processes],
        "rates_hz": {kind.__name__: round(status.rate_hz(kind, now_ns), 1) for kind in RATED},
        "frame_rate": None if rate is None else msgspec.structs.asdict(rate),
        "delay_ms": _rounded(status.delay_ms(), 0),
        "map_matches_accepted": _rounded(status.matched_share(), 2),
        "dropped": {f"{process}: {kind}": count for (process, kind), count in sorted(status.dropped.items())},
        "computer": _computer(status),
        "rejected": [f"{v.measurement} {v.verdict.value}: {v.detail}".rstrip(": ") for v in reversed(status.rejected)],
        "texts": [text.text for text in reversed(status.texts)],
    }


def _position(status: Status, now_ns: int) -> dict[str, Any]:
    sent, estimate, search = status.last(m.GpsInput), status.last(m.NavEstimate), status.last(m.SearchState)
    age_s = status.age_s(m.GpsInput, now_ns)
    silent = age_s is None or age_s > SILENT_S
    has_fix = not silent and sent is not None and sent.fix_type >= FIX_3D
    found: dict[str, Any] = {
        "fix": "3D" if has_fix else "none",
        "reason": "" if has_fix else "no GPS_INPUT" if silent or sent is None else sent.no_fix_reason,
        "accuracy_m": _rounded(sent.horiz_accuracy_m, 1) if has_fix and sent is not None else None,
        "degradation": None if sent is None else sent.degradation,
        "since_map_fix_s": None if sent is None else _rounded(sent.unanchored_s, 1),
        "estimate_age_ms": _rounded(sent.estimate_age_ms, 0)
        if sent is not None and sent.estimate_age_ms >= 0
        else None,
        "resets": None if sent is None else sent.resets,
        "search": None if search is None else search.step.value,
    }
    if estimate is not None:
        placed = estimate.is_placed
        horizontal = np.reshape(estimate.cov, (6, 6))[:2, :2]
        found |= {
            "lat_deg": round(estimate.lat_deg, 6) if placed else None,
            "lon_deg": round(estimate.lon_deg, 6) if placed else None,
            "alt_amsl_m": _rounded(estimate.amsl_m, 1),
            "agl_m": round(estimate.agl_m, 1),
            "speed_mps": round(float(np.hypot(*estimate.velocity_enu_mps[:2])), 1),
            "radius_95_m": round(float(np.sqrt(CHI2_95 * np.linalg.eigvalsh(horizontal)[-1])), 1) if placed else None,
            "source": estimate.source_label.value,
            "covariance_mode": estimate.covariance_mode.value,
        }
    return found


def _autopilot(status: Status, now_ns: int) -> dict[str, Any]:
    link, ekf, source = status.last(m.LinkStatus), status.last(m.EkfStatus), status.last(m.PositionSource)
    age_s = status.age_s(m.LinkStatus, now_ns)
    return {
        "connected": link is not None and link.connected and age_s is not None and age_s <= SILENT_S,
        "autopilot": None if link is None else link.autopilot,
        "sent": None if link is None else link.sent,
        "received": None if link is None else link.received,
        "bad_bytes": None if link is None else link.bad,
        "refused": None if link is None else link.refused,
        "uses_position": None if ekf is None else bool(ekf.flags & EKF_POS_HORIZ_ABS),
        "position_test_ratio": None if ekf is None else _rounded(ekf.position_ratio, 2),
        "position_source": None if source is None else "vision" if source.vision else f"receiver {source.receiver}",
        "gnss": {
            str(receiver): {
                "state": found.state.value,
                "distance_m": _rounded(found.distance_m, 0),
                "why": found.reason,
            }
            for receiver, found in sorted(status.gnss.items())
        },
    }


def _process(status: Status, process: ProcessState) -> dict[str, Any]:
    event, thermal = status.events.get(process.name), status.last(m.ThermalReading)
    return {
        "name": process.name,
        "state": process.state,
        "idle_s": _rounded(process.idle_s, 1),
        "load": _rounded(None if thermal is None else thermal.cpu_load.get(process.name), 2),
        "restarts": status.restarts[process.name],
        "last_event": "" if event is None else f"{event.event}: {event.detail}".rstrip(": "),
    }


def _computer(status: Status) -> dict[str, Any]:
    health, thermal = status.last(m.Health), status.last(m.ThermalReading)
    return {
        "band": None if health is None else health.band.value,
        "temperature_c": None if health is None else _rounded(health.temperature_c, 1),
        "throttled": None if health is None else health.throttled,
        "power_w": None if health is None else _rounded(health.power_w, 1),
        "disk_free_mb": None if health is None else health.disk_free_mb,
        "load": _rounded(None if thermal is None else thermal.cpu_load.get("all"), 2),
    }


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)
