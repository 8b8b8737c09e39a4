"""One function per number of the acceptance table. It returns the measured value, or the reason for having none."""

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from terrafix.core.geodesy import LocalFrame
from terrafix.core.pnp import solved
from terrafix.link.ground_station.prior_request import PriorRequest
from terrafix.messages import CovarianceMode, NavEstimate, SearchState, SearchStep, SourceLabel
from terrafix.messages import Verdict as Answer
from terrafix_lab.accept.measuring.consistency import FLIGHT_CONFIDENCE, judge_claims
from terrafix_lab.accept.measuring.epipolar import reprojection_error
from terrafix_lab.accept.measuring.evidence import Evidence, FrameEvidence
from terrafix_lab.accept.measuring.map_distortion import left_by_local_model, mean_px, residuals, shows_distortion
from terrafix_lab.accept.measuring.results import Measured, Verdict
from terrafix_lab.faults.edits import Span

MAP_FLOOR_PX = 2.5  # AC-10
RELOCALIZED_FLOOR_S = 30.0  # AC-15
NEAR_M = 50.0  # AC-1; also the limit of a correct position after a fault (AC-3)
MIN_PATH_M = 100.0  # a relative drift over a shorter path has no meaning
UNKNOWN_M, REQUEST_FRAMES, REQUEST_S = 100.0, 3, 2.0  # AC-6: 1-sigma of an unknown position, for so long
# AC-6: time without a map fix, and the share of the route so far, or the way, that was flown in it
NO_FIX_S, NO_FIX_SHARE, NO_FIX_M = 5.0, 0.2, 2000.0
ROUNDING_M = 0.1  # of a way at its limit
BEGIN_FRAMES = 6  # PB-5: five frames are tried with the same local map before a new fragment starts
SETTLE_S = 10.0  # after a marked span, until frames count as outside of it


def within_50m(e: Evidence) -> Measured:
    return Measured(e.metrics["within_50m"])


def within_20m(e: Evidence) -> Measured:
    return Measured(e.metrics["within_20m"])


def within_50m_outside(e: Evidence) -> Measured:
    spans = [Span(s.from_s, s.to_s + SETTLE_S, s.text) for s in e.marks.spans]
    frames = [f for f in e.frames if f.compared and not any(s.has(f.t_s) for s in spans)]
    return _share([_near(f) for f in frames], f"from {SETTLE_S:.0f} s after it on; {len(frames)} frames")


def wrong_rejected(e: Evidence) -> Measured:
    wrong = [f for f in e.frames if f.row.file in e.marks.wrong_files]
    return _share([not f.fixed for f in wrong], f"{sum(not f.fixed for f in wrong)} of {len(wrong)}")


def error_after_wrong(e: Evidence) -> Measured:
    after = [b for a, b in pairwise(e.frames) if a.row.file in e.marks.wrong_files]
    errors = [f.error_m for f in after if f.compared]
    if any(error is None for error in errors):
        return Measured(None, "a frame after a wrong one has no position", Verdict.BELOW)
    known = [error for error in errors if error is not None]
    return Measured(max(known)) if known else Measured(None, "no truth for the frames after the wrong ones")


def fragments_localised(e: Evidence) -> Measured:
    """Share of the fragments of odometry that have a map fix within 50 m, which joins them to the flight.

    A gap of the scenario after which odometry begins no fragment counts as one without a map fix."""
    parts, gaps = _fragments(e), e.marks.breaks_s
    alive = sum(any(f.fixed and _near(f) for f in part) for part in parts)
    begun = sum(_begins_within(e, parts[1:], a_s, b_s) for a_s, b_s in pairwise([*gaps, np.inf]))
    total = len(parts) + len(gaps) - begun
    steps = [state.step for state in e.searches]
    named = f"new_fragment {steps.count(SearchStep.NEW_FRAGMENT)}, merge {steps.count(SearchStep.MERGE)}"
    return Measured(alive / total, f"{alive} of {total}; {begun} begun after {len(gaps)} gaps; search: {named}")


