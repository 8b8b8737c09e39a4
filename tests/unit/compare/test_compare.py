"""`terrafix compare`: first divergence, positions, verdicts and timing of two records of one flight."""

import json
from html.parser import HTMLParser
from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

import live_record
from flight_records import PERIOD_NS, estimate, live_messages, origin, write_record
from simulated_flight import Flight
from terrafix import messages as m
from terrafix.core import gate
from terrafix.core.errors import OutputError, SourceError
from terrafix.recorder.provenance import RECORD_FORMAT
from terrafix.recorder.writer import FlightWriter
from terrafix_tools.cli import app
from terrafix_tools.compare.alignment import read_record
from terrafix_tools.compare.difference import compare_records
from terrafix_tools.compare.text import summary
from terrafix_tools.rerun.run import replay_record


def record(folder: Path, messages: list[m.Message]) -> Path:
    folder.mkdir()
    write_record(folder / "flight.mcap", messages)
    return folder


def compared(tmp_path: Path, a: list[m.Message], b: list[m.Message]) -> dict:  # type: ignore[type-arg]
    return compare_records(read_record(record(tmp_path / "a", a)), read_record(record(tmp_path / "b", b)))


def changed(messages: list[m.Message], number: int, **fields: object) -> list[m.Message]:
    """-> the messages with other fields in the ``number``-th NavEstimate."""
    places = [place for place, message in enumerate(messages) if isinstance(message, m.NavEstimate)]
    copy = list(messages)
    copy[places[number]] = msgspec.structs.replace(copy[places[number]], **fields)
    return copy


def test_equal_records_are_equal_whatever_the_order_of_types_and_the_clock_of_publication(tmp_path: Path) -> None:
    messages = live_messages()
    others = changed(messages, 4, emitted_at_ns=17)
    by_type = sorted(others, key=lambda message: type(message).__name__ != "Origin")
    found = compared(tmp_path, messages, by_type)
    assert found["equal"] and found["compared"] == len(messages) and found["first"] is None
    assert f"equal: all {len(messages)} messages" in list(summary(found))


def test_the_first_differing_message_is_named_with_its_frame_time_and_field(tmp_path: Path) -> None:
    messages = live_messages()
    others = changed(changed(messages, 9, alt_amsl_m=601.5), 14, agl_m=90.0)
    found = compared(tmp_path, messages, others)
    assert not found["equal"]
    assert found["first"] == {
        "message": "NavEstimate",
        "t_s": 5.0,
        "frame_id": 10,
        "fields": [{"field": "alt_amsl_m", "a": 600.0, "b": 601.5}],
        "more_fields": 0,
    }
    assert found["messages"]["NavEstimate"] == {"equal": 17, "different": 2, "only_a": 0, "only_b": 0}
    assert "first difference: NavEstimate of frame 10 at 5.000 s: alt_amsl_m 600.0 -> 601.5" in list(summary(found))


def test_the_earliest_difference_is_first_although_its_type_comes_later_in_the_record(tmp_path: Path) -> None:
    messages = live_messages()
    others = [
        msgspec.structs.replace(message, disk_free_mb=2)
        if isinstance(message, m.Health) and message.t_ns == 3 * PERIOD_NS
        else message
        for message in changed(messages, 9, agl_m=90.0)
    ]
    found = compared(tmp_path, messages, others)
    assert [first["message"] for first in found["first_of_each_message"]] == ["Health", "NavEstimate"]
    assert found["first"]["t_s"] == 1.5


def test_messages_of_one_record_only_are_named(tmp_path: Path) -> None:
    messages = live_messages()
    without = [message for message in messages if not (isinstance(message, m.NavEstimate) and message.frame_id == 7)]
    found = compared(tmp_path, messages, without)
    assert found["first"] == {"message": "NavEstimate", "t_s": 3.5, "frame_id": 7, "only_in": "a"}
    assert found["positions"]["only_a"] == 1 and found["messages"]["NavEstimate"]["only_a"] == 1
    (tmp_path / "other").mkdir()
    turned = compared(tmp_path / "other", without, messages)
    assert turned["first"]["only_in"] == "b" and not turned["equal"]


