"""The true course that the autopilot peer flies, and its file: one row a moment, interpolated in between."""

import csv
import math
from bisect import bisect_right
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path

from terrafix.core.errors import OutputError, SourceError


@dataclass(frozen=True)
class PeerState:
    """Where the vehicle truly is; angles in radians (yaw clockwise from true north), velocity north, east, down."""

    lat_deg: float
    lon_deg: float
    amsl_m: float
    agl_m: float
    yaw_rad: float
    pitch_rad: float
    roll_rad: float
    vn_mps: float
    ve_mps: float
    vd_mps: float


Course = Callable[[float], PeerState]  # seconds of the flight -> truth

COLUMNS = ("t_s", *(f.name for f in fields(PeerState)))
_ANGLES = {"yaw_rad", "roll_rad", "pitch_rad"}


def write_course(path: Path, rows: Iterable[tuple[float, PeerState]]) -> None:
    """(seconds, state) in order of time -> CSV. Raises OutputError."""
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(COLUMNS)
            for t_s, state in rows:
                writer.writerow([repr(t_s), *(repr(getattr(state, name)) for name in COLUMNS[1:])])
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from None


def read_course(path: Path) -> Course:
    """CSV -> course; before the first and after the last row the vehicle stands still there. Raises SourceError."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = [[float(row[name]) for name in COLUMNS] for row in csv.DictReader(file)]
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from None
    except (KeyError, TypeError, ValueError):
        raise SourceError(f"{path}: not a course; needs the columns {', '.join(COLUMNS)}") from None
    if not rows:
        raise SourceError(f"{path}: holds no rows")
    times = [row[0] for row in rows]

    def state(t_s: float) -> PeerState:
        i = bisect_right(times, t_s)
        if i == 0 or i == len(rows):
            return replace(PeerState(*rows[min(i, len(rows) - 1)][1:]), vn_mps=0.0, ve_mps=0.0, vd_mps=0.0)
        before, after = rows[i - 1], rows[i]
        share = (t_s - before[0]) / (after[0] - before[0]) if after[0] > before[0] else 0.0
        return PeerState(
            *(_between(n, a, b, share) for n, a, b in zip(COLUMNS, before, after, strict=True) if n != "t_s")
        )

    return state


def _between(name: str, a: float, b: float, share: float) -> float:
    return a + share * (math.remainder(b - a, math.tau) if name in _ANGLES else b - a)
