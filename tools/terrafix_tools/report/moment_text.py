"""The reasons of a moment in plain words."""

from typing import TypeVar

from terrafix.messages import MeasurementVerdict, SearchStep, Verdict
from terrafix_tools.pages.charts import clock
from terrafix_tools.report.data import FlightView, radius95_m
from terrafix_tools.report.moment_record import FrameRecord
from terrafix_tools.report.moments import Moment

T = TypeVar("T")
VERDICTS = {
    Verdict.ACCEPTED: "accepted",
    Verdict.BAD_IMAGE: "the picture is unreadable",
    Verdict.NO_GROUND: "the gimbal looks away from the ground",
    Verdict.OVERTAKEN: "left out, the computer was too slow",
    Verdict.STALLED: "the camera repeats an earlier picture",
    Verdict.NO_FEATURES: "nothing in the picture to follow",
    Verdict.FEW_INLIERS: "too few matches agree with one motion or pose",
    Verdict.NO_PREDICTION: "no position to start from",
    Verdict.OUTSIDE_MAP: "outside the map",
    Verdict.TOO_LOW: "too low above the ground to match",
    Verdict.AMBIGUOUS: "more than one place fits",
    Verdict.DEGENERATE: "the matches do not determine a pose",
    Verdict.INNOVATION: "too far from the prediction",
    Verdict.STALE: "too late",
    Verdict.UNCONFIRMED: "of a part of the flight that nothing ties to the rest yet",
    Verdict.IMPLAUSIBLE: "not plausible",
    Verdict.MODEL_FAILED: "the learned model gave no output",
    Verdict.THROTTLED: "not matched, to save power while the computer is hot",
    Verdict.LOST: "the pictures contradict the position",
}
STEPS = {
    SearchStep.NORMAL: "",
    SearchStep.SKIP: "this frame tells nothing, the next one is tried",
    SearchStep.NEW_FRAGMENT: "odometry does not connect this frame to the one before",
    SearchStep.MERGE: "the position was found, and the parts of the flight are joined",
    SearchStep.WIDEN: "lost: searching around the last position",
    SearchStep.WHOLE_MAP: "lost: searching the whole map",
    SearchStep.ASK: "lost: the whole map was searched, a coarse position from the operator would help",
}
SOURCES = {
    "satellite_anchored": "from a map match",
    "visual_propagated": "carried on by odometry",
    "dead_reckoned": "dead reckoning: neither map nor odometry",
    "not_placed": "not placed: no map match yet, and no known start",
}
TEXTS_WITHIN_S = 5.0  # texts to the pilot that belong to a moment
MIN_MASS = 0.005  # of a place that is listed
STATE_WITHIN_S = 3.0  # messages at 1 Hz: an older state of the computer or the autopilot is not that of the moment


def facts(view: FlightView, moment: Moment, own: FrameRecord, shown: FrameRecord) -> list[tuple[str, str]]:
    """(name, what the record says). ``own``: the frame of the moment; ``shown``: the one whose matches are shown."""
    rows = [("Position", _position(view, moment))]
    rows += [(_name(verdict), _verdict(verdict)) for verdict in own.verdicts if _says_something(verdict)]
    if own.odometry is not None:
        found = own.odometry
        rows.append(("Odometry", f"{VERDICTS[found.verdict]}; {found.inliers} of {found.tracked} tracked points agree"))
    rows += _match_facts(moment, shown)
    rows += _state_facts(view, moment.t_s)
    return [(name, text) for name, text in rows if text]


def _position(view: FlightView, moment: Moment) -> str:
    row = view.rows[moment.row]
    if not row.localised:
        return SOURCES.get(row.source_label, "none")
    parts = [SOURCES.get(row.source_label, "")]
    if (radius_m := radius95_m(row)) is not None:
        parts.append(f"95 % radius {radius_m:.1f} m")
    if (error_m := view.error_m(row)) is not None:
        parts.append(f"error {error_m:.1f} m")
    if row.anchor_age_ms is not None:
        parts.append(
            f"last map match {row.anchor_age_ms / 1000:.1f} s before" if row.anchor_age_ms >= 0 else "no map match yet"
        )
    if row.agl_m is not None:
        parts.append(f"{row.agl_m:.0f} m above ground")
    return "; ".join(part for part in parts if part)


