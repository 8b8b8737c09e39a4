"""Motion model: how velocity and position follow from one node to the next, by the IMU or by a process model.

Both cases use the state (position, velocity, unmodelled acceleration). Without an IMU the unmodelled acceleration is
the whole acceleration. With an IMU it is the error of the measured one, mostly gravity that a tilt error lets in (one
degree: 0.17 m/s^2). It is a first-order Gauss-Markov process (Singer 1970, "Estimating optimal tracking filter
performance for manned maneuvering targets") in the axes of the heading, where the acceleration of a turn and the effect
of a tilt error stay constant while the vehicle turns. A second acceleration, for the IMU alone, hardly changes in a
flight: accelerometer bias, and an autopilot board that is not level in the frame. Map fixes estimate it, and dead
reckoning then drifts by the changing part only; while it is unknown the position error grows with the square of the
time."""

from dataclasses import dataclass, replace

import numpy as np

from terrafix.core.gate import GATE
from terrafix.core.geodesy import local_rotation_up
from terrafix.core.inertial import GRAVITY_MPS2, trapezoid_weights
from terrafix.estimator.state import (
    ACCELERATIONS,
    DELTA_ACCELERATIONS,
    DELTA_GAUSS_MARKOV,
    DELTA_MOTION,
    DELTA_P,
    DELTA_SINGER,
    DELTA_STEADY,
    DELTA_V,
    GAUSS_MARKOV_ACCEL,
    INCREMENT_SIZE,
    MOTION_SIZE,
    VELOCITY,
)

MAX_SPEED_SIGMA_MPS = np.array([15.0, 15.0, 3.0])  # 1-sigma of an unknown velocity in the air, east, north, up [tuned]
# Without IMU: 1-sigma of acceleration, m/s^2, of a small drone in cruise; the same per m/s of speed, for a fast one;
# and of climb. [tuned]
MANOEUVRE_MPS2, MANOEUVRE_PER_MPS, CLIMB_MPS2 = 1.0, 0.08, 0.7
MANOEUVRE_CORRELATION_S = 3.0  # about the duration of a manoeuvre [tuned]
# Heading change, rad, up to which a turn is not modelled: the compass may wander; above it the course may turn. [tuned]
MIN_TURN_RAD = np.radians(5.0)
# 1-sigma of acceleration, m/s^2, while the vehicle has not been seen to fly: a take-off run, a launch by hand, the
# start of a climb. A simulated plane has 10 m/s^2. [tuned]
LAUNCH_MPS2 = np.array([6.0, 6.0, 5.0])
MIN_MODEL_SPEED_MPS = 5.0  # lower bound of the speed in the model: a hovering vehicle may have begun to fly [tuned]
# With IMU: share of the variance of the autopilot's attitude that is time-varying, and its correlation time. The rest
# is a board that is not level. The tilt of a real fixed wing changed by 0.9 degrees in 10 s, of a copter by 1.5: of 0.7
# degrees that are stated, 0.65 vary. [measured: docs/simulated-flights.md]
TILT_VARYING_SHARE = 0.85
TILT_CORRELATION_S = 15.0  # [measured: docs/simulated-flights.md]
# Accelerometers of this class have, after calibration, a bias of 5 mg and a scale error of 0.3 %.
ACCELEROMETER_SIGMA_MPS2 = 0.07  # 1-sigma of the vertical error [spec: InvenSense DS-000347]
# 1-sigma and correlation time of the steady horizontal error: the bias above and half a degree of board tilt. [tuned]
STEADY_ACCEL_SIGMA_MPS2, STEADY_ACCEL_CORRELATION_S = 0.11, 600.0
NOISE_FLOOR_MPS2 = 0.03  # per root hertz: interpolated attitude, readings that are not simultaneous [tuned]
UNCOVERED_ACCEL_MPS2 = 2.0  # 1-sigma change of acceleration in the time that no reading covers [tuned]
NO_DECAY_S = 1e6  # correlation time of a velocity that does not decay [spec: long against any increment]
STATIONARY_M, STATIONARY_MPS = 0.3, 0.1  # 1-sigma of a vehicle whose motors may not turn [tuned]
CLOCK_JITTER_S = 0.005  # 1-sigma of the time of an image against the autopilot's clock [tuned]
POSITION_NOISE_M = 0.02  # 1-sigma of each increment beside the model: numerical floor [tuned]
MODEL_SAMPLES = 9  # samples of an increment without readings [tuned]
_QUADRATURE_NODES, _QUADRATURE_WEIGHTS = np.polynomial.legendre.leggauss(8)  # order per panel [tuned]


