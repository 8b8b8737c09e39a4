"""Parser for frames.csv and telemetry tables: strict about columns, order and numbers; an empty cell is unknown."""

import csv
import math
from dataclasses import dataclass
from pathlib import Path

from terrafix.core.errors import SourceError
from terrafix.messages import VehicleState

# column -> plausible range; a value outside it has another unit or is in the wrong column
TELEMETRY_BOUNDS: dict[str, tuple[float, float]] = {
    "yaw_deg": (-720.0, 720.0),  # a heading plus a bias or declination may exceed 360
    "pitch_deg": (-90.0, 90.0),
    "roll_deg": (-180.0, 180.0),
    "agl_m": (-500.0, 20_000.0),
}
MAX_T_S = 1e6  # 11 days; a larger value is a wall-clock time


@dataclass(frozen=True)
class Row:
    number: int  # line number in the file; the header is 1
    file: str
    t_ns: int
    state: VehicleState | None  # None: every telemetry cell is empty


def read_table(path: Path, source: str, *, with_file: bool) -> list[Row]:
    """Rows of a table with columns t_s, telemetry columns, and ``file`` when ``with_file``.

    Raises SourceError with the row number: unknown or missing column, not a number, out of range, times that do not
    increase, duplicate file name."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise SourceError(f"{path}: no such file; docs/flight-folder.md shows what belongs in it") from None
    except UnicodeDecodeError:
        raise SourceError(f"{path}: not a UTF-8 text file; export it as CSV (UTF-8)") from None
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from None
    reader = csv.reader(text.splitlines(), strict=True)
    rows: list[Row] = []
    columns: list[str] = []
    row_of_file: dict[str, int] = {}
    try:
        for cells in reader:
            number = reader.line_num
            if not any(cell.strip() for cell in cells):
                continue
            if not columns:
                columns = _columns(path, [cell.strip() for cell in cells], with_file)
                continue
            if len(cells) != len(columns):
                raise SourceError(f"{path} row {number}: {len(cells)} cells, the header has {len(columns)}")
            row = _row(path, number, dict(zip(columns, (c.strip() for c in cells), strict=True)), source)
            if rows and row.t_ns <= rows[-1].t_ns:
                raise SourceError(
                    f"{path} row {number}: t_s {row.t_ns / 1e9:g} is not later than the row before "
                    f"({rows[-1].t_ns / 1e9:g}); sort the rows by time"
                )
            if with_file and row.file in row_of_file:
                raise SourceError(f"{path} row {number}: '{row.file}' is already in row {row_of_file[row.file]}")
            row_of_file[row.file] = number
            rows.append(row)
    except csv.Error as error:
        raise SourceError(f"{path} row {reader.line_num}: not valid CSV ({error})") from None
    if not rows:
        raise SourceError(f"{path}: there are no rows; one row for each frame is needed")
    return rows


def _columns(path: Path, columns: list[str], with_file: bool) -> list[str]:
    known = [*(["file"] if with_file else []), "t_s", *TELEMETRY_BOUNDS]
    for name in columns:
        if name not in known:
            raise SourceError(f"{path} row 1: unknown column '{name}'; known: {', '.join(known)}")
    for name in known[: 2 if with_file else 1]:
        if name not in columns:
            raise SourceError(f"{path} row 1: there is no column '{name}'; the header needs {' and '.join(known[:2])}")
    if len(set(columns)) != len(columns):
        raise SourceError(f"{path} row 1: a column stands twice in '{','.join(columns)}'")
    return columns


def _row(path: Path, number: int, cells: dict[str, str], source: str) -> Row:
    if cells.get("file") == "":
        raise SourceError(f"{path} row {number}: the file name is empty")
    t_s = _number(path, number, "t_s", cells["t_s"], (0.0, MAX_T_S))
    if t_s is None:
        raise SourceError(f"{path} row {number}: t_s is empty; every frame needs its time in seconds")
    t_ns = round(t_s * 1e9)
    known = {
        name: value
        for name, bounds in TELEMETRY_BOUNDS.items()
        if (value := _number(path, number, name, cells.get(name, ""), bounds)) is not None
    }
    state = None
    if known:
        angles = {
            name: math.radians(known[f"{name}_deg"]) for name in ("yaw", "pitch", "roll") if f"{name}_deg" in known
        }
        yaw = angles.get("yaw")
        state = VehicleState(
            t_ns=t_ns,
            source=source,
            yaw_rad=None if yaw is None else math.remainder(yaw, math.tau),
            pitch_rad=angles.get("pitch"),
            roll_rad=angles.get("roll"),
            agl_m=known.get("agl_m"),
        )
    return Row(number, cells.get("file", ""), t_ns, state)


def _number(path: Path, row: int, column: str, cell: str, bounds: tuple[float, float]) -> float | None:
    if not cell:
        return None
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise SourceError(f"{path} row {row}: {column} '{cell}' is not a number; leave the cell empty when unknown")
    if not bounds[0] <= value <= bounds[1]:
        raise SourceError(f"{path} row {row}: {column} {cell} is outside {bounds[0]:g} .. {bounds[1]:g}")
    return value