def test_positions_are_compared_in_metres_by_the_last_estimate_of_a_frame(tmp_path: Path) -> None:
    messages = live_messages()
    moved = [
        msgspec.structs.replace(estimate(message.frame_id, 5.0 * message.frame_id + 4.0, 6.0), emitted_at_ns=0)
        if isinstance(message, m.NavEstimate) and message.frame_id > 10
        else message
        for message in messages
    ]
    found = compared(tmp_path, messages, moved)["positions"]
    assert found["frames"] == 19 and found["equal"] == 10
    assert found["max_m"] == pytest.approx(5.0, abs=0.01) and found["median_m"] == 0.0
    assert found["p95_m"] == pytest.approx(5.0, abs=0.01) and found["max_at_s"] >= 5.5


def test_numbers_of_verdicts_and_delays_are_compared(tmp_path: Path) -> None:
    messages = live_messages()
    others = [
        msgspec.structs.replace(message, verdict=m.Verdict.STALE)
        if isinstance(message, m.MeasurementVerdict) and message.frame_id == 6
        else msgspec.structs.replace(message, emitted_at_ns=message.t_ns + 50_000_000)
        if isinstance(message, m.NavEstimate)
        else message
        for message in messages
    ]
    found = compared(tmp_path, messages, others)
    assert found["verdicts"] == [
        {"measurement": "map", "verdict": "accepted", "a": 16, "b": 15},
        {"measurement": "map", "verdict": "ambiguous", "a": 4, "b": 4},
        {"measurement": "map", "verdict": "stale", "a": 0, "b": 1},
    ]
    assert found["delay_ms"]["a"]["p50"] == 120.0 and found["delay_ms"]["b"]["p99"] == 50.0
    lines = list(summary(found))
    assert "verdicts: map accepted: 16 -> 15" in lines
    assert "delay of an estimate in B: p50 50.0 ms, p95 50.0 ms, p99 50.0 ms" in lines


def test_distance_and_the_first_verdict_that_changed_come_first(tmp_path: Path) -> None:
    messages = live_messages()
    others = [
        msgspec.structs.replace(message, verdict=m.Verdict.STALE)
        if isinstance(message, m.MeasurementVerdict) and message.frame_id in (6, 8)
        else message
        for message in messages
    ]
    lines = list(summary(compared(tmp_path, messages, others)))
    assert lines[0].startswith("positions: 19 of 19 frames equal")
    assert lines[1] == "first verdict that changed: map of frame 6 at 3.000 s: accepted -> stale"


def test_a_replay_is_not_asked_for_what_only_a_live_flight_has(tmp_path: Path) -> None:
    messages = live_messages()
    replayed = [x for x in messages if isinstance(x, m.Origin | m.Frame | m.NavEstimate | m.MeasurementVerdict)]
    found = compared(tmp_path, messages, replayed)
    assert found["equal"] and {"GpsInput", "Health", "ProcessEvent"} <= set(found["only_live"])
    assert "not compared, because a replay has none: Dropped, GpsInput" in "\n".join(summary(found))


def test_what_was_before_the_start_is_said_so_and_not_at_a_negative_time(tmp_path: Path) -> None:
    early = m.ProcessEvent(t_ns=-2_500_000_000, process="link", event="started", detail="")
    found = compared(tmp_path, live_messages(), [*live_messages(), early])
    text = "\n".join(summary(found))
    assert "ProcessEvent 2.500 s before the start: only in B" in text and "-2" not in text


def test_records_with_other_clocks_are_compared_by_the_time_since_their_start(tmp_path: Path) -> None:
    def later(message: m.Message) -> m.Message:
        return msgspec.structs.replace(message, t_ns=message.t_ns + 7_000_000_000)

    messages = live_messages()
    found = compared(tmp_path, messages, [later(message) for message in messages])
    assert found["equal"] and found["not_compared"] == ["Imu", "InputOrder"]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"lat_deg": 48.01}, "their starts are 1112 m apart"),
        ({"camera": m.Camera(width=64, height=48, fx=61.0, fy=60.0, cx=32.0, cy=24.0)}, "their cameras differ"),
    ],
)
def test_records_of_two_flights_are_refused(tmp_path: Path, change: dict[str, object], why: str) -> None:
    messages = live_messages()
    others = [msgspec.structs.replace(origin(), **change), *messages[1:]]
    with pytest.raises(SourceError, match=f"of different flights: {why}"):
        compared(tmp_path, messages, others)


