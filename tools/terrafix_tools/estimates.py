"""estimates.csv: one row per input frame. Conversion from messages, writing and reading."""

import csv
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TextIO

from terrafix.core.errors import EvaluationError
from terrafix.core.flight_id import frame_uid
from terrafix.core.geodesy import rot_from_quat, yaw_of
from terrafix.messages import Frame, Message, NavEstimate, Origin, RefinedPose, Refinement


@dataclass
class Row:
    """One input frame. ``None`` is an empty cell (unknown). Field order is column order; docs/outputs.md describes
    each.
    """

    file: str
    t_s: float
    lat_deg: float | None = None
    lon_deg: float | None = None
    alt_amsl_m: float | None = None
    agl_m: float | None = None
    sigma_e_m: float | None = None
    sigma_n_m: float | None = None
    cov_en_m2: float | None = None
    yaw_deg: float | None = None
    source_label: str = ""
    anchor_age_ms: int | None = None
    covariance_mode: str = ""
    process_ms: float | None = None
    refined_lat_deg: float | None = None
    refined_lon_deg: float | None = None
    refined_alt_amsl_m: float | None = None
    refined_q_w_c: str = ""
    refined_cov: str = ""
    refined_m_per_unit: float | None = None
    refined_fragment_id: int | None = None
    frame_uid: str = ""

    @property
    def localised(self) -> bool:
        return self.lat_deg is not None and self.lon_deg is not None


COLUMNS: tuple[str, ...] = tuple(f.name for f in fields(Row))

# Digits after the decimal point, fixed so that two replays write the same bytes. 1e-8 degree is 1 mm.
DIGITS: dict[str, int] = {
    "t_s": 3,
    "lat_deg": 8,
    "lon_deg": 8,
    "alt_amsl_m": 3,
    "agl_m": 3,
    "sigma_e_m": 4,
    "sigma_n_m": 4,
    "cov_en_m2": 5,
    "yaw_deg": 3,
    "process_ms": 1,
    "refined_lat_deg": 8,
    "refined_lon_deg": 8,
    "refined_alt_amsl_m": 3,
    "refined_m_per_unit": 4,
}
_TEXT = ("file", "source_label", "covariance_mode", "refined_q_w_c", "refined_cov", "frame_uid")
_INTEGERS = ("anchor_age_ms", "refined_fragment_id")
_REQUIRED = ("file", "lat_deg", "lon_deg", "sigma_e_m", "sigma_n_m", "cov_en_m2")
NS = 1_000_000_000
ESTIMATES = "estimates.csv"
PARTIAL = ".partial"  # suffix of the name of an output file until the flight is over


def yaw_deg_of(estimate: NavEstimate) -> float:
    """Heading of the body, degrees clockwise from true north, 0 <= yaw < 360."""
    yaw_deg = math.degrees(yaw_of(rot_from_quat(estimate.q_w_b))) % 360.0
    return 0.0 if round(yaw_deg, DIGITS["yaw_deg"]) >= 360.0 else yaw_deg


class RowTable:
    """Builds the rows from the messages of a flight, in the order of publication."""

    def __init__(self) -> None:
        self.rows: dict[int, Row] = {}  # by frame id, in order of arrival
        self._flight_id = ""

    def take(self, message: Message) -> None:
        if isinstance(message, Origin):
            self._flight_id = message.flight_id
        elif isinstance(message, Frame):
            uid = frame_uid(self._flight_id, message.frame_id)
            self.rows.setdefault(message.frame_id, Row(file=message.file, t_s=message.t_ns / NS, frame_uid=uid))
        elif isinstance(message, NavEstimate) and message.frame_id in self.rows:
            self._estimate(self.rows[message.frame_id], message)
        elif isinstance(message, Refinement):
            for pose in message.poses:
                if pose.frame_id in self.rows:
                    self._refined(self.rows[pose.frame_id], pose)

    @staticmethod
    def _refined(row: Row, pose: RefinedPose) -> None:
        row.refined_lat_deg, row.refined_lon_deg, row.refined_alt_amsl_m = pose.lat_deg, pose.lon_deg, pose.alt_amsl_m
        row.refined_q_w_c, row.refined_cov = numbers(pose.q_w_c or ()), numbers(pose.cov or ())
        row.refined_fragment_id = pose.fragment_id
        if pose.m_per_unit is not None:
            row.refined_m_per_unit = pose.m_per_unit

    @staticmethod
    def _estimate(row: Row, estimate: NavEstimate) -> None:
        placed = estimate.is_placed
        row.lat_deg, row.lon_deg = (estimate.lat_deg, estimate.lon_deg) if placed else (None, None)
        row.alt_amsl_m, row.agl_m = estimate.amsl_m, estimate.agl_m
        row.sigma_e_m = math.sqrt(estimate.cov[0]) if placed else None
        row.sigma_n_m = math.sqrt(estimate.cov[7]) if placed else None
        row.cov_en_m2 = estimate.cov[1] if placed else None
        row.yaw_deg = yaw_deg_of(estimate)
        row.source_label, row.covariance_mode = str(estimate.source_label), str(estimate.covariance_mode)
        row.anchor_age_ms = estimate.last_anchor_age_ms


