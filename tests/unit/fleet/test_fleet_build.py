"""`terrafix fleet build`: what it finds and adds, what a killed worker or build leaves, and its errors."""

import os
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
from pyarrow import fs
from typer.testing import CliRunner, Result

from dying_examiner import DyingExaminer
from fleet_records import Invented, write_records
from map_cluster import local_cluster
from terrafix.core.errors import OutputError, SourceError, UsageError
from terrafix.recorder.writer import FlightWriter
from terrafix_tools.cli import app
from terrafix_tools.fleet import build as build_module
from terrafix_tools.fleet.build import DEATHS, DEATHS_ALONE, KILLED, build, examine_all, processes
from terrafix_tools.fleet.examine import Examiner
from terrafix_tools.fleet.find import Place, find_records, open_place
from terrafix_tools.fleet.query import query
from terrafix_tools.fleet.store import LIST, FleetFolder, open_fleet
from terrafix_tools.installation import install_command

RECORDS = 12
LIMIT = DEATHS + DEATHS_ALONE
COUNTS = "SELECT count(*), count(DISTINCT flight), sum(frames) FROM flights"


def tree(fleet: Path) -> dict[str, bytes]:
    """Contents of all files by path."""
    return {str(path.relative_to(fleet)): path.read_bytes() for path in fleet.rglob("*") if path.is_file()}


def rows(fleet: Path, sql: str) -> list[tuple[object, ...]]:
    return query(fleet, sql).rows


def build_command(source: Path, out: Path) -> list[str]:
    arguments = ["fleet", "build", str(source), "--out", str(out), "--workers", "1"]
    return [sys.executable, "-m", "terrafix_tools.program", *arguments]


def flights_in(out: Path) -> int:
    return len(list((out / "flights").glob("date=*/flight=*/part.parquet")))


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["fleet", *(str(argument) for argument in arguments)])


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("written")
    write_records(folder, RECORDS, frames=8)
    return folder


@pytest.fixture
def records(written: Path, tmp_path: Path) -> Path:
    return shutil.copytree(written, tmp_path / "records")


def test_every_record_becomes_a_flight_in_the_folder_of_its_date(records: Path, tmp_path: Path) -> None:
    fleet = tmp_path / "fleet"
    result = build(str(records), fleet, workers=1)
    assert (result.found, result.new, result.flights, result.errors) == (RECORDS, RECORDS, RECORDS, [])
    assert rows(fleet, COUNTS) == [(RECORDS, RECORDS, 8 * RECORDS)]
    assert rows(fleet, "SELECT count(*), count(DISTINCT (flight, frame)) FROM frames") == [(96, 96)]
    by_date = rows(fleet, "SELECT date, flight FROM flights")
    assert [date for date, _ in by_date].count(None) == 2, "of the two replays, which have no clock"
    for day, flight in by_date:
        date = day or "__HIVE_DEFAULT_PARTITION__"
        for table in ("flights", "frames"):
            assert (fleet / table / f"date={date}" / f"flight={flight}" / "part.parquet").is_file()


def test_runs_single_files_and_nested_folders_are_found_and_recorded_sources_are_not(tmp_path: Path) -> None:
    for name in ("run/flight-000.mcap", "run/flight-001.mcap", "run/cut.mcap", "replay/flight.mcap.partial",
                 "source/flight.mcap", "source/flight.toml", "deep/er/other.mcap", "run/estimates.csv",
                 "replay/summary.json"):  # fmt: skip
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")
    found, unlisted = find_records(open_place(str(tmp_path)))
    assert [(record.path.removeprefix(f"{tmp_path}/"), record.run, record.names) for record in found] == [
        ("deep/er/other.mcap", False, ("other.mcap",)),
        ("replay", True, ("flight.mcap.partial", "summary.json")),
        ("run", True, ("flight-000.mcap", "flight-001.mcap")),
        ("run/cut.mcap", False, ("cut.mcap",)),
        ("source/flight.mcap", False, ("flight.mcap",)),
    ]
    assert unlisted == []


