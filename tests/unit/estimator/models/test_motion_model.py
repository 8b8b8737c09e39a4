"""Motion model: against direct integration, against Monte Carlo of the process, and in flight."""

import math
from dataclasses import replace

import gtsam
import msgspec
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, C, F, V

from inertial_flight import ORIGIN, InertialFlight, flown
from terrafix.core.geodesy import local_rotation_up, rot_w_b
from terrafix.estimator.factors.focal import FocalKey
from terrafix.estimator.factors.motion import motion_factor
from terrafix.estimator.factors.noise import FACTOR_HUBER_K
from terrafix.estimator.measurements.telemetry_buffer import Telemetry
from terrafix.estimator.models.motion_model import (
    MANOEUVRE_CORRELATION_S,
    STEADY_ACCEL_SIGMA_MPS2,
    TILT_VARYING_SHARE,
    WorldAcceleration,
    fuse_odometry_increment,
    integrate_motion,
    predict_covariance,
    unknown_motion_cov,
    velocity_correlation_time_s,
)
from terrafix.estimator.node import EstimatorNode
from terrafix.estimator.state import CALIBRATION_SIZE, HEADING, MOTION_SIZE
from terrafix.messages import (
    CovarianceMode,
    Imu,
    MapMatch,
    Odometry,
    Prediction,
    SourceLabel,
    ThermalBand,
    VehicleState,
    Verdict,
)

G = 9.81
S = 1_000_000_000


def coordinated_turn(
    seconds: float, rate_hz: float = 50.0, attitude_hz: float = 25.0, turn_radps: float = 0.2
) -> Telemetry:
    """A coordinated turn at constant speed, from time 0 on: 0.2 rad/s at 20 m/s is 4 m/s^2 to the right."""
    telemetry = Telemetry()
    lateral_mps2 = 20.0 * turn_radps
    bank = math.atan2(lateral_mps2, G)
    for i in range(round(seconds * attitude_hz) + 1):
        t = i / attitude_hz
        yaw = math.remainder(1.0 + turn_radps * t, math.tau)
        telemetry.add(VehicleState(t_ns=round(t * S), source="test", yaw_rad=yaw, pitch_rad=0.0, roll_rad=bank))
    down = -math.hypot(lateral_mps2, G)  # all of the force is along the body's down axis
    for i in range(round(seconds * rate_hz) + 1):
        sample = (0, 0.0, 0.0, down, 0.0, 0.0, 0.0)
        telemetry.add_imu(Imu(t_ns=round(i / rate_hz * S), source="test", samples=[sample]))
    return telemetry


# --- world acceleration --------------------------------------------------------------------------------------------


def test_a_banked_turn_gives_centripetal_acceleration() -> None:
    acceleration = coordinated_turn(6.0).world_acceleration(round(1.005 * S), round(4.0 * S))
    assert acceleration is not None
    assert (acceleration.s_s[0], acceleration.s_s[-1]) == (0.0, pytest.approx(2.995))
    yaw = 1.0 + 0.2 * (1.005 + acceleration.s_s)
    right = 4.0 * np.column_stack([np.cos(yaw), -np.sin(yaw), np.zeros(len(yaw))])
    assert acceleration.accel_w_mps2 == pytest.approx(right, abs=0.03)
    assert acceleration.noise_mps2 < 1e-3  # no vibration


