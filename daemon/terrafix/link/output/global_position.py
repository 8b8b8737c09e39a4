"""Global position messages: GLOBAL_POSITION_SENSOR (296) and MAV_CMD_EXTERNAL_POSITION_ESTIMATE (43003)."""

import math

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.link.integrity.output_predictor import offset
from terrafix.messages import GpsInput

# Field id of GLOBAL_POSITION_SENSOR. PX4 disables the slot of its EKF whose EKF2_AGPn_ID is 0, so 0 is no sensor.
SENSOR_ID = 1  # [measured: docs/autopilot.md]
# The position is already predicted to the time of transmission. [spec: MAVLink field processing_time]
PROCESSING_TIME = 0


def global_position_sensor(gps: GpsInput, sysid: int) -> mavlink.MAVLink_global_position_sensor_message:
    """For PX4 (EKF2_AGP0_*, in older versions EKF2_AGP_*), and for ArduPilot once it handles the message. ``gps`` must
    have a 3D fix.

    Without a fix the message must not be sent: PX4 1.18 does not read the flag "unhealthy", takes a NaN accuracy for
    the best one, and after 5 s resets its EKF to a latitude that is marked invalid (INT32_MAX): measured, 25 798 km
    away."""
    return mavlink.MAVLink_global_position_sensor_message(
        sysid,
        mavlink.MAV_COMP_ID_AUTOPILOT1,
        SENSOR_ID,
        gps.t_ns // 1000,
        PROCESSING_TIME,
        mavlink.GLOBAL_POSITION_SRC_VISION,
        0,
        round(gps.lat_deg * 1e7),
        round(gps.lon_deg * 1e7),
        math.nan,  # height above the ellipsoid is not known: the map has heights above mean sea level
        gps.alt_amsl_m,
        gps.horiz_accuracy_m,
        gps.vert_accuracy_m,
    )


def external_position_estimate(gps: GpsInput, sysid: int) -> mavlink.MAVLink_command_int_message:
    """ArduPilot accepts it only as COMMAND_INT, in a global frame, without height (z NaN), and only when its EKF has
    had no position for a second. It is a hard reset of the EKF without a gate.

    Its time is a float32 in seconds of our clock: the resolution is 8 ms after a day and half a second after 50 days
    (11 m at 22 m/s). So the position is moved back, with the velocity of ``gps``, to the newest time that the field can
    represent. A clock that starts with the link would have a finer resolution, but it would start again at each restart
    in flight, which ArduPilot takes for late packets (JitterCorrection)."""
    t_s = gps.t_ns * 1e-9
    field_t_s = float32_floor(t_s)
    back_s = t_s - field_t_s
    lat_deg, lon_deg = offset(gps.lat_deg, gps.lon_deg, -back_s * gps.ve_mps, -back_s * gps.vn_mps)
    return mavlink.MAVLink_command_int_message(
        sysid,
        mavlink.MAV_COMP_ID_AUTOPILOT1,
        mavlink.MAV_FRAME_GLOBAL,
        mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE,
        0,
        0,
        field_t_s,
        float(PROCESSING_TIME),
        gps.horiz_accuracy_m,
        0.0,
        round(lat_deg * 1e7),
        round(lon_deg * 1e7),
        math.nan,
    )


def float32_floor(value: float) -> float:
    """The largest float32 that is not above ``value``."""
    nearest = np.float32(value)
    return float(nearest if float(nearest) <= value else np.nextafter(nearest, np.float32(-math.inf)))