def test_a_second_build_changes_nothing(records: Path, tmp_path: Path) -> None:
    fleet = tmp_path / "fleet"
    build(str(records), fleet, workers=1)
    before = tree(fleet)
    result = build(str(records), fleet, workers=1)
    assert (result.unchanged, result.new, result.grown) == (RECORDS, 0, 0)
    assert tree(fleet) == before


def test_a_flight_under_two_paths_is_there_once_with_the_longer_record(records: Path, tmp_path: Path) -> None:
    run = records / "vehicle-1" / "run-0001"
    longer = FlightWriter(records / "a-longer.mcap", Invented(1, frames=20).header)
    for message, received_ns in Invented(1, frames=20).messages():
        longer.write(message, received_ns)
    longer.close()
    shutil.copytree(run, records / "z-copy")
    shutil.copytree(records / "vehicle-2" / "run-0002", records / "z-copy-2")
    result = build(str(records), tmp_path / "fleet", workers=1)
    assert (result.found, result.flights) == (RECORDS + 3, RECORDS)
    flight = rows(tmp_path / "fleet", "SELECT flight FROM flights WHERE frames = 20")[0][0]
    assert rows(tmp_path / "fleet", f"SELECT count(*) FROM frames WHERE flight = '{flight}'") == [(20,)]
    kept = [path for (path,) in rows(tmp_path / "fleet", "SELECT record FROM flights WHERE record LIKE '%run-0002'")]
    assert kept == [f"{records}/vehicle-2/run-0002"], "of two equal records the first"
    assert build(str(records), tmp_path / "fleet", workers=1).unchanged == RECORDS + 3


def test_a_record_that_has_grown_replaces_its_rows_and_one_whose_beginning_was_deleted_does_not(
    tmp_path: Path,
) -> None:
    run = tmp_path / "records" / "run"
    run.mkdir(parents=True)
    fleet = tmp_path / "fleet"
    origin, *messages = Invented(0, frames=20).messages()

    def write(name: str, part: slice) -> None:
        writer = FlightWriter(run / name, Invented(0, frames=20).header)
        for message, received_ns in (origin, *messages[part]):
            writer.write(message, received_ns)
        writer.close()

    write("flight-000.mcap", slice(0, 30))
    build(str(tmp_path / "records"), fleet, workers=1)
    assert rows(fleet, "SELECT frames FROM flights") == [(10,)]
    write("flight-001.mcap", slice(30, 999))
    result = build(str(tmp_path / "records"), fleet, workers=1)
    assert (result.new, result.grown) == (0, 1)
    (run / "flight-000.mcap").unlink()
    result = build(str(tmp_path / "records"), fleet, workers=1)
    assert (result.new, result.grown, result.unchanged) == (0, 0, 0)
    assert rows(fleet, COUNTS) == [(1, 1, 20)]
    assert rows(fleet, "SELECT count(*) FROM frames") == [(20,)]


def test_a_flight_whose_date_becomes_known_later_moves_to_it(tmp_path: Path) -> None:
    run = tmp_path / "records" / "run"
    run.mkdir(parents=True)
    messages = Invented(0, frames=5).messages()
    for part in ([pair for pair in messages if type(pair[0]).__name__ != "WallClock"], messages):
        writer = FlightWriter(run / "flight-000.mcap", Invented(0, frames=5).header)
        for message, received_ns in part:
            writer.write(message, received_ns)
        writer.close()
        build(str(tmp_path / "records"), tmp_path / "fleet", workers=1)
    dated = rows(tmp_path / "fleet", "SELECT CAST(date AS VARCHAR), season FROM flights")
    assert dated == [("2026-01-01", "winter")]
    assert rows(tmp_path / "fleet", "SELECT count(*) FROM frames") == [(5,)]


