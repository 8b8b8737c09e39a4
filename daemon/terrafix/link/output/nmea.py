"""The position as NMEA 0183 sentences GGA, RMC and GST, for whatever else takes a GPS receiver.

Layout of the sentences: NMEA 0183 version 4.10 as gpsd describes it (gpsd.gitlab.io/gpsd/NMEA.html)."""

import math
from datetime import UTC, datetime
from functools import reduce

from terrafix.link.output.gps_time import unix_ms
from terrafix.messages import GpsInput

TALKER = "GP"
KNOTS_PER_MPS = 3600 / 1852
GPS_FIX, INVALID = 1, 0  # quality of GGA; 6, "estimated", is taken for no fix by many


def sentences(gps: GpsInput) -> bytes:
    """Three lines, each with checksum and CRLF. Without a fix there is no position in them, without a clock no time."""
    good = gps.fix_type >= 3
    when = _utc(gps)
    time = f"{when:%H%M%S}.{when.microsecond // 10_000:02d}" if when else ""
    place = _place(gps) if good else ",,,"
    return b"".join((_gga(gps, good, time, place), _rmc(gps, good, time, place, when), _gst(gps, good, time)))


def _gga(gps: GpsInput, good: bool, time: str, place: str) -> bytes:
    quality, satellites = (GPS_FIX, gps.satellites_visible) if good else (INVALID, 0)
    dop, height = (f"{gps.hdop:.1f}", f"{gps.alt_amsl_m:.2f}") if good else ("", "")
    return _line(f"GGA,{time},{place},{quality},{satellites:02d},{dop},{height},M,,M,,")


def _rmc(gps: GpsInput, good: bool, time: str, place: str, when: datetime | None) -> bytes:
    date = f"{when:%d%m%y}" if when else ""
    speed = course = ""
    if good:
        speed = f"{math.hypot(gps.vn_mps, gps.ve_mps) * KNOTS_PER_MPS:.3f}"
        course = f"{math.degrees(math.atan2(gps.ve_mps, gps.vn_mps)) % 360.0:.2f}"
    status, mode = ("A", "A") if good else ("V", "N")
    return _line(f"RMC,{time},{status},{place},{speed},{course},{date},,,{mode}")


def _gst(gps: GpsInput, good: bool, time: str) -> bytes:
    h, v = (f"{gps.horiz_accuracy_m:.2f}", f"{gps.vert_accuracy_m:.2f}") if good else ("", "")
    return _line(f"GST,{time},,{h},{h},,{h},{h},{v}")


def _place(gps: GpsInput) -> str:
    return f"{_angle(gps.lat_deg, 2)},{'NS'[gps.lat_deg < 0]},{_angle(gps.lon_deg, 3)},{'EW'[gps.lon_deg < 0]}"


def _angle(degrees: float, digits: int) -> str:
    """ddmm.mmmmmm, rounded as a whole, so that it never says 60 minutes."""
    micro_minutes = round(abs(degrees) * 60e6)
    whole, rest = divmod(micro_minutes, 60_000_000)
    return f"{whole:0{digits}d}{rest / 1e6:09.6f}"


def _utc(gps: GpsInput) -> datetime | None:
    ms = unix_ms(gps.time_week, gps.time_week_ms)
    return None if ms is None else datetime.fromtimestamp(ms / 1000, UTC)


def _line(body: str) -> bytes:
    text = TALKER + body
    return f"${text}*{reduce(lambda a, b: a ^ b, text.encode('ascii')):02X}\r\n".encode("ascii")
