"""`terrafix fleet query` and `page`: answers, what a query cannot do, and what the page says."""

import csv
import io
import json
import re
import shutil
import subprocess
import sys
from datetime import date
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from fleet_records import LAKE_M, LAKE_RADIUS_M, write_records
from terrafix.core.errors import OutputError, SourceError, UsageError
from terrafix_tools.cli import app, main
from terrafix_tools.fleet.build import build
from terrafix_tools.fleet.page import months, write_page
from terrafix_tools.fleet.places import METRES_PER_DEG, grids, picture, worst
from terrafix_tools.fleet.query import FleetTables, query

RECORDS, FRAMES = 30, 60


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("queried")
    write_records(folder / "records", RECORDS, FRAMES)
    (folder / "records" / "text.mcap").write_text("no record")
    build(str(folder / "records"), folder / "fleet", workers=1)
    return folder / "fleet"


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["fleet", *(str(argument) for argument in arguments)])


def test_json_has_an_object_for_each_row_with_dates_and_maps(fleet: Path) -> None:
    sql = """SELECT flight, date, start_utc, refused, map_date, live FROM flights
        WHERE record LIKE '%run-0003' OR record LIKE '%run-0004' ORDER BY record"""
    live, replay = sorted(json.loads(call("query", fleet, sql, "--json").stdout), key=lambda row: not row["live"])
    assert (live["date"], live["start_utc"]) == ("2026-01-22", "2026-01-22T10:00:00+00:00")
    assert (replay["date"], replay["start_utc"], replay["map_date"]) == (None, None, "2024-07-01")
    assert live["refused"]["ambiguous"] > 0 and re.fullmatch("[0-9a-f]{16}", live["flight"])


def test_csv_has_a_header_and_empty_cells_for_unknown(fleet: Path) -> None:
    sql = "SELECT frame, lat_deg, 'a,b' AS text, CAST('nan' AS DOUBLE) AS n FROM frames WHERE frame = 0 LIMIT 1"
    assert list(csv.reader(io.StringIO(call("query", fleet, sql, "--csv").stdout))) == [
        ["frame", "lat_deg", "text", "n"],
        ["0", "", "a,b", ""],
    ]


def test_the_printed_table_is_cut_at_fifty_rows_and_says_so(fleet: Path) -> None:
    lines = call("query", fleet, "SELECT frame, reason FROM frames ORDER BY flight, frame").stdout.splitlines()
    assert lines[0].split() == ["frame", "reason"] and len(lines) == 52
    assert lines[-1] == f"50 of {RECORDS * FRAMES} rows; all of them with --csv or --json"


def test_a_single_row_is_printed_with_one_line_a_column(fleet: Path) -> None:
    assert call("query", fleet, "SELECT count(*) AS n, min(map) AS map FROM flights").stdout == (
        "n    30\nmap  coast-2024\n"
    )


def test_the_sums_over_the_frames_are_those_of_the_flights(fleet: Path) -> None:
    sql = """SELECT f.flight FROM flights f JOIN (SELECT flight, count(*) n, count(*) FILTER (verdict = 'accepted') a,
        count(reason) r, count(lat_deg) l, max(sigma_m) s FROM frames GROUP BY flight) g USING (flight)
        WHERE f.frames <> n OR f.fixes <> a OR f.refusals <> r OR f.localised <> l OR f.sigma_max_m <> s"""
    assert query(fleet, sql).rows == []
    assert query(fleet, "SELECT sum(frames) FROM flights").rows == [(RECORDS * FRAMES,)]


def test_errors_and_records_are_tables_too(fleet: Path) -> None:
    assert query(fleet, "SELECT count(*), count(error) FROM records").rows == [(RECORDS + 1, 1)]
    assert query(fleet, "SELECT error FROM errors").rows[0][0].startswith("text.mcap is not a flight record")


