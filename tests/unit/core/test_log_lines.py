"""Log lines of published messages: event, level and fields; lines of a process for the record."""

import ast
import io
import json
from pathlib import Path

import pytest

from terrafix import messages as m
from terrafix.core import codec, logs
from terrafix.core.log_lines import LogEntry, MessageLog


def log_entry(message: m.Message) -> LogEntry | None:
    return MessageLog().entry(message)


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
        (model_event(m.ModelChange.GIVEN_UP), "error", "learned model"),
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
    logs.write(log_entry(m.StatusText(t_ns=1, severity=4, text="lost, send a position hint")))
    logs.write(log_entry(m.SearchState(t_ns=1, step=m.SearchStep.SKIP)))  # below the configured level
    logs.write(log_entry(hint(m.Verdict.INNOVATION)))
    writer.close()
    text, verdict = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert (text["process"], text["level"], text["event"]) == ("link", "warning", "text to the pilot")
    assert (text["text"], text["severity"]) == ("lost, send a position hint", 4)
    assert {k: verdict[k] for k in ("verdict", "text", "distance_m", "sigma_m")} == {
        "verdict": "innovation", "text": "hint: search there", "distance_m": 12.0, "sigma_m": 3.0}  # fmt: skip


def frame(number: int, error: str = "") -> m.Frame:
    return m.Frame(t_ns=number, frame_id=number, file="", width=1, height=1, error=error)


def odometry(number: int, verdict: m.Verdict) -> m.Odometry:
    return m.Odometry(t_ns=number, frame_id=number, keyframe_id=0, verdict=verdict, two_view=[])


@pytest.mark.parametrize(
    ("messages", "expected"),
    [
        ([frame(0), frame(1)], []),
        ([frame(0), frame(1, "torn"), frame(2, "torn"), frame(3)], ["warning no image", "info images again"]),
        (
            [odometry(1, m.Verdict.ACCEPTED), odometry(2, m.Verdict.FEW_INLIERS), odometry(3, m.Verdict.ACCEPTED)],
            ["warning no odometry", "info odometry again"],
        ),
    ],
)
def test_of_messages_of_every_frame_only_the_changes_are_lines(messages: list[m.Message], expected: list[str]) -> None:
    log = MessageLog()
    entries = [entry for message in messages if (entry := log.entry(message)) is not None]
    assert [f"{entry.level} {entry.event}" for entry in entries] == expected


def gps(fix_type: int, reason: str = "") -> m.GpsInput:
    zero = dict.fromkeys(
        ("time_week", "time_week_ms", "lat_deg", "lon_deg", "alt_amsl_m", "hdop", "vdop", "vn_mps", "ve_mps", "vd_mps",
         "speed_accuracy_mps", "horiz_accuracy_m", "vert_accuracy_m", "satellites_visible", "estimate_age_ms"), 0,
    )  # fmt: skip
    return m.GpsInput(t_ns=1, fix_type=fix_type, no_fix_reason=reason, **zero)


def test_the_loss_of_the_fix_is_a_warning_with_its_reason_and_each_receiver_has_a_state_of_its_own() -> None:
    log = MessageLog()
    lost = [log.entry(gps(3)), log.entry(gps(3)), log.entry(gps(1, "estimate too old"))][-1]
    assert lost is not None
    assert (lost.level, lost.text) == ("warning", "GPS_INPUT has no fix, reason estimate too old")
    spoofed = [
        m.GnssVerdict(t_ns=1, receiver=r, state=m.GnssState.SPOOFED, distance_m=900.0, sigmas=30.0) for r in (0, 1, 0)
    ]
    assert [entry.level if (entry := log.entry(v)) else None for v in spoofed] == ["warning", "warning", None]


def test_the_restart_of_the_graph_is_a_warning_although_its_verdict_is_accepted() -> None:
    verdict = m.MeasurementVerdict(
        t_ns=1, frame_id=4, measurement="reset", verdict=m.Verdict.ACCEPTED, detail="indeterminate"
    )
    entry = log_entry(verdict)
    assert entry is not None and (entry.level, entry.fields["reason"]) == ("warning", "indeterminate")


ERRORS = [
    m.ProcessEvent(t_ns=1, process="anchor", event="gave_up", detail="died more than 5 times in 60 s"),
    model_event(m.ModelChange.GIVEN_UP),
]


@pytest.mark.parametrize("message", ERRORS, ids=lambda message: type(message).__name__)
def test_lines_of_errors_say_what_to_do(message: m.Message) -> None:
    entry = log_entry(message)
    assert entry is not None and entry.level == "error" and len(entry.fields["todo"]) > 20


def test_all_log_calls_of_the_level_error_in_the_daemon_say_what_to_do() -> None:
    calls = []
    for path in (Path(logs.__file__).parents[1]).rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if "logs.get().error" in text else ():
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "logs.get().error":
                calls.append(f"{path.name}:{node.lineno}")
                assert "todo" in {keyword.arg for keyword in node.keywords}, calls[-1]
    assert len(calls) >= 3


def test_lines_for_the_record_are_those_that_no_message_says() -> None:
    writer = logs.configure("INFO", "vision", io.StringIO())
    list(logs.take_lines())
    logs.get().warning("camera lost", source=Path("/dev/video0"), attempts=2)
    logs.write(log_entry(fault(active=True)))
    logs.get().debug("below the level")
    writer.close()
    (line,) = (m.LogLine(process="vision", **line) for line in logs.take_lines())
    assert (line.level, line.event) == ("warning", "camera lost")
    assert line.fields == {"source": "/dev/video0", "attempts": 2}
    assert codec.decode(codec.encode(line)) == line
    assert list(logs.take_lines()) == []
