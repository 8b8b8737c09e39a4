"""`terrafix fleet query`: SQL over the tables of a fleet, by DuckDB."""

import csv
import json
import math
import sys
from dataclasses import dataclass
from datetime import date, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow
from pyarrow import dataset

from terrafix.core.errors import SourceError, UsageError
from terrafix_tools.fleet.store import check_fleet, read_list
from terrafix_tools.fleet.tables import PART, PARTITIONS, RECORDS, TABLES

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

MAX_SHOWN = 50  # rows of a printed table

VIEWS = """
CREATE {kind} flights AS SELECT date, flight, * EXCLUDE (date, flight) FROM flights_files;
CREATE {kind} frames AS SELECT date, flight, * EXCLUDE (date, flight) FROM frames_files
    WHERE flight IN (SELECT flight FROM flights_files);
CREATE VIEW records AS SELECT * EXCLUDE (modified_ns) FROM records_list;
CREATE VIEW errors AS SELECT record, error FROM records_list WHERE error IS NOT NULL;
"""
# A query reaches the four views and nothing else: no file, no network, no variable of this program.
CLOSED = """
SET python_enable_replacements = false;
SET enable_external_access = false;
SET TimeZone = 'UTC';
SET lock_configuration = true;
"""


@dataclass(frozen=True)
class Answer:
    columns: list[str]
    rows: list[tuple[Any, ...]]

    def objects(self) -> list[dict[str, Any]]:
        return [dict(zip(self.columns, row, strict=True)) for row in self.rows]


class FleetTables:
    """The tables of a fleet, opened for queries. A context manager."""

    def __init__(self, folder: Path, *, keep: bool = False) -> None:
        """``keep``: reads the files once, for many queries. Raises SourceError: there is no fleet, or a file of it
        cannot be read."""
        check_fleet(folder)
        import duckdb

        self._folder = folder
        self._duckdb_error = duckdb.Error
        self._select = duckdb.StatementType.SELECT
        self._open: DuckDBPyConnection = duckdb.connect(":memory:")
        for name, schema in TABLES.items():
            columns = pyarrow.unify_schemas([PARTITIONS.schema, schema])
            files = dataset.dataset(folder / name, schema=columns, format="parquet", partitioning=PARTITIONS)
            self._open.register(f"{name}_files", files)
        listed = [
            {"record": one.record, "size": one.size, "flights": one.flights, "error": one.error}
            for one in read_list(folder).values()
        ]
        self._open.register("records_list", pyarrow.Table.from_pylist(listed, schema=RECORDS))
        try:
            self._open.execute(VIEWS.format(kind="TABLE" if keep else "VIEW") + CLOSED)
        except duckdb.Error as error:
            raise self._wrong(error) from None

    def __enter__(self) -> "FleetTables":
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def ask(self, sql: str, values: list[Any] | None = None) -> Answer:
        """``values``: of the parameters ($1, ...). Raises UsageError: not one SELECT, or a wrong one; SourceError: a
        file of the fleet cannot be read."""
        try:
            statements = self._open.extract_statements(sql)
            if len(statements) != 1 or statements[0].type != self._select:
                raise UsageError("SQL: give one SELECT; a query changes and writes nothing")
            done = self._open.execute(statements[0], values)
            return Answer([column[0] for column in done.description], done.fetchall())
        except self._duckdb_error as error:
            raise self._wrong(error) from None

    def _wrong(self, error: Exception) -> SourceError | UsageError:
        text = " ".join(str(error).split("\n\nLINE ")[0].split())
        if PART in text:
            return SourceError(f"{self._folder}: a file cannot be read ({text}); delete it and build again")
        return UsageError(f"SQL: {text}")


def query(folder: Path, sql: str) -> Answer:
    """Raises SourceError, UsageError."""
    with FleetTables(folder) as tables:
        return tables.ask(sql)


def print_json(answer: Answer) -> None:
    json.dump([_plain(row) for row in answer.objects()], sys.stdout, indent=2)
    sys.stdout.write("\n")


def print_csv(answer: Answer) -> None:
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(answer.columns)
    for row in answer.rows:
        cells = [_plain(cell) for cell in row]
        writer.writerow([json.dumps(cell) if isinstance(cell, dict | list) else cell for cell in cells])


def print_table(answer: Answer) -> None:
    """Columns side by side, not folded; a single row as one line a column."""
    cells = [[_cell(_plain(value)) for value in row] for row in answer.rows[:MAX_SHOWN]]
    if len(cells) == 1:
        width = max(map(len, answer.columns))
        lines = [f"{name:<{width}}  {cell}" for name, cell in zip(answer.columns, cells[0], strict=True)]
    else:
        lines = []
        widths = [max(map(len, column)) for column in zip(answer.columns, *cells, strict=True)]
        right = [all(isinstance(row[i], int | float | None) for row in answer.rows) for i in range(len(widths))]
        for line in (answer.columns, *cells):
            padded = [
                cell.rjust(width) if number else cell.ljust(width)
                for cell, width, number in zip(line, widths, right, strict=True)
            ]
            lines.append("  ".join(padded).rstrip())
    if len(answer.rows) > MAX_SHOWN:
        lines.append(f"{MAX_SHOWN} of {len(answer.rows)} rows; all of them with --csv or --json")
    sys.stdout.write("".join(f"{line}\n" for line in lines))


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, dict | list):
        return json.dumps(value)
    return f"{value:.7g}" if isinstance(value, float) else str(value)


def _plain(value: Any) -> Any:
    """A value as JSON has it; numbers that it does not have become null."""
    if isinstance(value, dict):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    return value.isoformat() if isinstance(value, date | datetime) else str(value)
