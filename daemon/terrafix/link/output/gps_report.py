"""Builds GpsInput, the message with what is sent to the autopilot, with a fix and without."""

from dataclasses import dataclass

from terrafix.link.integrity import fix_type
from terrafix.link.integrity.output_predictor import PredictedState
from terrafix.messages import FIX_3D, NO_FIX, GpsInput

# Small on purpose: 6 satellites pass every check of the autopilot (5 scale its noise up and fail alignment), and a real
# receiver with a 3D fix has more where the autopilot chooses by their number (GPS_AUTO_SWITCH 1).
SATELLITES_VISIBLE = 6  # [measured: docs/autopilot-facts.md]
# Copters require <= 1.4 (GPS_HDOP_GOOD). A position from a map has no satellite geometry to report. [tuned]
DOP_WITH_FIX = 1.0
DOP_WITHOUT_FIX = 99.99  # [spec: usual value of receivers without a fix]


@dataclass(frozen=True)
class Degradation:
    level: int  # index into fix_type.DEGRADATION_LEVELS
    unanchored_s: float | None  # since the last map fix; None: there was no accepted estimate


def with_fix(
    predicted: PredictedState,
    accuracy: tuple[float, float, float],
    gps_time: tuple[int, int],
    degradation: Degradation,
    map_offset_m: tuple[float, float],
    *,
    resets: int,
) -> GpsInput:
    """``accuracy``: horizontal [m], vertical [m], speed [m/s]. ``gps_time``: GPS week, millisecond of the week.
    ``map_offset_m``: map offset that was subtracted from ``predicted``, east and north. ``resets``: number of jumps of
    the estimate that were accepted so far."""
    ve, vn, vu = predicted.velocity_enu_mps
    return GpsInput(
        t_ns=predicted.t_ns,
        fix_type=FIX_3D,
        time_week=gps_time[0],
        time_week_ms=gps_time[1],
        lat_deg=predicted.lat_deg,
        lon_deg=predicted.lon_deg,
        alt_amsl_m=predicted.alt_amsl_m,
        hdop=DOP_WITH_FIX,
        vdop=DOP_WITH_FIX,
        vn_mps=vn,
        ve_mps=ve,
        vd_mps=-vu,
        speed_accuracy_mps=accuracy[2],
        horiz_accuracy_m=fix_type.clamp_accuracy_m(accuracy[0]),
        vert_accuracy_m=fix_type.clamp_accuracy_m(accuracy[1]),
        satellites_visible=SATELLITES_VISIBLE,
        estimate_age_ms=predicted.age_s * 1e3,
        degradation=degradation.level,
        unanchored_s=degradation.unanchored_s,
        map_offset_m=map_offset_m,
        resets=resets,
    )


def no_fix(
    now_ns: int,
    reason: str,
    age_ms: float,
    ground_amsl_m: float | None,
    gps_time: tuple[int, int],
    degradation: Degradation,
) -> GpsInput:
    """Fix type 1 with latitude and longitude 0, so that no screen and no log shows a position that is not known.

    The height stays a plausible constant, the ground at the origin, because an autopilot takes a missing one for 0 m
    AMSL. ``age_ms``: age of the estimate, -1 without one."""
    return GpsInput(
        t_ns=now_ns,
        fix_type=NO_FIX,
        time_week=gps_time[0],
        time_week_ms=gps_time[1],
        lat_deg=0.0,
        lon_deg=0.0,
        alt_amsl_m=ground_amsl_m or 0.0,
        hdop=DOP_WITHOUT_FIX,
        vdop=DOP_WITHOUT_FIX,
        vn_mps=0.0,
        ve_mps=0.0,
        vd_mps=0.0,
        speed_accuracy_mps=fix_type.MAX_ACCURACY_M,
        horiz_accuracy_m=fix_type.MAX_ACCURACY_M,
        vert_accuracy_m=fix_type.MAX_ACCURACY_M,
        satellites_visible=0,
        estimate_age_ms=age_ms,
        degradation=degradation.level,
        unanchored_s=degradation.unanchored_s,
        no_fix_reason=reason,
    )
