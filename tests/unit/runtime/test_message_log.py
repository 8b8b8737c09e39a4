"""Log lines of published messages: event, level and fields."""

import io
import json

import pytest

from terrafix import messages as m
from terrafix.core import logs
from terrafix.runtime.message_log import log_entry, log_message


def fault(*, active: bool) -> m.CalibrationFault:
    return m.CalibrationFault(t_ns=1, quantity="heading", factor=90.0, detail="turns", active=active)


def model_event(change: m.ModelChange) -> m.ModelEvent:
    return m.ModelEvent(t_ns=1, model="xfeat", change=change, provider="CPU", detail="why")


def hint(verdict: m.Verdict) -> m.HintVerdict:
    return m.HintVerdict(t_ns=2, hint_t_ns=1, verdict=verdict, distance_m=12.0, sigma_m=3.0, text="hint: search there")


@pytest.mark.parametrize(
    ("step", "level"),
    [
        (m.SearchStep.NORMAL, "debug"),
        (m.SearchStep.SKIP, "debug"),
        (m.SearchStep.NEW_FRAGMENT, "info"),
        (m.SearchStep.MERGE, "info"),
        (m.SearchStep.WIDEN, "warning"),
        (m.SearchStep.WHOLE_MAP, "warning"),
        (m.SearchStep.ASK, "warning"),
    ],
)
def test_each_step_of_the_search_is_logged_by_its_name(step: m.SearchStep, level: str) -> None:
    entry = log_entry(m.SearchState(t_ns=1, step=step))
    assert entry is not None
    assert (entry.level, entry.event, entry.fields) == (level, "search step", {"step": step.value})


@pytest.mark.parametrize(
    ("message", "level", "event"),
    [
        (m.StatusText(t_ns=1, severity=4, text="lost, send a position hint"), "warning", "text to the pilot"),
        (m.StatusText(t_ns=1, severity=5, text="computer is hot"), "info", "text to the pilot"),
        (hint(m.Verdict.ACCEPTED), "info", "position hint"),
        (hint(m.Verdict.OUTSIDE_MAP), "warning", "position hint"),
        (fault(active=True), "warning", "calibration fault"),
        (fault(active=False), "info", "calibration fault ended"),
        (model_event(m.ModelChange.OPENED), "info", "learned model"),
        (model_event(m.ModelChange.RESUMED), "info", "learned model"),
        (model_event(m.ModelChange.SUSPENDED), "warning", "learned model"),
        (model_event(m.ModelChange.GIVEN_UP), "warning", "learned model"),
    ],
)
def test_changes_that_a_reader_of_the_journal_needs_have_an_event_and_a_level(
    message: m.Message, level: str, event: str
) -> None:
    entry = log_entry(message)
    assert entry is not None and (entry.level, entry.event) == (level, event)


def test_a_log_line_has_the_fields_of_its_message() -> None:
    stream = io.StringIO()
    writer = logs.configure("INFO", "link", stream)
    log_message(m.StatusText(t_ns=1, severity=4, text="lost, send a position hint"))
    log_message(m.SearchState(t_ns=1, step=m.SearchStep.SKIP))  # below the configured level
    log_message(hint(m.Verdict.INNOVATION))
    writer.close()
    text, verdict = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert (text["process"], text["level"], text["event"]) == ("link", "warning", "text to the pilot")
    assert (text["text"], text["severity"]) == ("lost, send a position hint", 4)
    assert {k: verdict[k] for k in ("verdict", "text", "distance_m", "sigma_m")} == {
        "verdict": "innovation", "text": "hint: search there", "distance_m": 12.0, "sigma_m": 3.0}  # fmt: skip


def test_messages_of_every_frame_have_no_log_line() -> None:
    assert log_entry(m.Frame(t_ns=1, frame_id=1, file="", width=1, height=1)) is None
