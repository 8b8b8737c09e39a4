"""Prediction with inertial readings: a copter that rolls into a corner is followed, constant velocity is not used."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from link_rig import covariance, estimate
from terrafix import messages as m
from terrafix.core.geodesy import quat_from_rot, rot_w_b
from terrafix.link.integrity.output_predictor import (
    ACCEL_SIGMA_ATTITUDE_MPS2,
    ACCEL_SIGMA_UNKNOWN_MPS2,
    InertialBuffer,
    PredictedState,
    distance_m,
    offset,
    predict_to,
)

MS, S = 1_000_000, 1_000_000_000
LAT, LON, AMSL = 48.1, 14.3, 400.0
SPEED_MPS, YAW_RAD = 8.0, math.radians(30.0)
UP = np.array([0.0, 0.0, 9.81])


def accel(t_s: float) -> np.ndarray:
    """Acceleration east, north, up: brakes and turns within half a second, as ArduPilot's copter at a waypoint."""
    rise = min(t_s / 0.3, 1.0)
    return np.array([-3.0 * rise, 4.0 * rise, 0.5 * rise])


def attitude(t_s: float) -> tuple[float, float]:
    """Pitch and roll [rad]."""
    rise = min(t_s / 0.3, 1.0)
    return math.radians(-20.0 + 15.0 * rise), math.radians(-25.0 * rise)


def true_motion(t_s: float) -> tuple[np.ndarray, np.ndarray]:
    """True velocity and displacement, integrated in steps of a tenth of a millisecond."""
    v, p, dt = np.array([SPEED_MPS, 0.0, 0.0]), np.zeros(3), 1e-4
    for k in range(round(t_s / dt)):
        v, p = v + accel((k + 0.5) * dt) * dt, p + v * dt
    return v, p


def recorded(
    until_s: float,
    *,
    compass_rad: float = 0.0,
    lost_s: tuple[float, float] = (9.0, 9.0),
    attitude_lost_s: tuple[float, float] = (9.0, 9.0),
) -> InertialBuffer:
    """ATTITUDE at 25 Hz, readings at 33 Hz, from 0.2 s before the corner; no readings in the span ``lost_s``, no
    attitudes in ``attitude_lost_s``."""
    inertial = InertialBuffer()
    moments = [
        (t, "attitude") for t in np.arange(-0.2, until_s, 0.04) if not attitude_lost_s[0] < t < attitude_lost_s[1]
    ] + [(t, "imu") for t in np.arange(-0.19, until_s, 0.03) if not lost_s[0] < t < lost_s[1]]
    for t_s, kind in sorted(moments):
        pitch, roll = attitude(max(t_s, 0.0))
        t_ns = round(t_s * S) + S
        if kind == "attitude":
            state = m.VehicleState(
                t_ns=t_ns, source="mavlink", yaw_rad=YAW_RAD + compass_rad, pitch_rad=pitch, roll_rad=roll
            )
            inertial.add_attitude(state)
        else:
            a_w = accel(t_s) if t_s > 0.0 else np.zeros(3)
            f = rot_w_b(YAW_RAD, pitch, roll).T @ (a_w + UP)
            inertial.add_imu(
                m.Imu(t_ns=t_ns, source="mavlink", samples=[(0, float(f[0]), float(f[1]), float(f[2]), 0.0, 0.0, 0.0)])
            )
    return inertial


def predicted(age_s: float, inertial: InertialBuffer, *, heading_sigma_rad: float = 0.01) -> PredictedState:
    cov = list(covariance(3.0))
    cov[35] = heading_sigma_rad**2
    place = {"lat_deg": LAT, "lon_deg": LON, "alt_amsl_m": AMSL, "velocity_enu_mps": (SPEED_MPS, 0.0, 0.0)}
    attitude_w_b = quat_from_rot(rot_w_b(YAW_RAD, *attitude(0.0)))
    current = estimate(S, velocity_sigma=0.2, late_ns=0, cov=tuple(cov), q_w_b=attitude_w_b, **place)
    return predict_to(current, S + round(age_s * S), inertial)


def speed_error_mps(state: PredictedState, age_s: float) -> float:
    return float(np.linalg.norm(np.array(state.velocity_enu_mps) - true_motion(age_s)[0]))


@pytest.mark.parametrize("age_s", [0.25, 0.65, 1.5])
@pytest.mark.parametrize("compass_deg", [0.0, -12.0])
def test_inertial_prediction_follows_a_corner_with_the_heading_of_the_estimate(
    age_s: float, compass_deg: float
) -> None:
    """The prediction uses the heading of the estimate, because the autopilot's compass may be wrong."""
    state = predicted(age_s, recorded(age_s, compass_rad=math.radians(compass_deg)))
    assert speed_error_mps(state, age_s) < min(0.5, 2.0 * state.speed_sigma_mps)
    _, displacement = true_motion(age_s)
    lat, lon = offset(LAT, LON, float(displacement[0]), float(displacement[1]))
    assert distance_m(state.lat_deg, state.lon_deg, lat, lon) < 0.5
    assert state.alt_amsl_m == pytest.approx(AMSL + displacement[2], abs=0.3)


