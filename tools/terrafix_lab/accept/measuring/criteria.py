"""The rows AC-1 to AC-17: measurement, floor and goal of each number. Described in docs/acceptance.md."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from terrafix_lab.accept.false_inputs import integrity, loop_integrity
from terrafix_lab.accept.measuring import measures as of
from terrafix_lab.accept.measuring.consistency import COVERAGE
from terrafix_lab.accept.measuring.evidence import Evidence
from terrafix_lab.accept.measuring.results import Bounds, JudgedRow, Measured, Verdict
from terrafix_lab.track import CRITERIA as CRITERIA_OF_TRACKS


@dataclass(frozen=True)
class Criterion:
    """``floor`` None: shown, not judged. ``not_judged``: reason why the number is not judged on this machine."""

    ac: str
    what: str
    unit: str
    floor: Bounds | None
    goal: Bounds | None
    measure: Callable[[Evidence], Measured]
    not_judged: str = ""


def _least(low: float) -> Bounds:
    return Bounds(low=low)


def _most(high: float) -> Bounds:
    return Bounds(high=high)


ALL = _least(1.0)
LATENCY_NOTE = "the promise is for the computer on board; this machine may fly several scenarios at once"
_ROWS: dict[str, tuple[str, str, str, Bounds | None, Bounds | None, Callable[[Evidence], Measured]]] = {
    # name: row, what, unit, floor, goal, how
    "within 50 m": ("AC-1", "frames within 50 m", "%", _least(0.80), _least(0.99), of.within_50m),
    "within 50 m outside": (
        "AC-1", "frames within 50 m, outside the marked time", "%", _least(0.80), _least(0.99), of.within_50m_outside),
    "within 20 m": ("AC-2", "frames within 20 m", "%", _least(0.60), _least(0.95), of.within_20m),
    "near at all": ("AC-2", "frames within 20 m, shown only", "%", None, None, of.within_20m),
    "wrong ones rejected": ("AC-3", "wrong frames or fixes rejected", "%", ALL, None, of.wrong_rejected),
    "next frame": ("AC-3", "error after a wrong frame or fix, worst", "m", _most(50.0), None, of.error_after_wrong),
    "fragments": ("AC-4", "disconnected fragments that survive", "%", ALL, None, of.fragments_localised),
    "fragments merged": (
        "AC-4", "from a fragment's map fix to its refined past, in flight", "s", _most(5.0), None,
        of.fragments_merged_after_s),
    "fragments accurate": (
        "AC-4", "frames within 50 m, worst fragment", "%", _least(0.80), _least(0.99), of.worst_fragment),
    "not localised": ("AC-5", "frames not localised", "%", _most(0.10), _most(0.01), of.not_localised),
    "says so": ("AC-6", "time until it says that the map no longer holds it", "s", _most(2.0), None, of.label_change_s),
    "asks": ("AC-6", "asks for a position only when it must: late by", "s", _most(2.0), None, of.prior_request_delay_s),
    "latency": ("AC-7", "image to position, p95", "ms", _most(400.0), _most(120.0), of.latency_p95),
    "both estimates": ("AC-8", "frames with both, immediate and refined", "%", _least(0.80), None, of.both_estimates),
    "odometry": ("AC-9", "frames registered by odometry", "%", _least(0.95), None, of.odometry_rate),
    "odometry px": ("AC-10", "reprojection error of odometry, mean", "px", _most(1.0), None, of.odometry_px),
    "map px": ("AC-10", "reprojection error of map matches, mean", "px", _most(of.MAP_FLOOR_PX), None, of.map_px),
    "drift": ("AC-11", "drift between map fixes, worst", "m", _most(100.0), _most(50.0), of.drift),
    "drift share": ("AC-11", "drift by distance, longest way without a fix", "%", None, _most(0.005), of.drift_share),
    "claims": ("AC-12", "estimates with covariance, label, mode, age of fix", "%", ALL, None, of.complete_estimates),
    "coverage": ("AC-13", "truth inside the 95 % ellipse", "%", COVERAGE, None, of.coverage),
    "false fixes": ("AC-13", "frames wrong by over 50 m and sure of it", "", _most(0.0), None, of.false_fixes),
    "interval": ("AC-14", "GPS_INPUT interval, p99", "ms", _most(120.0), None, of.gps_interval_p99_ms),
    "gap": ("AC-14", "longest gap between GPS_INPUT", "ms", _most(245.0), None, of.gps_longest_gap_ms),
    "first position": ("AC-15", "first position after the start", "s", _most(30.0), _most(15.0), of.first_position_s),
    "found again": (
        "AC-15", "back within 50 m afterwards", "s", _most(of.RELOCALIZED_FLOOR_S), _most(15.0),
        of.relocalized_after_s),
    "memory": ("AC-16", "peak memory", "MB", _most(8192.0), _most(2048.0), of.memory_mb),
    "vehicle error": (
        "ON-6", "error of the autopilot's own position, worst", "m", _most(200.0), _most(50.0), of.vehicle_error_m),
    "failsafes": ("ON-6", "fail-safes of the autopilot", "", _most(0.0), None, of.failsafes),
    "late false fixes": (
        "AC-13", "false fixes later than 3 s and 5 frames into the lie", "", _most(0.0), None,
        integrity.late_false_fixes),
    "late sure over 20 m": (
        "AC-13", "the same beyond 20 m", "", _most(0.0), None, integrity.late_overconfident_over_20m),
    "false fixes in all": ("AC-13", "false fixes in all", "", None, None, integrity.false_fixes_in_all),
    "time to notice": (
        "AC-13", "from the lie's beginning to the last false fix", "s", None, None, integrity.time_to_notice_s),
    "longest false run": ("AC-13", "false fixes in a row, most", "", None, None, integrity.longest_false_run),
    "recovery": ("AC-15", "frames until right again", "", _most(10.0), None, integrity.recovery_frames),
    "right at the end": (
        "AC-15", "frames within 50 m in the last tenth", "%", _least(0.80), None, integrity.right_at_the_end),
    "claim width": ("AC-13", "claimed 1-sigma over that of the error", "", None, None, integrity.claim_width),
    "aside on a fix": (
        "ON-6", "aside of the way without the lie while a 3D fix is sent, worst", "m", _most(50.0), None,
        loop_integrity.deviation_on_a_fix_m),
    "aside at withdrawal": (
        "ON-6", "aside when the 3D fix is withdrawn", "m", None, None, loop_integrity.deviation_at_withdrawal_m),
    "late lies sent": (
        "AC-13", "false GPS_INPUT later than 3 s and 5 frames into the lie", "", _most(0.0), None,
        loop_integrity.late_false_fixes_sent),
    "lies sent": ("AC-13", "false GPS_INPUT in all", "", None, None, loop_integrity.false_fixes_sent),
    "fix again": ("AC-15", "3D fix and right again after the lie", "s", _most(5.0), None, loop_integrity.fix_again_s),
    "mode": ("ON-2", "frames with the covariance mode that heat asks for", "%", ALL, None, of.right_mode),
}  # fmt: skip
SHARED = tuple(
    name for name, row in CRITERIA_OF_TRACKS.items() if name not in _ROWS and not row.live
)  # with all campaigns; shown, not judged
_ROWS |= {
    name: (
        "AC-15",
        CRITERIA_OF_TRACKS[name].what,
        CRITERIA_OF_TRACKS[name].unit,
        None,
        None,
        partial(integrity.of_track, name),
    )
    for name in SHARED
}
CRITERIA = {name: Criterion(*row, not_judged=LATENCY_NOTE if name == "latency" else "") for name, row in _ROWS.items()}

# Rows of a false input that lasts to the end of the flight, and of one that ends before.
PERMANENT = (
    "late false fixes", "false fixes in all", "time to notice", "longest false run", "near at all", "claims",
    *SHARED,
)  # fmt: skip
TEMPORARY = (*PERMANENT, "recovery", "right at the end", "claim width")
LYING_IN_THE_LOOP = (
    "aside on a fix", "aside at withdrawal", "late lies sent", "lies sent", "fix again", "recovery",
    "late false fixes", "false fixes in all", "right at the end", "claims", "vehicle error", "failsafes",
)  # fmt: skip
WITH_SPAN = ("claims", "coverage", "false fixes", "both estimates", "within 50 m outside", "says so", "found again")
EVERYWHERE = ("within 50 m", "within 20 m", "not localised", "both estimates", "claims", "coverage", "false fixes")
SCARCE = (*EVERYWHERE, "claim width")


def judge(scenario: str, names: tuple[str, ...], evidence: Evidence) -> list[JudgedRow]:
    """One row for each name, a key of CRITERIA."""
    return [_row(scenario, CRITERIA[name], evidence) for name in names]


def unmeasured(scenario: str, names: tuple[str, ...], why: str) -> list[JudgedRow]:
    """The same rows for a scenario that cannot be flown."""
    return [_made(scenario, CRITERIA[name], None, Verdict.NOT_MEASURABLE, why) for name in names]


def failed(scenario: str, names: tuple[str, ...], why: str) -> list[JudgedRow]:
    """The same rows for a flight that crashed."""
    return [_made(scenario, CRITERIA[name], None, Verdict.BELOW, why) for name in names]


def _row(scenario: str, criterion: Criterion, evidence: Evidence) -> JudgedRow:
    found = criterion.measure(evidence)
    if found.verdict is not None:
        return _made(scenario, criterion, found.value, found.verdict, found.why)
    if found.value is None or criterion.not_judged:
        return _made(scenario, criterion, found.value, Verdict.NOT_MEASURABLE, found.why or criterion.not_judged)
    holds = criterion.floor is None or criterion.floor.holds(found.value)
    return _made(scenario, criterion, found.value, Verdict.PASS if holds else Verdict.BELOW, found.why)


def _made(scenario: str, criterion: Criterion, value: float | None, verdict: Verdict, why: str) -> JudgedRow:
    judged = value is not None and criterion.goal is not None and verdict in (Verdict.PASS, Verdict.BELOW)
    return JudgedRow(
        scenario=scenario,
        ac=criterion.ac,
        what=criterion.what,
        measured=None if value is None else round(value, 6),
        unit=criterion.unit,
        floor="" if criterion.floor is None else criterion.floor.text(criterion.unit),
        goal="" if criterion.goal is None else criterion.goal.text(criterion.unit),
        verdict=verdict,
        goal_met=criterion.goal.holds(value) if judged and criterion.goal and value is not None else None,
        why=why,
    )
