"""What a fault did: GPS_INPUT against the truth, time to recover, what the record lacks."""

import itertools
import math
from collections.abc import Sequence

import msgspec
import numpy as np

from terrafix_lab.faults.edits import Span
from terrafix_lab.sim.autopilot.report import ReceivedFix
from terrafix_lab.track import Track

# A position is wrong when its error is above this many times its horiz_accuracy (1-sigma of the worst axis): of a true
# claim 3 of 10 000 are, exp(-4^2 / 2).
WRONG_SIGMAS = 4.0
STEADY_S = 1.0  # a fix is back when none of the GPS_INPUT of this long afterwards lacks one
MATCH_S = 0.15  # a recorded GPS_INPUT within this time of a received one is that one: its period is 0.1 s
WITHOUT_FIX_S = 0.35  # between two 3D fixes, from which on there was no fix: more than three periods
NOTHING_M = 1e-6  # the claim of a fix that states none: any error is beyond it
NO_FIX = "no fix before the fault"  # the flight itself failed, on a busy computer; the cell is flown again
RECORD_LIMIT_S = 1.5  # a kill or a power cut loses at most 1.25 s by the promise of the recorder, and a period


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """Of one cell. Times in seconds; wall time, on a computer that may be busy with other things."""

    fault: str
    phase: str
    verdict: str  # "ok", or what is not
    fixes: int = 0  # 3D fixes that the autopilot received
    wrong: int = 0
    worst_sigmas: float | None = None  # largest error over its horiz_accuracy
    worst_error_m: float | None = None
    silence_s: float | None = None  # longest time without any GPS_INPUT from the beginning of the fault on
    without_fix_s: float | None = None  # sum of the times without a 3D fix from the beginning of the fault on
    fix_lost: int = 0  # times that the 3D fix was lost from the beginning of the fault on
    back_s: float | None = None  # from the end of the fault to a lasting fix; None: not back, or none before
    not_recorded_s: float | None = None  # longest time of GPS_INPUT that the record lacks
    stop_s: float | None = None  # that the ordered stop took
    texts: list[str] = []  # that the autopilot received from the beginning of the fault on, with seconds since then
    report: str = ""  # the verdict of the report
    untrusted: list[str] = []  # spans that it does not trust, in seconds since the beginning of the fault, with reason
    criteria: dict[str, str] = {}  # those of terrafix_lab/track.py
    load: float | None = None  # load average of the computer over its cores at the end


def track_of(fixes: Sequence[ReceivedFix], fault: Span | None, frames_s: Sequence[float], cause: str = "") -> Track:
    """Of the 3D fixes; the claim is that of the worst axis. ``frames_s``: times of the images."""
    t_s, error_m, sigma_m = (
        np.array([(f.received_s, f.error_m, f.horizontal_m or NOTHING_M) for f in fixes]).reshape(-1, 3).T
    )
    return Track(t_s, error_m, (error_m / sigma_m) ** 2, sigma_m, fault, frames_s, cause=cause)


def without_fix_s(fixes_s: Sequence[float], from_s: float, to_s: float) -> float:
    return sum(_gaps_s(fixes_s, from_s, to_s))


def times_lost(fixes_s: Sequence[float], from_s: float, to_s: float) -> int:
    return len(_gaps_s(fixes_s, from_s, to_s))


def _gaps_s(fixes_s: Sequence[float], from_s: float, to_s: float) -> list[float]:
    times = [from_s, *(t for t in fixes_s if from_s <= t <= to_s), to_s]
    return [gap for a, b in itertools.pairwise(times) if (gap := b - a) > WITHOUT_FIX_S]


def back_s(fixes_s: Sequence[float], ended_s: float, to_s: float) -> float | None:
    """From the end of the fault to the first fix after which none is missing; None: there is none to the end."""
    times = [t for t in fixes_s if t <= to_s]
    if not times or to_s - times[-1] > WITHOUT_FIX_S:
        return None
    first = times[-1]
    for before in reversed(times[:-1]):
        if first - before > WITHOUT_FIX_S:
            break
        first = before
    return max(0.0, first - ended_s)


def not_recorded_s(received_s: Sequence[float], recorded_s: Sequence[float]) -> float:
    """Longest time over which GPS_INPUT was received that is not in the record."""
    recorded = sorted(recorded_s)
    longest, began = 0.0, None
    index = 0
    for t in sorted(received_s):
        while index < len(recorded) and recorded[index] < t - MATCH_S:
            index += 1
        if index < len(recorded) and recorded[index] <= t + MATCH_S:
            began = None
            continue
        began = t if began is None else began
        longest = max(longest, t - began)
    return longest


def wrong_fixes(fixes: Sequence[ReceivedFix], truth_sigma_m: float = 0.0) -> list[ReceivedFix]:
    """``truth_sigma_m``: of the position that they are compared with."""
    return [fix for fix in fixes if sigmas(fix, truth_sigma_m) > WRONG_SIGMAS]


def sigmas(fix: ReceivedFix, truth_sigma_m: float = 0.0) -> float:
    return fix.error_m / math.hypot(fix.horizontal_m, truth_sigma_m) if fix.horizontal_m else float("inf")


def text_of(outcome: Outcome, *, fix_expected: bool, record_expected: bool) -> str:
    """The verdict: "ok", or the promises that were broken."""
    broken = []
    if outcome.wrong:
        broken.append(f"{outcome.wrong} wrong positions")
    if fix_expected and outcome.back_s is None:
        broken.append("no fix afterwards")
    if record_expected and (outcome.not_recorded_s or 0.0) > RECORD_LIMIT_S:
        broken.append(f"{outcome.not_recorded_s:.1f} s not recorded")
    return ", ".join(broken) or "ok"
