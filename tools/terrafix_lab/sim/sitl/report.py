"""Evaluates the observer's log of a SITL flight: figures, and a verdict on each requirement."""

import bisect
import math
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from terrafix.core.errors import OutputError
from terrafix.link.integrity.output_predictor import distance_m
from terrafix_lab.sim.out_folder import write_json
from terrafix_lab.sim.sitl.firmware import Home
from terrafix_lab.sim.sitl.observer import FlightLog, PositionRecord, Truth

MAX_LANDING_ERROR_M = 30.0
MAX_RECOVERY_S = 2.0  # from the restart of all of Terrafix or the camera's return to the 3D fix,
MAX_USE_S = 2.0  # and from this fix until the EKF has a position
MIN_FIX_SHARE = 0.95  # of the reports outside restarts; measured flights: 0.979 to 1 [measured: docs/sitl.md]
MAX_GAP_S = 7.0  # without a 3D fix: an EKF without airspeed gives its velocity up after that [measured: docs/sitl.md]
MAX_P95_M, MAX_ERROR_M = 20.0, 50.0  # own position; 8.3 and 16.2 m at worst [measured: docs/sitl.md]
MAX_TOUCHDOWN_ERROR_M = 20.0  # of the same at touchdown, 9.5 m at worst [measured: docs/sitl.md]
FIX_3D = 3
TOUCHDOWN_HEIGHT_M = (
    1.0  # height above home below which the vehicle counts as touched down; the simulated ground is flat
)
# Substrings of ArduPilot's texts, in lower case (libraries/AP_NavEKF3, ArduCopter/ekf_check.cpp, AP_Arming_GPS).
NOT_HEALTHY = ("not healthy",)
FAILSAFE = ("ekf failsafe", "ekf variance", "failsafe on", "crash", "dcm active", "ahrs: not using")
CRASH = ("crash",)  # ArduPilot notices it after the touchdown
CLEARED = "cleared"
GLITCH = ("gps glitch", "glitch or compass")
SEVERITIES = ("EMERGENCY", "ALERT", "CRITICAL", "ERROR", "WARNING", "NOTICE", "INFO", "DEBUG")


@dataclass(frozen=True)
class Interruption:
    """A time without the camera, or without all of Terrafix; times on the monotonic clock."""

    began_ns: int
    ended_ns: int  # the camera is back, Terrafix restarted
    recovered_ns: int | None = None  # first 3D fix after that
    used_ns: int | None = None  # first report after that fix in which the EKF has a horizontal position again


@dataclass(frozen=True)
class Times:
    """Events of the flight on the monotonic clock; None: did not happen."""

    armed_ns: int | None = None
    lost_ns: int | None = None  # the receiver's 3D fix ended
    landed_ns: int | None = None  # disarmed
    interruptions: tuple[Interruption, ...] = ()


@dataclass(frozen=True)
class Figures:
    """Figures of the time from the GNSS loss to the touchdown, unless stated otherwise. Field names are keys of
    ardupilot.json.
    """

    took_off_on_gnss: bool  # the receiver had a 3D fix from arming to the loss
    landed: bool
    without_gnss_s: float
    flown_m: float  # on GPS_INPUT alone
    landing_error_m: float | None  # distance of the final position from the mission's landing point
    touchdown_m: float | None  # same at touchdown: a plane flares before the point and rolls to it
    # error of the autopilot's own position at touchdown: the share of navigation in it
    belief_touchdown_m: float | None
    not_healthy: int  # texts from arming on, and reports of an unhealthy GPS with a 3D fix
    ekf_failsafes: int  # texts from arming on
    ekf_failsafes_on_ground: int  # of these, between touchdown and disarming, when the vehicle can no longer fall
    crashes: int  # texts from arming to disarming
    glitches: int  # texts from arming on
    gnss_fix_reports: int  # reports in which the disabled receiver has a 3D fix
    gps_input_fix_share: float  # share of the reports in which GPS_INPUT has a 3D fix
    gps_input_longest_gap_s: float  # without one
    # Outside interruptions: from the beginning of each until the fix is back nothing is expected.
    undisturbed_fix_share: float
    undisturbed_longest_gap_s: float
    undisturbed_healthy_share: float  # of the reports of GPS health, with and without a 3D fix
    belief_median_m: float | None  # distance of the autopilot's own position from the truth
    belief_p95_m: float | None
    belief_max_m: float | None
    seen_lost_s: list[float | None]  # from the beginning of each interruption until GPS_INPUT had no fix
    back_s: list[float | None]  # from the end of each interruption to the first 3D fix
    used_s: list[float | None]  # from that fix until the EKF had a horizontal position


