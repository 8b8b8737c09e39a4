"""Log lines of messages (ON-8): the only place that decides which message is a line of the log, and at what level.

ERROR: data or a function is lost; the line says what to do (``todo``). WARN: degraded operation. INFO: a change of
state. DEBUG: for developers. Nodes do not log: the shell of a process passes what its node publishes through
``MessageLog`` to the journal, and the recorder passes all messages through another one to the topic ``/log``."""

from collections.abc import Callable
from typing import Any

import msgspec

from terrafix.messages import (
    FIX_3D,
    OVERTAKEN,
    CalibrationFault,
    Dropped,
    Frame,
    GnssState,
    GnssVerdict,
    GpsInput,
    HintVerdict,
    InitialPosition,
    LogLine,
    MapMatch,
    MapOffset,
    MeasurementVerdict,
    Message,
    ModelChange,
    ModelEvent,
    NavEstimate,
    Odometry,
    Origin,
    PositionSource,
    ProcessEvent,
    Refinement,
    SearchState,
    SearchStep,
    SourceEnded,
    SourceLabel,
    StatusText,
    Verdict,
    WallClock,
)

WARNING_SEVERITY = 4  # MAV_SEVERITY_WARNING; lower numbers are more severe
DEBUG_SEVERITY = 7  # MAV_SEVERITY_DEBUG
# Tracking without and with information from a frame: these two alternate where images are bad.
TRACKING_STEPS = (SearchStep.NORMAL, SearchStep.SKIP)
SEARCHING_STEPS = (SearchStep.WIDEN, SearchStep.WHOLE_MAP, SearchStep.ASK)


class LogEntry(msgspec.Struct, frozen=True):
    """``level``: name of the method of the logger; ``part``: the process or the part that speaks."""

    level: str
    part: str
    event: str
    fields: dict[str, Any] = {}

    @property
    def text(self) -> str:
        """ "learned model, model xfeat, change failed": the fields that are known."""
        known = (f"{name} {_text_of(value)}" for name, value in self.fields.items() if value not in ("", None))
        return ", ".join((self.event, *known))


class MessageLog:
    """Lines of a sequence of messages. Of a message that repeats a state only the changes are lines."""

    def __init__(self) -> None:
        self._states: dict[tuple[type[Message], Any], Any] = {}
        self._lost = False

    def entry(self, message: Message) -> LogEntry | None:
        """-> the line of the next message; None: it has none."""
        kind = type(message)
        describe = _DESCRIBE.get(kind)
        if describe is None or (kind in _STATE and not self._changes(message)):
            return None
        entry = describe(message)
        if isinstance(message, SearchState) and entry is not None:
            was_lost, self._lost = self._lost, message.step in SEARCHING_STEPS
            if was_lost != self._lost:
                name, level = ("RecoveryStarted", "warning") if self._lost else ("RecoverySucceeded", "info")
                return msgspec.structs.replace(entry, level=level, fields={**entry.fields, "recovery": name})
        return entry

    def _changes(self, message: Message) -> bool:
        """Whether the state differs from that of the message before; the first one changes what is not normal."""
        of, state, normal = _STATE[type(message)](message)
        before = self._states.get((type(message), of), normal)
        self._states[type(message), of] = state
        return state != before


def _text_of(value: Any) -> str:
    return f"{value:.7g}" if isinstance(value, float) else str(value)


def _origin(origin: Origin) -> LogEntry:
    fields = {"lat_deg": origin.lat_deg, "lon_deg": origin.lon_deg, "start_sigma_m": origin.start_sigma_m}
    return LogEntry("info", "vision", "source open", fields)


def _source_ended(ended: SourceEnded) -> LogEntry:
    return LogEntry("info", "vision", "source ended", {"frames": ended.frames})


def _frame(frame: Frame) -> LogEntry:
    if frame.error in ("", OVERTAKEN):
        return LogEntry("info", "vision", "images again", {"frame": frame.frame_id})
    return LogEntry("warning", "vision", "no image", {"reason": frame.error, "frame": frame.frame_id})


