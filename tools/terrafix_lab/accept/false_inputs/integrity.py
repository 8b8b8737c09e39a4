"""Metrics of a flight with a false input ("lie"): false fixes, time to notice, recovery, and width of the covariance.

A false fix is that of evaluate.py: an error of more than 50 m and more than 3 sigma. The lie is ``Marks.lie``."""

import math
from itertools import groupby

import numpy as np

from terrafix.core.gate import CHI2_95
from terrafix_lab.accept.measuring.evidence import Evidence, FrameEvidence
from terrafix_lab.accept.measuring.results import Measured, Verdict
from terrafix_lab.faults.edits import Span
from terrafix_lab.track import CRITERIA, LATE_M, Track
from terrafix_tools.report.data import radius95_m
from terrafix_tools.score import FALSE_FIX_ERROR_M

RECOVERED_M, RECOVERED_FRAMES = 20.0, 3  # recovered: below this error and not false, for this many consecutive frames
LAST_SHARE = 0.1  # of the frames: an error there counts as permanent
MEDIAN_ERROR = math.sqrt(2.0 * math.log(2.0))  # of a circular normal error, in its sigmas (Rayleigh distribution)


def late_false_fixes(e: Evidence) -> Measured:
    """False fixes except those of the first 3 s or 5 frames since the start of the lie, also if it is shorter."""
    return _late(e, FALSE_FIX_ERROR_M)


def late_overconfident_over_20m(e: Evidence) -> Measured:
    """The same with 20 m instead of 50 m."""
    return _late(e, LATE_M)


def of_track(name: str, e: Evidence) -> Measured:
    """A row of the criteria that all campaigns share."""
    value = CRITERIA[name].measure(track_of(e))
    return Measured(None, "never") if value == math.inf else Measured(value)


def false_fixes_in_all(e: Evidence) -> Measured:
    lie, track = lie_of(e), track_of(e)
    wrong_s = track.t_s[track.is_false()].tolist()
    during, before = sum(map(lie.has, wrong_s)), sum(t_s < lie.from_s for t_s in wrong_s)
    after = len(wrong_s) - during - before
    return Measured(float(len(wrong_s)), f"{before} before the lie, {during} in it, {after} after it")


def time_to_notice_s(e: Evidence) -> Measured:
    """From the start of the lie to the last false fix; zero if there is none."""
    notice_s = track_of(e).notice_s()
    if notice_s is None:
        return Measured(0.0, "no false fix")
    frames = sum(0.0 <= f.t_s - lie_of(e).from_s <= notice_s for f in e.frames)
    return Measured(notice_s, f"{frames} frames")


def longest_false_run(e: Evidence) -> Measured:
    """Largest number of consecutive false frames."""
    runs = groupby(track_of(e).is_false().tolist())
    return Measured(float(max((len(list(run)) for false, run in runs if false), default=0)))


def recovery_frames(e: Evidence) -> Measured:
    """Frames from the end of the lie to the first of three consecutive ones within 20 m and not false, inclusive."""
    after = [f for f in e.frames if f.compared and f.t_s > lie_of(e).to_s]
    if len(after) < RECOVERED_FRAMES:
        return Measured(None, "the flight ends with the lie")
    right = [_is_recovered(f) for f in after]
    for number in range(len(after) - RECOVERED_FRAMES + 1):
        if all(right[number : number + RECOVERED_FRAMES]):
            return Measured(float(number + 1), f"{after[number].t_s - lie_of(e).to_s:.1f} s")
    return Measured(None, f"not in the {len(after)} frames that follow", Verdict.BELOW)


def right_at_the_end(e: Evidence) -> Measured:
    """Share of the last tenth of the frames within 50 m, if inputs are true there."""
    known = [f for f in e.frames if f.compared]
    last = known[-max(1, round(LAST_SHARE * len(known))) :]
    if any(lie_of(e).has(f.t_s) for f in last):
        return Measured(None, "the lie lasts to the end")
    near = [f.error_m is not None and f.error_m <= FALSE_FIX_ERROR_M for f in last]
    return Measured(sum(near) / len(near), f"{len(last)} frames")


def claim_width(e: Evidence) -> Measured:
    """Median published 1-sigma over the 1-sigma that follows from the median error of the same frames; 1 if consistent.

    Only frames outside of the lie, with a position."""
    frames = [f for f in e.frames if f.error_m is not None and not in_lie(e, f)]
    claims = [
        math.sqrt(0.5 * (f.row.sigma_e_m**2 + f.row.sigma_n_m**2))
        for f in frames
        if f.row.sigma_e_m and f.row.sigma_n_m
    ]
    if not claims:
        return Measured(None, "no frame with true inputs")
    median_m = float(np.median([f.error_m for f in frames if f.error_m is not None]))
    claim_m = float(np.median(claims))
    return Measured(
        claim_m * MEDIAN_ERROR / max(median_m, 1e-3), f"{claim_m:.1f} m claimed, {median_m:.1f} m median error"
    )


def track_of(e: Evidence) -> Track:
    """Of the frames, with the span of ``lie_of`` as the fault."""
    compared = [f.compared for f in e.frames]
    nan = math.nan
    numbers = [
        (nan, nan) if c is None or c.error_m is None or c.mahalanobis2 is None else (c.error_m, c.mahalanobis2)
        for c in compared
    ]
    radii_m = [radius95_m(f.row) for f in e.frames]
    sigma_m = np.array([nan if r is None else r for r in radii_m]) / math.sqrt(CHI2_95)
    error_m, nees = np.array(numbers).reshape(-1, 2).T
    return Track(np.array([f.t_s for f in e.frames]), error_m, nees, sigma_m, lie_of(e))


def is_false(frame: FrameEvidence, beyond_m: float = FALSE_FIX_ERROR_M) -> bool:
    """Whether the frame is a false fix; without truth it is not."""
    return frame.compared is not None and frame.compared.is_false(beyond_m)


def in_lie(e: Evidence, frame: FrameEvidence) -> bool:
    return e.marks.lie is not None and e.marks.lie.has(frame.t_s)


def _late(e: Evidence, beyond_m: float) -> Measured:
    track = track_of(e)
    late, of_all = track.is_late(beyond_m), f"of {track.is_false(beyond_m).sum()}"
    worst_m = track.error_m[late].max(initial=0.0)
    return Measured(float(late.sum()), f"{of_all}; {worst_m:.0f} m at worst" if late.any() else of_all)


def _is_recovered(frame: FrameEvidence) -> bool:
    return frame.error_m is not None and frame.error_m <= RECOVERED_M and not is_false(frame)


def lie_of(e: Evidence) -> Span:
    """Span of the lie; without one the last marked span, or an empty span at the start."""
    if e.marks.lie is not None:
        return e.marks.lie
    first_s = e.frames[0].t_s
    return e.marks.spans[-1] if e.marks.spans else Span(first_s, first_s, "")
