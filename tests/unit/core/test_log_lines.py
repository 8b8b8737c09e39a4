"""Log lines of published messages: event, level and fields; lines of a process for the record."""

import ast
import io
import json
from pathlib import Path

import msgspec
import pytest

from gps_messages import GPS
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


def rejected(frame_id: int, measurement: str, verdict: m.Verdict, detail: str = "") -> m.MeasurementVerdict:
    return m.MeasurementVerdict(t_ns=7, frame_id=frame_id, measurement=measurement, verdict=verdict, detail=detail)


SEVERITIES = {"warning": (-1, 0, 2, 4), "info": (5, 6, 9), "debug": (7,)}
STEPS = {"debug": ("normal",), "info": ("new_fragment", "merge"), "warning": ("widen", "whole_map", "ask")}
EVENTS = {"info": ("started", "stopped"), "warning": ("died", "stuck", "restarted"), "error": ("gave_up",)}
CHANGES = {"info": ("opened", "resumed"), "warning": ("provider", "suspended", "failed"), "error": ("given_up",)}
LINES: list[tuple[m.Message, str]] = [
    *(
        (
            m.StatusText(t_ns=7, severity=severity, text="no map fix"),
            f"{level} pilot: text to the pilot, text no map fix, severity {severity}",
        )
        for level, severities in SEVERITIES.items()
        for severity in severities
    ),
    *(
        (
            m.SearchState(t_ns=7, step=m.SearchStep(step)),
            f"{level} search: search step, step {step}" + (", recovery RecoveryStarted" if level == "warning" else ""),
        )
        for level, steps in STEPS.items()
        for step in steps
    ),
    (m.SearchState(t_ns=7, step=m.SearchStep.SKIP), "info search: frame skipped, step skip"),
    *(
        (
            m.ProcessEvent(t_ns=7, process="anchor", event=event, detail="9"),
            f"{level} supervisor: process {event}, child anchor, detail 9",
        )
        for level, events in EVENTS.items()
        for event in events
    ),
    *(
        (
            model_event(m.ModelChange(change)),
            f"{level} xfeat: learned model, model xfeat, change {change}, provider CPU, detail why",
        )
        for level, changes in CHANGES.items()
        for change in changes
    ),
    (fault(active=True), "warning calibration: calibration fault, quantity heading, factor 90, detail turns"),
    (fault(active=False), "info calibration: calibration fault ended, quantity heading, factor 90, detail turns"),
    (
        msgspec.structs.replace(fault(active=False), factor=None, detail=""),
        "info calibration: calibration fault ended, quantity heading",
    ),
    (
        hint(m.Verdict.ACCEPTED),
        "info hint: position hint, verdict accepted, text hint: search there, distance_m 12, sigma_m 3",
    ),
    (
        hint(m.Verdict.OUTSIDE_MAP),
        "warning hint: position hint, verdict outside_map, text hint: search there, distance_m 12, sigma_m 3",
    ),
    (m.Dropped(t_ns=7, process="link", message="Imu", count=3), "warning link: messages lost, message Imu, count 3"),
    *(
        (
            m.PositionSource(t_ns=7, vision=vision, receiver=1),
            f"warning link: the autopilot is to navigate by another position, position {position}",
        )
        for vision, position in ((True, "Terrafix"), (False, "GNSS receiver 1"))
    ),
    (
        rejected(4, "map", m.Verdict.INNOVATION, "12 m off"),
        "debug map: measurement rejected, verdict innovation, frame 4, detail 12 m off",
    ),
    (rejected(-1, "height", m.Verdict.IMPLAUSIBLE), "debug height: measurement rejected, verdict implausible"),
    (rejected(4, "relocalization", m.Verdict.ACCEPTED), "info estimator: relocalise, frame 4"),
    (
        rejected(4, "reset", m.Verdict.ACCEPTED, "indeterminate"),  # although its verdict is accepted
        "warning estimator: graph begins again, frame 4, reason indeterminate",
    ),
]


@pytest.mark.parametrize(("message", "line"), LINES, ids=[line for _, line in LINES])
def test_a_message_is_a_line_with_its_level_part_and_known_fields_and_an_error_says_what_to_do(
    message: m.Message, line: str
) -> None:
    entry = log_entry(message)
    assert entry is not None
    found, _, todo = f"{entry.level} {entry.part}: {entry.text}".partition(", todo ")
    assert found == line and (len(todo) > 20) == (entry.level == "error")


def test_a_log_line_has_the_fields_of_its_message() -> None:
    stream = io.StringIO()
    writer = logs.configure("INFO", "link", stream)
    logs.write(log_entry(m.StatusText(t_ns=1, severity=4, text="lost, send a position hint")))
    logs.write(log_entry(m.SearchState(t_ns=1, step=m.SearchStep.NORMAL)))  # below the configured level
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
    return msgspec.structs.replace(GPS, fix_type=fix_type, no_fix_reason=reason)


def test_the_loss_of_the_fix_is_a_warning_with_its_reason_and_each_receiver_has_a_state_of_its_own() -> None:
    log = MessageLog()
    lost = [log.entry(gps(3)), log.entry(gps(3)), log.entry(gps(1, "estimate too old"))][-1]
    assert lost is not None
    assert (lost.level, lost.text) == ("warning", "GPS_INPUT has no fix, reason estimate too old")
    spoofed = [
        m.GnssVerdict(t_ns=1, receiver=r, state=m.GnssState.SPOOFED, distance_m=900.0, sigmas=30.0) for r in (0, 1, 0)
    ]
    assert [entry.level if (entry := log.entry(v)) else None for v in spoofed] == ["warning", "warning", None]


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


def test_a_search_has_a_line_where_it_begins_and_where_it_has_found_the_position() -> None:
    log, steps = MessageLog(), ("normal", "widen", "whole_map", "merge", "normal", "ask")
    entries = [log.entry(m.SearchState(t_ns=7, step=m.SearchStep(step))) for step in steps]
    assert [entry.fields.get("recovery") for entry in entries if entry is not None] == [
        *(None, "RecoveryStarted", None, "RecoverySucceeded", None, "RecoveryStarted")
    ]
    assert [entry.level for entry in entries if entry is not None][3] == "info"