def test_prediction_with_constant_velocity_is_wrong_in_a_corner() -> None:
    """Shows that the test above can fail."""
    still = InertialBuffer()
    assert speed_error_mps(predicted(0.65, still), 0.65) > 2.0


@pytest.mark.parametrize("lost_s", [(-1.0, 9.0), (0.1, 0.5), (0.3, 9.0)])
def test_readings_that_do_not_cover_the_interval_are_not_used(lost_s: tuple[float, float]) -> None:
    state = predicted(0.65, recorded(0.65, lost_s=lost_s))
    assert state.velocity_enu_mps == pytest.approx((SPEED_MPS, 0.0, 0.0))


def test_the_sigma_of_inertial_prediction_grows_with_age_and_acceleration() -> None:
    sigmas = [predicted(age_s, recorded(age_s)).speed_sigma_mps for age_s in (0.0, 0.3, 0.8, 1.6)]
    assert sigmas == sorted(sigmas) and sigmas[0] == pytest.approx(0.2)


def error_in_sigmas(state: PredictedState, age_s: float) -> tuple[float, float]:
    """Error of position and of velocity over what the prediction adds to the claim of the estimate, which is 3 m and
    0.2 m/s: the estimate itself is exact here."""
    velocity, displacement = true_motion(age_s)
    lat, lon = offset(LAT, LON, float(displacement[0]), float(displacement[1]))
    added_m = math.sqrt(state.horizontal_sigma_m**2 - 3.0**2)
    added_mps = math.sqrt(state.speed_sigma_mps**2 - 0.2**2)
    error_mps = float(np.linalg.norm(np.array(state.velocity_enu_mps[:2]) - velocity[:2]))
    return distance_m(state.lat_deg, state.lon_deg, lat, lon) / added_m, error_mps / added_mps


@pytest.mark.parametrize("age_s", [0.5, 1.0, 2.0])
@pytest.mark.parametrize(
    "until",
    [
        pytest.param(lambda age_s: age_s - 0.05, id="the link has one attitude: it was restarted"),
        pytest.param(lambda age_s: age_s - 0.25, id="the link has attitudes of the last 0.25 s"),
        pytest.param(lambda age_s: 9.0, id="no telemetry since before the corner"),
    ],
)
def test_a_corner_that_the_telemetry_does_not_cover_is_in_the_claim(
    age_s: float, until: Callable[[float], float]
) -> None:
    """Of a position that was 7 of its sigmas off: a link that had just been restarted took its first attitude, with no
    yaw rate yet, for the proof that the vehicle had flown straight since an estimate that was 2 s old."""
    gap = (-1.0, until(age_s))
    state = predicted(age_s, recorded(age_s, lost_s=gap, attitude_lost_s=gap))
    assert max(error_in_sigmas(state, age_s)) < 3.0


def test_a_gap_of_the_attitudes_within_the_interval_is_in_the_claim() -> None:
    whole = predicted(1.0, recorded(1.0, lost_s=(-1.0, 9.0)))
    gap = predicted(1.0, recorded(1.0, lost_s=(-1.0, 9.0), attitude_lost_s=(0.3, 0.7)))
    assert gap.speed_sigma_mps == pytest.approx(math.hypot(0.2, ACCEL_SIGMA_UNKNOWN_MPS2))
    assert whole.speed_sigma_mps < gap.speed_sigma_mps


@pytest.mark.parametrize("age_s", [0.3, 0.65, 1.5])
def test_a_corner_that_attitudes_alone_show_is_in_the_claim(age_s: float) -> None:
    """A lean to the side and to the rear without a turn of the heading: brakes, or leans against the wind."""
    state = predicted(age_s, recorded(age_s, lost_s=(-1.0, 9.0)))
    assert max(error_in_sigmas(state, age_s)) < 3.5


def test_level_flight_with_attitudes_alone_claims_gusts_only() -> None:
    inertial = InertialBuffer()
    for t_ns in range(S - 200 * MS, 2 * S, 40 * MS):
        inertial.add_attitude(m.VehicleState(t_ns=t_ns, source="mavlink", yaw_rad=YAW_RAD, pitch_rad=0.0, roll_rad=0.0))
    assert predicted(1.0, inertial).speed_sigma_mps == pytest.approx(math.hypot(0.2, ACCEL_SIGMA_ATTITUDE_MPS2))


def test_a_heading_that_is_hardly_known_turns_the_inertial_increments() -> None:
    """The readings are rotated by the heading of the estimate, so its uncertainty is that of their direction."""
    velocity, _ = true_motion(1.0)
    increment_mps = float(np.linalg.norm((velocity - np.array([SPEED_MPS, 0.0, 0.0]))[:2]))
    usual = predicted(1.0, recorded(1.0), heading_sigma_rad=math.radians(1.0))
    unknown = predicted(1.0, recorded(1.0), heading_sigma_rad=0.5)
    assert usual.speed_sigma_mps == pytest.approx(math.hypot(0.2, 0.4, math.radians(5.0) * increment_mps), rel=0.02)
    assert unknown.speed_sigma_mps == pytest.approx(math.hypot(0.2, 0.4, 0.5 * increment_mps), rel=0.02)
