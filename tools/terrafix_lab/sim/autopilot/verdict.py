"""Verdict on the use of GPS_INPUT by an autopilot, and key figures of a flight."""

from typing import Any

from terrafix_lab.sim.autopilot.report import PeerReport

MIN_HEALTHY_SHARE = 0.8  # least share of the flight with a healthy GPS
MIN_FIX3_SHARE = 0.5  # least share with a 3D fix
MAX_MEDIAN_ERROR_M = 20.0  # largest median error of the sent positions
MAX_P95_ERROR_M = 100.0  # largest 95 % quantile of their error


def gps_input_failure(peer: PeerReport) -> str:
    """Returns why the flight does not count as flown on GPS_INPUT; "" when it does."""
    if not peer.gps_input_received:
        return "no GPS_INPUT arrived"
    if peer.accepted == 0:
        return f"{peer.gps_input_received} GPS_INPUT arrived, none was used"
    if peer.healthy_share < MIN_HEALTHY_SHARE:
        return f"its GPS was healthy for only {100 * peer.healthy_share:.0f} % of the time"
    if peer.fix3_share < MIN_FIX3_SHARE:
        return f"it had a 3D fix for only {100 * peer.fix3_share:.0f} % of the time"
    if peer.gps_error_median_m is None or peer.gps_error_median_m > MAX_MEDIAN_ERROR_M:
        return f"the positions were wrong by {number(peer.gps_error_median_m, 'm')} in the median"
    if peer.gps_error_p95_m is None or peer.gps_error_p95_m > MAX_P95_ERROR_M:
        return f"5 % of the positions were wrong by over {number(peer.gps_error_p95_m, 'm')}"
    return ""


def key_figures(evaluation: dict[str, Any], peer: PeerReport) -> list[str]:
    """Returns the key figures of a flight as text lines."""
    localised = f"{evaluation.get('localised', 0)} of {evaluation.get('frames', 0)} localised"
    shares = ", ".join(f"{100 * evaluation.get(f'within_{m}m', 0.0):.0f} % within {m} m" for m in (10, 20, 50))
    coverage = evaluation.get("ellipse95_coverage")
    return [
        f"frames   {localised}: {shares}; median error {number(evaluation.get('median_m'), 'm')}",
        f"ellipse  truth inside the 95 % ellipse in {'-' if coverage is None else f'{100 * coverage:.0f} %'} of them, "
        f"{evaluation.get('false_fixes', 0)} false fixes",
        f"GPS      {peer.gps_input_received} GPS_INPUT, interval {number(peer.interval_median_ms, 'ms')} "
        f"(p99 {number(peer.interval_p99_ms, 'ms')}, longest {number(peer.longest_gap_ms, 'ms')}), "
        f"healthy {100 * peer.healthy_share:.0f} %, 3D fix {100 * peer.fix3_share:.0f} % of the time",
        f"autopilot used {peer.accepted}, rejected {peer.rejected}, {peer.resets} resets; its position error was "
        f"{number(peer.position_error_median_m, 'm')} (median), {number(peer.position_error_p95_m, 'm')} (95 %)",
    ]


def number(value: float | None, unit: str) -> str:
    """Formats metres with one digit, other units without."""
    return "-" if value is None else f"{value:.1f} {unit}" if unit == "m" else f"{value:.0f} {unit}"