def test_records_that_cannot_be_read_are_named_and_the_others_are_built(records: Path, tmp_path: Path) -> None:
    (records / "empty.mcap").write_bytes(b"")
    (records / "text.mcap").write_text("no record")
    (records / "link.mcap").symlink_to(records / "nowhere")
    done = call("build", records, "--out", tmp_path / "fleet", "--workers", 1)
    assert done.exit_code == 1
    assert f"{records}/link.mcap: No such file or directory\n" in done.stderr
    assert (
        f"{records}/text.mcap: text.mcap is not a flight record, or ends before its head; give another\n" in done.stderr
    )
    assert done.stdout == (
        f"{RECORDS + 3} records, 0 of them unchanged, 3 not readable; "
        f"{RECORDS} flights added, 0 grown; {RECORDS} flights in {tmp_path / 'fleet'}\n"
    )
    named = [record for (record,) in rows(tmp_path / "fleet", "SELECT record FROM errors ORDER BY record")]
    assert named == [f"{records}/{name}.mcap" for name in ("empty", "link", "text")]
    for name in ("empty", "text", "link"):
        (records / f"{name}.mcap").unlink()
    assert call("build", records, "--out", tmp_path / "fleet", "--workers", 1).exit_code == 0
    assert rows(tmp_path / "fleet", "SELECT count(*) FROM errors") == [(0,)]


def test_a_truncated_record_is_a_flight_that_says_so(records: Path, tmp_path: Path) -> None:
    path = records / "vehicle-0" / "run-0000" / "flight-000.mcap"
    path.write_bytes(path.read_bytes()[:-20])
    build(str(records), tmp_path / "fleet", workers=1)
    assert rows(tmp_path / "fleet", "SELECT record FROM flights WHERE truncated") == [(str(path.parent),)]


