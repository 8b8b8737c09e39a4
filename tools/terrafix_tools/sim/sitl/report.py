"""What a flight on ArduPilot's firmware has shown: numbers out of the observer's notes, and a verdict for each."""

import bisect
import math
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from terrafix.core.errors import OutputError
from terrafix.link.integrity.output_predictor import distance_m
from terrafix_tools.sim.out_folder import write_json
from terrafix_tools.sim.sitl.firmware import Home
from terrafix_tools.sim.sitl.observer import Belief, Notes, Truth

LANDED_WITHIN_M = 30.0
BACK_WITHIN_S = 2.0  # of the restart of all of Terrafix
FIX_3D = 3
TOUCHED_M = 1.0  # height over home at which it stands or rolls: the simulated ground is flat
# Words of ArduPilot's texts, in lower case (libraries/AP_NavEKF3, ArduCopter/ekf_check.cpp, AP_Arming_GPS).
NOT_HEALTHY = ("not healthy",)
FAILSAFE = ("ekf failsafe", "ekf variance", "failsafe on", "crash", "dcm active", "ahrs: not using")
CLEARED = "cleared"
GLITCH = ("gps glitch", "glitch or compass")
SEVERITIES = ("EMERGENCY", "ALERT", "CRITICAL", "ERROR", "WARNING", "NOTICE", "INFO", "DEBUG")


@dataclass(frozen=True)
class Kill:
    """All of Terrafix was killed, and started again: moments on the monotonic clock."""

    killed_ns: int
    restarted_ns: int
    back_ns: int | None = None  # its first 3D fix after that


@dataclass(frozen=True)
class Times:
    """Moments of the flight on the monotonic clock; None: never came to it."""

    armed_ns: int | None = None
    lost_ns: int | None = None  # the receiver had no 3D fix any more
    landed_ns: int | None = None  # disarmed
    kills: tuple[Kill, ...] = ()


@dataclass(frozen=True)
class Figures:
    """Of the time from the loss of the GNSS to the touchdown, unless it says otherwise."""

    took_off_on_gnss: bool  # a 3D fix of the receiver from arming to the loss
    landed: bool
    without_gnss_s: float
    flown_m: float  # on GPS_INPUT alone
    landing_error_m: float | None  # from the mission's landing point to where it stands in the end
    touchdown_m: float | None  # ... and to where it touched down: a plane flares before the point, and rolls to it
    belief_touchdown_m: float | None  # how far off its own position was then: what of it was navigation
    not_healthy: int  # texts from arming on, and reports of a GPS that has a 3D fix and is not healthy
    ekf_failsafes: int  # texts from arming on
    ekf_failsafes_on_ground: int  # ... and between touchdown and disarming, when nothing can fall any more
    glitches: int  # texts from arming on
    gnss_fix_reports: int  # in which the dead receiver had a 3D fix after all
    gps_input_fix_share: float  # of the reports in which GPS_INPUT had a 3D fix
    gps_input_longest_gap_s: float  # without one
    belief_median_m: float | None  # distance of the autopilot's own position from the truth
    belief_p95_m: float | None
    belief_max_m: float | None
    seen_lost_s: list[float | None]  # from each kill until the firmware said that GPS_INPUT has no fix
    back_s: list[float | None]  # from each restart to the first 3D fix


def figures(notes: Notes, times: Times, home: Home) -> Figures:
    """Pure arithmetic on what was noted; the mission lands at home."""
    first = times.lost_ns if times.lost_ns is not None else math.inf
    touchdown = next((s for s in notes.truth if s.t_ns >= first and s.amsl_m < home.amsl_m + TOUCHED_M), None)
    last = touchdown.t_ns if touchdown else math.inf

    def after(rows: list[tuple[int, int]] | list[tuple[int, bool]]) -> list[tuple[int, int]]:
        return [(t_ns, int(value)) for t_ns, value in rows if first <= t_ns <= last]

    truth = [state for state in notes.truth if first <= state.t_ns <= last]
    errors = [e for e in (_error_m(notes.truth, b) for b in notes.beliefs if first <= b.t_ns <= last) if e is not None]
    before = [fix for t_ns, fix in notes.fix_types[0] if (times.armed_ns or math.inf) <= t_ns < first]
    fixes = after(notes.fix_types[1])
    texts = [said.text.lower() for said in notes.said if (times.armed_ns or math.inf) <= said.t_ns <= last]
    stands = times.landed_ns if times.landed_ns is not None else math.inf
    on_ground = [said.text.lower() for said in notes.said if last < said.t_ns <= stands]
    return Figures(
        took_off_on_gnss=bool(before) and min(before) >= FIX_3D,
        landed=times.landed_ns is not None,
        without_gnss_s=(truth[-1].t_ns - truth[0].t_ns) / 1e9 if truth else 0.0,
        flown_m=_length_m(truth),
        landing_error_m=_to_home_m(notes.truth[-1], home) if touchdown and times.landed_ns is not None else None,
        touchdown_m=_to_home_m(touchdown, home) if touchdown else None,
        belief_touchdown_m=errors[-1] if touchdown and errors else None,
        not_healthy=_count(texts, NOT_HEALTHY) + _sick(after(notes.gps_healthy), fixes),
        ekf_failsafes=_count(texts, FAILSAFE),
        ekf_failsafes_on_ground=_count(on_ground, FAILSAFE),
        glitches=_count(texts, GLITCH),
        gnss_fix_reports=sum(fix >= FIX_3D for _, fix in after(notes.fix_types[0])),
        gps_input_fix_share=float(np.mean([fix >= FIX_3D for _, fix in fixes])) if fixes else 0.0,
        gps_input_longest_gap_s=_longest_gap_s(fixes),
        belief_median_m=float(np.median(errors)) if errors else None,
        belief_p95_m=float(np.quantile(errors, 0.95)) if errors else None,
        belief_max_m=max(errors) if errors else None,
        seen_lost_s=[_since_s(kill.killed_ns, _lost_ns(fixes, kill)) for kill in times.kills],
        back_s=[_since_s(kill.restarted_ns, kill.back_ns) for kill in times.kills],
    )


