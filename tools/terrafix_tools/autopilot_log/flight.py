"""What a flight record has of the autopilot: its attitude as received, and the positions that were sent to it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from terrafix.core.autopilot_log.attitude import AttitudeSeries, cleaned
from terrafix.core.errors import SourceError
from terrafix.messages import GpsInput, Origin, PositionSource, VehicleState
from terrafix.recorder.reader import ReadResult, check_format, read_received
from terrafix_tools.autopilot_log.structure import LogEvent

NS = 1_000_000_000


@dataclass(frozen=True)
class Sent:
    """GPS_INPUT as sent; arrays (N,). ``t_s``: seconds of the record at which the position holds."""

    t_s: np.ndarray
    fix_type: np.ndarray
    lat_deg: np.ndarray
    lon_deg: np.ndarray
    alt_amsl_m: np.ndarray


@dataclass(frozen=True)
class FlightSide:
    """Times are seconds since the origin of the record (its first message, if it has none)."""

    path: Path
    end_s: float  # of the last message
    attitude: AttitudeSeries
    sent: Sent
    events: list[LogEvent]  # what Terrafix did to the autopilot
    gps_id: int  # configured instance of our GPS_INPUT; 0 is the first


def read_flight_side(path: Path) -> FlightSide:
    """Reads a record: a file, or the folder of a replay or run. Raises SourceError."""
    result = ReadResult()
    attitude: list[tuple[int, float, float, float]] = []
    sent: list[tuple[int, float, float, float, float]] = []
    switches: list[PositionSource] = []
    zero_ns: int | None = None
    first_ns: int | None = None
    last_ns = 0
    for _, t_ns, _, message in read_received(path, result):
        if isinstance(message, Origin):
            zero_ns = message.t_ns if zero_ns is None else zero_ns
            continue
        first_ns = t_ns if first_ns is None else first_ns
        last_ns = max(last_ns, t_ns)
        if isinstance(message, VehicleState):
            if message.roll_rad is not None and message.pitch_rad is not None and message.yaw_rad is not None:
                attitude.append((message.t_ns, message.roll_rad, message.pitch_rad, message.yaw_rad))
        elif isinstance(message, GpsInput):
            sent.append((message.t_ns, message.fix_type, message.lat_deg, message.lon_deg, message.alt_amsl_m))
        elif isinstance(message, PositionSource):
            switches.append(message)
    check_format(path, result)
    if not attitude:
        raise SourceError(
            f"{path}: the record has no attitude of an autopilot (VehicleState with roll, pitch and yaw), by which its "
            "clock is aligned; give the record of a flight with a link"
        )
    zero = zero_ns if zero_ns is not None else first_ns or 0
    return FlightSide(
        path=path,
        end_s=(last_ns - zero) / NS,
        attitude=cleaned(AttitudeSeries(*_columns(attitude, 4, zero))),
        sent=Sent(*_columns(sent, 5, zero)),
        events=[LogEvent((switch.t_ns - zero) / NS, "source", _switched(switch)) for switch in switches],
        gps_id=int(result.header["config"].get("link", {}).get("gps_id", 0)),
    )


def _columns(rows: Sequence[tuple[float, ...]], count: int, zero_ns: int) -> list[np.ndarray]:
    """Rows with a time [ns] first -> columns, the time in seconds."""
    t_s = np.array([(row[0] - zero_ns) / NS for row in rows])
    return [t_s, *(np.array([row[i] for row in rows], dtype=np.float64) for i in range(1, count))]


def _switched(switch: PositionSource) -> str:
    return "Terrafix asked for its own position" if switch.vision else f"Terrafix asked for GPS {switch.receiver + 1}"
