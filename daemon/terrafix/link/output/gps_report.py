"""GpsInput, the record of what is sent: with a fix, and without."""

from dataclasses import dataclass

from terrafix.link.integrity import fix_type
from terrafix.link.integrity.output_predictor import PredictedState
from terrafix.messages import GpsInput

# Low on purpose: 6 passes every check of the autopilot (5 inflates its noise and fails alignment), and a real
# receiver with a 3D fix is never outranked by number of satellites where the autopilot chooses (GPS_AUTO_SWITCH 1).
SATELLITES = 6
DOP_GOOD = 1.0  # copters ask for <= 1.4 (GPS_HDOP_GOOD); a position from a map has no geometry of satellites to report
DOP_UNKNOWN = 99.99


@dataclass(frozen=True)
class Degradation:
    rung: int
    unanchored_s: float | None  # since the last map fix


def with_fix(
    carried: PredictedState,
    accuracy: tuple[float, float, float],
    week: tuple[int, int],
    caution: Degradation,
    map_offset_m: tuple[float, float],
    *,
    resets: int,
) -> GpsInput:
    """``accuracy``: horizontal and vertical [m], speed [m/s]; ``week``: GPS week and its millisecond; ``map_offset_m``:
    what was taken out of ``carried``; ``resets``: jumps of the estimate that were accepted so far."""
    ve, vn, vu = carried.velocity_enu_mps
    return GpsInput(
        t_ns=carried.t_ns,
        fix_type=fix_type.FIX_3D,
        time_week=week[0],
        time_week_ms=week[1],
        lat_deg=carried.lat_deg,
        lon_deg=carried.lon_deg,
        alt_amsl_m=carried.alt_amsl_m,
        hdop=DOP_GOOD,
        vdop=DOP_GOOD,
        vn_mps=vn,
        ve_mps=ve,
        vd_mps=-vu,
        speed_accuracy_mps=accuracy[2],
        horiz_accuracy_m=fix_type.bounded(accuracy[0]),
        vert_accuracy_m=fix_type.bounded(accuracy[1]),
        satellites_visible=SATELLITES,
        estimate_age_ms=carried.age_s * 1e3,
        caution=caution.rung,
        unanchored_s=caution.unanchored_s,
        map_offset_m=map_offset_m,
        resets=resets,
    )


def no_fix(
    now_ns: int, why: str, age_ms: float, ground_amsl_m: float | None, week: tuple[int, int], caution: Degradation
) -> GpsInput:
    """Fix type 1 carries no position: what is not known now is not shown, on no screen and in no log.

    The height stays a plausible constant, since an autopilot takes a missing one for 0 m AMSL."""
    return GpsInput(
        t_ns=now_ns,
        fix_type=fix_type.NO_FIX,
        time_week=week[0],
        time_week_ms=week[1],
        lat_deg=0.0,
        lon_deg=0.0,
        alt_amsl_m=ground_amsl_m or 0.0,
        hdop=DOP_UNKNOWN,
        vdop=DOP_UNKNOWN,
        vn_mps=0.0,
        ve_mps=0.0,
        vd_mps=0.0,
        speed_accuracy_mps=fix_type.MAX_ACCURACY_M,
        horiz_accuracy_m=fix_type.MAX_ACCURACY_M,
        vert_accuracy_m=fix_type.MAX_ACCURACY_M,
        satellites_visible=0,
        estimate_age_ms=age_ms,
        caution=caution.rung,
        unanchored_s=caution.unanchored_s,
        reason=why,
    )
