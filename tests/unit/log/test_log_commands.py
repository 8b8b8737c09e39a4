"""`terrafix log`: contents, damage, lines of text, exports and parts of a record, as commands."""

import csv
import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import msgspec
import pyogrio
import pytest
from mcap.reader import make_reader
from pyarrow import parquet
from typer.testing import CliRunner, Result

from flight_records import ORIGIN, PERIOD_NS, estimate, frame, live_messages, origin, write_record
from terrafix import messages as m
from terrafix.core.config import Config
from terrafix.core.errors import SourceError, UsageError
from terrafix.recorder.provenance import header
from terrafix.recorder.reader import ReadResult, read_flight, read_thumbnails
from terrafix.recorder.writer import FlightWriter
from terrafix_tools.cli import app
from terrafix_tools.log.show import Selection, follow

FRAMES = 20
LOCATED = FRAMES - 1  # the first frame has no position
NOON_NS = 1_783_080_000_000_000_000  # 2026-07-03 12:00:00 UTC


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["log", *(str(argument) for argument in arguments)])


@pytest.fixture
def record(tmp_path: Path) -> Path:
    """The record of a live run, with the wall clock."""
    clock = m.WallClock(t_ns=2 * PERIOD_NS, unix_ns=NOON_NS + 2 * PERIOD_NS, source="autopilot")
    folder = tmp_path / "run"
    folder.mkdir()
    write_record(folder / "flight-000.mcap", [*live_messages(FRAMES), clock])
    return folder


def recorded(path: Path) -> list[m.Message]:
    return [message for _, _, message in read_flight(path)]


def damaged(path: Path, share: float) -> Path:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    return path


def test_info_names_files_duration_start_frames_and_rates(record: Path) -> None:
    lines = call("info", record).output.splitlines()
    assert lines[0].startswith(f"{record}: 1 files, ") and lines[0].endswith("format terrafix-flight/2")
    assert "duration 9.9 s, start 2026-07-03T12:00:00+00:00" in lines
    assert "from 48.000000, 11.000000" in lines
    assert f"{LOCATED} of {FRAMES} frames localised" in lines
    assert any(line.split() == ["Frame", "20", "2.02", "Hz"] for line in lines)


def test_info_names_map_models_and_computer(tmp_path: Path) -> None:
    head = header(Config()) | {
        "map": '{"path": "/maps/a.gpkg", "checksum": "0123456789abcdef"}',
        "models": '{"xfeat": {"path": "/m/x.onnx", "sha256": "fedcba9876543210"}}',
        "device": '{"product": "Jetson", "processor": "Cortex"}',
    }
    writer = FlightWriter(tmp_path / "flight-000.mcap", head)
    writer.write(origin(), 0)
    writer.close()
    lines = call("info", tmp_path).output.splitlines()
    assert "map /maps/a.gpkg, checksum 0123456789ab" in lines
    assert "model xfeat: /m/x.onnx, sha256 fedcba987654" in lines
    assert "computer Jetson, Cortex" in lines
    found = json.loads(call("info", tmp_path, "--json").output)
    assert found["map_checksum"] == "0123456789abcdef" and found["calibration"]["width"] == origin().camera.width


def test_info_as_json_has_the_same(record: Path) -> None:
    found = json.loads(call("info", record, "--json").output)
    assert found["messages"]["NavEstimate"] == LOCATED and found["damage"] == []
    assert found["files"][0]["name"] == "flight-000.mcap" and found["start_utc"].startswith("2026-07-03T12:00:00")


def test_check_says_undamaged_and_has_exit_code_0(record: Path) -> None:
    result = call("check", record)
    assert (result.exit_code, result.output) == (0, f"undamaged: 1 files, {len(recorded(record))} messages\n")


def test_check_names_each_damage_and_has_exit_code_1(record: Path) -> None:
    damaged(record / "flight-000.mcap", 0.9)
    result = call("check", record)
    assert result.exit_code == 1
    assert result.output.splitlines()[0] == "flight-000.mcap: ends in the middle of a record"
    assert "'terrafix log recover'" in result.output


