"""GpsInput as MAVLink GPS_INPUT (232). All fields are always sent: ArduPilot keeps the last value of ignored fields."""

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.messages import GpsInput

# An ignored velocity would stay at its last value and be fused for ever. [spec: ArduPilot issue 19633]
IGNORE_NONE = 0
GPS_INPUT_YAW_UNKNOWN = 0  # centidegrees; 0 means "not available", north would be 36000 [spec: MAVLink GPS_INPUT yaw]


def encode(gps: GpsInput, gps_id: int) -> mavlink.MAVLink_gps_input_message:
    """Converts SI units and degrees into the units of the message. ``gps_id`` must be the autopilot's instance,
    otherwise the autopilot drops the message."""
    return mavlink.MAVLink_gps_input_message(
        time_usec=gps.t_ns // 1000,  # ArduPilot ignores it; useful in logs
        gps_id=gps_id,
        ignore_flags=IGNORE_NONE,
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
        yaw=GPS_INPUT_YAW_UNKNOWN,
    )