def figures(log: FlightLog, times: Times, home: Home) -> Figures:
    """Computes the figures from the log; the mission lands at ``home``."""
    first = times.lost_ns if times.lost_ns is not None else math.inf
    touchdown = next((s for s in log.truth if s.t_ns >= first and s.amsl_m < home.amsl_m + TOUCHDOWN_HEIGHT_M), None)
    last = touchdown.t_ns if touchdown else math.inf

    def after(rows: list[tuple[int, int]] | list[tuple[int, bool]]) -> list[tuple[int, int]]:
        return [(t_ns, int(value)) for t_ns, value in rows if first <= t_ns <= last]

    truth = [state for state in log.truth if first <= state.t_ns <= last]
    errors = [e for e in (_error_m(log.truth, b) for b in log.positions if first <= b.t_ns <= last) if e is not None]
    before = [fix for t_ns, fix in log.fix_types[0] if (times.armed_ns or math.inf) <= t_ns < first]
    fixes = after(log.fix_types[1])
    texts = [record.text.lower() for record in log.texts if (times.armed_ns or math.inf) <= record.t_ns <= last]
    healthy = after(log.gps_healthy)
    undisturbed = _outside(fixes, times.interruptions)
    disarmed_ns = times.landed_ns if times.landed_ns is not None else math.inf
    on_ground = [record.text.lower() for record in log.texts if last < record.t_ns <= disarmed_ns]
    return Figures(
        took_off_on_gnss=bool(before) and min(before) >= FIX_3D,
        landed=times.landed_ns is not None,
        without_gnss_s=(truth[-1].t_ns - truth[0].t_ns) / 1e9 if truth else 0.0,
        flown_m=_length_m(truth),
        landing_error_m=_to_home_m(log.truth[-1], home) if touchdown and times.landed_ns is not None else None,
        touchdown_m=_to_home_m(touchdown, home) if touchdown else None,
        belief_touchdown_m=errors[-1] if touchdown and errors else None,
        not_healthy=_count(texts, NOT_HEALTHY) + _unhealthy_reports(healthy, fixes),
        ekf_failsafes=_count(texts, FAILSAFE),
        ekf_failsafes_on_ground=_count(on_ground, FAILSAFE),
        crashes=_count([*texts, *on_ground], CRASH),
        glitches=_count(texts, GLITCH),
        gnss_fix_reports=sum(fix >= FIX_3D for _, fix in after(log.fix_types[0])),
        gps_input_fix_share=_share([fix >= FIX_3D for _, fix in fixes]),
        gps_input_longest_gap_s=_longest_gap_s(fixes),
        undisturbed_fix_share=_share([fix >= FIX_3D for _, fix in undisturbed]),
        undisturbed_longest_gap_s=_longest_gap_s(undisturbed),
        undisturbed_healthy_share=_share([bool(good) for _, good in _outside(healthy, times.interruptions)]),
        belief_median_m=float(np.median(errors)) if errors else None,
        belief_p95_m=float(np.quantile(errors, 0.95)) if errors else None,
        belief_max_m=max(errors) if errors else None,
        seen_lost_s=[_elapsed_s(gap.began_ns, _lost_ns(fixes, gap)) for gap in times.interruptions],
        back_s=[_elapsed_s(gap.ended_ns, gap.recovered_ns) for gap in times.interruptions],
        used_s=[_elapsed_s(gap.recovered_ns or gap.ended_ns, gap.used_ns) for gap in times.interruptions],
    )


def _share(held: list[bool]) -> float:
    return float(np.mean(held)) if held else 0.0


def _outside(rows: list[tuple[int, int]], interruptions: tuple[Interruption, ...]) -> list[tuple[int, int]]:
    """The reports that were not received between the beginning of an interruption and the 3D fix after it."""
    spans = [(gap.began_ns, math.inf if gap.recovered_ns is None else gap.recovered_ns) for gap in interruptions]
    return [row for row in rows if not any(begin <= row[0] < end for begin, end in spans)]


def _lost_ns(fixes: list[tuple[int, int]], gap: Interruption) -> int | None:
    recovered_ns = math.inf if gap.recovered_ns is None else gap.recovered_ns
    return next((t_ns for t_ns, fix in fixes if gap.began_ns < t_ns < recovered_ns and fix < FIX_3D), None)


def _elapsed_s(from_ns: int, to_ns: int | None) -> float | None:
    return None if to_ns is None else (to_ns - from_ns) / 1e9