def fragments_merged_after_s(e: Evidence) -> Measured:
    """From the first right map fix of each fragment of odometry to the first refined pose of it, in flight; worst."""
    delays = []
    for part in _fragments(e):
        fixed = next((f for f in part if f.fixed and _near(f)), None)
        if fixed is None:
            continue
        number = max(-1 if f.odometry is None else f.odometry.fragment_id for f in part)
        if number not in e.refined_ns:
            return Measured(None, f"fragment {number} has a map fix and was not refined in flight", Verdict.BELOW)
        delays.append(max(0.0, e.refined_ns[number] * 1e-9 - fixed.t_s))
    if not delays:
        return Measured(None, "no fragment has a right map fix")
    return Measured(max(delays), ", ".join(f"{delay:.1f} s" for delay in delays))


def worst_fragment(e: Evidence) -> Measured:
    """Of the fragments of odometry."""
    known = [[_near(f) for f in part if f.compared] for part in _fragments(e)]
    shares = [float(np.mean(part)) for part in known if part]
    if not shares:
        return Measured(None, "no frame with truth")
    return Measured(min(shares), ", ".join(f"{100 * s:.0f} %" for s in shares))


def not_localised(e: Evidence) -> Measured:
    """Share of the frames with truth that have no position, or one of dead reckoning only."""
    frames = [f for f in e.frames if f.compared]
    lost = [not f.row.localised or f.row.source_label == SourceLabel.DEAD_RECKONED for f in frames]
    return _share(lost, "no position, or dead reckoning alone")


def label_change_s(e: Evidence) -> Measured:
    """Time from the first marked frame until the label is not satellite_anchored for the rest of the span."""
    frames = e.within(0)
    if not frames:
        return Measured(None, "no frame in the marked time")
    anchored = [f.t_s for f in frames if f.row.source_label == SourceLabel.SATELLITE_ANCHORED]
    if not anchored:
        return Measured(0.0)
    later = [f.t_s for f in frames if f.t_s > anchored[-1]]
    return Measured((later[0] if later else frames[-1].t_s) - frames[0].t_s, "" if later else "the label never changes")


def prior_request_delay_s(e: Evidence) -> Measured:
    """Delay of the first request for a position by the code of the link since AC-6 requires one.

    A request at a time without that need breaks the criterion."""
    estimates = [estimate for frame in e.frames for estimate in frame.estimates]
    needed = request_is_needed(estimates)
    requests = _requests(estimates, e.searches)
    needless = [i for i in requests if not needed[i]]
    if needless:
        first_s = _in_flight_s(e, estimates[needless[0]].t_ns)
        why = f"{len(needless)} of {len(requests)} requests without need, the first {first_s:.0f} s into the flight"
        return Measured(None, why, Verdict.BELOW)
    if not any(needed):
        worst_m = max((_worst_sigma_m(estimate) for estimate in estimates), default=0.0)
        return Measured(None, f"its place was never lost and it never asks: it claims {worst_m:.0f} m at worst")
    required_ns = estimates[needed.index(True)].t_ns
    if not requests:
        return Measured(
            None, f"lost {_in_flight_s(e, required_ns):.0f} s into the flight, and never asks", Verdict.BELOW
        )
    asked_ns = estimates[requests[0]].t_ns
    return Measured((asked_ns - required_ns) * 1e-9, f"asked {_in_flight_s(e, asked_ns):.0f} s into the flight")


def request_is_needed(estimates: Sequence[NavEstimate]) -> list[bool]:
    """For each estimate, in order, whether AC-6 lets the operator be asked for a coarse position."""
    return [a or b for a, b in zip(_unknown(estimates), _far_without_fix(estimates), strict=True)]


def latency_p95(e: Evidence) -> Measured:
    return Measured(e.metrics["frame_ms_p95"])


def both_estimates(e: Evidence) -> Measured:
    return _share([f.row.localised and f.row.refined_lat_deg is not None for f in e.frames])


def odometry_rate(e: Evidence) -> Measured:
    return Measured(e.metrics["odometry_rate"])


