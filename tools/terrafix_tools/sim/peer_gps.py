"""The GPS driver of the autopilot peer: what ArduPilot makes of GPS_INPUT before its filter sees it.

Behaviour after the "ArduPilot GPS_INPUT" facts (AP_GPS.cpp, AP_GPS_MAV.cpp, JitterCorrection.cpp), written anew."""

import math
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

TYPE_MAV = 14  # GPS1_TYPE: GPS_INPUT
MEAN_GAP_LIMIT_S = 0.215  # mean interval that still counts as healthy
MEAN_GAP_KEEP = 0.98  # weight of the past in the mean
GAP_LIMIT_S = 0.245  # a longer gap is a delay; two in a row are unhealthy
DELAYS_LIMIT = 2
TIMEOUT_S = 4.0  # silence after which the receiver counts as gone
DEFAULT_LAG_S = 0.2  # age of a fix that the driver assumes while GPS1_DELAY_MS is 0
MAX_LAG_S = 0.25  # what the filter's buffer can hold
JITTER_MAX_LAG_S = 0.5
JITTER_SAMPLES = 100
WEEK_S = 7 * 24 * 3600.0
NO_DOP = 99.99
CHECK_SATS, CHECK_HDOP, CHECK_SPEED, CHECK_POSITION, CHECK_YAW = 1, 2, 4, 8, 16  # EK3_GPS_CHECK
ALIGN_S = 10.0  # the checks must hold this long


@dataclass(frozen=True)
class Fix:
    """A 3D fix as the filter gets it, in seconds of the peer's clock."""

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


class GpsDriver:
    """One GPS instance of type MAV."""

    def __init__(self, instance: int, delay_ms: float) -> None:
        self._instance = instance
        self._lag_s = min(MAX_LAG_S, delay_ms / 1e3 if delay_ms > 0 else DEFAULT_LAG_S)
        self._jitter = JitterCorrection()
        self._last_s: float | None = None
        self._mean_gap_s: float | None = None
        self._delays = 0
        self._passing_since_s: float | None = None
        # These keep their last value when a later message ignores them.
        self._velocity = [0.0, 0.0, 0.0]
        self._hdop = NO_DOP
        self._horizontal: float | None = None
        self._vertical: float | None = None
        self._speed: float | None = None
        self.fix_type = 1
        self.satellites = 0
        self.lat_lon_e7 = (0, 0)
        self.other_instance = 0
        self.gaps_s: list[float] = []

    def take(self, gps: Any, now_s: float) -> Fix | None:
        """A decoded GPS_INPUT -> a fix for the filter, or None below 3D or for another instance."""
        if gps.gps_id != self._instance:
            self.other_instance += 1
            return None
        self._time(now_s)
        self._remember(gps)
        self.fix_type, self.satellites = max(1, gps.fix_type), gps.satellites_visible
        self.lat_lon_e7 = (gps.lat, gps.lon)
        if gps.fix_type < 3:
            self._passing_since_s = None
            return None
        t_s = now_s
        if gps.time_week > 0:
            t_s = self._jitter.correct(gps.time_week * WEEK_S + gps.time_week_ms / 1e3, now_s)
        vn, ve, vd = self._velocity
        return Fix(
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

    def look(self, now_s: float) -> None:
        """After 4 s of silence the receiver is gone, and its state with it."""
        if self._last_s is not None and now_s - self._last_s > TIMEOUT_S:
            self.fix_type, self.satellites, self._passing_since_s = 1, 0, None

    def healthy(self, now_s: float) -> bool:
        return (
            self._last_s is not None
            and now_s - self._last_s <= TIMEOUT_S
            and self._delays < DELAYS_LIMIT
            and (self._mean_gap_s is None or self._mean_gap_s < MEAN_GAP_LIMIT_S)
        )

    def aligned(self, fix: Fix, now_s: float, check: int, scale: float) -> bool:
        """Have the checks before first use (EK3_GPS_CHECK, EK3_CHECK_SCALE in per cent) held for 10 s?"""
        if not self._passes(fix, check, scale / 100.0):
            self._passing_since_s = None
            return False
        if self._passing_since_s is None:
            self._passing_since_s = now_s
        return now_s - self._passing_since_s >= ALIGN_S

    @staticmethod
    def _passes(fix: Fix, check: int, scale: float) -> bool:
        return not (
            (check & CHECK_SATS and fix.satellites < 6)
            or (check & CHECK_HDOP and fix.hdop > 2.5)
            or (check & CHECK_SPEED and (fix.speed_mps or 0.0) > 1.0 * scale)
            or (check & CHECK_POSITION and (fix.horizontal_m or 0.0) > 5.0 * scale)
            or (check & CHECK_POSITION and (fix.vertical_m or 0.0) > 7.5 * scale)
        )

    def _time(self, now_s: float) -> None:
        if self._last_s is not None:
            gap_s = now_s - self._last_s
            self.gaps_s.append(gap_s)
            before_s = gap_s if self._mean_gap_s is None else self._mean_gap_s
            self._mean_gap_s = MEAN_GAP_KEEP * before_s + (1.0 - MEAN_GAP_KEEP) * gap_s
            self._delays = self._delays + 1 if gap_s > GAP_LIMIT_S else 0
        self._last_s = now_s

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