def _lost_ns(fixes: list[tuple[int, int]], kill: Kill) -> int | None:
    back_ns = math.inf if kill.back_ns is None else kill.back_ns
    return next((t_ns for t_ns, fix in fixes if kill.killed_ns < t_ns < back_ns and fix < FIX_3D), None)


def _since_s(from_ns: int, to_ns: int | None) -> float | None:
    return None if to_ns is None else (to_ns - from_ns) / 1e9


def verdicts(flown: Figures, asked_m: float) -> dict[str, bool]:
    """What was asked of the flight -> whether it held."""
    landing_m = flown.landing_error_m
    held = {
        "take-off on GNSS": flown.took_off_on_gnss,
        f"{asked_m / 1e3:g} km on GPS_INPUT alone": flown.flown_m >= asked_m and flown.gnss_fix_reports == 0,
        "landed": flown.landed,
        f"landing within {LANDED_WITHIN_M:.0f} m": landing_m is not None and landing_m <= LANDED_WITHIN_M,
        "no 'GPS not healthy'": flown.not_healthy == 0,
        "no EKF failsafe": flown.ekf_failsafes == 0,
    }
    if flown.back_s:
        quick = [back_s is not None and back_s <= BACK_WITHIN_S for back_s in flown.back_s]
        held[f"3D fix again within {BACK_WITHIN_S:g} s of each restart"] = all(quick)
    return held


def write_report(path: Path, about: dict[str, object], flown: Figures, asked_m: float) -> None:
    """JSON. Raises OutputError."""
    held = verdicts(flown, asked_m)
    table = about | {"figures": asdict(flown), "verdicts": held, "passed": all(held.values())}
    write_json(path, table)


def write_texts(path: Path, notes: Notes) -> None:
    """Every STATUSTEXT with its second since the first truth. Raises OutputError."""
    zero_ns = notes.truth[0].t_ns if notes.truth else (notes.said[0].t_ns if notes.said else 0)
    lines = [
        f"{(said.t_ns - zero_ns) / 1e9:9.2f} {SEVERITIES[min(said.severity, 7)]:9} {said.text}" for said in notes.said
    ]
    _write(path, "\n".join([*lines, ""]))


def write_truth(path: Path, notes: Notes) -> None:
    """The true course as CSV, on the clock of the record. Raises OutputError."""
    rows = ["t_ns,lat_deg,lon_deg,amsl_m,vn_mps,ve_mps,vd_mps,roll_deg,pitch_deg,yaw_deg"]
    for state in notes.truth:
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


def _count(texts: list[str], words: tuple[str, ...]) -> int:
    return sum(any(word in text for word in words) and CLEARED not in text for text in texts)


def _length_m(states: list[Truth]) -> float:
    """Of the path, over pieces of a second: what a vehicle that stands trembles does not count."""
    length, last = 0.0, states[0] if states else None
    for state in states:
        if last is not None and state.t_ns - last.t_ns >= 1_000_000_000:
            length += distance_m(last.lat_deg, last.lon_deg, state.lat_deg, state.lon_deg)
            last = state
    return length


def _sick(healthy: list[tuple[int, int]], fixes: list[tuple[int, int]]) -> int:
    """Reports of bad health between two reports of a 3D fix: without a fix no GPS counts as healthy."""
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


def _error_m(truth: list[Truth], belief: Belief) -> float | None:
    """Against the nearest state in time: 12 ms at 40 Hz."""
    at = bisect.bisect_left(truth, belief.t_ns, key=lambda state: state.t_ns)
    near = [truth[i] for i in (at - 1, at) if 0 <= i < len(truth)]
    if not near:
        return None
    state = min(near, key=lambda state: abs(state.t_ns - belief.t_ns))
    return distance_m(state.lat_deg, state.lon_deg, belief.lat_deg, belief.lon_deg)
