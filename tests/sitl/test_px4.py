"""PX4's firmware in the loop flies on the position of Terrafix: which outputs it fuses, and what it does without."""

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from px4 import AUTO, HOME, HOVER_M, LAND, LOITER, NO_GPS, OURS, WAYPOINT_M, Px4Flight, px4
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix import messages as m
from terrafix.link.integrity.output_predictor import offset

pytestmark = pytest.mark.slow
ODOMETRY = {"EKF2_EV_CTRL": 5}  # fuses horizontal position and velocity of ODOMETRY
BOTH = OURS | {"EKF2_EV_CTRL": 4}  # fuses only the velocity of ODOMETRY
CORNERS_M = ((60.0, 0.0), (60.0, 80.0), (-40.0, 80.0), (0.0, 0.0))  # north, east
NEAR_M = 8.0  # the estimates have errors of 1.8 m (mean) and 3.5 m (most); the EKF follows them without a velocity
UNKNOWN_E7 = 2**31 - 1
FAR_M = 1e6


@contextmanager
def px4_flight(folder: Path, parameters: dict[str, float], *outputs: str) -> Iterator[Px4Flight]:
    with px4(folder, parameters) as ports:
        flight = Px4Flight(ports, outputs)
        try:
            yield flight
        finally:
            flight.close()


def print_errors(flight: Px4Flight, since_s: float, what: str) -> None:
    """Prints the horizontal error of the EKF since ``since_s``."""
    errors_m = sorted(x for s, x, _ in flight.errors_m if s >= since_s and not math.isnan(x))
    sys.stdout.write(
        f"{what}: EKF error {errors_m[len(errors_m) // 2]:.1f} m (median), {errors_m[-1]:.1f} m (largest)\n"
    )


@pytest.mark.parametrize(
    ("outputs", "parameters"),
    [((), OURS), (("odometry",), ODOMETRY), (("global_position", "odometry"), BOTH)],
    ids=["global_position", "odometry", "both"],
)
def test_fact_px4_flies_a_mission_and_lands_on_the_sent_position_alone(
    outputs: tuple[str, ...], parameters: dict[str, float], tmp_path: Path
) -> None:
    with px4_flight(tmp_path, NO_GPS | parameters, *outputs) as flight:
        flight.take_off()
        began_s = flight.s
        distances_m = flight.mission([offset(HOME[0], HOME[1], east, north) for north, east in CORNERS_M])
        flight.land()
        print_errors(flight, began_s, f"mission on {outputs or 'global position'}")
        assert flight.largest_error_m(began_s) < NEAR_M
        assert max(distances_m) < WAYPOINT_M + NEAR_M and flight.distance_from_home_m() < WAYPOINT_M + NEAR_M
        assert not [text for text in flight.texts if "ailsafe" in text]
        newest = {type(x): x for x in flight.published}
        for kind in ("ATTITUDE", "HIGHRES_IMU", "ALTITUDE"):
            assert kind not in newest[m.LinkStatus].detail  # named there if they arrive too slowly
        assert newest[m.EkfStatus].flags & mavlink.ESTIMATOR_POS_HORIZ_ABS
        assert m.Imu in newest


def test_fact_px4_descends_5_s_after_the_last_position_and_holds_when_positions_return(tmp_path: Path) -> None:
    with px4_flight(tmp_path, NO_GPS | OURS) as flight:
        flight.take_off()
        lost_s, flight.errors.silent = flight.s, True
        flight.wait_for("the failsafe", lambda: flight.mode() == (AUTO, LAND))
        after_s = flight.s - lost_s
        flight.run_for(3.0)
        assert 5.0 < after_s < 12.0  # includes 2 s for which the link predicts from the last estimate
        assert flight.largest_error_m(lost_s) < 100.0
        flight.errors.silent, flight.errors.north_m, back_s = False, 10.0, flight.s
        flight.wait_for("hold", lambda: flight.mode() == (AUTO, LOITER))
        hold_after_s = flight.s - back_s
        flight.run_for(20.0)
        sys.stdout.write(f"descends after {after_s:.1f} s, holds again after {hold_after_s:.1f} s\n")
        assert hold_after_s < 10.0 and flight.armed and flight.height_m() > HOVER_M / 4
        assert abs(flight.error_m() - 10.0) < NEAR_M  # the EKF follows the shifted position


def test_fact_px4_fuses_a_position_that_is_marked_invalid(tmp_path: Path) -> None:
    """Reason why the link sends no position without a fix, on the ground and in flight."""
    with px4_flight(tmp_path, NO_GPS | OURS) as flight:
        flight.wait_for("position", flight.has_position)
        flight.run_for(5.0)
        assert flight.error_m() < NEAR_M
        flight.errors.silent = True
        lost = (mavlink.GLOBAL_POSITION_SRC_VISION, mavlink.GLOBAL_POSITION_UNHEALTHY, UNKNOWN_E7, UNKNOWN_E7)
        unknown = (math.nan,) * 4
        invalid = mavlink.MAVLink_global_position_sensor_message(1, 1, 1, 0, 0, *lost, *unknown)
        for _ in range(150):
            flight.send(invalid)
            flight.run_for(0.1)
        assert flight.error_m() > FAR_M