def test_a_changed_constant_is_found_by_replay_and_compare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flown = tmp_path / "flight-000.mcap"
    live_record.write(flown, Flight(24))
    replay_record(flown, tmp_path / "same")
    monkeypatch.setitem(gate.GATE, 6, 1.0)
    replay_record(flown, tmp_path / "changed")
    assert compare_records(read_record(flown), read_record(tmp_path / "same"))["equal"]
    found = compare_records(read_record(flown), read_record(tmp_path / "changed"))
    first = found["first"]
    assert first["message"] in ("MeasurementVerdict", "NavEstimate", "PoseSolution") and first["frame_id"] >= 0
    names = {entry["field"] for entry in first.get("fields", [])}
    assert names, "the fields are named"
    map_verdicts = {row["verdict"]: row for row in found["verdicts"] if row["measurement"] == "map"}
    assert map_verdicts["innovation"]["b"] > map_verdicts["innovation"]["a"]


class Cells(HTMLParser):
    """Text of the table cells and headings of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.text: list[str] = []

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def test_the_command_writes_text_json_and_a_page_and_its_exit_code_says_whether_they_differ(tmp_path: Path) -> None:
    messages = live_messages()
    a = record(tmp_path / "a", messages)
    b = record(tmp_path / "b", changed(messages, 9, alt_amsl_m=601.5))
    runner, page = CliRunner(), tmp_path / "page.html"
    same = runner.invoke(app, ["compare", str(a), str(a)])
    assert same.exit_code == 0 and same.output.startswith("positions: 19 of 19 frames equal")
    assert same.output.splitlines()[1] == f"equal: all {len(messages)} messages"
    other = runner.invoke(app, ["compare", str(a), str(b), "--html", str(page)])
    assert other.exit_code == 1 and "alt_amsl_m 600.0 -> 601.5" in other.output
    as_json = runner.invoke(app, ["compare", str(a), str(b), "--json"])
    assert as_json.exit_code == 1 and json.loads(as_json.output)["first"]["frame_id"] == 10
    cells = Cells()
    cells.feed(page.read_text())
    assert ["different", " 1 of 200 messages"][0] in " ".join(cells.text)
    assert "NavEstimate" in cells.text and "first difference" in cells.text
    assert "http" not in page.read_text().replace("http://www.w3.org", "")


def test_a_page_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    a = record(tmp_path / "a", live_messages())
    result = CliRunner().invoke(app, ["compare", str(a), str(a), "--html", str(tmp_path / "none" / "page.html")])
    assert isinstance(result.exception, OutputError)


def test_a_file_of_a_future_version_is_one_line(tmp_path: Path) -> None:
    writer = FlightWriter(tmp_path / "flight.mcap", {"format": "terrafix-flight/99", "config": "{}", "versions": "{}"})
    writer.write(origin(), 0)
    writer.close()
    with pytest.raises(SourceError, match=f"format 'terrafix-flight/99', and this program reads '{RECORD_FORMAT}'"):
        read_record(tmp_path / "flight.mcap")


@pytest.mark.parametrize("content", [b"", b"<html>"], ids=["empty", "no MCAP"])
def test_a_file_that_is_no_record_is_one_line_in_compare(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.mcap").write_bytes(content)
    with pytest.raises(SourceError, match="is not a flight record"):
        read_record(tmp_path / "x.mcap")


def test_a_truncated_record_is_compared_up_to_its_end(tmp_path: Path) -> None:
    a = record(tmp_path / "a", live_messages(200))
    b = record(tmp_path / "b", live_messages(200))
    file = b / "flight.mcap"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    found = compare_records(read_record(a), read_record(b))
    assert found["b"]["cut_off"] == ["flight.mcap"] and not found["equal"]
    assert found["first"]["only_in"] == "a"
