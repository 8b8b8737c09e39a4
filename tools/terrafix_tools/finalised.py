"""finalised.csv: one row per frame of a record, smoothed over the whole flight; docs/finalise.md has the columns."""

import csv
import json
import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from terrafix.core.errors import EvaluationError, OutputError
from terrafix.messages import RefinedPose
from terrafix_tools.estimates import PARTIAL, number, read_table

TABLE, SUMMARY = "finalised.csv", "finalised.json"


@dataclass
class FinalRow:
    """``None`` is an empty cell: not known. Field order is column order; names are those of estimates.csv."""

    file: str
    t_s: float
    lat_deg: float | None = None
    lon_deg: float | None = None
    alt_amsl_m: float | None = None
    sigma_e_m: float | None = None
    sigma_n_m: float | None = None
    cov_en_m2: float | None = None
    sigma_u_m: float | None = None
    yaw_deg: float | None = None
    q_w_c: str | None = None
    cov: str | None = None
    m_per_unit: float | None = None
    fragment_id: int | None = None

    def pose(self, frame_id: int) -> RefinedPose:
        """The pose of a row of ``read_poses``."""
        assert self.lat_deg is not None and self.lon_deg is not None and self.q_w_c and self.cov
        w, x, y, z = (float(v) for v in self.q_w_c.split())
        cov = tuple(float(v) for v in self.cov.split())
        return RefinedPose(
            frame_id=frame_id,
            lat_deg=self.lat_deg,
            lon_deg=self.lon_deg,
            alt_amsl_m=self.alt_amsl_m,
            sigma_e_m=math.sqrt(cov[0]),
            sigma_n_m=math.sqrt(cov[7]),
            cov_en_m2=cov[1],
            fragment_id=-1 if self.fragment_id is None else int(self.fragment_id),
            q_w_c=(w, x, y, z),
            cov=cov,
            m_per_unit=self.m_per_unit,
        )


# Digits after the point: fixed, so that the same record gives the same bytes. 1e-8 degree is 1 mm.
DIGITS = {"t_s": 3, "lat_deg": 8, "lon_deg": 8, "cov_en_m2": 5, "alt_amsl_m": 3, "yaw_deg": 3}
OTHER_DIGITS = 4
TEXT = ("q_w_c", "cov")  # several numbers in a cell


def write(folder: Path, rows: list[FinalRow], summary: dict[str, Any]) -> None:
    """Writes both files, each renamed into place when complete. Raises OutputError."""
    try:
        with (folder / (TABLE + PARTIAL)).open("w", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(f.name for f in fields(FinalRow))
            writer.writerows(_cells(row) for row in rows)
        text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
        (folder / (SUMMARY + PARTIAL)).write_text(text, encoding="utf-8")
        for name in (TABLE, SUMMARY):
            (folder / (name + PARTIAL)).replace(folder / name)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written ({error.strerror}); is the disk full, or read-only?") from None


def read_track(path: Path) -> list[tuple[float, float]]:
    """Latitude and longitude of the rows that have them. Rows are identified by their time, because frames of a live
    camera have no file name. Raises EvaluationError."""
    track = []
    for line, row in read_table(path, ("t_s", "lat_deg", "lon_deg"), "write it with 'terrafix finalise'", key="t_s"):
        lat_deg, lon_deg = (number(path, line, name, row[name]) for name in ("lat_deg", "lon_deg"))
        if lat_deg is not None and lon_deg is not None:
            track.append((lat_deg, lon_deg))
    return track


def read_poses(folder: Path) -> list[FinalRow]:
    """The rows with a pose of the table in ``folder``, in order; none without a table, or by an earlier version. Raises
    EvaluationError."""
    path, found = folder / TABLE, list[FinalRow]()
    if not path.is_file():
        return found
    for line, raw in read_table(path, ("t_s", "lat_deg", "lon_deg"), "write it with 'terrafix finalise'", key="t_s"):
        if raw.get("q_w_c") and raw.get("cov"):
            row = FinalRow(raw["file"], number(path, line, "t_s", raw["t_s"]) or 0.0)
            for field in fields(FinalRow)[2:]:
                text = raw.get(field.name, "")
                setattr(row, field.name, text if field.name in TEXT else number(path, line, field.name, text))
            found.append(row)
    return found


def read_flights(path: Path) -> list[dict[str, Any]]:
    """The flights of a summary; none where it has none. Raises EvaluationError."""
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return []
    except (OSError, ValueError) as error:
        raise EvaluationError(f"{path}: cannot be read ({error}); write it again with 'terrafix finalise'") from None
    return list(summary.get("flights", [])) if isinstance(summary, dict) else []


def _cells(row: FinalRow) -> list[str]:
    cells = [row.file]
    for field in fields(FinalRow)[1:]:
        value = getattr(row, field.name)
        if value is None or not isinstance(value, float):
            cells.append("" if value is None else str(value))
            continue
        digits = DIGITS.get(field.name, OTHER_DIGITS)
        rounded = round(value, digits)
        cells.append(f"{rounded if rounded or math.isnan(rounded) else 0.0:.{digits}f}")  # no minus zero
    return cells