def odometry_px(e: Evidence) -> Measured:
    """Mean over the published point pairs, with a free depth for each; pixels of the frames."""
    means = [
        reprojection_error(np.array(frame.odometry.two_view)) * e.origin.camera.fx
        for frame in e.frames
        if frame.odometry is not None and len(frame.odometry.two_view) >= 8
    ]
    return Measured(float(np.mean(means)), "pixels of the stored frames") if means else Measured(None, "no odometry")


def map_px(e: Evidence) -> Measured:
    """Mean over the matched points of accepted fixes, projected with the published pose; pixels of the frames.

    Where the matches of other frames show the map's local distortion, it is taken out: ``shows_distortion`` is the
    rule. Else the number is that of the points as they are, and not decidable if only the floor lies between both. The
    reason has both numbers and says which one."""
    found = []
    for frame in e.frames:
        match = None if frame.match is None else solved(frame.match)
        if frame.fixed and match is not None and match.matches and match.pose is not None:
            found.append(residuals(match, e.origin.camera.fx))
    if not found:
        return Measured(None, "no map fix")
    whole_px = float(np.mean([f.px.mean() for f in found]))
    left_px = mean_px(found, left_by_local_model(found))
    why = f"pixels of the stored frames; {whole_px:.1f} px with the map's local distortion, {left_px:.1f} px without"
    if shows_distortion(found):
        return Measured(left_px, f"{why}: judged without, other frames have matched the same ground")
    why += ": too few frames have matched the same ground"
    if left_px <= MAP_FLOOR_PX < whole_px:
        return Measured(whole_px, f"{why} to tell the map's error from that of the matches", Verdict.NOT_MEASURABLE)
    return Measured(whole_px, f"{why}, judged with")


def drift(e: Evidence) -> Measured:
    paths = _paths_between_fixes(e)
    if not paths:
        return Measured(None, "no two map fixes with odometry all the way between them")
    drift_m, path_m = max(paths)
    return Measured(drift_m, f"over {path_m:.0f} m")


def drift_share(e: Evidence) -> Measured:
    paths = _paths_between_fixes(e)
    drift_m, path_m = max(paths, key=lambda path: path[1], default=(0.0, 0.0))
    if path_m < MIN_PATH_M:
        return Measured(None, f"the longest way between two fixes is {path_m:.0f} m")
    return Measured(drift_m / path_m, f"{drift_m:.0f} m over {path_m:.0f} m")


def complete_estimates(e: Evidence) -> Measured:
    estimates = [estimate for frame in e.frames for estimate in frame.estimates]
    return _share([_complete(estimate) for estimate in estimates], f"{len(estimates)} estimates")


def coverage(e: Evidence) -> Measured:
    """One flight is one draw of the map's error: it may be inside altogether, which all flights together decide."""
    inside, nees = e.metrics["ellipse95_coverage"], e.metrics["mean_nees"]
    if inside is None:
        return Measured(None, "no position")
    if nees is None:
        return Measured(inside, "no valid covariance", Verdict.BELOW)
    verdict, why = judge_claims(inside, nees, 1, FLIGHT_CONFIDENCE)
    return Measured(inside, why, verdict)


def false_fixes(e: Evidence) -> Measured:
    return Measured(float(e.metrics["false_fixes"]))


def first_position_s(e: Evidence) -> Measured:
    first = next((f for f in e.frames if f.fixed and _near(f)), None)
    if first is None:
        return Measured(None, "never", Verdict.BELOW)
    in_flight_s = first.t_s - e.frames[0].t_s
    return Measured(e.start_up_s + in_flight_s, f"{e.start_up_s:.1f} s to start, {in_flight_s:.1f} s of flight")


