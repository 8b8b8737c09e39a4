"""The position as NMEA 0183 sentences GGA, RMC and GST, for other devices that accept a GPS receiver.

Layout of the sentences: NMEA 0183 version 4.10 as gpsd describes it (gpsd.gitlab.io/gpsd/NMEA.html)."""

import math
from datetime import UTC, datetime
from functools import reduce

from terrafix.link.output.gps_time import unix_ms
from terrafix.messages import GpsInput

TALKER = "GP"
KNOTS_PER_MPS = 3600 / 1852  # [spec: 1 knot is 1852 m per hour]
GPS_FIX, INVALID = 1, 0  # quality of GGA; many devices take 6, "estimated", for no fix [spec: NMEA 0183]


def sentences(gps: GpsInput) -> bytes:
    """Three lines, each with checksum and CRLF. The position fields are empty without a fix, the time fields without a
    wall clock."""
    has_fix = gps.fix_type >= 3
    utc = _utc(gps)
    time = f"{utc:%H%M%S}.{utc.microsecond // 10_000:02d}" if utc else ""
    lat_lon = _lat_lon_fields(gps) if has_fix else ",,,"
    return b"".join(
        (_gga(gps, has_fix, time, lat_lon), _rmc(gps, has_fix, time, lat_lon, utc), _gst(gps, has_fix, time))
    )


def _gga(gps: GpsInput, has_fix: bool, time: str, lat_lon: str) -> bytes:
    quality, satellites = (GPS_FIX, gps.satellites_visible) if has_fix else (INVALID, 0)
    dop, height = (f"{gps.hdop:.1f}", f"{gps.alt_amsl_m:.2f}") if has_fix else ("", "")
    return _sentence(f"GGA,{time},{lat_lon},{quality},{satellites:02d},{dop},{height},M,,M,,")


def _rmc(gps: GpsInput, has_fix: bool, time: str, lat_lon: str, utc: datetime | None) -> bytes:
    date = f"{utc:%d%m%y}" if utc else ""
    speed = course = ""
    if has_fix:
        speed = f"{math.hypot(gps.vn_mps, gps.ve_mps) * KNOTS_PER_MPS:.3f}"
        # rounded before the modulus: a course just west of north is 0.00 and not 360.00
        course = f"{round(math.degrees(math.atan2(gps.ve_mps, gps.vn_mps)) * 100) % 36_000 / 100:.2f}"
    status, mode = ("A", "A") if has_fix else ("V", "N")
    return _sentence(f"RMC,{time},{status},{lat_lon},{speed},{course},{date},,,{mode}")


def _gst(gps: GpsInput, has_fix: bool, time: str) -> bytes:
    h, v = (f"{gps.horiz_accuracy_m:.2f}", f"{gps.vert_accuracy_m:.2f}") if has_fix else ("", "")
    return _sentence(f"GST,{time},,{h},{h},,{h},{h},{v}")


def _lat_lon_fields(gps: GpsInput) -> str:
    lat, lon = _degrees_minutes(gps.lat_deg, 2), _degrees_minutes(gps.lon_deg, 3)
    return f"{lat},{'NS'[gps.lat_deg < 0]},{lon},{'EW'[gps.lon_deg < 0]}"


def _degrees_minutes(degrees: float, digits: int) -> str:
    """``degrees`` as (d)ddmm.mmmmmm with ``digits`` digits of degrees; rounded before the split, so that the minutes
    stay below 60."""
    micro_minutes = round(abs(degrees) * 60e6)
    whole, rest = divmod(micro_minutes, 60_000_000)
    return f"{whole:0{digits}d}{rest / 1e6:09.6f}"


def _utc(gps: GpsInput) -> datetime | None:
    ms = unix_ms(gps.time_week, gps.time_week_ms)
    return None if ms is None else datetime.fromtimestamp(ms / 1000, UTC)


def _sentence(body: str) -> bytes:
    text = TALKER + body
    return f"${text}*{reduce(lambda a, b: a ^ b, text.encode('ascii')):02X}\r\n".encode("ascii")