def test_vibration_raises_the_noise_density() -> None:
    telemetry, rng = coordinated_turn(0.0), np.random.default_rng(1)
    for i in range(1, 200):
        telemetry.add(VehicleState(t_ns=i * S // 50, source="test", yaw_rad=0.0, pitch_rad=0.0, roll_rad=0.0))
        force = rng.normal((0.0, 0.0, -G), 0.5)
        sample = (0, float(force[0]), float(force[1]), float(force[2]), 0.0, 0.0, 0.0)
        telemetry.add_imu(Imu(t_ns=i * S // 50, source="test", samples=[sample]))
    acceleration = telemetry.world_acceleration(S, 3 * S)
    assert acceleration is not None and acceleration.noise_mps2 == pytest.approx(0.5 * math.sqrt(0.02), rel=0.2)


def test_readings_that_do_not_cover_the_interval_give_none() -> None:
    assert coordinated_turn(3.0).world_acceleration(S, 2 * S) is not None
    assert (
        coordinated_turn(3.0).world_acceleration(2 * S, round(3.1 * S)) is not None
    )  # the newest batch has not arrived yet
    assert coordinated_turn(3.0).world_acceleration(2 * S, 4 * S) is None  # no readings
    assert coordinated_turn(3.0, rate_hz=4.0).world_acceleration(S, 2 * S) is None  # rate too low
    assert coordinated_turn(3.0, attitude_hz=2.0).world_acceleration(S, 2 * S) is None  # attitude rate too low
    assert coordinated_turn(3.0).world_acceleration(2 * S, 2 * S) is None
    assert Telemetry().world_acceleration(0, S) is None


def test_a_batch_of_samples_equals_single_messages() -> None:
    one, batch = coordinated_turn(0.0), coordinated_turn(0.0)
    samples = [(40_000_000, 1.0, 2.0, -9.0, 0.0, 0.0, 0.0), (0, 3.0, 2.0, -9.0, 0.0, 0.0, 0.0)]
    for i in range(1, 60):
        t_ns = i * 80_000_000
        for telemetry in (one, batch):
            telemetry.add(VehicleState(t_ns=t_ns, source="test", yaw_rad=0.1, pitch_rad=0.0, roll_rad=0.2))
        batch.add_imu(Imu(t_ns=t_ns, source="test", samples=samples))
        for before_ns, *rest in samples:
            one.add_imu(Imu(t_ns=t_ns - before_ns, source="test", samples=[(0, *rest)]))  # type: ignore[list-item]
    a, b = (t.world_acceleration(S, 2 * S) for t in (one, batch))
    assert a is not None and b is not None
    assert (a.accel_w_mps2 == b.accel_w_mps2).all() and (a.s_s == b.s_s).all()


# --- one increment ----------------------------------------------------------------------------------------------------


def test_an_inertial_increment_is_the_integral_of_the_acceleration() -> None:
    acceleration = coordinated_turn(6.0).world_acceleration(S, 3 * S)
    increment = integrate_motion(2.0, acceleration, (0.0, 0.0), 0.0, 20.0, 0.01, same_source=True)
    start, end = (20.0 * np.array([math.sin(y), math.cos(y), 0.0]) for y in (1.2, 1.6))
    p, v = increment.predict(np.zeros(3), np.concatenate([start, np.zeros(5)]), 0.0)
    assert v[:3] == pytest.approx(end, abs=0.05)
    # The chord of the turn: 100 m radius about the point to the right of the start.
    assert p == pytest.approx(
        100.0 * np.array([math.cos(1.2) - math.cos(1.6), math.sin(1.6) - math.sin(1.2), 0.0]), abs=0.05
    )


def test_the_heading_bias_rotates_the_inertial_increment_back() -> None:
    true, read = (
        coordinated_turn(6.0).world_acceleration(S, 3 * S),
        coordinated_turn(6.0).world_acceleration(S, 3 * S),
    )
    assert true is not None and read is not None
    turned = WorldAcceleration(read.s_s, read.accel_w_mps2 @ rot_up(0.1), read.yaw_rad + 0.1, read.noise_mps2)
    v = np.array([10.0, 5.0, 0.0, 0.3, -0.2, 0.1, 0.05, -0.03])
    a = integrate_motion(2.0, true, (0.0, 0.0), 0.0, 20.0, 0.01, same_source=True).predict(np.zeros(3), v, 0.0)
    b = integrate_motion(2.0, turned, (0.0, 0.0), 0.1, 20.0, 0.01, same_source=True).predict(np.zeros(3), v, 0.1)
    assert a[0] == pytest.approx(b[0]) and a[1] == pytest.approx(b[1])


def rot_up(angle_rad: float) -> np.ndarray:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("measured", [False, True])
def test_the_process_noise_matches_monte_carlo_of_the_process(measured: bool) -> None:
    """Monte Carlo of the process in small steps: Gauss-Markov acceleration in rotating axes.

    The increment computes its noise in the axes of its end, which makes little difference for a turn of 11 degrees.
    Without inertial readings so large a turn would widen the noise, because the course may turn too."""
    dt, steps, runs = 2.0, 400, 4000
    rng = np.random.default_rng(2)
    t = np.linspace(0.0, dt, steps + 1)
    turn = 0.1 if measured else 0.04
    acceleration = WorldAcceleration(t, np.zeros((steps + 1, 3)), 0.4 + turn * t, 0.1) if measured else None
    increment = integrate_motion(dt, acceleration, (0.4, 0.4 + turn * dt), 0.0, 20.0, 0.02, same_source=True)
    memory, course = (15.0, 1e6) if measured else (MANOEUVRE_CORRELATION_S, velocity_correlation_time_s(20.0))
    sigma = G * 0.02 * math.sqrt(TILT_VARYING_SHARE) if measured else 1.6  # the rest of the tilt error is steady
    h = dt / steps
    a, v, p = (np.zeros((runs, 2)) for _ in range(3))
    for i in range(steps):
        yaw = 0.4 + turn * t[i]
        world = a @ np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        p += v * h
        v += (world - v / course) * h + (0.1 if measured else 0.0) * math.sqrt(h) * rng.normal(size=(runs, 2))
        a += -a / memory * h + sigma * math.sqrt(2 * h / memory) * rng.normal(size=(runs, 2))
    sampled = np.cov(np.hstack([p, v, a]).T)
    claimed = increment.cov[np.ix_([0, 1, 3, 4, 6, 7], [0, 1, 3, 4, 6, 7])].copy()
    claimed[:2, :2] -= (0.02**2 + (0.005 * 20.0) ** 2) * np.eye(2)  # clocks
    scale = np.sqrt(np.diag(sampled))
    assert np.abs((claimed - sampled) / np.outer(scale, scale)).max() < 0.12


def test_a_change_of_heading_widens_the_process_noise_across_the_course() -> None:
    """A plane at 22 m/s turns by 90 degrees between two photos at a constant rate: a circle of 70 m radius."""
    speed, dt, turn = 22.0, 5.0, 0.5 * math.pi
    radius = speed * dt / turn
    off = np.array([radius, radius - speed * dt])  # east, north, from the straight continuation; it flew north
    predicted_cov = [
        predict_covariance(
            integrate_motion(dt, None, yaws, 0.0, speed, 0.02, same_source=True), 0.1 * np.eye(MOTION_SIZE)
        )[:2, :2]
        for yaws in ((0.5 * math.pi, 0.5 * math.pi), (0.5 * math.pi, 0.5 * math.pi - turn))
    ]
    straight, turned = (float(off @ np.linalg.solve(cov, off)) for cov in predicted_cov)
    assert turned < 5.99 < 10.0 < straight
    wander = math.radians(4.0)  # of a compass: no turn of the course
    as_before = predict_covariance(
        integrate_motion(dt, None, (0.0, wander), 0.0, speed, 0.02, same_source=True), 0.1 * np.eye(MOTION_SIZE)
    )
    assert np.allclose(np.diag(as_before[:2, :2]), np.diag(predicted_cov[0]), rtol=0.01)


def test_an_unknown_steady_acceleration_error_grows_with_the_square_of_the_time() -> None:
    """A minute of straight dead reckoning: the position error by a steady acceleration error alone is a t^2 / 2, and
    vanishes when that error is known."""
    cov = np.zeros((MOTION_SIZE, MOTION_SIZE))
    cov[6:, 6:] = unknown_motion_cov()[6:, 6:]
    t = np.linspace(0.0, 1.0, 50)
    increment = integrate_motion(
        1.0, WorldAcceleration(t, np.zeros((50, 3)), np.zeros(50), 0.0), (0.0, 0.0), 0.0, 20.0, 0.0, same_source=True
    )
    place, total = np.zeros((3, 3)), np.zeros((11, 11))
    total[3:, 3:] = cov
    for _ in range(60):
        by = np.zeros((11, 11))
        by[:3, :3], by[:, 3:] = np.eye(3), increment.transition()
        total = by @ total @ by.T
        place = total[:3, :3]
    steady = 600.0 * (1.0 - math.exp(-60.0 / 600.0))  # s; the error decays over ten minutes
    reached = STEADY_ACCEL_SIGMA_MPS2 * 600.0 * (60.0 - steady)
    assert np.sqrt(np.diag(place)[:2]) == pytest.approx(reached, rel=0.02)
    assert reached == pytest.approx(0.5 * STEADY_ACCEL_SIGMA_MPS2 * 60.0**2, rel=0.05)
    assert place[2, 2] == 0.0
    known = predict_covariance(increment, np.zeros((MOTION_SIZE, MOTION_SIZE)))
    assert np.sqrt(known[0, 0]) < 0.2


def test_a_steady_acceleration_error_has_no_effect_without_imu() -> None:
    increment = integrate_motion(2.0, None, (0.3, 0.3), 0.0, 20.0, 0.01, same_source=True)
    assert not increment.phi_pa[:, 3:].any() and not increment.phi_va[:, 3:].any()
    assert increment.phi_aa[3:] == pytest.approx(math.exp(-2.0 / 600.0))  # it persists until readings come again


@pytest.mark.parametrize("speed_mps", [5.0, 12.0, 25.0])
def test_without_measurements_the_speed_persists_and_the_course_decays(speed_mps: float) -> None:
    """The stationary covariance of the velocity is that of the speed in an unknown direction."""
    increment = integrate_motion(1000.0, None, (0.0, 0.0), 0.0, speed_mps, 0.0, same_source=True)
    assert increment.phi_vv < 1e-6
    assert np.sqrt(increment.cov[3, 3] + increment.cov[4, 4]) == pytest.approx(speed_mps, rel=0.02)
    assert (
        velocity_correlation_time_s(5.0) < velocity_correlation_time_s(12.0) < velocity_correlation_time_s(25.0) < 40.0
    )


@pytest.mark.parametrize("measured", [False, True])
@pytest.mark.parametrize("above", [False, True])
def test_the_jacobians_of_the_motion_factor_match_numerical_differences(measured: bool, above: bool) -> None:
    acceleration = coordinated_turn(6.0).world_acceleration(S, 2 * S) if measured else None
    increment = integrate_motion(1.0, acceleration, (1.2, 1.4), 0.05, 20.0, 0.01, same_source=True)
    increment = replace(increment.in_height_units(90.0, 6.0), terrain_unknown=True) if above else increment
    values = gtsam.Values()
    for node, (yaw, at) in enumerate(((1.2, (0.0, 0.0, 100.0)), (1.4, (18.0, 6.0, 101.0)))):
        values.insert(C(node), gtsam.Pose3(gtsam.Rot3(rot_w_b(yaw, 0.1, 0.2)), np.array(at)))
        values.insert(V(node), np.array([18.0, 7.0, 0.5, 0.1, -0.2, 0.05, 0.03, -0.04]))
        values.insert(B(node), np.array([0.01, 0.02, 0.05, 1.0, 0.005]))
    camera = gtsam.Rot3(rot_w_b(1.3, 0.1, 0.2))  # when the increment was made: 0.1 rad from the values
    factor = motion_factor((C(0), V(0)), (C(1), V(1)), (B(0), B(1)), increment, camera)
    whitened = np.linalg.inv(np.linalg.cholesky(increment.cov))
    analytic, _ = factor.linearize(values).jacobian()
    numeric = []
    for key in factor.keys():  # noqa: SIM118
        size = {C(0): 6, C(1): 6, B(0): CALIBRATION_SIZE, B(1): CALIBRATION_SIZE}.get(key, MOTION_SIZE)
        for i in range(size):
            step = np.zeros(size)
            step[i] = 1e-5
            moved = gtsam.VectorValues()
            moved.insert(key, step)
            numeric.append((factor.unwhitenedError(values.retract(moved)) - factor.unwhitenedError(values)) / 1e-5)
    off = float(np.linalg.norm(whitened @ factor.unwhitenedError(values)))
    numeric_w = (
        whitened @ np.array(numeric).T * (np.sqrt(min(1.0, FACTOR_HUBER_K / off)) if above and not measured else 1.0)
    )
    assert analytic.T @ analytic == pytest.approx(numeric_w.T @ numeric_w, rel=1e-3, abs=1e-2 * np.abs(analytic).max())


@pytest.mark.parametrize("measured", [False, True])
@pytest.mark.parametrize("above", [False, True])
def test_the_motion_factor_does_not_observe_a_rotation_of_the_whole_flight(measured: bool, above: bool) -> None:
    """Neither its error nor its linearization where the residual is tens of sigmas: with axes fixed in the world the
    derivative along such a rotation was the residual itself."""
    acceleration = coordinated_turn(6.0).world_acceleration(S, 2 * S) if measured else None
    increment = integrate_motion(1.0, acceleration, (1.2, 1.4), 0.05, 20.0, 0.01, same_source=True)
    increment = replace(increment.in_height_units(90.0, 6.0), terrain_unknown=True) if above else increment
    factor = motion_factor((C(0), V(0)), (C(1), V(1)), (B(0), B(1)), increment, gtsam.Rot3(rot_w_b(1.4, 0.1, 0.2)))

    def values_turned(angle_rad: float) -> gtsam.Values:
        values, turn = gtsam.Values(), local_rotation_up(angle_rad)
        for node, (yaw, at) in enumerate(((1.2, (0.0, 0.0, 100.0)), (1.4, (38.0, 6.0, 101.0)))):
            values.insert(C(node), gtsam.Pose3(gtsam.Rot3(turn @ rot_w_b(yaw, 0.1, 0.2)), turn @ np.array(at)))
            velocity_mps = turn @ np.array([8.0, 17.0, 0.5])
            values.insert(V(node), np.array([*velocity_mps, 0.1, -0.2, 0.05, 0.03, -0.04]))
            values.insert(B(node), np.array([0.01, 0.02, 0.05 + angle_rad, 1.0, 0.005, 0.0]))
        return values

    error = factor.unwhitenedError(values_turned(0.0))
    assert np.abs(error).max() > 0.1
    assert factor.unwhitenedError(values_turned(0.3)) == pytest.approx(error, abs=1e-9)
    values = values_turned(0.0)
    jacobian, _ = factor.linearize(values).jacobian()
    rotation, up = list[np.ndarray](), np.array([0.0, 0.0, 1.0])
    for key in factor.keys():  # noqa: SIM118
        if key in (C(0), C(1)):
            pose = values.atPose3(key)
            rotation += [pose.rotation().unrotate(up), pose.rotation().unrotate(np.cross(up, pose.translation()))]
        elif key in (V(0), V(1)):
            rotation += [np.cross(up, values.atVector(key)[:3]), np.zeros(MOTION_SIZE - 3)]
        else:
            rotation.append(np.eye(CALIBRATION_SIZE)[HEADING])
    assert jacobian @ np.concatenate(rotation) == pytest.approx(np.zeros(len(jacobian)), abs=1e-6)


def test_an_increment_without_imu_in_height_units_does_not_constrain_the_height() -> None:
    """The same flight at half the height with half the translations has the same error; an inertial one has not."""
    ground_m, errors = 40.0, {}
    for measured in (False, True):
        acceleration = coordinated_turn(6.0).world_acceleration(S, 2 * S) if measured else None
        increment = integrate_motion(1.0, acceleration, (1.2, 1.4), 0.0, 20.0, 0.01, same_source=True).in_height_units(
            100.0, ground_m
        )
        for scale in (1.0, 0.5):
            values = gtsam.Values()
            for node, at in enumerate(((0.0, 0.0, 98.0), (15.0, 6.0, 100.0))):
                values.insert(C(node), gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, ground_m]) + scale * np.array(at)))
                values.insert(V(node), np.concatenate([scale * np.array([18.0, 7.0, 0.5]), np.zeros(MOTION_SIZE - 3)]))
            values.insert(B(1), np.zeros(CALIBRATION_SIZE))
            errors[measured, scale] = motion_factor(
                (C(0), V(0)), (C(1), V(1)), (B(0), B(1)), increment, gtsam.Rot3()
            ).error(values)
    assert errors[False, 0.5] == pytest.approx(errors[False, 1.0], rel=1e-9)
    assert errors[True, 0.5] != pytest.approx(errors[True, 1.0], rel=0.01)


@pytest.mark.parametrize("measured", [False, True])
def test_an_increment_in_heights_as_seen_does_not_constrain_the_focal_length(measured: bool) -> None:
    """The map gives the distances: with a longer focal length only the heights grow, and the error stays the same."""
    acceleration = coordinated_turn(6.0).world_acceleration(S, 2 * S) if measured else None
    seen = integrate_motion(1.0, acceleration, (1.2, 1.4), 0.0, 20.0, 0.01, same_source=True)
    seen = seen.in_height_units(100.0, 40.0)
    errors, jacobians = [], []
    for log_focal in (0.0, 0.1, 0.1 + 1e-6):
        values = gtsam.Values()
        for node, at in enumerate(((0.0, 0.0), (15.0, 6.0))):
            up_m = 40.0 + 100.0 * math.exp(log_focal)
            values.insert(C(node), gtsam.Pose3(gtsam.Rot3(), np.array([*at, up_m])))
            values.insert(V(node), np.array([18.0, 7.0, *np.zeros(MOTION_SIZE - 2)]))
        values.insert(B(1), np.zeros(CALIBRATION_SIZE))
        values.insert(F(0), np.array([log_focal]))
        factor = motion_factor((C(0), V(0)), (C(1), V(1)), (B(0), B(1)), seen, gtsam.Rot3(), FocalKey(F(0), 0.0))
        errors.append(factor.unwhitenedError(values))
        jacobians.append(factor.linearize(values).jacobian()[0])
    assert errors[1] == pytest.approx(errors[0], rel=1e-9) and np.abs(errors[0]).max() > 0.1
    by_focal, by_up = jacobians[1][:, -1], 100.0 * math.exp(0.1) * (jacobians[1][:, 5] + jacobians[1][:, 19])
    assert by_focal == pytest.approx(-by_up, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize(
    ("measured", "above", "cost"),
    [(True, False, 50.0), (False, False, 50.0), (False, True, FACTOR_HUBER_K * (10.0 - 0.5 * FACTOR_HUBER_K))],
)
def test_only_an_increment_without_imu_in_height_units_has_a_huber_loss(
    measured: bool, above: bool, cost: float
) -> None:
    """An error of ten sigmas costs half of a hundred with an IMU, and without odometry; with odometry and without IMU
    the Huber loss applies."""
    acceleration = coordinated_turn(6.0).world_acceleration(S, 2 * S) if measured else None
    increment = integrate_motion(1.0, acceleration, (1.2, 1.4), 0.0, 20.0, 0.01, same_source=True)
    v0 = np.array([18.0, 7.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    p1, v1 = increment.predict(np.zeros(3), v0, 0.0)
    sigmas = np.linalg.cholesky(increment.cov)
    end_m = p1 + sigmas[:3, 0] * 10.0
    values = gtsam.Values()
    values.insert(C(0), gtsam.Pose3())
    values.insert(V(0), v0)
    values.insert(C(1), gtsam.Pose3(gtsam.Rot3(), end_m))
    values.insert(V(1), v1 + sigmas[3:, 0] * 10.0)
    values.insert(B(1), np.zeros(CALIBRATION_SIZE))
    if above:
        increment = increment.in_height_units(100.0, -100.0)
    factor = motion_factor((C(0), V(0)), (C(1), V(1)), (B(0), B(1)), increment, gtsam.Rot3())
    assert factor.error(values) == pytest.approx(cost)


def test_odometry_corrects_the_velocity_at_the_end_of_the_increment() -> None:
    """By half of the innovation, where increment and odometry have equal covariance."""
    increment = integrate_motion(1.0, None, (1.2, 1.2), 0.0, 20.0, 0.0, same_source=True)
    predicted_cov = predict_covariance(increment, unknown_motion_cov())
    off_m = np.array([3.0, -2.0, 0.5])
    _, left, gained = fuse_odometry_increment(increment, off_m, predicted_cov, predicted_cov[:3, :3])
    assert gained == pytest.approx(0.5 * predicted_cov[3:, :3] @ np.linalg.solve(predicted_cov[:3, :3], off_m))
    assert left[:3, :3] == pytest.approx(0.5 * predicted_cov[:3, :3])
    assert np.linalg.norm(gained[:3]) > 0.4 * np.linalg.norm(off_m)


def test_a_velocity_that_follows_an_image_of_another_time_is_claimed_as_uncertain_as_it_has_moved() -> None:
    """An image that jumps by 23 m in a second passes the gate of a vehicle that may brake with 4 g."""
    increment = integrate_motion(1.0, None, (1.2, 1.2), 0.0, 12.0, 0.0, same_source=True)
    known = np.diag([0.5**2] * 3 + [0.3**2] * (MOTION_SIZE - 3))
    predicted_cov, odometry_cov = predict_covariance(increment, known), 0.5**2 * np.eye(3)
    wider, left, gained = fuse_odometry_increment(increment, np.array([-23.0, 4.0, 0.0]), predicted_cov, odometry_cov)
    assert np.linalg.norm(gained[:2]) > 20.0
    assert gained[0] ** 2 < 4.0 * left[3, 3]
    assert np.trace(wider.cov) > 10.0 * np.trace(increment.cov)


# --- in flight ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plane() -> InertialFlight:
    return InertialFlight(seed=3)


@pytest.mark.parametrize(
    ("imu", "band", "rms_mps", "claim_mps"),
    [
        (True, ThermalBand.NORMAL, 0.45, 0.8),
        (True, ThermalBand.HOT, 0.6, 1.2),
        (False, ThermalBand.NORMAL, 1.0, 1.7),
        (False, ThermalBand.HOT, 1.3, 2.6),
    ],
)
def test_velocity_error_and_covariance_are_consistent(
    plane: InertialFlight, imu: bool, band: ThermalBand, rms_mps: float, claim_mps: float
) -> None:
    run = flown(plane, imu=imu, band=band)
    mode = CovarianceMode.MARGINALS if band is ThermalBand.NORMAL else CovarianceMode.JACOBIAN
    assert {published.covariance_mode for published in run.estimates[1:]} == {mode}
    errors, sigma = run.velocity_error_mps[10:], run.velocity_sigma_mps[10:]
    assert np.sqrt(np.mean(np.square(errors[:, :2]))) < rms_mps
    assert np.median(sigma) < claim_mps
    assert (np.abs(errors) < 1.96 * sigma[:, None]).mean() > 0.95
    assert np.abs(errors / sigma[:, None]).max() < 3.5


def test_inertial_dead_reckoning_without_pictures_is_consistent(plane: InertialFlight) -> None:
    """Half a minute of a turning plane without pictures: the error is tens of metres and within the covariance."""
    blind = (20, 50)
    with_imu, without = (flown(plane, imu=imu, blind=blind) for imu in (True, False))
    assert {with_imu.estimates[i].source_label for i in range(*blind)} == {SourceLabel.DEAD_RECKONED}
    for run in (with_imu, without):
        assert (np.abs(run.position_error_m / run.position_sigma_m) < 3.5).all()
    at = blind[1] - 1
    assert with_imu.position_sigma_m[at].max() < 90.0 and np.abs(with_imu.position_error_m[at]).max() < 70.0
    assert without.position_sigma_m[at].min() > 2.0 * with_imu.position_sigma_m[at].max()
    assert without.position_sigma_m[blind[0] + 2].max() < 18.0  # of the process model, without a heavy tail
    assert (np.abs(with_imu.position_error_m[-1]) < 10.0).all()  # corrected by the next map match


def test_a_start_in_the_air_without_pictures_has_a_wide_velocity() -> None:
    run = flown(InertialFlight(seed=4, seconds=20), imu=True, blind=(0, 20))
    assert (np.abs(run.position_error_m / run.position_sigma_m) < 3.0).all()
    assert (np.abs(run.velocity_error_mps[:, :2] / run.velocity_sigma_mps[:, None]) < 3.0).all()


def test_a_gap_in_the_inertial_readings_widens_the_velocity_covariance(plane: InertialFlight) -> None:
    gap = flown(plane, imu=True, no_imu=(15.0, 25.0))
    errors, sigma = gap.velocity_error_mps[10:], gap.velocity_sigma_mps[10:]
    assert np.abs(errors / sigma[:, None]).max() < 3.5
    assert sigma[10] > 1.5 * sigma[25]  # between 15 and 25 s there are no readings


def test_two_runs_publish_identical_messages(plane: InertialFlight) -> None:
    a, b = (flown(plane, imu=True, frames=30) for _ in range(2))
    assert a.estimates == b.estimates


def test_the_first_prediction_after_frames_without_odometry_contains_the_whole_displacement(
    plane: InertialFlight,
) -> None:
    """The anchor's belief moves by Predictions only: the next one contains the displacement that it has missed."""
    node, first, end = EstimatorNode(), 20, 40
    list(node.on(ORIGIN))
    published: dict[int, Prediction] = {}
    for i, messages in enumerate(plane.messages_by_frame[: end + 3]):
        for message in messages:
            if first <= i < end and isinstance(message, MapMatch):
                continue
            if first <= i < end and isinstance(message, Odometry):
                message = Odometry(t_ns=message.t_ns, frame_id=i, keyframe_id=i, verdict=Verdict.STALLED)
            if i >= end and isinstance(message, Odometry) and message.keyframe_id < end:
                message = msgspec.structs.replace(message, verdict=Verdict.FEW_INLIERS, two_view=[])
            published |= {m.frame_id: m for m in node.on(message) if isinstance(m, Prediction)}
    assert not published.keys() & set(range(first, end))
    flown_m = plane.poses[end][1][:2] - plane.poses[first - 1][1][:2]
    assert np.hypot(*flown_m) > 150.0
    assert np.hypot(*(published[end].step_m - flown_m)) < 60.0
    step_m = plane.poses[end + 1][1][:2] - plane.poses[end][1][:2]
    assert (
        np.hypot(*(published[end + 1].step_m - step_m)) < 10.0
    )  # and the one after it the displacement since this one


@pytest.mark.slow
def test_a_camera_outage_of_40_s_is_bridged_by_one_inertial_increment() -> None:
    """Without pictures there are no frames: the outage is one increment."""
    far, sigma_m = [], []
    for seed in (4, 5, 6):
        run = flown(InertialFlight(seed=seed, seconds=113), imu=True, no_camera=(70, 110))
        after = next(i for i, published in enumerate(run.estimates) if published.frame_id == 110)
        far.append(np.linalg.norm(run.position_error_m[after]) / np.linalg.norm(run.position_sigma_m[after]))
        sigma_m.append(run.position_sigma_m[after].max())
    assert max(far) < 2.5 and max(sigma_m) < 150.0
