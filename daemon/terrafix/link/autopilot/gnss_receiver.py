"""Readings of the autopilot's GNSS receivers, from GPS_RAW_INT and GPS2_RAW. They are not fused into the position."""

from typing import Any

from terrafix.messages import FIX_2D, GnssReading

RECEIVERS = {"GPS_RAW_INT": 0, "GPS2_RAW": 1}  # message -> receiver index [spec: MAVLink ardupilotmega.xml]
UINT16_UNKNOWN = 65_535  # [spec: MAVLink common.xml]
UINT8_UNKNOWN = 255  # [spec: MAVLink common.xml]


def gnss_reading(message: Any, now_ns: int) -> GnssReading:
    """Converts a decoded GPS_RAW_INT or GPS2_RAW. Accuracy 0 and a value of all ones mean unknown (common.xml)."""
    has_position = message.fix_type >= FIX_2D
    return GnssReading(
        t_ns=now_ns,
        receiver=RECEIVERS[message.get_type()],
        fix_type=message.fix_type,
        lat_deg=message.lat / 1e7 if has_position else None,
        lon_deg=message.lon / 1e7 if has_position else None,
        horizontal_m=message.h_acc / 1e3 or None,
        speed_mps=None if message.vel == UINT16_UNKNOWN else message.vel / 100,
        satellites=None if message.satellites_visible == UINT8_UNKNOWN else message.satellites_visible,
    )