def relocalized_after_s(e: Evidence) -> Measured:
    """From the end of the last marked span, or from the start, to the first of 5 consecutive frames within 50 m.

    A flight that ends sooner than RELOCALIZED_FLOOR_S after it decides nothing."""
    end_s = e.marks.spans[-1].to_s if e.marks.spans else e.frames[0].t_s
    after = [f for f in e.frames if f.t_s >= end_s and f.compared]
    for i, frame in enumerate(after):
        if all(_near(f) for f in after[i : i + 5]):
            return Measured(frame.t_s - end_s)
    flown_s = after[-1].t_s - end_s if after else 0.0
    if flown_s < RELOCALIZED_FLOOR_S:
        return Measured(None, f"not yet when the flight ends {flown_s:.0f} s later")
    return Measured(None, "never", Verdict.BELOW)


def memory_mb(e: Evidence) -> Measured:
    return Measured(e.summary["peak_memory_mb"], "vision, anchor and estimator in one process")


def right_mode(e: Evidence) -> Measured:
    estimates = [estimate for frame in e.frames for estimate in frame.estimates]
    right = [
        (estimate.covariance_mode is CovarianceMode.JACOBIAN) == (estimate.emitted_at_ns in e.hot)
        for estimate in estimates
    ]
    return _share(right, f"{len(e.hot)} of {len(e.frames)} frames hot")


def gps_interval_p99_ms(e: Evidence) -> Measured:
    return _of_peer(e, "interval_p99_ms", "in simulated time")


def gps_longest_gap_ms(e: Evidence) -> Measured:
    return _of_peer(e, "longest_gap_ms", "in simulated time")


def vehicle_error_m(e: Evidence) -> Measured:
    return _of_peer(e, "position_error_max_m", "what it steers by, against the truth")


def failsafes(e: Evidence) -> Measured:
    return _of_peer(e, "failsafes", "")


def _requests(estimates: Sequence[NavEstimate], searches: Sequence[SearchState]) -> list[int]:
    """Numbers of the estimates after which the code of the link sends a request."""
    asking, waiting, sent = PriorRequest(), list(searches), []
    for number, estimate in enumerate(estimates):
        while waiting and waiting[0].t_ns <= estimate.t_ns:
            asking.search_step = waiting.pop(0).step
        asking.on_estimate(estimate)
        if asking.due(estimate.t_ns):
            sent.append(number)
    return sent


def _unknown(estimates: Sequence[NavEstimate]) -> list[bool]:
    """For each estimate, whether the 1-sigma has exceeded UNKNOWN_M for three frames in a row and two seconds."""
    unknown: list[bool] = []
    frames_ns: dict[int, int] = {}  # time of the first estimate, by frame
    for estimate in estimates:
        if _worst_sigma_m(estimate) <= UNKNOWN_M:
            frames_ns = {}
        else:
            frames_ns.setdefault(estimate.frame_id, estimate.t_ns)
        since_ns = estimate.t_ns - min(frames_ns.values(), default=estimate.t_ns)
        unknown.append(len(frames_ns) >= REQUEST_FRAMES and since_ns >= REQUEST_S * 1e9)
    return unknown


def _far_without_fix(estimates: Sequence[NavEstimate]) -> list[bool]:
    """For each estimate, whether a fifth of the way so far, or 2 km, was flown without a map fix, for 5 s or more.

    Before the first map fix the first estimate counts as one."""
    if not estimates:
        return []
    t_s = np.maximum.accumulate([(estimate.t_ns - estimates[0].t_ns) * 1e-9 for estimate in estimates])
    speed_mps = np.array([np.hypot(*estimate.velocity_enu_mps[:2]) for estimate in estimates])
    way_m = np.cumsum(speed_mps * np.diff(t_s, prepend=0.0))
    age_s = np.array([estimate.last_anchor_age_ms * 1e-3 for estimate in estimates])
    fix_s = np.maximum.accumulate(np.where(age_s >= 0.0, np.maximum(t_s - age_s, 0.0), 0.0))
    since_fix_m = way_m - np.interp(fix_s, t_s, way_m)
    far = since_fix_m + ROUNDING_M >= np.minimum(NO_FIX_SHARE * way_m, NO_FIX_M)
    return [bool(v) for v in far & (since_fix_m > 0.0) & (t_s - fix_s >= NO_FIX_S - 1e-3)]