def _odometry(odometry: Odometry) -> LogEntry:
    fields = {"frame": odometry.frame_id, "tracked": odometry.tracked, "inliers": odometry.inliers}
    if odometry.verdict is Verdict.ACCEPTED:
        return LogEntry("info", "vision", "odometry again", fields)
    return LogEntry("warning", "vision", "no odometry", {"reason": odometry.verdict.value, **fields})


def _map_match(match: MapMatch) -> LogEntry:
    fields = {"frame": match.frame_id, "verdict": match.verdict.value, "inliers": match.inliers}
    return LogEntry("debug", "anchor", "map match", {**fields, "refined": match.refined})


def _model_event(event: ModelEvent) -> LogEntry:
    fields = {"model": event.model, "change": event.change.value, "provider": event.provider, "detail": event.detail}
    if event.change is ModelChange.GIVEN_UP:
        todo = "the map is matched without it; after landing: terrafix models verify"
        return LogEntry("error", event.model, "learned model", {**fields, "todo": todo})
    level = "info" if event.change in (ModelChange.OPENED, ModelChange.RESUMED) else "warning"
    return LogEntry(level, event.model, "learned model", fields)


def _search_state(state: SearchState) -> LogEntry:
    if state.step is SearchStep.SKIP:  # with a limit of its own (logs.RateLimit): every second frame may be one
        return LogEntry("info", "search", "frame skipped", {"step": state.step.value})
    level = "debug" if state.step in TRACKING_STEPS else "warning" if state.step in SEARCHING_STEPS else "info"
    return LogEntry(level, "search", "search step", {"step": state.step.value})


def _hint_verdict(hint: HintVerdict) -> LogEntry:
    level = "info" if hint.verdict is Verdict.ACCEPTED else "warning"
    fields = {"verdict": hint.verdict.value, "text": hint.text, "distance_m": hint.distance_m, "sigma_m": hint.sigma_m}
    return LogEntry(level, "hint", "position hint", fields)


def _initial_position(initial: InitialPosition) -> LogEntry:
    fields = {
        "verdict": initial.verdict.value,
        "lat_deg": initial.lat_deg,
        "lon_deg": initial.lon_deg,
        "sigma_m": initial.sigma_m,
    }
    return LogEntry("info", "anchor", "initial position", fields)


def _estimate(estimate: NavEstimate) -> LogEntry:
    fields = {"source": estimate.source_label.value, "frame": estimate.frame_id}
    if estimate.source_label is SourceLabel.NOT_PLACED:
        return LogEntry("warning", "estimator", "not placed: no map match yet, and no known start", fields)
    if estimate.source_label is SourceLabel.DEAD_RECKONED:
        return LogEntry("warning", "estimator", "dead reckoning", fields)
    return LogEntry("info", "estimator", "position from images", fields)


def _calibration_fault(fault: CalibrationFault) -> LogEntry:
    fields = {"quantity": fault.quantity, "factor": fault.factor, "detail": fault.detail}
    if not fault.active:
        return LogEntry("info", "calibration", "calibration fault ended", fields)
    return LogEntry("warning", "calibration", "calibration fault", fields)


def _verdict(verdict: MeasurementVerdict) -> LogEntry | None:
    frame = verdict.frame_id if verdict.frame_id >= 0 else None
    if verdict.measurement == "reset":
        return LogEntry("warning", "estimator", "graph begins again", {"frame": frame, "reason": verdict.detail})
    if verdict.verdict is Verdict.ACCEPTED and verdict.measurement == "user_fix":
        return LogEntry("info", "estimator", "UserFixApplied", {"frame": frame, "detail": verdict.detail})
    if verdict.verdict is Verdict.ACCEPTED and verdict.measurement == "relocalization":
        return LogEntry("info", "estimator", "relocalise", {"frame": frame})
    if verdict.verdict is Verdict.ACCEPTED:
        return None
    fields = {"verdict": verdict.verdict.value, "frame": frame, "detail": verdict.detail}
    return LogEntry("debug", verdict.measurement, "measurement rejected", fields)


def _refinement(refinement: Refinement) -> LogEntry:
    fields = {"poses": len(refinement.poses), "source": refinement.source.value}
    return LogEntry("debug", "smoother", "past refined", fields)


