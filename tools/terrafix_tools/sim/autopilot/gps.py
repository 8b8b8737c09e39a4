"""What an autopilot's GPS library makes of GPS_INPUT and of a real receiver, before its filter sees a fix.

Behaviour after ArduPilot (AP_GPS.cpp, AP_GPS_MAV.cpp, JitterCorrection.cpp) as measured on its firmware; written
anew."""

import math
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix_tools.sim.interfaces import GnssFix

TYPE_NONE, TYPE_AUTO, TYPE_MAV = 0, 1, 14  # GPSn_TYPE: off, a real receiver, GPS_INPUT
NO_GPS, NO_FIX, FIX_3D = 0, 1, 3
MEAN_GAP_LIMIT_S = 0.215  # mean interval that still counts as healthy
MEAN_GAP_KEEP = 0.98  # weight of the past in the mean
GAP_LIMIT_S = 0.245  # a longer gap is a delay; two in a row are unhealthy
DELAYS_LIMIT = 2
TIMEOUT_S = 4.0  # silence after which the receiver counts as gone
DEFAULT_LAG_S = 0.2  # age of a GPS_INPUT that the driver assumes while its delay parameter is 0
RECEIVER_LAG_S = 0.12  # age of a real receiver's fix on arrival: u-blox M8 (AP_GPS_UBLOX::get_lag)
MAX_LAG_S = 0.25  # what the filter's buffer can hold
JITTER_MAX_LAG_S = 0.5
JITTER_SAMPLES = 100
WEEK_S = 7 * 24 * 3600.0
NO_DOP = 99.99


@dataclass(frozen=True)
class Fix:
    """A 3D fix as the filter gets it; ``t_s`` is the moment that it is for, in seconds of the flight."""

    t_s: float
    lat_deg: float
    lon_deg: float
    alt_amsl_m: float
    velocity_ned_mps: tuple[float, float, float]
    horizontal_m: float | None  # accuracies: None = never sent
    vertical_m: float | None
    speed_mps: float | None
    satellites: int
    hdop: float


class JitterCorrection:
    """Sender's time onto ours, taking the quickest message of the last hundred for one without delay."""

    def __init__(self) -> None:
        self._offset_s: float | None = None
        self._least_s = math.inf
        self._count = 0

    def correct(self, sent_s: float, arrived_s: float) -> float:
        behind_s = arrived_s - sent_s
        if self._offset_s is None or behind_s < self._offset_s:
            self._offset_s = behind_s
        t_s = sent_s + self._offset_s
        if t_s < arrived_s - JITTER_MAX_LAG_S:
            t_s = arrived_s - JITTER_MAX_LAG_S
            self._offset_s = t_s - sent_s
        self._least_s = min(self._least_s, behind_s)
        self._count += 1
        if self._count >= JITTER_SAMPLES:
            self._offset_s, self._least_s, self._count = self._least_s, math.inf, 0
        return t_s


class GpsInstance:
    """One of the autopilot's GPS: its last report, whether it still speaks, and how regularly."""

    def __init__(self, instance: int) -> None:
        self.instance = instance
        self.fix_type = NO_FIX  # before anything is heard: the driver is there, the fix is not
        self.satellites = 0
        self.fix: Fix | None = None  # the last 3D fix; still there when fix_type has fallen
        self.gaps_s: list[float] = []
        self._last_s: float | None = None
        self._mean_gap_s: float | None = None
        self._delays = 0
        self.gone = False  # it has spoken, and then fell silent

    def look(self, now_s: float) -> None:
        """After 4 s of silence the receiver is gone, and its state with it."""
        if self._last_s is not None and now_s - self._last_s > TIMEOUT_S:
            self.fix_type, self.satellites, self.gone = NO_FIX, 0, True

    def has_fix(self) -> bool:
        return self.fix_type >= FIX_3D

    def heard(self) -> bool:
        return self._last_s is not None

    def healthy(self, now_s: float) -> bool:
        return (
            self._last_s is not None
            and now_s - self._last_s <= TIMEOUT_S
            and self._delays < DELAYS_LIMIT
            and (self._mean_gap_s is None or self._mean_gap_s < MEAN_GAP_LIMIT_S)
        )

    def _time(self, now_s: float) -> None:
        if self._last_s is not None:
            gap_s = now_s - self._last_s
            self.gaps_s.append(gap_s)
            before_s = gap_s if self._mean_gap_s is None else self._mean_gap_s
            self._mean_gap_s = MEAN_GAP_KEEP * before_s + (1.0 - MEAN_GAP_KEEP) * gap_s
            self._delays = self._delays + 1 if gap_s > GAP_LIMIT_S else 0
        self._last_s, self.gone = now_s, False