def numbers(values: Iterable[float]) -> str:
    """Several numbers as one cell, with six significant digits."""
    return " ".join(f"{value:.6g}" for value in values)


def cells(row: Row) -> list[str]:
    out: list[str] = []
    for name in COLUMNS:
        value = getattr(row, name)
        if value is None:
            out.append("")
        elif name in DIGITS:
            text = f"{value:.{DIGITS[name]}f}"
            out.append(text[1:] if text.startswith("-") and not text.strip("-0.") else text)  # no "-0.000"
        else:
            out.append(str(value))
    return out


def write_rows(stream: TextIO, rows: Iterable[Row], *, header: bool = True) -> None:
    writer = csv.writer(stream, lineterminator="\n")
    if header:
        writer.writerow(COLUMNS)
    writer.writerows(cells(row) for row in rows)


def read_rows(path: Path) -> list[Row]:
    """Returns the rows of an estimates.csv. Raises EvaluationError with file, line and reason."""
    rows: list[Row] = []
    for line, raw in read_table(path, _REQUIRED, "write it with 'terrafix replay'"):
        row = Row(file=raw["file"], t_s=number(path, line, "t_s", raw.get("t_s", "")) or 0.0)
        for name in COLUMNS[2:]:
            text = raw.get(name, "")
            if name in _TEXT:
                setattr(row, name, text)
            elif (value := number(path, line, name, text)) is not None:
                setattr(row, name, int(value) if name in _INTEGERS else value)
        rows.append(row)
    return rows


def read_table(
    path: Path, required: tuple[str, ...], hint: str, *, key: str = "file"
) -> Iterator[tuple[int, dict[str, str]]]:
    """Yields (line number, cells by column); no two rows have the same ``key``.

    Raises EvaluationError: file or columns missing, wrong number of cells, duplicate key.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise EvaluationError(f"{path}: no such file; {hint}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise EvaluationError(f"{path}: cannot be read ({error})") from None
    reader = csv.reader(text.splitlines())
    header = [name.strip() for name in next(reader, [])]
    missing = [name for name in required if name not in header]
    if missing:
        raise EvaluationError(
            f"{path}: column {', '.join(missing)} missing; the columns are {', '.join(header) or 'none'}"
        )
    seen: dict[str, int] = {}
    for raw in reader:
        if not any(cell.strip() for cell in raw):
            continue
        line = reader.line_num
        if len(raw) != len(header):
            raise EvaluationError(f"{path}, line {line}: {len(raw)} cells, but the header has {len(header)}")
        row = {name: cell.strip() for name, cell in zip(header, raw, strict=True)}
        file = row[key]
        if file in seen:
            raise EvaluationError(f"{path}, line {line}: duplicate row of '{file}' (first in line {seen[file]})")
        seen[file] = line
        yield line, row


def number(path: Path, line: int, column: str, text: str) -> float | None:
    """Returns a finite number, or None for an empty cell; raises EvaluationError otherwise."""
    if not text:
        return None
    try:
        value = float(text)
    except ValueError:
        raise EvaluationError(f"{path}, line {line}: {column} is '{text}', not a number") from None
    if not math.isfinite(value):
        raise EvaluationError(f"{path}, line {line}: {column} is '{text}', not a finite number")
    return value
