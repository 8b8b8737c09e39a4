"""GpsInput with all fields set, and without a fix."""

from terrafix.messages import GpsInput

S = 1_000_000_000

GPS = GpsInput(
    t_ns=123_456_789_000,
    fix_type=3,
    time_week=2445,
    time_week_ms=561_618_250,
    lat_deg=48.123_456_7,
    lon_deg=-122.765_432_1,
    alt_amsl_m=512.25,
    hdop=1.0,
    vdop=1.0,
    vn_mps=-3.5,
    ve_mps=12.25,
    vd_mps=-0.5,
    speed_accuracy_mps=0.75,
    horiz_accuracy_m=6.5,
    vert_accuracy_m=4.5,
    satellites_visible=6,
    estimate_age_ms=180.0,
)
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
