"""The position on the globe: GLOBAL_POSITION_SENSOR (296) and MAV_CMD_EXTERNAL_POSITION_ESTIMATE (43003)."""

import math

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.link.integrity.output_predictor import offset
from terrafix.messages import GpsInput

SENSOR_ID = 1  # 0 is no sensor to PX4: a slot of its filter whose EKF2_AGPn_ID is 0 is off
PROCESSING = 0  # what is sent was carried to the moment of sending


def global_position_sensor(gps: GpsInput, sysid: int) -> mavlink.MAVLink_global_position_sensor_message:
    """For PX4 (EKF2_AGP0_*, in older versions EKF2_AGP_*), and ArduPilot once it takes it.

    Only with a 3D fix: PX4 1.18 does not read the flag "unhealthy", takes an accuracy that is NaN for the best, and
    after 5 s resets its filter to a latitude that is "invalid" (INT32_MAX): measured, 25 798 km away."""
    return mavlink.MAVLink_global_position_sensor_message(
        sysid,
        mavlink.MAV_COMP_ID_AUTOPILOT1,
        SENSOR_ID,
        gps.t_ns // 1000,
        PROCESSING,
        mavlink.GLOBAL_POSITION_SRC_VISION,
        0,
        round(gps.lat_deg * 1e7),
        round(gps.lon_deg * 1e7),
        math.nan,  # above the ellipsoid: a map has heights above mean sea level
        gps.alt_amsl_m,
        gps.horiz_accuracy_m,
        gps.vert_accuracy_m,
    )


def external_position_estimate(gps: GpsInput, sysid: int) -> mavlink.MAVLink_command_int_message:
    """ArduPilot takes it only as a COMMAND_INT, in a global frame, without a height (z NaN), and only while it has had
    no position for a second. It is a hard reset of its filter, behind no gate.

    Its time is a float of 32 bits, in seconds on our clock: after a day it knows steps of 8 ms, after 50 days of half a
    second (11 m at 22 m/s). So the position is that of the newest moment that the message can state, at the velocity of
    ``gps``. A clock that begins with the link would have finer steps, but begin anew with each restart in flight, which
    ArduPilot takes for packets that are late (JitterCorrection)."""
    t_s = gps.t_ns * 1e-9
    stated_s = float32_not_above(t_s)
    back_s = t_s - stated_s
    lat_deg, lon_deg = offset(gps.lat_deg, gps.lon_deg, -back_s * gps.ve_mps, -back_s * gps.vn_mps)
    return mavlink.MAVLink_command_int_message(
        sysid,
        mavlink.MAV_COMP_ID_AUTOPILOT1,
        mavlink.MAV_FRAME_GLOBAL,
        mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE,
        0,
        0,
        stated_s,
        float(PROCESSING),
        gps.horiz_accuracy_m,
        0.0,
        round(lat_deg * 1e7),
        round(lon_deg * 1e7),
        math.nan,
    )


def float32_not_above(value: float) -> float:
    """The greatest number of 32 bits that is not above ``value``."""
    near = np.float32(value)
    return float(near if float(near) <= value else np.nextafter(near, np.float32(-math.inf)))
