"""`terrafix finalise`: files, bytes and words, from a whole record, a torn one, and none at all."""

import csv
import json
from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

from flight_records import frame, write_record
from simulated_flight import Flight
from terrafix.core.config import Config
from terrafix.core.errors import SourceError
from terrafix.messages import MapMatch, Message, Odometry, Origin
from terrafix.recorder.reader import read_flight
from terrafix.recorder.schema import topic_of
from terrafix.recorder.writer import FlightWriter, header
from terrafix_tools.cli import app
from terrafix_tools.estimates import RowTable, write_rows
from terrafix_tools.evaluate import evaluate
from terrafix_tools.finalise.run import finalise, last_lines
from terrafix_tools.report.page import report
from told_flight import messages, record, shifted

FRAMES = 36


def rows_of(folder: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((folder / "finalised.csv").read_text(encoding="utf-8").splitlines()))


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a record, finalised once."""
    folder = tmp_path_factory.mktemp("flown")
    record(folder, Flight(FRAMES, seed=2))
    finalise(folder)
    return folder


def test_every_frame_has_a_row(flown: Path) -> None:
    rows = rows_of(flown)
    assert [r["file"] for r in rows] == [f"{i:04d}.jpg" for i in range(FRAMES)]
    assert all(float(r["sigma_e_m"]) > 0.0 and 0.0 <= float(r["yaw_deg"]) < 360.0 for r in rows)
    said = json.loads((flown / "finalised.json").read_text(encoding="utf-8"))
    assert said["frames"] == said["finalised"] == FRAMES and said["cut_off"] == []
    assert said["flights"][0]["map_matches"]["believed"] == 4


def test_the_same_record_gives_the_same_bytes(flown: Path, tmp_path: Path) -> None:
    (tmp_path / "flight.mcap").write_bytes((flown / "flight.mcap").read_bytes())
    finalise(tmp_path / "flight.mcap")
    assert (tmp_path / "finalised.csv").read_bytes() == (flown / "finalised.csv").read_bytes()


def test_it_is_evaluated_and_shown_beside_what_was_said_in_flight(flown: Path) -> None:
    table = RowTable()
    for _, _, message in read_flight(flown):
        table.take(message)
    with (flown / "estimates.csv").open("w", encoding="utf-8", newline="") as stream:
        write_rows(stream, table.rows.values())
    found = evaluate(flown, flown / "truth.csv", json_only=True)
    assert found["finalised"] == FRAMES and found["finalised_within_20m"] == 1.0
    assert found["finalised_median_m"] < 5.0 and found["finalised_false_fixes"] == 0
    page = report(flown).read_text(encoding="utf-8")
    assert 'data-layer="finalised"' in page and 'class="layer finalised"' in page


def test_a_torn_record_is_used_as_far_as_it_goes(flown: Path, tmp_path: Path) -> None:
    whole = (flown / "flight.mcap").read_bytes()
    (tmp_path / "flight.mcap.partial").write_bytes(whole[: len(whole) * 2 // 3])
    summary = finalise(tmp_path)
    assert 5 < summary["frames"] < FRAMES
    assert (
        summary["finalised"] >= summary["frames"] - 1
    )  # of the last frame there may be no more than that it was taken
    assert any("ends in the middle" in line for line in last_lines(summary, tmp_path))


def test_a_record_without_map_matches_says_so(tmp_path: Path) -> None:
    record(tmp_path, Flight(12, seed=3), lambda m: None if isinstance(m, MapMatch) else m)
    lines = list(last_lines(finalise(tmp_path), tmp_path))
    assert any("No map match is believed" in line for line in lines) and "12 of 12 frames" in lines[-1]


def test_a_start_that_nobody_knew_is_no_place(tmp_path: Path) -> None:
    """A start as wide as a map, and all matches of it wrong in their own way: the frames stay without a position."""

    def alter(message: Message) -> Message | None:
        if isinstance(message, Origin):
            return msgspec.structs.replace(message, start_sigma_m=2000.0)
        return None if isinstance(message, MapMatch) else message

    record(tmp_path, Flight(12, seed=3), alter)
    summary = finalise(tmp_path)
    assert summary["finalised"] == 0 and all(r["lat_deg"] == "" for r in rows_of(tmp_path))
    assert any("12 frames have no place" in line for line in last_lines(summary, tmp_path))


def test_a_wrong_match_is_counted(tmp_path: Path) -> None:
    def alter(message: Message) -> Message | None:
        wrong = isinstance(message, MapMatch) and message.frame_id == 18
        return shifted(message, (300.0, 0.0)) if wrong and isinstance(message, MapMatch) else message

    record(tmp_path, Flight(FRAMES, seed=2), alter)
    assert finalise(tmp_path)["flights"][0]["map_matches"]["refused"] == 1


@pytest.mark.parametrize(
    ("said", "words"),
    [([], "no origin"), ([frame(0)], "no origin"), (None, "no flight record")],
    ids=["empty", "no origin", "no record"],
)
def test_what_cannot_be_finalised_is_said_in_one_line(said: list[Message] | None, words: str, tmp_path: Path) -> None:
    if said is not None:
        write_record(tmp_path / "flight.mcap", said)
    with pytest.raises(SourceError, match=words):
        finalise(tmp_path)
    assert not (tmp_path / "finalised.csv").exists()


def test_what_is_no_record_is_said_so(tmp_path: Path) -> None:
    (tmp_path / "flight.mcap").write_bytes(b"no record at all")
    with pytest.raises(SourceError, match="not a flight record"):
        finalise(tmp_path)


def test_a_record_of_another_format_is_named(flown: Path, tmp_path: Path) -> None:
    whole = (flown / "flight.mcap").read_bytes()
    assert b"terrafix-flight/1" in whole
    (tmp_path / "flight.mcap").write_bytes(whole.replace(b"terrafix-flight/1", b"terrafix-flight/9"))
    with pytest.raises(SourceError, match="terrafix-flight/9"):
        finalise(tmp_path)


def test_messages_of_another_version_are_left_out_and_counted(tmp_path: Path) -> None:
    writer = FlightWriter(tmp_path / "flight.mcap", header(Config()))
    for message in messages(Flight(6, seed=4)):
        writer.write(message, message.t_ns)
        if isinstance(message, Odometry):
            writer._add(topic_of(Odometry), b'{"type":"Odometry","from":"the future"}', message.t_ns, message.t_ns)
    writer.close()
    summary = finalise(tmp_path)
    assert summary["undecodable"] == 6 and summary["finalised"] == 6
    assert any("another version" in line for line in last_lines(summary, tmp_path))


def test_the_command(flown: Path, tmp_path: Path) -> None:
    (tmp_path / "flight.mcap").write_bytes((flown / "flight.mcap").read_bytes())
    done = CliRunner().invoke(app, ["finalise", str(tmp_path), "--quiet"])
    assert done.exit_code == 0 and f"{FRAMES} of {FRAMES} frames placed by 4 map matches" in done.output