@dataclass(frozen=True)
class WorldAcceleration:
    """Acceleration between two times, from the accelerometers and the autopilot's attitude.

    ``s_s`` (N,) seconds since the first time, from 0 to the whole span; ``accel_w_mps2`` (N, 3) without gravity and
    ``yaw_rad`` (N,), both by the autopilot's heading; ``noise_mps2`` per root hertz; ``uncovered_s``: time at the end
    for which no readings had arrived, in which the last one is used."""

    s_s: np.ndarray
    accel_w_mps2: np.ndarray
    yaw_rad: np.ndarray
    noise_mps2: float
    uncovered_s: float = 0.0


@dataclass(frozen=True)
class MotionIncrement:
    """State transition from one node to the next (compare preintegration, Forster et al. 2017):
    p1 = p0 + phi_pv v0 + delta_p + phi_pa a0;  v1 = phi_vv v0 + delta_v + phi_va a0;  a1 = phi_aa a0.

    a0 (5,) are both accelerations of V. ``cov`` (11, 11) is the process noise of position and velocity (world axes) and
    of the accelerations (axes of the heading).
    ``inertial``: delta_p and delta_v are from the IMU and rotate with the heading bias.
    ``height_scale_ref``: height of the end above the ground and AMSL elevation of that ground, both as estimated when
    the increment was made; the residual is then in units of the height. None: the residual is in metres.
    ``terrain_unknown``: heights are above ground of unknown elevation, whose rise is in the height bias."""

    phi_pv_s: float
    phi_vv: float
    delta_p_m: np.ndarray
    delta_v_mps: np.ndarray
    phi_pa: np.ndarray
    phi_va: np.ndarray
    phi_aa: np.ndarray
    cov: np.ndarray
    inertial: bool
    height_scale_ref: tuple[float, float] | None = None
    terrain_unknown: bool = False

    def predict(self, p_m: np.ndarray, v: np.ndarray, heading_bias_rad: float) -> tuple[np.ndarray, np.ndarray]:
        """``p_m`` (3,) and ``v`` (MOTION_SIZE,) at the beginning -> the same at the end."""
        turn = local_rotation_up(heading_bias_rad if self.inertial else 0.0)
        p1 = p_m + self.phi_pv_s * v[VELOCITY] + turn @ self.delta_p_m + self.phi_pa @ v[ACCELERATIONS]
        v1 = self.phi_vv * v[VELOCITY] + turn @ self.delta_v_mps + self.phi_va @ v[ACCELERATIONS]
        return p1, np.concatenate([v1, self.phi_aa * v[ACCELERATIONS]])

    def transition(self) -> np.ndarray:
        """(11, 8): Jacobian of position and V at the end by V at the beginning."""
        phi = np.zeros((INCREMENT_SIZE, MOTION_SIZE))
        phi[DELTA_P, VELOCITY], phi[DELTA_P, ACCELERATIONS] = self.phi_pv_s * np.eye(3), self.phi_pa
        phi[DELTA_V, VELOCITY], phi[DELTA_V, ACCELERATIONS] = self.phi_vv * np.eye(3), self.phi_va
        phi[DELTA_ACCELERATIONS, ACCELERATIONS] = np.diag(self.phi_aa)
        return phi

    def in_height_units(self, height_m: float, ground_m: float) -> "MotionIncrement":
        """The same increment with a residual in units of the height: its end is ``height_m`` above ground of elevation
        ``ground_m`` (AMSL). For increments that a camera observes.

        A camera measures translations in heights. With a residual in metres, a camera error weighs the less the lower
        the flight is believed to be, and the estimate sinks: to the ground without an IMU, by metres in minutes with
        one. In units of the height such noise has the same weight at any height. An IMU increment still constrains
        metres. An increment of the process model compares heights per second at both ends: with a decaying velocity in
        metres the vehicle would be slower at its end, and so nearer to the ground."""
        return replace(self, height_scale_ref=(height_m, ground_m))


