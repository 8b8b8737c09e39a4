"""GpsInput as MAVLink GPS_INPUT (232). All fields, always: what is ignored once keeps its last value there."""

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.messages import GpsInput

NOTHING_IGNORED = (
    0  # velocity above all: an ignored one stays at its last value and is fused for ever (ArduPilot #19633)
)
YAW_UNKNOWN = 0  # 0 is "none", north would be 36000


def encode(gps: GpsInput, gps_id: int) -> mavlink.MAVLink_gps_input_message:
    """SI and degrees into the units of the message; ``gps_id`` must be the autopilot's instance or it is dropped."""
    return mavlink.MAVLink_gps_input_message(
        time_usec=gps.t_ns // 1000,  # ignored by ArduPilot, of use in logs
        gps_id=gps_id,
        ignore_flags=NOTHING_IGNORED,
        time_week_ms=gps.time_week_ms,
        time_week=gps.time_week,
        fix_type=gps.fix_type,
        lat=round(gps.lat_deg * 1e7),
        lon=round(gps.lon_deg * 1e7),
        alt=gps.alt_amsl_m,
        hdop=gps.hdop,
        vdop=gps.vdop,
        vn=gps.vn_mps,
        ve=gps.ve_mps,
        vd=gps.vd_mps,
        speed_accuracy=gps.speed_accuracy_mps,
        horiz_accuracy=gps.horiz_accuracy_m,
        vert_accuracy=gps.vert_accuracy_m,
        satellites_visible=gps.satellites_visible,
        yaw=YAW_UNKNOWN,
    )
