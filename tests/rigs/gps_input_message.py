"""One GpsInput with all fields set."""

from terrafix import messages as m

GPS = m.GpsInput(
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