def acceleration_noise_sigma(
    inertial: bool, speed_mps: float, tilt_sigma_rad: float, launching: bool = False, turn_radps: float = 0.0
) -> np.ndarray:
    """(3,) 1-sigma of the unmodelled acceleration, m/s^2. ``launching``: the vehicle has not been seen to fly yet.
    ``turn_radps``: rate of the heading. The course of a plane turns with it; that of a copter need not."""
    if not inertial and launching:
        return LAUNCH_MPS2
    if not inertial:
        level = float(np.hypot(max(MANOEUVRE_MPS2, MANOEUVRE_PER_MPS * speed_mps), turn_radps * speed_mps))
        return np.array([level, level, CLIMB_MPS2])
    level = GRAVITY_MPS2 * tilt_sigma_rad * float(np.sqrt(TILT_VARYING_SHARE))
    return np.array([level, level, ACCELEROMETER_SIGMA_MPS2])


def velocity_correlation_time_s(speed_mps: float) -> float:
    """Correlation time of the velocity without measurements. It is chosen so that manoeuvres change the direction and
    leave the speed: 6 s at 5 m/s, 30 s for a fast vehicle.

    The stationary variance of a velocity with correlation time T, driven by an acceleration of variance a^2 and
    correlation time M, is a^2 T^2 M / (T + M) for each of two axes; this solves it for T."""
    speed = max(speed_mps, MIN_MODEL_SPEED_MPS)
    share = float(acceleration_noise_sigma(False, speed, 0.0)[0] / speed) ** 2
    half = 0.25 / MANOEUVRE_CORRELATION_S
    return (half + float(np.sqrt(half**2 + 0.5 * share))) / share


def integrate_motion(
    dt_s: float,
    imu: WorldAcceleration | None,
    yaws_rad: tuple[float, float],
    heading_bias_rad: float,
    speed_mps: float,
    tilt_sigma_rad: float,
    same_source: bool,
    launching: bool = False,
    velocity_observed: bool = False,
) -> MotionIncrement:
    """``yaws_rad``: true headings at both ends, used without an IMU. ``same_source``: the increment before had the same
    source (IMU or process model); if not, its acceleration does not predict this one's. ``velocity_observed``: another
    measurement gives the velocity, so that it does not decay."""
    memory_s, course_s = (
        (MANOEUVRE_CORRELATION_S, velocity_correlation_time_s(speed_mps))
        if imu is None
        else (TILT_CORRELATION_S, NO_DECAY_S)
    )
    if velocity_observed:
        course_s = NO_DECAY_S
    turn_radps = 0.0
    if imu is None:
        s = np.linspace(0.0, dt_s, MODEL_SAMPLES)
        turned = (yaws_rad[1] - yaws_rad[0] + np.pi) % (2 * np.pi) - np.pi
        turn_radps = max(abs(turned) - MIN_TURN_RAD, 0.0) / dt_s
        yaw = yaws_rad[0] + turned * s / dt_s
        accel, noise = np.zeros((MODEL_SAMPLES, 3)), 0.0
    else:
        s, accel, noise = imu.s_s, imu.accel_w_mps2, max(imu.noise_mps2, NOISE_FLOOR_MPS2)
        yaw = imu.yaw_rad - heading_bias_rad
    weight = trapezoid_weights(s)
    to_p, to_v = weight * _decay_integral(dt_s - s, course_s), weight * np.exp(-(dt_s - s) / course_s)
    decay = np.exp(-s / memory_s)
    heading = np.array([np.cos(yaw), np.sin(yaw), np.ones(len(yaw))])
    sigma = acceleration_noise_sigma(imu is not None, speed_mps, tilt_sigma_rad, launching, turn_radps)
    cov = _process_noise(dt_s, memory_s, course_s, sigma, noise, float(yaw[-1]), speed_mps)
    if imu is not None:
        cov[DELTA_V, DELTA_V] += (UNCOVERED_ACCEL_MPS2 * imu.uncovered_s) ** 2 * np.eye(3)
    steady = float(imu is not None)  # an error of the IMU: it has no effect without one
    result = MotionIncrement(
        phi_pv_s=float(_decay_integral(np.array(dt_s), course_s)),
        phi_vv=float(np.exp(-dt_s / course_s)),
        delta_p_m=to_p @ accel,
        delta_v_mps=to_v @ accel,
        phi_pa=_rotated_into_world(heading @ (to_p * decay), steady * (heading @ to_p)),
        phi_va=_rotated_into_world(heading @ (to_v * decay), steady * (heading @ to_v)),
        phi_aa=np.exp(-dt_s / np.array([memory_s] * 3 + [STEADY_ACCEL_CORRELATION_S] * 2)),
        cov=cov,
        inertial=imu is not None,
    )
    return result if same_source else _with_new_acceleration(result, sigma)