class Receiver(GpsInstance):
    """A real receiver (GPSn_TYPE 1), from the readings of the vehicle's sensors."""

    def take(self, gnss: GnssFix, now_s: float) -> Fix | None:
        """-> a fix for the filter, or None below 3D."""
        self._time(now_s)
        self.fix_type, self.satellites = gnss.fix_type, gnss.satellites
        if gnss.fix_type < FIX_3D:
            return None
        self.fix = Fix(
            t_s=now_s - RECEIVER_LAG_S,
            lat_deg=gnss.lat_deg,
            lon_deg=gnss.lon_deg,
            alt_amsl_m=gnss.alt_amsl_m,
            velocity_ned_mps=gnss.velocity_ned_mps,
            horizontal_m=gnss.horizontal_m,
            vertical_m=gnss.vertical_m,
            speed_mps=gnss.speed_mps,
            satellites=gnss.satellites,
            hdop=gnss.hdop,
        )
        return self.fix


class GpsInputDriver(GpsInstance):
    """GPS_INPUT (GPSn_TYPE 14). What a message ignores keeps its last value."""

    def __init__(self, instance: int, delay_ms: float) -> None:
        super().__init__(instance)
        self._lag_s = min(MAX_LAG_S, delay_ms / 1e3 if delay_ms > 0 else DEFAULT_LAG_S)
        self._jitter = JitterCorrection()
        self._velocity = [0.0, 0.0, 0.0]
        self._hdop = NO_DOP
        self._horizontal: float | None = None
        self._vertical: float | None = None
        self._speed: float | None = None

    def take(self, gps: Any, now_s: float) -> Fix | None:
        """A decoded GPS_INPUT of this instance -> a fix for the filter, or None below 3D."""
        self._time(now_s)
        self._remember(gps)
        self.fix_type, self.satellites = gps.fix_type, gps.satellites_visible
        if gps.fix_type < FIX_3D:
            return None
        t_s = now_s
        if gps.time_week > 0:
            t_s = self._jitter.correct(gps.time_week * WEEK_S + gps.time_week_ms / 1e3, now_s)
        vn, ve, vd = self._velocity
        self.fix = Fix(
            t_s=max(t_s - self._lag_s, now_s - MAX_LAG_S),
            lat_deg=gps.lat / 1e7,
            lon_deg=gps.lon / 1e7,
            alt_amsl_m=0.0 if gps.ignore_flags & mavlink.GPS_INPUT_IGNORE_FLAG_ALT else gps.alt,
            velocity_ned_mps=(vn, ve, vd),
            horizontal_m=self._horizontal,
            vertical_m=self._vertical,
            speed_mps=self._speed,
            satellites=gps.satellites_visible,
            hdop=self._hdop,
        )
        return self.fix

    def _remember(self, gps: Any) -> None:
        flags = gps.ignore_flags
        if not flags & mavlink.GPS_INPUT_IGNORE_FLAG_VEL_HORIZ:
            self._velocity[:2] = [gps.vn, gps.ve]
        if not flags & mavlink.GPS_INPUT_IGNORE_FLAG_VEL_VERT:
            self._velocity[2] = gps.vd
        if not flags & mavlink.GPS_INPUT_IGNORE_FLAG_HDOP:
            self._hdop = gps.hdop
        if not flags & mavlink.GPS_INPUT_IGNORE_FLAG_SPEED_ACCURACY:
            self._speed = gps.speed_accuracy
        if not flags & mavlink.GPS_INPUT_IGNORE_FLAG_HORIZONTAL_ACCURACY:
            self._horizontal = gps.horiz_accuracy
        if not flags & mavlink.GPS_INPUT_IGNORE_FLAG_VERTICAL_ACCURACY:
            self._vertical = gps.vert_accuracy
