"""What is read of an autopilot's own log, the same for every format.

Times are seconds on the clock of the log (``t_s``, in the order of the log). Angles are radians: yaw clockwise from
true north, pitch up, roll right. Body axes are forward, right, down (FRD); positions and velocities north, east, down
(NED). NaN: unknown.

A test ratio is the innovation over the limit of its gate: above 1 the EKF rejects the measurement. ArduPilot logs it
so; PX4 logs its square, of which the root is taken."""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from terrafix.core.autopilot_log.attitude import AttitudeSeries


@dataclass(frozen=True)
class BodyRates:
    """Angular velocity about the body axes: ``rates_radps`` (N, 3)."""

    t_s: np.ndarray
    rates_radps: np.ndarray


@dataclass(frozen=True)
class GlobalTrack:
    """The position that the autopilot navigates by, WGS84 degrees and metres above mean sea level; arrays (N,)."""

    t_s: np.ndarray
    lat_deg: np.ndarray
    lon_deg: np.ndarray
    alt_amsl_m: np.ndarray


@dataclass(frozen=True)
class Origin:
    """Origin of the NED positions."""

    lat_deg: float
    lon_deg: float
    alt_amsl_m: float


@dataclass(frozen=True)
class EkfTrack:
    """Position (from the origin) and velocity of one core (lane) of the EKF: (N, 3) each."""

    core: int
    t_s: np.ndarray
    position_ned_m: np.ndarray
    velocity_ned_mps: np.ndarray


@dataclass(frozen=True)
class Series:
    """Several quantities at the same times: arrays (N,) by name.

    Innovations: ``velocity_n_mps``, ``..._e_mps``, ``..._d_mps``, ``position_n_m``, ``..._e_m``, ``..._d_m``,
    ``mag_x_gauss``, ``..._y_gauss``, ``..._z_gauss``, ``yaw_rad``. Test ratios: ``velocity``, ``position``, ``height``,
    ``mag``, ``yaw``, ``airspeed``. What a log does not have is missing."""

    t_s: np.ndarray
    values: dict[str, np.ndarray]


@dataclass(frozen=True)
class GpsTrack:
    """One GPS instance of the autopilot (0 is its first); arrays (N,). ``fix_type`` as GPS_FIX_TYPE of MAVLink.

    ``horizontal_m``: 1-sigma that it reports. ``used``: the autopilot navigates by this instance; None: not logged."""

    instance: int
    t_s: np.ndarray
    fix_type: np.ndarray
    lat_deg: np.ndarray
    lon_deg: np.ndarray
    alt_amsl_m: np.ndarray
    horizontal_m: np.ndarray
    satellites: np.ndarray
    used: np.ndarray | None


@dataclass(frozen=True)
class Fusion:
    """Whether the EKF fuses one source: ``fused`` (N,) bool holds from its time to the next one."""

    name: str  # "GPS 1", "external navigation", "auxiliary position", "dead reckoning", ...
    t_s: np.ndarray
    fused: np.ndarray


@dataclass(frozen=True)
class Steps:
    """A number that changes in steps, at its changes only: primary core, source set (from 1)."""

    t_s: np.ndarray
    value: np.ndarray


@dataclass(frozen=True)
class LogEvent:
    t_s: float
    kind: str  # "mode", "arming", "lane", "source set", "gps", "error", "event", "message"
    text: str


@dataclass
class AutopilotLog:
    """A log of an autopilot. Lists and dictionaries are empty, and fields None, where the log has nothing."""

    path: Path
    kind: str  # "ArduPilot DataFlash", "MAVLink telemetry", "PX4 ULog"
    attitude: AttitudeSeries
    firmware: str = ""
    rates: BodyRates | None = None
    position: GlobalTrack | None = None
    origin: Origin | None = None
    ekf: list[EkfTrack] = field(default_factory=list)
    innovations: dict[int, Series] = field(default_factory=dict)  # by core
    ratios: dict[int, Series] = field(default_factory=dict)  # by core
    primary: Steps | None = None  # core that the autopilot flies on
    source_set: Steps | None = None
    gps: list[GpsTrack] = field(default_factory=list)
    fusion: list[Fusion] = field(default_factory=list)
    events: list[LogEvent] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)  # messages in the file, by type
    skipped_bytes: int = 0  # damaged or cut off
    notes: list[str] = field(default_factory=list)  # what was repaired, chosen and left out, in words

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time of the attitude."""
        return float(self.attitude.t_s[0]), float(self.attitude.t_s[-1])


def steps(t_s: np.ndarray, value: np.ndarray) -> Steps | None:
    """-> the changes of a series; None when it is empty."""
    if not t_s.size:
        return None
    keep = np.concatenate([[True], value[1:] != value[:-1]])
    return Steps(t_s[keep], value[keep])


def value_at(found: Steps, at_s: np.ndarray) -> np.ndarray:
    """-> the value that holds at the times; before the first step that of the first."""
    return found.value[np.maximum(np.searchsorted(found.t_s, at_s, side="right") - 1, 0)]


def changes(what: str, kind: str, found: Steps | None) -> list[LogEvent]:
    """-> an event for each change after the first value: "lane 0 -> 1"."""
    if found is None:
        return []
    pairs = zip(found.t_s[1:], found.value[:-1], found.value[1:], strict=True)
    return [LogEvent(float(t), kind, f"{what} {old:g} -> {new:g}") for t, old, new in pairs]