def unknown_motion_cov() -> np.ndarray:
    """(8, 8) of V of a vehicle in the air of whose motion nothing is known."""
    steady = [STEADY_ACCEL_SIGMA_MPS2, STEADY_ACCEL_SIGMA_MPS2]
    return np.diag([*MAX_SPEED_SIGMA_MPS, *acceleration_noise_sigma(False, 0.0, 0.0), *steady]) ** 2


def stationary_motion_cov() -> np.ndarray:
    """(8, 8) of V of a vehicle whose motors may not turn."""
    return np.diag([STATIONARY_MPS] * 6 + [STEADY_ACCEL_SIGMA_MPS2] * 2) ** 2


def predict_covariance(increment: MotionIncrement | None, velocity_cov: np.ndarray) -> np.ndarray:
    """Covariance (11, 11) of the change of position and of V at the end, from that of V (8, 8) at the beginning.
    ``increment`` None: the vehicle is stationary."""
    if increment is None:
        cov = np.zeros((INCREMENT_SIZE, INCREMENT_SIZE))
        cov[DELTA_P, DELTA_P], cov[DELTA_MOTION, DELTA_MOTION] = STATIONARY_M**2 * np.eye(3), stationary_motion_cov()
        return cov
    phi = increment.transition()
    return np.asarray(phi @ velocity_cov @ phi.T + increment.cov)


def fuse_odometry_increment(
    increment: MotionIncrement, innovation_m: np.ndarray, predicted_cov: np.ndarray, odometry_cov: np.ndarray
) -> tuple[MotionIncrement, np.ndarray, np.ndarray]:
    """Kalman update of an increment by odometry. ``innovation_m`` (3,): position by odometry less predicted position;
    ``predicted_cov`` (11, 11) of the increment; ``odometry_cov`` (3, 3) of the odometry position.

    -> the increment, its noise widened where the innovation exceeds the gate; the updated covariance (11, 11); and the
    correction (8,) of V at the end."""
    d2 = float(innovation_m @ np.linalg.solve(predicted_cov[DELTA_P, DELTA_P] + odometry_cov, innovation_m))
    if d2 > GATE[3]:  # the model missed something: a gust, a manoeuvre, an image with a wrong time
        # Without inertial readings as wide as this innovation is the most likely one [spec: maximum likelihood of a
        # variance, 3 dimensions].
        wider = (d2 / (GATE[3] if increment.inertial else 3.0) - 1.0) * increment.cov
        if not increment.inertial:
            # An image of another time is no acceleration, which would change the velocity by twice the way over the
            # time. Inertial readings tell: innovations are tested as a run (integrity/signed_innovations.py).
            wider[DELTA_V, DELTA_V] += (2.0 / increment.phi_pv_s) ** 2 * float(innovation_m @ innovation_m) * np.eye(3)
        increment, predicted_cov = replace(increment, cov=increment.cov + wider), predicted_cov + wider
    innovation_cov = predicted_cov[DELTA_P, DELTA_P] + odometry_cov
    gain = np.linalg.solve(innovation_cov, predicted_cov[DELTA_P, :]).T
    return increment, predicted_cov - gain @ predicted_cov[DELTA_P, :], (gain @ innovation_m)[DELTA_MOTION]


def replace_motion_covariance(predicted_cov: np.ndarray, velocity_cov: np.ndarray) -> np.ndarray:
    """``predicted_cov`` (11, 11) of a change of position and of V at its end, when the covariance of V is known to be
    ``velocity_cov`` (8, 8) instead."""
    gain = np.linalg.solve(predicted_cov[DELTA_MOTION, DELTA_MOTION], predicted_cov[DELTA_MOTION, :]).T
    return np.asarray(predicted_cov - gain @ (predicted_cov[DELTA_MOTION, DELTA_MOTION] - velocity_cov) @ gain.T)


