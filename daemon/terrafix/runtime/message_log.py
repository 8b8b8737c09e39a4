"""Log lines for the messages that tell a reader of the journal what changed. Nodes do not log: the shell of a process
passes what its node publishes to ``log_message``."""

from collections.abc import Callable
from typing import Any

import msgspec

from terrafix.core import logs
from terrafix.messages import (
    CalibrationFault,
    HintVerdict,
    Message,
    ModelChange,
    ModelEvent,
    SearchState,
    SearchStep,
    StatusText,
    Verdict,
)

WARNING_SEVERITY = 4  # MAV_SEVERITY_WARNING; lower numbers are more severe
# Tracking without and with information from a frame: these two alternate where images are bad.
TRACKING_STEPS = (SearchStep.NORMAL, SearchStep.SKIP)
SEARCHING_STEPS = (SearchStep.WIDEN, SearchStep.WHOLE_MAP, SearchStep.ASK)


class LogEntry(msgspec.Struct, frozen=True):
    """``level``: name of the method of the logger."""

    level: str
    event: str
    fields: dict[str, Any]


def log_message(message: Message) -> None:
    entry = log_entry(message)
    if entry is not None:
        getattr(logs.get(), entry.level)(entry.event, **entry.fields)


def log_entry(message: Message) -> LogEntry | None:
    """-> the log line of a published message; None: it has none."""
    describe = _DESCRIBE.get(type(message))
    return None if describe is None else describe(message)


def _search_state(state: SearchState) -> LogEntry:
    level = "debug" if state.step in TRACKING_STEPS else "warning" if state.step in SEARCHING_STEPS else "info"
    return LogEntry(level, "search step", {"step": state.step.value})


def _status_text(text: StatusText) -> LogEntry:
    level = "warning" if text.severity <= WARNING_SEVERITY else "info"
    return LogEntry(level, "text to the pilot", {"text": text.text, "severity": text.severity})


def _hint_verdict(hint: HintVerdict) -> LogEntry:
    level = "info" if hint.verdict is Verdict.ACCEPTED else "warning"
    fields = {"verdict": hint.verdict.value, "text": hint.text, "distance_m": hint.distance_m, "sigma_m": hint.sigma_m}
    return LogEntry(level, "position hint", fields)


def _calibration_fault(fault: CalibrationFault) -> LogEntry:
    fields = {"quantity": fault.quantity, "factor": fault.factor, "detail": fault.detail}
    if not fault.active:
        return LogEntry("info", "calibration fault ended", fields)
    return LogEntry("warning", "calibration fault", fields)


def _model_event(event: ModelEvent) -> LogEntry:
    level = "info" if event.change in (ModelChange.OPENED, ModelChange.RESUMED) else "warning"
    fields = {"model": event.model, "change": event.change.value, "provider": event.provider, "detail": event.detail}
    return LogEntry(level, "learned model", fields)


_DESCRIBE: dict[type[Message], Callable[[Any], LogEntry]] = {
    SearchState: _search_state,
    StatusText: _status_text,
    HintVerdict: _hint_verdict,
    CalibrationFault: _calibration_fault,
    ModelEvent: _model_event,
}