def test_a_bucket_gives_the_tables_of_a_folder(records: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file system other than the local one: records are copied to be read, and no copy stays."""
    bucket = Place(str(records), "", fs.SubTreeFileSystem(str(records), fs.LocalFileSystem()))
    assert not bucket.local
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(scratch))
    build(str(records), tmp_path / "folder", workers=1)
    monkeypatch.setattr(build_module, "open_place", lambda source: bucket)
    build("s3://fleet", tmp_path / "bucket", workers=1)
    assert tree(tmp_path / "bucket") == tree(tmp_path / "folder")
    assert list(scratch.iterdir()) == []


def test_an_address_of_the_local_file_system_is_read_in_place(records: Path, tmp_path: Path) -> None:
    place = open_place(f"file://{records}")
    assert place.local and find_records(place)[0][0].path.startswith(f"file://{records}/")
    assert build(f"file://{records}", tmp_path / "fleet", workers=1).new == RECORDS


def test_no_message_and_no_path_has_the_keys_of_an_address(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"^ftp://host/folder: cannot be opened") as caught:
        open_place("ftp://name:secret@host/folder?key=secret")
    assert "secret" not in str(caught.value)
    place = open_place(f"file://{tmp_path}")
    assert place.path == f"file://{tmp_path}"


@pytest.mark.slow
def test_killed_workers_lose_and_double_nothing(records: Path, tmp_path: Path) -> None:
    """Real processes, killed with SIGKILL at six records, more often than one record may kill them."""
    build(str(records), tmp_path / "undisturbed", workers=1)
    (tmp_path / "deaths").mkdir()
    deadly = tuple(f"run-{number:04d}" for number in range(0, RECORDS, 2))
    place = open_place(str(records))
    dying = DyingExaminer(place, deadly, tmp_path / "deaths", once=True)
    with open_fleet(tmp_path / "killed") as fleet:
        for examined in examine_all(dying, find_records(place)[0], partial(processes, 2), LIMIT):
            fleet.put(examined)
        fleet.finish()
    assert len(list((tmp_path / "deaths").iterdir())) == len(deadly) > LIMIT
    assert tree(tmp_path / "killed") == tree(tmp_path / "undisturbed")


@pytest.mark.slow
def test_a_record_at_which_every_worker_dies_is_given_up_and_named(records: Path, tmp_path: Path) -> None:
    place = open_place(str(records))
    dying = DyingExaminer(place, ("run-0006",), tmp_path, once=False)
    found = list(examine_all(dying, find_records(place)[0], partial(processes, 2), LIMIT))
    assert [(examined.record.path[-8:], examined.error) for examined in found if examined.error] == [
        ("run-0006", KILLED)
    ]
    assert sum(len(examined.flights) for examined in found) == RECORDS - 1
    assert len(list(tmp_path.glob("run-0006.*"))) <= LIMIT + 4


def test_the_row_of_a_flight_is_written_after_its_frames(
    records: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that a kill between the two leaves no flight without frames."""
    place = open_place(str(records))
    written: list[Path] = []

    def fail_at_the_second(self: FleetFolder, path: Path, content: bytes) -> None:
        written.append(path)
        if len(written) == 2:
            raise OSError(28, "No space left on device")
        path.parent.mkdir(parents=True)
        path.write_bytes(content)

    monkeypatch.setattr(FleetFolder, "_write", fail_at_the_second)
    with pytest.raises(OutputError, match="No space left on device"), open_fleet(tmp_path / "fleet") as fleet:
        fleet.put(Examiner(place).render(find_records(place)[0][0]))
    assert rows(tmp_path / "fleet", COUNTS)[0][0] == 0
    assert (tmp_path / "fleet" / LIST).exists() is False


def test_a_line_after_one_that_was_cut_off_is_read(records: Path, tmp_path: Path) -> None:
    place = open_place(str(records))
    record = find_records(place)[0][0]
    (tmp_path / "fleet").mkdir()
    (tmp_path / "fleet" / LIST).write_bytes(b'{"record": "')
    with open_fleet(tmp_path / "fleet") as fleet:
        fleet.put(Examiner(place).render(record))
    assert list(FleetFolder(tmp_path / "fleet").listed) == [record.path]


def test_a_build_that_was_cut_off_is_resumed(records: Path, tmp_path: Path) -> None:
    """What a kill leaves: some flights, one without its row among the flights, a line and a file that are cut off."""
    build(str(records), tmp_path / "undisturbed", workers=1)
    place = open_place(str(records))
    found, _ = find_records(place)
    with open_fleet(tmp_path / "fleet") as fleet:
        for record in found[:5]:
            fleet.put(Examiner(place).render(record))
    with (tmp_path / "fleet" / LIST).open("ab") as listed:
        listed.write(b'{"record": "')
    for part in sorted((tmp_path / "fleet" / "flights").rglob("part.parquet"))[:1]:
        part.rename(part.with_name(".part-part.parquet"))
    assert rows(tmp_path / "fleet", "SELECT count(DISTINCT flight), count(*) FROM frames") == [(4, 32)]
    result = build(str(records), tmp_path / "fleet", workers=1)
    assert (result.unchanged, result.new) == (4, RECORDS - 4)
    assert tree(tmp_path / "fleet") == tree(tmp_path / "undisturbed")


@pytest.mark.slow
def test_a_build_that_is_killed_is_resumed(tmp_path: Path) -> None:
    """The real command, killed with SIGKILL after its first flights."""
    write_records(tmp_path / "records", RECORDS, frames=600)
    fleet = tmp_path / "fleet"
    building = subprocess.Popen(build_command(tmp_path / "records", fleet), stderr=subprocess.DEVNULL)
    while flights_in(fleet) < 2 and building.poll() is None:
        time.sleep(0.005)
    building.kill()
    assert building.wait() == -signal.SIGKILL and 2 <= flights_in(fleet) < RECORDS
    result = build(str(tmp_path / "records"), fleet, workers=1)
    assert result.new + result.unchanged <= RECORDS and result.new > 0
    build(str(tmp_path / "records"), tmp_path / "undisturbed", workers=1)
    assert tree(fleet) == tree(tmp_path / "undisturbed")


@pytest.mark.slow
def test_a_dask_cluster_gives_the_same_tables_also_when_a_worker_is_killed(tmp_path: Path) -> None:
    write_records(tmp_path / "records", RECORDS, frames=200)
    build(str(tmp_path / "records"), tmp_path / "here", workers=1)
    (tmp_path / "cluster").mkdir()
    with local_cluster(tmp_path / "cluster", workers=2) as cluster:
        command = [*build_command(tmp_path / "records", tmp_path / "there"), "--scheduler", cluster.address]
        building = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        while flights_in(tmp_path / "there") < 1 and building.poll() is None:
            time.sleep(0.01)
        cluster.workers[0].kill()
        _, errors = building.communicate(timeout=120)
    assert building.returncode == 0, errors
    assert tree(tmp_path / "there") == tree(tmp_path / "here")


def test_a_fleet_is_built_by_one_program_at_a_time(records: Path, tmp_path: Path) -> None:
    with open_fleet(tmp_path / "fleet"), pytest.raises(OutputError, match="another build is writing this fleet"):
        build(str(records), tmp_path / "fleet", workers=1)


def test_a_flight_whose_file_is_damaged_is_built_again(records: Path, tmp_path: Path) -> None:
    fleet = tmp_path / "fleet"
    build(str(records), fleet, workers=1)
    before = tree(fleet)
    part = sorted((fleet / "flights").rglob("part.parquet"))[3]
    part.write_bytes(part.read_bytes()[:100])
    assert build(str(records), fleet, workers=1).new == 1
    assert tree(fleet) == before


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("nowhere", "no such folder"),
        ("file.txt", "not a folder"),
        ("none", "no flight record below it"),
        ("ftp://host/folder", "cannot be opened"),
    ],
)
def test_a_source_without_records_is_one_line(tmp_path: Path, source: str, message: str) -> None:
    (tmp_path / "file.txt").touch()
    (tmp_path / "none").mkdir()
    place = source if "://" in source else str(tmp_path / source)
    with pytest.raises(SourceError, match=message) as caught:
        build(place, tmp_path / "fleet", workers=1)
    assert "\n" not in str(caught.value) and not (tmp_path / "fleet").exists()


