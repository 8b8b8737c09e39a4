"""A GpsInput without a fix."""

from terrafix.messages import GpsInput

S = 1_000_000_000


NO_FIX = GpsInput(
    t_ns=3 * S,
    fix_type=1,
    time_week=2445,
    time_week_ms=0,
    lat_deg=0.0,
    lon_deg=0.0,
    alt_amsl_m=0.0,
    hdop=99.99,
    vdop=99.99,
    vn_mps=0.0,
    ve_mps=0.0,
    vd_mps=0.0,
    speed_accuracy_mps=100.0,
    horiz_accuracy_m=100.0,
    vert_accuracy_m=100.0,
    satellites_visible=0,
    estimate_age_ms=-1.0,
)
