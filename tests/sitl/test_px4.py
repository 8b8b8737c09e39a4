"""PX4's own firmware flies on our position: what it takes, what it does without, and beside a receiver."""

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from px4 import AUTO, HOME, HOVER_M, LAND, LOITER, NO_GPS, OURS, WAYPOINT_M, Flight, px4
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix import messages as m
from terrafix.link.integrity.output_predictor import offset

pytestmark = pytest.mark.slow
ODOMETRY = {"EKF2_EV_CTRL": 5}  # horizontal position and velocity
BOTH = OURS | {"EKF2_EV_CTRL": 4}  # of ODOMETRY the velocity alone
CORNERS_M = ((60.0, 0.0), (60.0, 80.0), (-40.0, 80.0), (0.0, 0.0))  # north, east
NEAR_M = 8.0  # estimates are 1.8 m off in the mean and 3.5 m at most, and are followed without a velocity
UNKNOWN_E7 = 2**31 - 1
FAR_M = 1e6


@contextmanager
def flight(folder: Path, parameters: dict[str, float], *outputs: str) -> Iterator[Flight]:
    with px4(folder, parameters) as ports:
        flown = Flight(ports, outputs)
        try:
            yield flown
        finally:
            flown.close()


def told(flown: Flight, since_s: float, what: str) -> None:
    off = sorted(x for s, x, _ in flown.off if s >= since_s and not math.isnan(x))
    sys.stdout.write(f"{what}: filter off by {off[len(off) // 2]:.1f} m (median), {off[-1]:.1f} m (most)\n")


@pytest.mark.parametrize(
    ("outputs", "parameters"),
    [((), OURS), (("odometry",), ODOMETRY), (("global_position", "odometry"), BOTH)],
    ids=["global_position", "odometry", "both"],
)
def test_fact_px4_flies_a_mission_and_lands_on_our_position_alone(
    outputs: tuple[str, ...], parameters: dict[str, float], tmp_path: Path
) -> None:
    with flight(tmp_path, NO_GPS | parameters, *outputs) as flown:
        flown.up()
        began_s = flown.s
        off_m = flown.mission([offset(HOME[0], HOME[1], east, north) for north, east in CORNERS_M])
        flown.land()
        told(flown, began_s, f"mission on {outputs or 'global position'}")
        assert flown.most_off_m(began_s) < NEAR_M
        assert max(off_m) < WAYPOINT_M + NEAR_M and flown.from_home_m() < WAYPOINT_M + NEAR_M
        assert not [text for text in flown.texts if "ailsafe" in text]
        newest = {type(x): x for x in flown.said}
        for kind in ("ATTITUDE", "HIGHRES_IMU", "ALTITUDE"):
            assert kind not in newest[m.LinkStatus].detail  # else: too slow
        assert newest[m.FilterStatus].flags & mavlink.ESTIMATOR_POS_HORIZ_ABS
        assert m.Imu in newest


def test_fact_px4_descends_five_seconds_after_our_last_position_and_holds_again_when_it_is_back(tmp_path: Path) -> None:
    with flight(tmp_path, NO_GPS | OURS) as flown:
        flown.up()
        lost_s, flown.errors.silent = flown.s, True
        flown.until("the failsafe", lambda: flown.in_mode() == (AUTO, LAND))
        after_s = flown.s - lost_s
        flown.listen(3.0)
        assert 5.0 < after_s < 12.0  # of it 2 s are ours: the last estimate is carried so far
        assert flown.most_off_m(lost_s) < 100.0
        flown.errors.silent, flown.errors.north_m, back_s = False, 10.0, flown.s
        flown.until("hold", lambda: flown.in_mode() == (AUTO, LOITER))
        again_s = flown.s - back_s
        flown.listen(20.0)
        sys.stdout.write(f"descends after {after_s:.1f} s, holds again after {again_s:.1f} s\n")
        assert again_s < 10.0 and flown.armed and flown.height_m() > HOVER_M / 4
        assert abs(flown.off_truth_m() - 10.0) < NEAR_M  # it is where we say


def test_fact_px4_takes_a_position_that_is_marked_invalid(tmp_path: Path) -> None:
    """Why nothing is sent without a fix: on the ground as in the air."""
    with flight(tmp_path, NO_GPS | OURS) as flown:
        flown.until("a position", flown.placed)
        flown.listen(5.0)
        assert flown.off_truth_m() < NEAR_M
        flown.errors.silent = True
        lost = (mavlink.GLOBAL_POSITION_SRC_VISION, mavlink.GLOBAL_POSITION_UNHEALTHY, UNKNOWN_E7, UNKNOWN_E7)
        unknown = (math.nan,) * 4
        say = mavlink.MAVLink_global_position_sensor_message(1, 1, 1, 0, 0, *lost, *unknown)
        for _ in range(150):
            flown.send(say)
            flown.listen(0.1)
        assert flown.off_truth_m() > FAR_M
