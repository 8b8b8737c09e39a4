"""The position as MSP2_SENSOR_GPS, for iNav (GPS provider MSP) and ArduPilot (GPS1_TYPE 19), over a serial port.

Frame: MSP version 2 (github.com/iNavFlight/inav/wiki/MSP-V2). Payload: 52 bytes, little endian, packed, as
``mspSensorGpsDataMessage_t`` in iNav's msp_protocol_v2_sensor_msg.h. That file gives the accuracies in centimetres,
which ArduPilot takes them for (AP_GPS_MSP.cpp: times 0.01 m); iNav itself divides them by 10 before it uses them as
centimetres (src/main/io/gps_msp.c), so it reads them as millimetres and gets those."""

import math
import struct
from datetime import UTC, datetime

from terrafix.link.output.gps_time import unix_ms
from terrafix.messages import GpsInput

MSP2_SENSOR_GPS = 0x1F03  # message id [spec: iNav msp_protocol_v2_sensor.h]
WEEK_UNKNOWN, MSP_YAW_UNKNOWN = 0xFFFF, 0xFFFF  # [spec: iNav msp_protocol_v2_sensor_msg.h]
UINT16_MAX = 0xFFFF  # [spec: 16 bits]
# instance, week, ms of week, fix, satellites, accuracies h, v [cm, iNav: mm], speed [cm/s], hdop * 100, longitude,
# latitude [1e-7 deg], height AMSL [cm], velocity north, east, down [cm/s], course, yaw [0.01 deg], year, month, day,
# h, min, s
PAYLOAD = struct.Struct("<BHIBBHHHHiiiiiiHHHBBBBB")


PER_M, INAV_PER_M = 100.0, 1000.0  # units of an accuracy in a metre [spec: see above]


def inav_frame(gps: GpsInput) -> bytes:
    """``frame`` with accuracies as iNav reads them."""
    return frame(gps, INAV_PER_M)


def frame(gps: GpsInput, accuracy_per_m: float = PER_M) -> bytes:
    """One MSP frame with direction '<', a request to the flight controller."""
    has_fix = gps.fix_type >= 3
    ms = unix_ms(gps.time_week, gps.time_week_ms)
    utc = datetime.fromtimestamp(ms / 1000, UTC) if ms is not None else None
    payload = PAYLOAD.pack(
        0,
        gps.time_week or WEEK_UNKNOWN,
        gps.time_week_ms,
        gps.fix_type,
        gps.satellites_visible,
        _uint16(gps.horiz_accuracy_m * accuracy_per_m),
        _uint16(gps.vert_accuracy_m * accuracy_per_m),
        _uint16(gps.speed_accuracy_mps * 100),
        _uint16(gps.hdop * 100),
        round(gps.lon_deg * 1e7),
        round(gps.lat_deg * 1e7),
        round(gps.alt_amsl_m * 100),
        round(gps.vn_mps * 100),
        round(gps.ve_mps * 100),
        round(gps.vd_mps * 100),
        round(math.degrees(math.atan2(gps.ve_mps, gps.vn_mps)) * 100) % 36_000 if has_fix else 0,
        MSP_YAW_UNKNOWN,
        *((utc.year, utc.month, utc.day, utc.hour, utc.minute, utc.second) if utc else (0,) * 6),
    )
    header = struct.pack("<BHH", 0, MSP2_SENSOR_GPS, len(payload))
    return b"$X<" + header + payload + bytes([crc8_dvb_s2(header + payload)])


def crc8_dvb_s2(data: bytes) -> int:
    """CRC with polynomial 0xD5 and initial value 0 (ETSI EN 302 307)."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0xD5 if crc & 0x80 else crc << 1) & 0xFF
    return crc


def _uint16(value: float) -> int:
    """``value`` rounded and clamped to 16 bits."""
    return min(UINT16_MAX, max(0, round(value)))