def test_a_folder_that_cannot_be_listed_is_an_error_of_the_build(
    records: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed, scandir = records / "vehicle-0", os.scandir

    def refuse(path: str) -> object:
        if Path(path) == closed:
            raise PermissionError(13, "Permission denied", path)
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refuse)
    result = build(str(records), tmp_path / "fleet", workers=1)
    assert result.errors == [(str(closed), "cannot be listed (Permission denied)")]
    assert result.new == RECORDS - 3
    monkeypatch.undo()
    assert rows(tmp_path / "fleet", "SELECT record FROM errors") == [(str(closed),)]
    assert build(str(records), tmp_path / "fleet", workers=1).errors == []
    assert rows(tmp_path / "fleet", "SELECT count(*) FROM errors") == [(0,)]


def test_an_unreachable_scheduler_is_one_line(records: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"^--scheduler tcp://127.0.0.1:1: no Dask scheduler answers there") as caught:
        build(str(records), tmp_path / "fleet", workers=1, scheduler="tcp://127.0.0.1:1")
    assert "\n" not in str(caught.value) and not (tmp_path / "fleet").exists()


def test_without_pyarrow_one_line_states_what_to_install(records: Path, tmp_path: Path) -> None:
    command = build_command(records, tmp_path / "fleet")
    code = "import sys; sys.modules['pyarrow'] = None; from terrafix_tools.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", code, *command[3:]], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr == f"terrafix: this command needs pyarrow; install it: {install_command('ground')}\n"
