"""GPS library of the simulated autopilot: processes GPS_INPUT and a real receiver before the filter uses a fix.

Behaviour as measured on ArduPilot's firmware (AP_GPS.cpp, AP_GPS_MAV.cpp, JitterCorrection.cpp), reimplemented.
"""

import math
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix_lab.sim.interfaces import GnssFix

TYPE_NONE, TYPE_AUTO, TYPE_MAV = 0, 1, 14  # GPSn_TYPE: off, a real receiver, GPS_INPUT
NO_GPS, NO_FIX, FIX_3D = 0, 1, 3
MEAN_GAP_LIMIT_S = 0.215  # mean interval below which the GPS counts as healthy
MEAN_GAP_WEIGHT = 0.98  # weight of the previous mean
GAP_LIMIT_S = 0.245  # a longer interval is a delay; two in a row are unhealthy
MAX_DELAYS = 2
TIMEOUT_S = 4.0  # time without a report after which the receiver is lost
DEFAULT_LAG_S = 0.2  # age of a GPS_INPUT that the driver assumes while its delay parameter is 0
RECEIVER_LAG_S = 0.12  # age of a real receiver's fix on arrival: u-blox M8 (AP_GPS_UBLOX::get_lag)
MAX_LAG_S = 0.25  # capacity of the filter's buffer
JITTER_MAX_LAG_S = 0.5
JITTER_SAMPLES = 100
WEEK_S = 7 * 24 * 3600.0
NO_DOP = 99.99


@dataclass(frozen=True)
class Fix:
    """A 3D fix for the filter; ``t_s`` is its time of validity, in seconds of the flight."""

    t_s: float
    lat_deg: float
    lon_deg: float
    alt_amsl_m: float
    velocity_ned_mps: tuple[float, float, float]
    horizontal_m: float | None  # accuracies; None: never sent
    vertical_m: float | None
    speed_mps: float | None
    satellites: int
    hdop: float


class JitterCorrection:
    """Maps the sender's time to ours; the fastest message of the last hundred is assumed to have no delay."""

    def __init__(self) -> None:
        self._offset_s: float | None = None
        self._min_delay_s = math.inf
        self._count = 0

    def correct(self, sent_s: float, arrived_s: float) -> float:
        delay_s = arrived_s - sent_s
        if self._offset_s is None or delay_s < self._offset_s:
            self._offset_s = delay_s
        t_s = sent_s + self._offset_s
        if t_s < arrived_s - JITTER_MAX_LAG_S:
            t_s = arrived_s - JITTER_MAX_LAG_S
            self._offset_s = t_s - sent_s
        self._min_delay_s = min(self._min_delay_s, delay_s)
        self._count += 1
        if self._count >= JITTER_SAMPLES:
            self._offset_s, self._min_delay_s, self._count = self._min_delay_s, math.inf, 0
        return t_s


class GpsInstance:
    """One GPS of the autopilot: its last report, its time-out and the regularity of its reports."""

    def __init__(self, instance: int) -> None:
        self.instance = instance
        self.fix_type = NO_FIX  # before the first report: the driver exists, without a fix
        self.satellites = 0
        self.fix: Fix | None = None  # last 3D fix; kept when fix_type has dropped
        self.gaps_s: list[float] = []
        self._last_s: float | None = None
        self._mean_gap_s: float | None = None
        self._delays = 0
        self.timed_out = False  # it has reported before, and timed out

    def check_timeout(self, now_s: float) -> None:
        """After TIMEOUT_S without a report the receiver is lost, and its state reset."""
        if self._last_s is not None and now_s - self._last_s > TIMEOUT_S:
            self.fix_type, self.satellites, self.timed_out = NO_FIX, 0, True

    def has_fix(self) -> bool:
        return self.fix_type >= FIX_3D

    def has_reported(self) -> bool:
        return self._last_s is not None

    def healthy(self, now_s: float) -> bool:
        return (
            self._last_s is not None
            and now_s - self._last_s <= TIMEOUT_S
            and self._delays < MAX_DELAYS
            and (self._mean_gap_s is None or self._mean_gap_s < MEAN_GAP_LIMIT_S)
        )

    def _record_interval(self, now_s: float) -> None:
        if self._last_s is not None:
            gap_s = now_s - self._last_s
            self.gaps_s.append(gap_s)
            before_s = gap_s if self._mean_gap_s is None else self._mean_gap_s
            self._mean_gap_s = MEAN_GAP_WEIGHT * before_s + (1.0 - MEAN_GAP_WEIGHT) * gap_s
            self._delays = self._delays + 1 if gap_s > GAP_LIMIT_S else 0
        self._last_s, self.timed_out = now_s, False


class Receiver(GpsInstance):
    """A real receiver (GPSn_TYPE 1), from the readings of the vehicle's sensors."""

    def on_report(self, gnss: GnssFix, now_s: float) -> Fix | None:
        """Returns a fix for the filter, or None below 3D."""
        self._record_interval(now_s)
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
    """GPS_INPUT (GPSn_TYPE 14). Ignored fields keep their last value."""

    def __init__(self, instance: int, delay_ms: float) -> None:
        super().__init__(instance)
        self._lag_s = min(MAX_LAG_S, delay_ms / 1e3 if delay_ms > 0 else DEFAULT_LAG_S)
        self._jitter = JitterCorrection()
        self._velocity = [0.0, 0.0, 0.0]
        self._hdop = NO_DOP
        self._horizontal: float | None = None
        self._vertical: float | None = None
        self._speed: float | None = None

    def on_report(self, gps: Any, now_s: float) -> Fix | None:
        """Converts a decoded GPS_INPUT of this instance to a fix for the filter; None below 3D."""
        self._record_interval(now_s)
        self._store_fields(gps)
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

    def _store_fields(self, gps: Any) -> None:
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