@pytest.mark.parametrize(
    "sql",
    [
        "COPY flights TO '{out}'",
        "COPY (SELECT 1) TO '{out}' (FORMAT csv)",
        "CREATE TABLE t AS SELECT 1",
        "DROP VIEW flights",
        "ATTACH '{out}'",
        "EXPORT DATABASE '{out}'",
        "INSTALL httpfs",
        "SET lock_configuration = false",
        "SELECT 1; SELECT 2",
        "PRAGMA database_list",
        "",
    ],
)
def test_a_query_writes_and_changes_nothing(fleet: Path, tmp_path: Path, sql: str) -> None:
    with pytest.raises(UsageError, match="give one SELECT"):
        query(fleet, sql.format(out=tmp_path / "out"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("sql", ["SELECT * FROM read_text('{file}')", "SELECT * FROM '{file}'"])
def test_a_query_reads_no_file_beside_the_tables(fleet: Path, sql: str) -> None:
    with pytest.raises(UsageError, match="file system operations are disabled"):
        query(fleet, sql.format(file=fleet / "records.jsonl"))


def test_a_wrong_statement_is_one_line(fleet: Path) -> None:
    code = "from terrafix_tools.cli import main; main()"
    command = [sys.executable, "-c", code, "fleet", "query", str(fleet), "SELEC 1"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    line = 'terrafix: SQL: Parser Error: syntax error at or near "SELEC"\n'
    assert (done.returncode, done.stdout, done.stderr) == (2, "", line)


@pytest.mark.parametrize("sql", ["SELECT nope FROM flights", "SELECT 1/", "SELECT CAST('x' AS INT)", "FROM flight"])
def test_what_is_wrong_in_a_statement_is_said_in_one_line(fleet: Path, sql: str) -> None:
    with pytest.raises(UsageError, match=r"^SQL: ") as caught:
        query(fleet, sql)
    assert "\n" not in str(caught.value) and "LINE 1" not in str(caught.value)


def test_without_duckdb_one_line_states_what_to_install(
    fleet: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "duckdb", None)
    monkeypatch.setattr(sys, "argv", ["terrafix", "fleet", "query", str(fleet), "SELECT 1"])
    with pytest.raises(SystemExit):
        main()
    assert "this command needs duckdb; install it: " in capsys.readouterr().err


def test_a_folder_without_a_fleet_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no fleet here; make one with 'terrafix fleet build"):
        query(tmp_path, "SELECT 1")


def test_a_damaged_file_of_the_fleet_is_named(fleet: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(fleet, tmp_path / "fleet")
    part = sorted((copy / "flights").rglob("part.parquet"))[0]
    part.write_bytes(b"PAR1")
    with pytest.raises(SourceError, match=re.escape(str(part))):
        query(copy, "SELECT sum(frames) FROM flights")
    with pytest.raises(SourceError, match=re.escape(str(part))):
        write_page(copy, tmp_path / "page.html")


def test_json_and_csv_together_are_refused(fleet: Path) -> None:
    result = call("query", fleet, "SELECT 1", "--json", "--csv")
    assert isinstance(result.exception, UsageError)


def test_the_cells_that_fail_are_over_the_lake(fleet: Path) -> None:
    """The invented flights have a lake, 250 m east and 150 m north of each start, where most matches are refused."""
    with FleetTables(fleet) as tables:
        found = grids(tables)
        starts = dict(tables.ask("SELECT DISTINCT map, [start_lat_deg, start_lon_deg] FROM flights").rows)
    assert sorted(str(grid.map) for grid in found) == ["coast-2024", "plain-2023", "valley-2025"]
    assert sum(cell.frames for grid in found for cell in grid.cells) == pytest.approx(RECORDS * FRAMES, rel=0.05)
    cells = worst(found, 6)
    for grid, cell in cells:
        lat_deg, lon_deg = starts[str(grid.map)]
        north_m = (cell.lat_deg - lat_deg) * METRES_PER_DEG - LAKE_M[1]
        east_m = (cell.lon_deg - lon_deg) * METRES_PER_DEG * 0.66 - LAKE_M[0]
        assert (north_m**2 + east_m**2) ** 0.5 < LAKE_RADIUS_M + grid.cell_m
        assert cell.share > 0.6 and cell.reason == "few_inliers"
    assert [cell.share for _, cell in cells] == sorted((cell.share for _, cell in cells), reverse=True)


def test_a_cell_is_drawn_at_its_row_from_the_north_with_its_numbers(fleet: Path) -> None:
    with FleetTables(fleet) as tables:
        grid = grids(tables)[0]
    cell = max(grid.cells, key=lambda one: (one.frames, one.y))
    tip = f"{cell.refused} of {cell.frames} frames refused ({cell.share:.0%})"
    drawn = re.search(rf'y="([\d.]+)"[^>]*><title>[^<]*{re.escape(tip)}', picture(grid))
    assert drawn and float(drawn[1]) == pytest.approx((grid.rows - 1 - cell.y) * 12 + 0.5)


def test_a_wrong_position_far_away_does_not_change_the_grid(fleet: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with FleetTables(fleet) as tables:
        before = grids(tables)
        tables._open.execute("""CREATE TEMP VIEW frames AS SELECT * REPLACE
            (CASE WHEN frame = 59 AND rowid = 0 THEN 60.0 ELSE lat_deg END AS lat_deg) FROM
            (SELECT *, row_number() OVER (ORDER BY flight, frame DESC) - 1 AS rowid FROM memory.frames)""")
        after = grids(tables)
    assert [(grid.map, grid.cell_m) for grid in after] == [(grid.map, grid.cell_m) for grid in before]


def test_the_page_has_trends_places_and_errors_and_needs_no_other_file(fleet: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "page.html"
    result = call("page", fleet, "--out", out)
    assert result.output == f"{out}\n"
    text = out.read_text(encoding="utf-8")
    assert not re.search(r"https?://|<script|<link|<img|url\(", text)
    for expected in ("valley-2025", "winter", "narrow", "50 to 100 m", "1.0.0 v1.0.0", "few inliers", "text.mcap"):
        assert expected in text, expected
    with FleetTables(fleet) as tables:
        dates = tables.ask("SELECT min(date), max(date) FROM flights").rows[0]
    assert f"<p>{dates[0]} to {dates[1]}; {RECORDS // 5} of the flights are replays" in text
    shares = query(fleet, "SELECT sum(refusals) / sum(fixes + refusals) FROM flights WHERE season = 'winter'").rows
    winter = re.search(r"<tr><td>winter</td>.*?</tr>", text)
    assert winter and f"{100 * shares[0][0]:.1f} %" in winter[0]
    assert text.count('<svg class="places"') == 3
    assert [path.name for path in out.parent.iterdir()] == ["page.html"]


def test_a_month_without_flights_is_a_gap_in_the_line_of_the_page(tmp_path: Path) -> None:
    class Months:
        def ask(self, _sql: str) -> "Months":
            return self

        def objects(self) -> list[dict[str, object]]:
            flown = (date(2025, 11, 1), date(2025, 12, 1), date(2026, 3, 1))
            return [{"month": month, "refused": 0.1, "availability": 0.9, "flights": 2} for month in flown]

    lines = re.findall(r'<polyline class="line none" points="([^"]*)"', months(Months()))  # type: ignore[arg-type]
    assert [len(points.split()) for points in lines] == [2, 2]  # November and December; March as a dot


def test_the_page_of_a_fleet_without_flights_says_so(tmp_path: Path) -> None:
    (tmp_path / "records").mkdir()
    (tmp_path / "records" / "text.mcap").write_text("no record")
    build(str(tmp_path / "records"), tmp_path / "fleet", workers=1)
    write_page(tmp_path / "fleet", tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<b>0<small></small></b><span>flights</span>" in text and "text.mcap" in text


def test_a_page_that_cannot_be_written_is_one_line(fleet: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="cannot be written"):
        write_page(fleet, tmp_path / "file" / "page.html")