def _worst_sigma_m(estimate: NavEstimate) -> float:
    cov = np.array(estimate.cov).reshape(6, 6)[:2, :2]
    return float(np.sqrt(max(0.0, np.linalg.eigvalsh(cov)[-1])))


def _in_flight_s(e: Evidence, t_ns: int) -> float:
    return (t_ns - next(f.estimates[0].t_ns for f in e.frames if f.estimates)) * 1e-9


def _of_peer(e: Evidence, key: str, why: str) -> Measured:
    value = e.peer.get(key)
    return Measured(None, "the autopilot did not say") if value is None else Measured(float(value), why)


def _near(frame: FrameEvidence) -> bool:
    return frame.error_m is not None and frame.error_m <= NEAR_M


def _share(values: list[bool], why: str = "") -> Measured:
    return Measured(sum(values) / len(values), why) if values else Measured(None, "no such frame in this flight")


def _fragments(e: Evidence) -> list[list[FrameEvidence]]:
    """Frames of each fragment of odometry, as vision has numbered them, in the order of their beginnings.

    A fragment has two or more frames: one to which no frame was registered, and frames of no fragment, belong to the
    fragment of the frame before."""
    ids = [-1 if frame.odometry is None else frame.odometry.fragment_id for frame in e.frames]
    frames_of = Counter(ids)
    parts: dict[int, list[FrameEvidence]] = {}
    last = -1
    for frame, fragment_id in zip(e.frames, ids, strict=True):
        last = fragment_id if fragment_id >= 0 and frames_of[fragment_id] > 1 else last
        parts.setdefault(last, []).append(frame)
    lost_first = parts.pop(-1, [])  # before the first fragment
    return [lost_first + part if i == 0 else part for i, part in enumerate(parts.values())] or [lost_first]


def _begins_within(e: Evidence, parts: list[list[FrameEvidence]], from_s: float, to_s: float) -> bool:
    """Whether one of these fragments begins with one of the first frames of this time."""
    first = [f for f in e.frames if from_s <= f.t_s < to_s][:BEGIN_FRAMES]
    return any(part[0] is frame for part in parts for frame in first)


def _paths_between_fixes(e: Evidence) -> list[tuple[float, float]]:
    """(drift, path) [m] for each pair of successive fixes with odometry in all frames between them.

    Drift: motion from the estimate at a fix to the prediction at the next one, less the true motion."""
    place = LocalFrame(e.origin.lat_deg, e.origin.lon_deg)
    paths: list[tuple[float, float]] = []
    from_m = true_from_m = true_last_m = None
    path_m = 0.0
    for frame in e.frames:
        true_m = e.local_truth_m(frame)
        if true_m is None or frame.odometry_verdict is not Answer.ACCEPTED:
            from_m = None
            continue
        path_m += 0.0 if true_last_m is None else float(np.hypot(*(true_m - true_last_m)))
        true_last_m = true_m
        if not frame.fixed:
            continue
        if from_m is not None and true_from_m is not None and frame.prediction is not None:
            motion = np.array(frame.prediction.p_c_in_w_m[:2]) - from_m
            paths.append((float(np.hypot(*(motion - (true_m - true_from_m)))), path_m))
        from_m = None
        if frame.row.lat_deg is not None and frame.row.lon_deg is not None:
            from_m = np.array(place.to_local(frame.row.lat_deg, frame.row.lon_deg), dtype=float)
        true_from_m, path_m = true_m, 0.0
    return paths


def _complete(estimate: NavEstimate) -> bool:
    cov = np.array(estimate.cov).reshape(6, 6) if len(estimate.cov) == 36 else np.full((6, 6), np.nan)
    finite = bool(np.isfinite(cov).all()) and bool(np.allclose(cov, cov.T, rtol=1e-6, atol=1e-9))
    return finite and bool(np.linalg.eigvalsh(cov)[0] > 0.0) and estimate.last_anchor_age_ms >= -1