def _with_new_acceleration(increment: MotionIncrement, sigma: np.ndarray) -> MotionIncrement:
    """The increment with a Gauss-Markov acceleration that is independent of the one before, of 1-sigma ``sigma``
    (3,)."""
    by_accel = increment.transition()[:, GAUSS_MARKOV_ACCEL]
    steady_only = np.array([0.0, 0.0, 0.0, 1.0, 1.0])
    return replace(
        increment,
        phi_pa=increment.phi_pa * steady_only,
        phi_va=increment.phi_va * steady_only,
        phi_aa=increment.phi_aa * steady_only,
        cov=increment.cov + by_accel @ np.diag(sigma**2) @ by_accel.T,
    )


def _decay_integral(t_s: np.ndarray, correlation_s: float) -> np.ndarray:
    """Integral of exp(-t / correlation_s) from 0 to ``t_s``."""
    return np.asarray(-np.expm1(-t_s / correlation_s) * correlation_s)


def _rotated_into_world(varying: np.ndarray, steady: np.ndarray) -> np.ndarray:
    """(3, 5): sums of weighted rotations from the axes of the heading into the world. Each argument (3,) is the sum of
    the cosines, of the sines, and of the weights."""
    (c, s, w), (c_steady, s_steady, _) = varying.tolist(), steady.tolist()
    return np.array([[c, s, 0.0, c_steady, s_steady], [-s, c, 0.0, -s_steady, c_steady], [0.0, 0.0, w, 0.0, 0.0]])


def _process_noise(
    dt_s: float,
    memory_s: float,
    course_s: float,
    sigma: np.ndarray,
    noise_mps2: float,
    yaw_end_rad: float,
    speed_mps: float,
) -> np.ndarray:
    """Process noise (11, 11) of an increment, by Gauss-Legendre quadrature over the time at which the noise enters.
    ``memory_s`` and ``course_s``: correlation times of acceleration and velocity."""
    panels = int(np.ceil(dt_s / (2.0 * memory_s)))
    half_s = 0.5 * dt_s / panels
    t = (half_s * (_QUADRATURE_NODES + 1.0) + 2.0 * half_s * np.arange(panels)[:, None]).ravel()
    w = np.tile(half_s * _QUADRATURE_WEIGHTS, panels)
    rate = 1.0 / memory_s - 1.0 / course_s
    accel_decay, velocity_decay = np.exp(-t / memory_s), np.exp(-t / course_s)
    displacement = _decay_integral(t, course_s)
    # Response of position, velocity, acceleration, t seconds after a unit impulse of acceleration and of velocity.
    by_accel_impulse = np.array(
        [(displacement - _decay_integral(t, memory_s)) / rate, (velocity_decay - accel_decay) / rate, accel_decay]
    )
    by_velocity_impulse = np.array([displacement, velocity_decay, np.zeros(len(t))])
    by_accel = (by_accel_impulse * w) @ by_accel_impulse.T * (2.0 / memory_s)
    by_velocity = (by_velocity_impulse * w) @ by_velocity_impulse.T
    by_accel, by_velocity = by_accel[:, None, :, None], by_velocity[:, None, :, None]  # Kronecker product with (3, 3)
    singer = by_accel * np.diag(sigma**2)[:, None] + by_velocity * (noise_mps2**2 * np.eye(3))[:, None]
    singer = singer.reshape(9, 9)
    singer[DELTA_P, DELTA_P] += (POSITION_NOISE_M**2 + (CLOCK_JITTER_S * speed_mps) ** 2) * np.eye(3)
    to_heading = np.eye(9)
    to_heading[DELTA_GAUSS_MARKOV, DELTA_GAUSS_MARKOV] = local_rotation_up(-yaw_end_rad).T
    cov = np.zeros((INCREMENT_SIZE, INCREMENT_SIZE))
    cov[DELTA_SINGER, DELTA_SINGER] = to_heading @ singer @ to_heading.T
    steady_decay = np.expm1(-2.0 * dt_s / STEADY_ACCEL_CORRELATION_S)
    cov[DELTA_STEADY, DELTA_STEADY] = -(STEADY_ACCEL_SIGMA_MPS2**2) * steady_decay * np.eye(2)
    return cov