def verdicts(flown: Figures, required_m: float) -> dict[str, bool]:
    """Returns requirement -> whether the flight met it."""
    landing_m = flown.landing_error_m

    def within(found: float | None, limit: float) -> bool:
        return found is not None and found <= limit

    requirements = {
        "take-off on GNSS": flown.took_off_on_gnss,
        f"{required_m / 1e3:g} km on GPS_INPUT alone": flown.flown_m >= required_m and flown.gnss_fix_reports == 0,
        "landed": flown.landed,
        f"landing within {MAX_LANDING_ERROR_M:.0f} m": within(landing_m, MAX_LANDING_ERROR_M),
        "no 'GPS not healthy'": flown.not_healthy == 0,
        f"GPS healthy in {MIN_FIX_SHARE:.0%} of the reports": flown.undisturbed_healthy_share >= MIN_FIX_SHARE,
        "no EKF failsafe": flown.ekf_failsafes == 0,
        "no GPS glitch": flown.glitches == 0,
        "no crash": flown.crashes == 0,
        f"3D fix for {MIN_FIX_SHARE:.0%} of the time": flown.undisturbed_fix_share >= MIN_FIX_SHARE,
        f"never {MAX_GAP_S:g} s without a 3D fix": flown.undisturbed_longest_gap_s < MAX_GAP_S,
        f"own position within {MAX_P95_M:.0f} m for 95 % of the time": within(flown.belief_p95_m, MAX_P95_M),
        f"own position within {MAX_ERROR_M:.0f} m always": within(flown.belief_max_m, MAX_ERROR_M),
        f"own position within {MAX_TOUCHDOWN_ERROR_M:.0f} m at touchdown": within(
            flown.belief_touchdown_m, MAX_TOUCHDOWN_ERROR_M
        ),
    }
    if flown.back_s:
        recovered_in_time = [within(back_s, MAX_RECOVERY_S) for back_s in flown.back_s]
        requirements[f"3D fix again within {MAX_RECOVERY_S:g} s of each interruption"] = all(recovered_in_time)
        used_in_time = [within(used_s, MAX_USE_S) for used_s in flown.used_s]
        requirements[f"used by the EKF within {MAX_USE_S:g} s of this fix"] = all(used_in_time)
    return requirements


def write_report(path: Path, about: dict[str, object], flown: Figures, required_m: float) -> None:
    """Writes JSON. Raises OutputError."""
    requirements = verdicts(flown, required_m)
    table = about | {"figures": asdict(flown), "verdicts": requirements, "passed": all(requirements.values())}
    write_json(path, table)


def write_texts(path: Path, log: FlightLog) -> None:
    """Writes every STATUSTEXT with its time since the first true state. Raises OutputError."""
    zero_ns = log.truth[0].t_ns if log.truth else (log.texts[0].t_ns if log.texts else 0)
    lines = [
        f"{(record.t_ns - zero_ns) / 1e9:9.2f} {SEVERITIES[min(record.severity, 7)]:9} {record.text}"
        for record in log.texts
    ]
    _write(path, "\n".join([*lines, ""]))


def write_truth(path: Path, log: FlightLog) -> None:
    """Writes the true trajectory as CSV, on the clock of the record. Raises OutputError."""
    rows = ["t_ns,lat_deg,lon_deg,amsl_m,vn_mps,ve_mps,vd_mps,roll_deg,pitch_deg,yaw_deg"]
    for state in log.truth:
        angles = (math.degrees(a) for a in (state.roll_rad, state.pitch_rad, state.yaw_rad % (2 * math.pi)))
        cells = [f"{state.t_ns}", f"{state.lat_deg:.7f}", f"{state.lon_deg:.7f}"]
        cells += [f"{state.amsl_m:.2f}", *(f"{v:.2f}" for v in state.velocity_ned_mps), *(f"{a:.2f}" for a in angles)]
        rows.append(",".join(cells))
    _write(path, "\n".join([*rows, ""]))


def _to_home_m(state: Truth, home: Home) -> float:
    return distance_m(state.lat_deg, state.lon_deg, home.lat_deg, home.lon_deg)


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another --out") from None


def _count(texts: list[str], patterns: tuple[str, ...]) -> int:
    return sum(any(word in text for word in patterns) and CLEARED not in text for text in texts)


def _length_m(states: list[Truth]) -> float:
    """Path length over steps of a second, so that the jitter of a standing vehicle does not add up."""
    length, last = 0.0, states[0] if states else None
    for state in states:
        if last is not None and state.t_ns - last.t_ns >= 1_000_000_000:
            length += distance_m(last.lat_deg, last.lon_deg, state.lat_deg, state.lon_deg)
            last = state
    return length


def _unhealthy_reports(healthy: list[tuple[int, int]], fixes: list[tuple[int, int]]) -> int:
    """Counts reports of bad health between two reports of a 3D fix; without a fix no GPS counts as healthy, and the
    share of healthy reports is judged instead."""
    at = [t_ns for t_ns, _ in fixes]
    count = 0
    for t_ns, good in healthy:
        i = bisect.bisect_left(at, t_ns)
        count += not good and 0 < i < len(fixes) and min(fixes[i - 1][1], fixes[i][1]) >= FIX_3D
    return count


def _longest_gap_s(fixes: list[tuple[int, int]]) -> float:
    longest_ns, since_ns = 0, None
    for t_ns, fix in fixes:
        if fix >= FIX_3D:
            since_ns = None
        else:
            since_ns = since_ns or t_ns
            longest_ns = max(longest_ns, t_ns - since_ns)
    return longest_ns / 1e9


def _error_m(truth: list[Truth], position: PositionRecord) -> float | None:
    """Error against the state nearest in time: 12 ms at 40 Hz."""
    at = bisect.bisect_left(truth, position.t_ns, key=lambda state: state.t_ns)
    near = [truth[i] for i in (at - 1, at) if 0 <= i < len(truth)]
    if not near:
        return None
    state = min(near, key=lambda state: abs(state.t_ns - position.t_ns))
    return distance_m(state.lat_deg, state.lon_deg, position.lat_deg, position.lon_deg)
