"""Effect of single fields of GPS_INPUT in ArduPilot's GPS library and filter: facts from its source code."""

from itertools import pairwise

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from autopilot_rig import HOME_M, LAT, LON, Rig, changed
from terrafix_lab.sim.autopilot.navigation.gps import GpsInputDriver
from terrafix_lab.sim.autopilot.parameters import Kind

ACCURACIES = (
    mavlink.GPS_INPUT_IGNORE_FLAG_SPEED_ACCURACY
    | mavlink.GPS_INPUT_IGNORE_FLAG_HORIZONTAL_ACCURACY
    | mavlink.GPS_INPUT_IGNORE_FLAG_VERTICAL_ACCURACY
)
VELOCITY = mavlink.GPS_INPUT_IGNORE_FLAG_VEL_HORIZ | mavlink.GPS_INPUT_IGNORE_FLAG_VEL_VERT


def gps_input(*, ignore: int = 0, hacc: float = 7.0, speed_mps: float = 3.0) -> mavlink.MAVLink_gps_input_message:
    return mavlink.MAVLink_gps_input_message(
        time_usec=123_456_789,
        gps_id=0,
        ignore_flags=ignore,
        time_week_ms=0,
        time_week=0,
        fix_type=3,
        lat=round(LAT * 1e7),
        lon=round(LON * 1e7),
        alt=HOME_M,
        hdop=1.0,
        vdop=1.0,
        vn=speed_mps,
        ve=0.0,
        vd=0.5,
        speed_accuracy=0.4,
        horiz_accuracy=hacc,
        vert_accuracy=2.0,
        satellites_visible=6,
    )


def displacement_m(hacc: float, satellites: int = 10, sacc: float = 0.5, seconds: float = 5.0) -> float:
    """Displacement of a hovering copter, m, towards a false position 30 m to the north."""
    rig = Rig(Kind.COPTER)
    rig.fly(20.0, changed(hacc=hacc, sacc=sacc, satellites=satellites))
    rig.fly(seconds, changed(north_m=30.0, hacc=hacc, sacc=sacc, satellites=satellites))
    return rig.north_m()


def test_fact_an_ignored_field_keeps_its_last_value() -> None:
    """A flag must be set always or never: otherwise an earlier accuracy or velocity is fused forever."""
    driver = GpsInputDriver(0, 5.0)
    first = driver.on_report(gps_input(), 0.0)
    later = driver.on_report(gps_input(ignore=ACCURACIES | VELOCITY, hacc=50.0, speed_mps=20.0), 0.1)
    assert first is not None and later is not None
    assert (later.horizontal_m, later.speed_mps, later.vertical_m) == pytest.approx((7.0, 0.4, 2.0))
    assert later.velocity_ned_mps == first.velocity_ned_mps


def test_fact_a_velocity_never_sent_is_zero() -> None:
    fix = GpsInputDriver(0, 5.0).on_report(gps_input(ignore=VELOCITY), 0.0)
    assert fix is not None and fix.velocity_ned_mps == (0.0, 0.0, 0.0)


def test_fact_an_ignored_height_is_sea_level() -> None:
    fix = GpsInputDriver(0, 5.0).on_report(gps_input(ignore=mavlink.GPS_INPUT_IGNORE_FLAG_ALT), 0.0)
    assert fix is not None and fix.alt_amsl_m == 0.0


def test_fact_accuracies_never_sent_count_as_the_best() -> None:
    trusted = Rig(Kind.COPTER)
    trusted.fly(20.0, changed(ignore=ACCURACIES))
    trusted.fly(5.0, changed(north_m=3.0, ignore=ACCURACIES))
    reported = Rig(Kind.COPTER)
    reported.fly(20.0, changed(hacc=5.0))
    reported.fly(5.0, changed(north_m=3.0, hacc=5.0))
    assert trusted.north_m() > 2.0 and reported.north_m() < 1.0


def test_fact_without_a_gps_week_the_time_of_arrival_is_used_whatever_time_usec_is() -> None:
    driver = GpsInputDriver(0, 5.0)
    for now_s in (10.0, 10.16, 10.2):
        fix = driver.on_report(gps_input(), now_s)
        assert fix is not None and fix.t_s == pytest.approx(now_s - 0.005)


@pytest.mark.parametrize(("satellites", "factor"), [(6, 1.0), (5, 1.4), (4, 2.0)])
def test_fact_few_satellites_increase_both_noises(satellites: int, factor: float) -> None:
    assert displacement_m(20.0, satellites) == pytest.approx(displacement_m(20.0 * factor, 6, 0.5 * factor), rel=0.02)


def test_fact_an_accuracy_beyond_100_m_counts_as_100_m() -> None:
    assert displacement_m(300.0, seconds=30.0) == pytest.approx(displacement_m(100.0, seconds=30.0), rel=0.01)


def test_fact_a_report_of_80_m_takes_14_s_to_fade_to_5() -> None:
    rig = Rig(Kind.COPTER)
    rig.fly(20.0, changed(hacc=5.0))
    assert rig.autopilot.ekf is not None
    rig.fly(0.2, changed(hacc=80.0))
    held = rig.autopilot.ekf
    before = held.position_ratio
    after = []
    for _ in range(20):
        rig.fly(1.0, changed(north_m=15.0, hacc=5.0))
        after.append(rig.north_m())
    slow = [b - a for a, b in pairwise([0.0, *after])]
    assert before < 1.0 and max(slow[:4]) < 0.3 * max(slow[10:])  # a low gain at first


def test_fact_the_reported_speed_accuracy_does_not_widen_the_velocity_gate() -> None:
    """Therefore a too uncertain velocity must be sent as no fix, not as a fix with a large accuracy."""
    ratios = []
    for sacc in (0.3, 3.0):
        rig = Rig(Kind.COPTER)
        rig.fly(20.0, changed(sacc=sacc))
        rig.fly(0.2, changed(sacc=sacc, velocity=(5.0, 0.0, 0.0)))
        assert rig.autopilot.ekf is not None
        ratios.append(rig.autopilot.ekf.velocity_ratio)
    assert ratios[0] > 1.0 and ratios[1] > 1.0
