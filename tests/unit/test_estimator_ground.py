"""The ground under a vehicle that flies on along a slope, and the attitude of the body behind a learnt mount."""

import numpy as np
import pytest

from terrafix.estimator.filter import Estimator
from terrafix.estimator.telemetry import Attitude
from terrafix.messages import Camera, MapMatch, Odometry, Origin, Verdict

ORIGIN = Origin(
    t_ns=0,
    camera=Camera(width=960, height=540, fx=560.0, fy=560.0, cx=479.5, cy=269.5, mount_tolerance_deg=2.0),
    lat_deg=48.0,
    lon_deg=11.0,
    ground_amsl_m=40.0,
    start_sigma_m=5.0,
    yaw_sigma_deg=3.0,
    agl_sigma_m=3.0,
    attitude_sigma_deg=0.7,
)


def begun(attitude: Attitude) -> Estimator:
    estimator = Estimator(ORIGIN)
    first = Odometry(t_ns=0, frame_id=0, keyframe_id=0, verdict=Verdict.ACCEPTED, becomes_keyframe=True)
    estimator.advance(0, 0.0, first, attitude)
    return estimator


def test_the_plane_of_the_ground_is_that_of_the_place_where_it_was_fitted() -> None:
    estimator = begun(Attitude(0.0, 0.0, 0.0, 100.0))
    assert estimator.terrain.below(np.array([300.0, -200.0, 140.0])) == 40.0  # flat until a map says otherwise
    match = MapMatch(t_ns=0, frame_id=0, verdict=Verdict.FEW_INLIERS, matcher="gradient", ground=(50.0, 0.1, -0.05))
    estimator.fix(match)
    assert estimator.terrain.below(np.array([0.0, 0.0, 140.0])) == pytest.approx(50.0, abs=0.5)
    here = estimator.terrain.below(np.array([0.0, 0.0, 140.0]))
    assert estimator.terrain.below(np.array([20.0, 10.0, 140.0])) - here == pytest.approx(20.0 * 0.1 - 10.0 * 0.05)


@pytest.mark.parametrize(("pitch_rad", "sigma_deg"), [(0.0, 0.7), (None, 2.0)])
def test_the_body_is_known_no_better_than_who_tells_it_from_the_mount(
    pitch_rad: float | None, sigma_deg: float
) -> None:
    estimator = begun(Attitude(0.0, pitch_rad, pitch_rad, 100.0))
    assert estimator.body_sigma_rad == pytest.approx(np.radians(sigma_deg))


def unseen(t_s: float) -> Odometry:
    frame_id = round(2 * t_s)
    return Odometry(t_ns=round(t_s * 1e9), frame_id=frame_id, keyframe_id=0, verdict=Verdict.FEW_INLIERS)


def test_a_take_off_that_nobody_measured_is_claimed_to_be_one() -> None:
    """Off the runway at 8 m/s^2, without IMU: 6 s later it is 102 m away."""
    estimator = begun(Attitude(0.0, 0.0, 0.0, 0.0, armed=False))
    for t_s in np.arange(0.5, 60.0, 0.5):
        waiting = estimator.advance(round(2 * t_s), t_s, unseen(t_s), Attitude(0.0, 0.0, 0.0, 0.0, armed=False))
    assert np.sqrt(waiting.placed.cov[3, 3]) < 6.0  # it stands: the start is what it was
    for t_s in np.arange(60.0, 66.0, 0.5):
        height_m = max(0.0, 5.0 * (t_s - 64.0))
        off = estimator.advance(round(2 * t_s), t_s, unseen(t_s), Attitude(0.0, 0.1, 0.0, height_m, armed=True))
    position = np.sqrt(np.linalg.eigvalsh(off.placed.cov[3:, 3:])[-1])
    assert 102.0 / 3.0 < position < 150.0
    assert 22.0 / 3.0 < np.sqrt(off.placed.velocity_cov[0, 0]) < 40.0
