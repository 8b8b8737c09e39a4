"""`terrafix finalise`: output files and messages, for complete, truncated and missing records."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import gtsam
import msgspec
import numpy as np
import pytest
from typer.testing import CliRunner

from flight_records import frame, write_record
from recorded_flight import messages, record, replayed_graph, shifted
from simulated_flight import Flight
from terrafix.core.config import Config
from terrafix.core.errors import SourceError
from terrafix.messages import MapMatch, Message, Odometry, Origin
from terrafix.recorder.provenance import header
from terrafix.recorder.reader import read_flight
from terrafix.recorder.schema import topic_of
from terrafix.recorder.writer import FlightWriter
from terrafix_tools.cli import app
from terrafix_tools.estimates import RowTable, write_rows
from terrafix_tools.evaluate import evaluate
from terrafix_tools.finalise.batch_smoother import smooth
from terrafix_tools.finalise.point_cloud import VERTEX
from terrafix_tools.finalise.run import finalise, last_lines, m_per_unit
from terrafix_tools.report.page import report

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


def test_finalised_csv_has_a_row_per_frame(flown: Path) -> None:
    rows = rows_of(flown)
    assert [r["file"] for r in rows] == [f"{i:04d}.jpg" for i in range(FRAMES)]
    assert all(float(r["sigma_e_m"]) > 0.0 and 0.0 <= float(r["yaw_deg"]) < 360.0 for r in rows)
    covs = np.array([[float(v) for v in r["cov"].split()] for r in rows])
    for column, i in (("cov_en_m2", 1), ("sigma_e_m", 0), ("sigma_n_m", 7), ("sigma_u_m", 14)):
        stated = [float(r[column]) if column == "cov_en_m2" else float(r[column]) ** 2 for r in rows]
        assert stated == pytest.approx(covs[:, i], rel=1e-3, abs=1e-3)
    summary = json.loads((flown / "finalised.json").read_text(encoding="utf-8"))
    assert summary["frames"] == summary["finalised"] == FRAMES and summary["cut_off"] == []
    assert summary["flights"][0]["map_matches"]["believed"] == 4
    focal, k1 = summary["flights"][0]["before_after"][:2]
    assert focal["before"] == focal["after"] == 560.0  # no point was seen by three keyframes
    assert k1["what"] == "radial coefficient" and 0.0 < k1["after_sigma"] < 0.05


def test_the_scale_of_a_segment_is_its_length_in_the_solution_over_that_by_odometry() -> None:
    flight = replayed_graph(Flight(12, seed=2))
    solved = smooth(flight, estimates_lens=False)
    ((begin, as_flown),) = m_per_unit(flight, solved).items()
    assert as_flown == pytest.approx(1.0, abs=0.05)
    moved = [gtsam.Pose3(pose.rotation(), 1.5 * pose.translation()) for pose in solved.poses]
    assert m_per_unit(flight, replace(solved, poses=moved)) == {begin: pytest.approx(1.5 * as_flown, rel=1e-3)}


def test_points_of_the_ground_are_written_beside_the_track(flown: Path) -> None:
    """The simulated ground is level: the points are at its elevation, as far as their sigma and the heights say."""
    body = (flown / "points.ply").read_bytes().split(b"end_header\n", 1)[1]
    points = np.frombuffer(body, VERTEX)
    summary = json.loads((flown / "finalised.json").read_text(encoding="utf-8"))
    assert len(points) == summary["flights"][0]["points"] > 500
    assert np.median(points["views"]) >= 2 and set(points["fragment"].tolist()) == {0}
    ground_m = float(np.median(points["z"]))
    assert np.median(np.abs(points["z"] - ground_m) / points["sigma"]) < 1.0
    rows = rows_of(flown)
    assert float(rows[0]["alt_amsl_m"]) - ground_m == pytest.approx(100.0, rel=0.05)


def test_the_finalised_track_is_evaluated_and_shown_in_the_report(flown: Path) -> None:
    table = RowTable()
    for _, _, message in read_flight(flown):
        table.take(message)
    with (flown / "estimates.csv").open("w", encoding="utf-8", newline="") as stream:
        write_rows(stream, table.rows.values())
    metrics = evaluate(flown, flown / "truth.csv", json_only=True)
    assert metrics["finalised"] == FRAMES and metrics["finalised_within_20m"] == 1.0
    assert metrics["finalised_median_m"] < 5.0 and metrics["finalised_false_fixes"] == 0
    page = report(flown).read_text(encoding="utf-8")
    assert 'data-layer="finalised"' in page and 'class="layer finalised"' in page


def test_a_truncated_record_is_used_up_to_its_end(flown: Path, tmp_path: Path) -> None:
    whole = (flown / "flight.mcap").read_bytes()
    (tmp_path / "flight.mcap.partial").write_bytes(whole[: len(whole) * 2 // 3])
    summary = finalise(tmp_path)
    assert 5 < summary["frames"] < FRAMES
    assert summary["finalised"] >= summary["frames"] - 1  # the record may have only the Frame message of the last one
    assert any("ends in the middle" in line for line in last_lines(summary, tmp_path))


def test_a_record_without_map_matches_is_finalised_with_a_message(tmp_path: Path) -> None:
    record(tmp_path, Flight(12, seed=3), lambda m: None if isinstance(m, MapMatch) else m)
    lines = list(last_lines(finalise(tmp_path), tmp_path))
    assert any("No map match was accepted" in line for line in lines) and "12 of 12 frames" in lines[-1]


def test_frames_without_map_match_and_known_start_have_no_position(tmp_path: Path) -> None:
    """Without a map match and with a start sigma as wide as the map, no frame has a position."""

    def alter(message: Message) -> Message | None:
        if isinstance(message, Origin):
            return msgspec.structs.replace(message, start_sigma_m=2000.0)
        return None if isinstance(message, MapMatch) else message

    record(tmp_path, Flight(12, seed=3), alter)
    summary = finalise(tmp_path)
    assert summary["finalised"] == 0 and all(r["lat_deg"] == "" for r in rows_of(tmp_path))
    assert any("12 frames have no position" in line for line in last_lines(summary, tmp_path))


def test_an_outlier_map_match_is_counted_in_the_summary(tmp_path: Path) -> None:
    def alter(message: Message) -> Message | None:
        wrong = isinstance(message, MapMatch) and message.frame_id == 18
        return shifted(message, (300.0, 0.0)) if wrong and isinstance(message, MapMatch) else message

    record(tmp_path, Flight(FRAMES, seed=2), alter)
    assert finalise(tmp_path)["flights"][0]["map_matches"]["refused"] == 1


@pytest.mark.parametrize(
    ("recorded", "expected"),
    [([], "no origin"), ([frame(0)], "no origin"), (None, "no flight record"), (b"no record", "not a flight record")],
    ids=["empty", "no origin", "no record", "another file"],
)
def test_what_is_no_record_is_refused(recorded: list[Message] | bytes | None, expected: str, tmp_path: Path) -> None:
    if isinstance(recorded, bytes):
        (tmp_path / "flight.mcap").write_bytes(recorded)
    elif recorded is not None:
        write_record(tmp_path / "flight.mcap", recorded)
    with pytest.raises(SourceError, match=expected):
        finalise(tmp_path)
    assert not (tmp_path / "finalised.csv").exists()


def test_a_record_of_another_format_raises_an_error_with_the_format(flown: Path, tmp_path: Path) -> None:
    whole = (flown / "flight.mcap").read_bytes()
    assert b"terrafix-flight/2" in whole
    (tmp_path / "flight.mcap").write_bytes(whole.replace(b"terrafix-flight/2", b"terrafix-flight/9"))
    with pytest.raises(SourceError, match="terrafix-flight/9"):
        finalise(tmp_path)


def test_undecodable_messages_are_skipped_and_counted(tmp_path: Path) -> None:
    writer = FlightWriter(tmp_path / "flight.mcap", header(Config()))
    for message in messages(Flight(6, seed=4)):
        writer.write(message, message.t_ns)
        if isinstance(message, Odometry):
            writer._add(topic_of(Odometry), b'{"type":"Odometry","from":"the future"}', message.t_ns, message.t_ns)
    writer.close()
    summary = finalise(tmp_path)
    assert summary["undecodable"] == 6 and summary["finalised"] == 6
    assert any("another version" in line for line in last_lines(summary, tmp_path))


def test_the_finalise_command_prints_the_placed_frames_and_gives_identical_bytes(flown: Path, tmp_path: Path) -> None:
    (tmp_path / "flight.mcap").write_bytes((flown / "flight.mcap").read_bytes())
    done = CliRunner().invoke(app, ["finalise", str(tmp_path / "flight.mcap"), "--quiet"])
    assert (tmp_path / "finalised.csv").read_bytes() == (flown / "finalised.csv").read_bytes()
    assert done.exit_code == 0 and f"{FRAMES} of {FRAMES} frames placed by 4 map matches" in done.output
    assert "Before and after" in done.output and "560.0 ± 5.6" in done.output
