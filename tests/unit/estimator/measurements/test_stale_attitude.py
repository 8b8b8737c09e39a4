"""A report of the attitude that is not of the frame's time says less of it, the more so the longer ago it is."""

import math

import numpy as np
import pytest

from terrafix.estimator.measurements.ahrs_correction import AhrsCorrectionMonitor
from terrafix.estimator.measurements.telemetry_buffer import (
    MAX_ATTITUDE_GAP_NS,
    MAX_STATE_GAP_NS,
    TURN_UNSEEN_RAD,
    UNKNOWN_ATTITUDE_RAD,
    Attitude,
    Telemetry,
)
from terrafix.messages import VehicleState

SIGMAS_RAD = math.radians(0.7), math.radians(3.0)


def reported(*t_ns: int) -> Telemetry:
    telemetry = Telemetry()
    for t in t_ns:
        telemetry.add(VehicleState(t_ns=t, source="test", yaw_rad=1.0, pitch_rad=0.0, roll_rad=0.1, agl_m=100.0))
    return telemetry


def attitude_after(gap_ns: int) -> Attitude:
    return AhrsCorrectionMonitor(reported(0)).attitude_at(gap_ns, *SIGMAS_RAD)


def test_between_two_reports_of_the_slowest_stream_nothing_is_added() -> None:
    telemetry = reported(0, MAX_ATTITUDE_GAP_NS)
    for t_ns in np.linspace(0, MAX_ATTITUDE_GAP_NS, 9):
        attitude = AhrsCorrectionMonitor(telemetry).attitude_at(round(float(t_ns)), *SIGMAS_RAD)
        assert (attitude.stale_s, attitude.righted_rad, attitude.turned_rad) == (0.0, 0.0, 0.0)


def test_the_uncertainty_grows_to_that_of_an_unreported_attitude() -> None:
    attitudes = [attitude_after(gap_ns) for gap_ns in range(200_000_000, MAX_STATE_GAP_NS, 100_000_000)]
    assert np.all(np.diff([attitude.righted_rad for attitude in attitudes]) > 0.0)
    last = attitude_after(MAX_STATE_GAP_NS)
    assert last.yaw_rad == 1.0
    assert 0.8 * UNKNOWN_ATTITUDE_RAD < last.righted_rad < UNKNOWN_ATTITUDE_RAD
    assert last.turned_rad / TURN_UNSEEN_RAD == pytest.approx(last.righted_rad / UNKNOWN_ATTITUDE_RAD)
    assert attitude_after(MAX_STATE_GAP_NS + 1).yaw_rad is None


def test_a_height_alone_is_no_stale_attitude() -> None:
    telemetry = Telemetry()
    telemetry.add(VehicleState(t_ns=0, source="test", agl_m=100.0))
    assert telemetry.at(900_000_000).stale_s == 0.0
