"""True course of the autopilot peer, and its CSV file: one row per time, interpolated in between."""

import csv
import math
from bisect import bisect_right
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from terrafix.core.errors import OutputError, SourceError
from terrafix.core.geodesy import LocalFrame
from terrafix_lab.sim.interfaces import State
from terrafix_lab.sim.vehicle.motion import GRAVITY_MPS2, mean_rates, quat_of, rotate_to_body


@dataclass(frozen=True)
class PeerState:
    """True state of the vehicle; angles in radians (yaw clockwise from true north), velocity north, east, down."""

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
    airspeed_mps: float = math.nan  # nan: unknown, as without sensor


def peer_state_of(state: State, frame: LocalFrame) -> PeerState:
    """``frame``: of the position of ``state``."""
    e_m, n_m, up_m = state.p_b_in_w_m.tolist()
    ve, vn, vu = state.velocity_enu_mps.tolist()
    angles = state.yaw_rad, state.pitch_rad, state.roll_rad
    return PeerState(*frame.to_wgs84(e_m, n_m), up_m, state.agl_m, *angles, vn, ve, -vu, state.airspeed_mps)


Course = Callable[[float], PeerState]  # seconds of the flight -> true state

COLUMNS = ("t_s", *(f.name for f in fields(PeerState)))
OPTIONAL = {"airspeed_mps"}
_ANGLES = {"yaw_rad", "roll_rad", "pitch_rad"}


def write_course(path: Path, rows: Iterable[tuple[float, PeerState]]) -> None:
    """Writes (seconds, state) in order of time as CSV. Raises OutputError."""
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(COLUMNS)
            for t_s, state in rows:
                writer.writerow([repr(t_s), *(repr(getattr(state, name)) for name in COLUMNS[1:])])
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from None


def read_course(path: Path) -> Course:
    """Reads a course from CSV; before the first and after the last row the vehicle stands still. Raises SourceError."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = [[_cell(row, name) for name in COLUMNS] for row in csv.DictReader(file)]
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from None
    except (KeyError, TypeError, ValueError):
        raise SourceError(f"{path}: not a course; needs the columns {', '.join(COLUMNS[:-1])}") from None
    if not rows:
        raise SourceError(f"{path}: no rows")
    times = [row[0] for row in rows]

    def state(t_s: float) -> PeerState:
        i = bisect_right(times, t_s)
        if i == 0 or i == len(rows):
            return replace(PeerState(*rows[min(i, len(rows) - 1)][1:]), vn_mps=0.0, ve_mps=0.0, vd_mps=0.0)
        before, after = rows[i - 1], rows[i]
        share = (t_s - before[0]) / (after[0] - before[0]) if after[0] > before[0] else 0.0
        return PeerState(
            *(_interpolate(n, a, b, share) for n, a, b in zip(COLUMNS, before, after, strict=True) if n != "t_s")
        )

    return state


def _cell(row: dict[str, str], name: str) -> float:
    return float(row.get(name, "nan") if name in OPTIONAL else row[name])


def _interpolate(name: str, a: float, b: float, share: float) -> float:
    return a + share * (math.remainder(b - a, math.tau) if name in _ANGLES else b - a)


class CourseFollower:
    """Follows a course and computes states with consistent inertial readings, in order of time."""

    def __init__(self, course: Course, frame: LocalFrame) -> None:
        self._course, self._frame = course, frame
        self._before: tuple[float, PeerState] | None = None

    def state(self, now_s: float, t_s: float) -> State:
        """Returns the state at the autopilot's ``now_s``, where the vehicle is at ``t_s`` of the course. Call in order
        of time.
        """
        current = self._course(t_s)
        before_s, before = self._before or (now_s, current)
        self._before = (now_s, current)
        dt_s = max(1e-3, now_s - before_s)
        rates, mid_quat = mean_rates(_quat(before), _quat(current), dt_s)
        accel_ned = ((a - b) / dt_s for a, b in zip(_ned(current), _ned(before), strict=True))
        north, east, down = accel_ned
        e_m, n_m = self._frame.to_local(current.lat_deg, current.lon_deg)
        return State(
            t_s=now_s,
            p_b_in_w_m=np.array((e_m, n_m, current.amsl_m)),
            velocity_enu_mps=np.array((current.ve_mps, current.vn_mps, -current.vd_mps)),
            yaw_rad=math.remainder(current.yaw_rad, math.tau),
            pitch_rad=current.pitch_rad,
            roll_rad=current.roll_rad,
            agl_m=current.agl_m,
            rates_b_radps=np.array(rates),
            force_b_mps2=np.array(rotate_to_body(mid_quat, north, east, down - GRAVITY_MPS2)),
            airspeed_mps=current.airspeed_mps,
        )


def _quat(state: PeerState) -> tuple[float, float, float, float]:
    return quat_of(state.yaw_rad, state.pitch_rad, state.roll_rad)


def _ned(state: PeerState) -> tuple[float, float, float]:
    return state.vn_mps, state.ve_mps, state.vd_mps
