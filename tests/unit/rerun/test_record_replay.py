"""`terrafix replay RECORD`: the estimator computes again from the messages of a record."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

import live_record
from flight_records import frame, write_record
from simulated_flight import Flight
from terrafix.core.errors import SourceError, UsageError
from terrafix.messages import Message, NavEstimate
from terrafix.recorder.reader import is_record, read_flight, read_received
from terrafix_tools.cli import app
from terrafix_tools.estimates import read_rows
from terrafix_tools.rerun.run import replay_record

FRAMES = 24


@pytest.fixture(scope="module")
def flight() -> Flight:
    return Flight(FRAMES)


def replayed(record: Path, out: Path) -> list[Message]:
    replay_record(record, out)
    return live_record.estimator_messages(read_flight(out / "flight.mcap"))


def outputs_of(record: Path) -> list[Message]:
    return live_record.estimator_messages(read_flight(record))


def test_a_record_replays_to_the_same_messages_although_they_were_received_in_another_order(
    tmp_path: Path, flight: Flight
) -> None:
    record = tmp_path / "flight-000.mcap"
    published = live_record.write(record, flight)
    assert sum(isinstance(message, NavEstimate) for message in published) >= FRAMES
    found = [message for message in replayed(record, tmp_path / "out") if type(message).__name__ != "InputOrder"]
    assert found == published


def test_without_its_input_order_such_a_record_replays_to_other_messages(tmp_path: Path, flight: Flight) -> None:
    record = tmp_path / "flight-000.mcap"
    published = live_record.write(record, flight, order=False)
    found = replayed(record, tmp_path / "out")
    assert found and found != published


def test_inputs_that_the_estimator_did_not_get_are_not_delivered(tmp_path: Path, flight: Flight) -> None:
    record = tmp_path / "flight-000.mcap"
    lost = frozenset(range(40, 50))
    published = live_record.write(record, flight, lost=lost)
    summary = replay_record(record, tmp_path / "out")
    found = live_record.estimator_messages(read_flight(tmp_path / "out" / "flight.mcap"))
    assert [message for message in found if type(message).__name__ != "InputOrder"] == published
    assert summary["record"]["undelivered_inputs"] > 0 and summary["record"]["missing_inputs"] == 0


def test_an_estimator_that_was_restarted_replays_from_its_checkpoint(tmp_path: Path, flight: Flight) -> None:
    record = tmp_path / "flight-000.mcap"
    published = live_record.write(record, flight, restart_at=60)
    assert published != live_record.write(tmp_path / "undisturbed.mcap", flight)
    summary = replay_record(record, tmp_path / "out")
    found = live_record.estimator_messages(read_flight(tmp_path / "out" / "flight.mcap"))
    assert [message for message in found if type(message).__name__ != "InputOrder"] == published
    assert summary["record"]["restarts"] == 1


def test_the_output_is_that_of_a_replay_and_keeps_the_other_messages_and_thumbnails(
    tmp_path: Path, flight: Flight
) -> None:
    record = tmp_path / "flight-000.mcap"
    live_record.write(record, flight)
    summary = replay_record(record, tmp_path / "out")
    rows = read_rows(tmp_path / "out" / "estimates.csv")
    assert len(rows) == summary["frames"] == FRAMES and rows[-1].lat_deg is not None
    kinds = [topic for topic, _, _ in read_flight(tmp_path / "out" / "flight.mcap")]
    before = [topic for topic, _, _ in read_flight(record)]
    assert sorted(kinds) == sorted(before), "as many of each type"


def test_a_truncated_record_is_replayed_up_to_its_end(tmp_path: Path, flight: Flight) -> None:
    record = tmp_path / "flight-000.mcap"
    live_record.write(record, flight)
    record.write_bytes(record.read_bytes()[: record.stat().st_size * 2 // 3])
    summary = replay_record(record, tmp_path / "out")
    assert summary["record"]["cut_off"] == ["flight-000.mcap"]
    # Telemetry and matches that the estimator handled just before the cut were received after it.
    received = [(received_ns, message) for _, _, received_ns, message in read_received(record)]
    complete_ns = received[-1][0] - live_record.LATE * live_record.MS
    expected = list(
        live_record.estimator_messages(
            ("", 0, message) for received_ns, message in received if received_ns < complete_ns
        )
    )
    assert expected and outputs_of(tmp_path / "out" / "flight.mcap")[: len(expected)] == expected
    assert summary["record"]["missing_inputs"] <= live_record.LATE


def test_a_replay_into_the_folder_of_its_record_is_refused_and_the_record_stays(tmp_path: Path, flight: Flight) -> None:
    record = tmp_path / "flight.mcap"
    live_record.write(record, flight)
    before = record.read_bytes()
    with pytest.raises(UsageError, match="give another folder with --out"):
        replay_record(tmp_path, tmp_path)
    assert record.read_bytes() == before


def test_a_record_is_known_by_its_name_and_a_flight_folder_is_none(tmp_path: Path) -> None:
    assert is_record(tmp_path / "flight-003.mcap") and is_record(tmp_path / "flight.mcap.partial")
    assert not is_record(tmp_path)
    (tmp_path / "flight.mcap").touch()
    assert is_record(tmp_path)
    (tmp_path / "flight.toml").touch()
    assert not is_record(tmp_path), "a source that somebody replayed into"


@pytest.mark.parametrize("content", [b"", b"<html>not a record</html>"], ids=["empty", "no MCAP"])
def test_a_file_that_is_no_record_is_one_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "flight.mcap").write_bytes(content)
    with pytest.raises(SourceError, match="is not a flight record, or ends before its head"):
        replay_record(tmp_path / "flight.mcap", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_record_without_an_origin_is_one_line(tmp_path: Path) -> None:
    write_record(tmp_path / "flight.mcap", [frame(0)])
    with pytest.raises(SourceError, match="no origin of a flight"):
        replay_record(tmp_path, tmp_path / "out")


@pytest.mark.parametrize("option", [["--map", "a.gpkg"], ["--model", "xfeat"], ["--start", "1,2"], ["--config", "c"]])
def test_options_of_a_source_are_refused_for_a_record(tmp_path: Path, option: list[str]) -> None:
    result = CliRunner().invoke(app, ["replay", str(tmp_path / "flight.mcap"), "--out", str(tmp_path / "o"), *option])
    assert isinstance(result.exception, UsageError)
    assert "a record is replayed from its messages" in str(result.exception)