def _gps_input(gps: GpsInput) -> LogEntry:
    if gps.fix_type >= FIX_3D:
        return LogEntry("info", "link", "GPS_INPUT has a fix", {"horiz_accuracy_m": gps.horiz_accuracy_m})
    return LogEntry("warning", "link", "GPS_INPUT has no fix", {"reason": gps.no_fix_reason})


def _gnss(verdict: GnssVerdict) -> LogEntry:
    level = "warning" if verdict.state in (GnssState.SPOOFED, GnssState.DISPUTED) else "info"
    fields = {
        "receiver": verdict.receiver,
        "state": verdict.state.value,
        "reason": verdict.reason,
        "distance_m": verdict.distance_m,
    }
    return LogEntry(level, "link", "GNSS receiver", fields)


def _map_offset(offset: MapOffset) -> LogEntry:
    return LogEntry("debug", "link", "map offset", {"east_m": offset.state[0], "north_m": offset.state[1]})


def _position_source(source: PositionSource) -> LogEntry:
    used = "Terrafix" if source.vision else f"GNSS receiver {source.receiver}"
    return LogEntry("warning", "link", "the autopilot is to navigate by another position", {"position": used})


def _wall_clock(clock: WallClock) -> LogEntry:
    level = "warning" if clock.unix_ns is None else "info"
    return LogEntry(level, "link", "wall clock", {"source": clock.source})


def _status_text(text: StatusText) -> LogEntry:
    level = "warning" if text.severity <= WARNING_SEVERITY else "debug" if text.severity == DEBUG_SEVERITY else "info"
    return LogEntry(level, "pilot", "text to the pilot", {"text": text.text, "severity": text.severity})


def _process_event(event: ProcessEvent) -> LogEntry:
    fields = {"child": event.process, "detail": event.detail}
    if event.event == "gave_up":
        todo = "flies on without it; after landing look at its traceback above, then restart Terrafix"
        return LogEntry("error", "supervisor", "process gave_up", {**fields, "todo": todo})
    level = "info" if event.event in ("started", "stopped") else "warning"
    return LogEntry(level, "supervisor", f"process {event.event}", fields)


def _dropped(dropped: Dropped) -> LogEntry:
    return LogEntry("warning", dropped.process, "messages lost", {"message": dropped.message, "count": dropped.count})


def _log_line(line: LogLine) -> LogEntry:
    return LogEntry(line.level, line.process, line.event, dict(line.fields))


_DESCRIBE: dict[type[Message], Callable[[Any], LogEntry | None]] = {
    Origin: _origin,
    SourceEnded: _source_ended,
    Frame: _frame,
    Odometry: _odometry,
    MapMatch: _map_match,
    ModelEvent: _model_event,
    SearchState: _search_state,
    HintVerdict: _hint_verdict,
    InitialPosition: _initial_position,
    NavEstimate: _estimate,
    CalibrationFault: _calibration_fault,
    MeasurementVerdict: _verdict,
    Refinement: _refinement,
    GpsInput: _gps_input,
    GnssVerdict: _gnss,
    MapOffset: _map_offset,
    PositionSource: _position_source,
    WallClock: _wall_clock,
    StatusText: _status_text,
    ProcessEvent: _process_event,
    Dropped: _dropped,
    LogLine: _log_line,
}

NOT_FROM_IMAGES = (SourceLabel.DEAD_RECKONED, SourceLabel.NOT_PLACED)
# Of these only a change of state is a line: (of what, the state, the state before the first message).
_STATE: dict[type[Message], Callable[[Any], tuple[Any, Any, Any]]] = {
    Frame: lambda m: (None, m.error not in ("", OVERTAKEN), False),
    Odometry: lambda m: (None, m.verdict is Verdict.ACCEPTED, True),
    InitialPosition: lambda m: (None, (m.verdict, m.lat_deg is None), None),
    NavEstimate: lambda m: (None, m.source_label if m.source_label in NOT_FROM_IMAGES else None, None),
    GpsInput: lambda m: (None, m.fix_type >= FIX_3D, None),
    GnssVerdict: lambda m: (m.receiver, m.state, GnssState.UNKNOWN),
    WallClock: lambda m: (None, m.source, None),
}