def test_show_has_a_line_for_each_message_with_its_time_since_the_start(record: Path) -> None:
    lines = call("show", record).output.splitlines()
    assert len(lines) == len(recorded(record))
    line = next(line for line in lines if "NavEstimate" in line)
    assert line.startswith("     0.500 NavEstimate frame_id=1 lat_deg=48.0000")


def test_show_selects_by_type_and_time(record: Path) -> None:
    lines = call(
        "show", record, "--message", "Frame", "--message", "Health", "--from", 2, "--to", 3
    ).output.splitlines()
    assert [line.split()[:2] for line in lines] == [
        [f"{t:.3f}", kind] for t in (2.0, 2.5, 3.0) for kind in ("Frame", "Health")
    ]


def test_show_refuses_an_unknown_message(record: Path) -> None:
    result = call("show", record, "--message", "Pose")
    assert isinstance(result.exception, UsageError) and "no such message; known: CalibrationEstimate" in str(
        result.exception
    )


def test_show_follows_a_record_that_is_being_written(tmp_path: Path) -> None:
    writer = FlightWriter(tmp_path / "flight-000.mcap", header(Config()))
    writer.write(origin(), 0)
    writer.write(frame(0), 0)
    writer.flush()

    def write_another(_: float) -> None:
        writer.write(frame(1), 1)
        writer.flush()

    lines = list(follow(tmp_path, Selection(("Frame",)), sleep=write_another, rounds=2))
    writer.close()
    assert [line.split("frame_id=")[1][0] for line in lines] == ["0", "1"], "each line once"


