"""Whether an autopilot was served, and its flight in a few lines."""

from typing import Any

from terrafix_tools.sim.autopilot.report import PeerReport

SERVED_HEALTHY = 0.8  # share of the flight in which the autopilot must call its GPS healthy
SERVED_FIX3 = 0.5  # ... and have a 3D fix
SERVED_ERROR_M = 20.0  # median error of the positions it was given
ASTRAY_ERROR_M = 100.0  # ... and 95 % of them must be nearer than this


def not_served(peer: PeerReport) -> str:
    """Why the flight does not count as flown on GPS_INPUT; "" when it does."""
    if not peer.gps_input_received:
        return "no GPS_INPUT arrived"
    if peer.accepted == 0:
        return f"{peer.gps_input_received} GPS_INPUT arrived and none was used"
    if peer.healthy_share < SERVED_HEALTHY:
        return f"its GPS was healthy for only {100 * peer.healthy_share:.0f} % of the time"
    if peer.fix3_share < SERVED_FIX3:
        return f"it had a 3D fix for only {100 * peer.fix3_share:.0f} % of the time"
    if peer.gps_error_median_m is None or peer.gps_error_median_m > SERVED_ERROR_M:
        return f"the positions were wrong by {number(peer.gps_error_median_m, 'm')} in the median"
    if peer.gps_error_p95_m is None or peer.gps_error_p95_m > ASTRAY_ERROR_M:
        return f"it was led astray: a twentieth of the positions was wrong by over {number(peer.gps_error_p95_m, 'm')}"
    return ""


def key_figures(evaluation: dict[str, Any], peer: PeerReport) -> list[str]:
    """The flight in a few lines."""
    found = f"{evaluation.get('localised', 0)} of {evaluation.get('frames', 0)} localised"
    shares = ", ".join(f"{100 * evaluation.get(f'within_{m}m', 0.0):.0f} % within {m} m" for m in (10, 20, 50))
    coverage = evaluation.get("ellipse95_coverage")
    return [
        f"frames   {found}: {shares}; median error {number(evaluation.get('median_m'), 'm')}",
        f"honesty  truth inside the 95 % ellipse in {'-' if coverage is None else f'{100 * coverage:.0f} %'} of them, "
        f"{evaluation.get('false_fixes', 0)} false fixes",
        f"GPS      {peer.gps_input_received} GPS_INPUT, interval {number(peer.interval_median_ms, 'ms')} "
        f"(p99 {number(peer.interval_p99_ms, 'ms')}, longest {number(peer.longest_gap_ms, 'ms')}), "
        f"healthy {100 * peer.healthy_share:.0f} %, 3D fix {100 * peer.fix3_share:.0f} % of the time",
        f"autopilot used {peer.accepted}, rejected {peer.rejected}, {peer.resets} resets; its own position was off by "
        f"{number(peer.position_error_median_m, 'm')} (median), {number(peer.position_error_p95_m, 'm')} (95 %)",
    ]


def number(value: float | None, unit: str) -> str:
    """For people: metres with a digit, other units without."""
    return "-" if value is None else f"{value:.1f} {unit}" if unit == "m" else f"{value:.0f} {unit}"
