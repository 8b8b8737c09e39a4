"""What the autopilot's GNSS receivers say, from GPS_RAW_INT and GPS2_RAW. Never to navigate by."""

from typing import Any

from terrafix.messages import GnssReading

RECEIVERS = {"GPS_RAW_INT": 0, "GPS2_RAW": 1}
FIX_2D = 2
UINT16_UNKNOWN = 65_535
UINT8_UNKNOWN = 255


def reading_of(message: Any, now_ns: int) -> GnssReading:
    """A decoded GPS_RAW_INT or GPS2_RAW. Accuracies of 0 and values of all ones mean "not known" (common.xml)."""
    placed = message.fix_type >= FIX_2D
    return GnssReading(
        t_ns=now_ns,
        receiver=RECEIVERS[message.get_type()],
        fix_type=message.fix_type,
        lat_deg=message.lat / 1e7 if placed else None,
        lon_deg=message.lon / 1e7 if placed else None,
        horizontal_m=message.h_acc / 1e3 or None,
        speed_mps=None if message.vel == UINT16_UNKNOWN else message.vel / 100,
        satellites=None if message.satellites_visible == UINT8_UNKNOWN else message.satellites_visible,
    )