@pytest.mark.parametrize("suffix", ["geojson", "gpkg", "kml", "shp"])
def test_gdal_opens_an_export_with_a_point_for_each_position(record: Path, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"track.{suffix}"
    result = call("export", record, out)
    assert result.output == f"{LOCATED} positions (immediate); written to {out}\n"
    layered = suffix in ("gpkg", "kml")
    info = pyogrio.read_info(out, layer="frames" if layered else None)
    assert info["features"] == LOCATED
    assert "lat_deg" in [str(name) for name in info["fields"]]
    west, south, east, north = info["total_bounds"]
    lat_deg, lon_deg = ORIGIN.to_wgs84(5.0 * 19 + 1.0, 2.0)
    assert (north, east) == pytest.approx((lat_deg, lon_deg), abs=1e-7) and south < north and west < east
    if layered:
        assert pyogrio.read_info(out, layer="track")["features"] == 1
    assert not list(tmp_path.glob("*.partial*"))


def test_the_geopackage_has_the_columns_of_estimates_csv_and_the_time(record: Path, tmp_path: Path) -> None:
    call("export", record, tmp_path / "track.gpkg")
    meta, _, _, values = pyogrio.raw.read(tmp_path / "track.gpkg", layer="frames")
    columns = dict(zip(meta["fields"], values, strict=True))
    assert list(columns["file"][:2]) == ["0001.jpg", "0002.jpg"]
    assert columns["sigma_e_m"][0] == 4.0 and columns["source_label"][0] == "satellite_anchored"
    assert columns["time_utc"][0] == "2026-07-03T12:00:00.500+00:00"


def test_gpx_is_one_track_with_times_and_heights(record: Path, tmp_path: Path) -> None:
    out = tmp_path / "track.gpx"
    call("export", record, out)
    space = {"g": "http://www.topografix.com/GPX/1/1"}
    root = ElementTree.parse(out).getroot()
    points = root.findall("g:trk/g:trkseg/g:trkpt", space)
    assert len(points) == LOCATED and len(root.findall("g:trk", space)) == 1
    assert float(points[0].findtext("g:ele", namespaces=space) or 0) == 600.0
    assert (points[0].findtext("g:time", namespaces=space) or "").startswith("2026-07-03T12:00:00.5")
    assert float(points[-1].get("lat") or 0) == pytest.approx(ORIGIN.to_wgs84(96.0, 2.0)[0], abs=1e-7)


def test_csv_and_parquet_have_the_positions(record: Path, tmp_path: Path) -> None:
    call("export", record, tmp_path / "track.csv")
    with (tmp_path / "track.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    call("export", record, tmp_path / "track.parquet")
    table = parquet.read_table(tmp_path / "track.parquet").to_pydict()
    assert len(rows) == len(table["file"]) == LOCATED
    assert float(rows[-1]["lat_deg"]) == pytest.approx(table["lat_deg"][-1], abs=1e-8)
    assert table["refined_lat_deg"][0] is None and table["time_utc"][0] == "2026-07-03T12:00:00.500+00:00"


def test_without_a_wall_clock_an_export_has_no_time(tmp_path: Path) -> None:
    write_record(tmp_path / "flight.mcap", live_messages(FRAMES))
    call("export", tmp_path / "flight.mcap", tmp_path / "track.parquet")
    assert "time_utc" not in parquet.read_table(tmp_path / "track.parquet").column_names
    call("export", tmp_path / "flight.mcap", tmp_path / "track.gpx")
    assert "<time>" not in (tmp_path / "track.gpx").read_text()


def test_a_flight_without_a_position_is_not_exported(tmp_path: Path) -> None:
    write_record(tmp_path / "flight.mcap", [origin(), frame(0)])
    result = call("export", tmp_path / "flight.mcap", tmp_path / "track.csv")
    assert isinstance(result.exception, SourceError) and "no frame has a position" in str(result.exception)


def test_cut_has_the_messages_between_two_times_the_origin_and_their_thumbnails(record: Path, tmp_path: Path) -> None:
    out = tmp_path / "part.mcap"
    result = call("cut", record, out, "--from", 2, "--to", 4)
    inside = [x for x in recorded(record) if isinstance(x, m.Origin) or 2 <= x.t_ns / 1e9 <= 4]
    assert recorded(out) == inside and result.output == f"{len(inside)} messages; written to {out}\n"
    assert [frame_id for frame_id, _ in read_thumbnails(out)] == [4, 5, 6, 7, 8]
    assert call("check", out).exit_code == 0


@pytest.mark.parametrize(("times", "kind"), [((4, 2), UsageError), ((40, 50), SourceError)])
def test_a_cut_without_messages_is_refused(
    record: Path, tmp_path: Path, times: tuple[int, int], kind: type[Exception]
) -> None:
    result = call("cut", record, tmp_path / "part.mcap", "--from", times[0], "--to", times[1])
    assert isinstance(result.exception, kind)


def test_merge_joins_the_segments_of_a_flight_and_keeps_one_origin(tmp_path: Path) -> None:
    messages = live_messages(FRAMES)
    write_record(tmp_path / "flight-000.mcap", messages[:60])
    write_record(tmp_path / "flight-001.mcap", [messages[0], *messages[60:]])
    out = tmp_path / "whole.mcap"
    call("merge", tmp_path / "flight-000.mcap", tmp_path / "flight-001.mcap", out)
    assert recorded(out) == messages
    assert len(list(read_thumbnails(out))) == FRAMES


def test_two_flights_are_not_merged(record: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    write_record(other, [m.Origin(**{**_fields(origin()), "lat_deg": 49.0}), frame(0)])
    result = call("merge", record, other, tmp_path / "whole.mcap")
    assert isinstance(result.exception, SourceError) and "is of another flight than" in str(result.exception)
    assert not (tmp_path / "whole.mcap").exists()


def _fields(message: m.Message) -> dict[str, object]:
    return {name: getattr(message, name) for name in message.__struct_fields__}


def test_recover_writes_what_is_readable_as_a_record_that_the_reference_reader_opens(
    record: Path, tmp_path: Path
) -> None:
    file = damaged(record / "flight-000.mcap", 0.9)
    readable = recorded(file)
    out = tmp_path / "recovered.mcap"
    result = call("recover", file, out)
    assert result.output.splitlines()[0] == "flight-000.mcap: ends in the middle of a record"
    assert recorded(out) == readable and call("check", out).exit_code == 0
    with out.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert sum(1 for _, channel, _ in reader.iter_messages() if channel.topic == "/frame") > 0


@pytest.mark.parametrize("command", ["cut", "recover"])
def test_a_record_is_not_written_over_itself(record: Path, command: str) -> None:
    file = record / "flight-000.mcap"
    before = file.read_bytes()
    assert isinstance(call(command, record, file).exception, UsageError)
    assert isinstance(call(command, record, record / "part.zip").exception, UsageError)
    assert file.read_bytes() == before


def test_a_record_is_readable_up_to_any_offset_and_its_rest_is_reported(record: Path, tmp_path: Path) -> None:
    data, whole = (record / "flight-000.mcap").read_bytes(), recorded(record)
    for number in range(50):
        part = tmp_path / "part.mcap"
        part.write_bytes(data[: len(data) * (number + 1) // 51])
        result = ReadResult()
        found = [message for _, _, message in read_flight(part, result)]
        assert found == whole[: len(found)] and result.truncated_files == [part]


@pytest.mark.parametrize("command", ["info", "check", "show"])
@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 a zip"], ids=["empty", "no MCAP"])
def test_a_file_that_is_no_record_is_one_line_of_the_log_commands(tmp_path: Path, command: str, content: bytes) -> None:
    (tmp_path / "x.mcap").write_bytes(content)
    result = call(command, tmp_path / "x.mcap")
    assert isinstance(result.exception, SourceError) and "is not a flight record" in str(result.exception)


def test_a_missing_file_is_one_line(tmp_path: Path) -> None:
    assert isinstance(call("info", tmp_path / "none.mcap").exception, SourceError)


def test_estimates_of_a_replay_are_exported_as_they_stand_in_its_csv(tmp_path: Path) -> None:
    write_record(tmp_path / "flight.mcap", [origin(), frame(0), estimate(0, 1.0, 2.0)])
    (tmp_path / "estimates.csv").write_text(
        "file,t_s,lat_deg,lon_deg,sigma_e_m,sigma_n_m,cov_en_m2\na.jpg,0,50,10,1,1,0\n"
    )
    call("export", tmp_path, tmp_path / "track.csv")
    assert "a.jpg,0.000,50.00000000,10.00000000" in (tmp_path / "track.csv").read_text()


def test_lines_are_the_log_of_the_flight_by_level_and_time(record: Path) -> None:
    def lines(*options: object) -> list[str]:
        return call("lines", record, *options).output.splitlines()

    everything = lines()
    assert "     0.000 info    vision     source open, lat_deg 48, lon_deg 11, start_sigma_m 10" in everything
    assert "     5.000 warning supervisor process died, child link, detail signal 9 <kill>" in everything
    assert "     5.500 warning vision     messages lost, message Frame, count 3" in everything
    warnings = lines("--level", "warning")
    assert warnings and all(line.split()[1] in ("warning", "error") for line in warnings)
    assert len(warnings) < len(everything) < len(lines("--level", "debug"))
    assert [line.split()[0] for line in lines("--level", "warning", "--from", 5.2, "--to", 5.6)] == ["5.500"]
    wrong = CliRunner().invoke(app, ["log", "lines", str(record), "--level", "loud"])
    assert isinstance(wrong.exception, UsageError) and "choose one of debug, info" in str(wrong.exception)


def test_lines_before_the_start_of_the_source_have_negative_times(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    early = m.LogLine(t_ns=1_000_000_000, process="link", level="info", event="autopilot", fields={"sysid": 1})
    late = msgspec.structs.replace(origin(), t_ns=3_000_000_000)
    write_record(path, [early, late])
    assert call("lines", path).output.splitlines()[0] == "    -2.000 info    link       autopilot, sysid 1"