def _says_something(verdict: MeasurementVerdict) -> bool:
    return verdict.verdict is not Verdict.ACCEPTED or verdict.test_ratio is not None or bool(verdict.detail)


def _name(verdict: MeasurementVerdict) -> str:
    return f"Gate of {verdict.measurement.replace('_', ' ')}"


def _verdict(verdict: MeasurementVerdict) -> str:
    parts = [VERDICTS[verdict.verdict]]
    if verdict.test_ratio is not None:
        parts.append(f"test ratio {verdict.test_ratio:.2f} (limit 1)")
    if verdict.detail:
        parts.append(verdict.detail)
    return "; ".join(parts)


def _match_facts(moment: Moment, shown: FrameRecord) -> list[tuple[str, str]]:
    match, solution = shown.match, shown.solution
    if match is None:
        return [("Map match", "this frame was not matched with the map")]
    where = "" if shown.frame_id == moment.frame_id else f" (of frame {shown.frame_id})"
    text = f"{VERDICTS[match.verdict]}; {match.inliers} points agree, by {match.matcher}"
    if match.reprojection_px:
        text += f", {match.reprojection_px:.1f} px"
    if match.position_only:
        text += "; a position alone, without attitude"
    rows = [(f"Map match{where}", text)]
    if solution is not None and solution.pose is not None:
        residual = f", {solution.residual_px:.1f} px RMS" if solution.residual_px is not None else ""
        rows.append((f"Pose{where}", f"{solution.method}: {solution.inliers} inliers{residual}"))
    if match.belief is not None and match.belief.modes:
        modes = [mode.mass for mode in match.belief.modes if mode.mass >= MIN_MASS] or [match.belief.modes[0].mass]
        shares = ", ".join(f"{100 * mass:.0f} %" for mass in modes)
        rows.append(("Places that fit", f"{len(modes)}, with {shares} of the probability"))
    search = STEPS[match.search.step]
    if search and match.search.sigma_m:
        search += f"; 1-sigma {match.search.sigma_m:.0f} m"
    rows.append(("Search", search))
    return rows


def _state_facts(view: FlightView, t_s: float) -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    if (sent := _at(view.gps, t_s, STATE_WITHIN_S)) is not None:
        text = f"fix type {sent.fix_type}, accuracy {sent.horiz_accuracy_m:.1f} m"
        rows.append(("GPS_INPUT", f"{text}; {sent.no_fix_reason}".rstrip("; ")))
    if (ekf := _at(view.ekf, t_s, STATE_WITHIN_S)) is not None:
        rows.append(
            ("Autopilot's EKF", f"test ratios: position {ekf.position_ratio:.2f}, velocity {ekf.velocity_ratio:.2f}")
        )
    if (health := _at(view.health, t_s, STATE_WITHIN_S)) is not None:
        parts = [str(health.band)]
        parts += [f"{health.temperature_c:.0f} °C"] if health.temperature_c is not None else []
        limit = health.clock_limit
        parts += [f"clocks limited to {100 * limit:.0f} %"] if limit is not None and limit < 1.0 else []
        parts += ["throttled"] if health.throttled else []
        parts += [f"{health.power_w:.1f} W"] if health.power_w is not None else []
        rows.append(("Computer", ", ".join(parts)))
    near = [(t, text.text) for t, text in view.pilot_texts if abs(t - t_s) <= TEXTS_WITHIN_S]
    rows += [(f"Text to the pilot, {clock(round(max(0.0, t)))}", text) for t, text in near[:4]]
    return rows


def _at(series: list[tuple[float, T]], t_s: float, within_s: float) -> T | None:
    """The newest of a series at a time; None if there is none within ``within_s`` before it."""
    newest = None
    for t, value in series:
        if t > t_s + 0.01:
            break
        if t_s - t <= within_s:
            newest = value
    return newest
