"""How velocity and position follow from one node to the next: by what the IMU felt, or by what drones do.

One model for both, with the state (position, velocity, acceleration that nobody measured). Without an IMU the last is
the whole acceleration; with an IMU it is what is wrong with the measured one, mostly gravity that a wrong tilt lets in
(one degree: 0.17 m/s^2). It is a first-order Gauss-Markov process (Singer 1970, "Estimating optimal tracking filter
performance for manned maneuvering targets") in the axes of the heading, where the pull of a turn and the error of a
tilt stay what they are while the vehicle turns. A second one, for the IMU alone, hardly changes in a flight: the bias
of the accelerometers, and a board that is not level in the frame. Fixes teach it, and a flight on dead reckoning then
drifts by what wanders only; while it is not known its error grows with the square of the time."""

from dataclasses import dataclass, replace

import numpy as np

from terrafix.core.gate import GATE
from terrafix.core.geodesy import local_rotation_up

# Of the variable V_k: velocity in the world [m/s]; in axes of the heading the acceleration that nobody measured (right,
# ahead, up) [m/s^2], and what of that is steady (right, ahead) [m/s^2].
V_SIZE = 8
MAX_SPEED_SIGMA_MPS = np.array([15.0, 15.0, 3.0])  # of a velocity of which nothing is known, in the air
GRAVITY_MPS2 = 9.81
# Without IMU: what a small drone does in cruise, more for a fast one, for about as long as a manoeuvre takes. The
# course is forgotten meanwhile (course_memory_s), since a drone that is out of sight also turns back.
MANOEUVRE_MPS2, MANOEUVRE_PER_SPEED, CLIMB_MPS2 = 1.0, 0.08, 0.7
MANOEUVRE_S = 3.0
TURN_RAD = np.radians(5.0)  # a heading that changed by less may be a compass that wanders; by more, the course may turn
# ... and of one that stood a moment ago: a take-off run, a throw, a climb that begins (a simulated plane: 10 m/s^2).
LAUNCH_MPS2 = np.array([6.0, 6.0, 5.0])
LEAST_SPEED_MPS = 5.0  # one that hovers may have begun to fly
# With IMU: so much of the variance of the autopilot's attitude wanders, and so long its filter stays wrong in one
# direction; the rest is a board that is not level. The tilt of a real fixed wing's changed by 0.9 degrees in 10 s, of a
# copter's by 1.5 (docs/simulated-flights.md): where 0.7 is stated, 0.65 wander. Bias and scale of small accelerometers
# after calibration are 5 mg and 0.3 % (InvenSense DS-000347); half a degree of the board beside makes the steady error.
WANDERING_SHARE = 0.85
TILT_S = 15.0
ACCELEROMETER_MPS2 = 0.07
STEADY_MPS2, STEADY_S = 0.11, 600.0
NOISE_FLOOR_MPS2 = 0.03  # per root hertz: interpolated attitude, readings that are not taken at one time
UNFELT_MPS2 = 2.0  # by how much acceleration changes within a tenth of a second
FOREVER_S = 1e6
STANDING_M, STANDING_MPS = 0.3, 0.1  # 1-sigma of a vehicle whose motors may not turn
CLOCK_JITTER_S = 0.005  # of a picture's time against the autopilot's
POINTS = 9  # between two nodes, when nothing was measured there
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)


@dataclass(frozen=True)
class WorldAcceleration:
    """Acceleration between two times, by the accelerometers and the autopilot's attitude.

    ``s_s`` (N,) seconds since the first time, from 0 to the whole span; ``accel_w_mps2`` (N, 3) without gravity and
    ``yaw_rad`` (N,), both by the autopilot's heading; ``noise_mps2`` per root hertz; ``unfelt_s`` at the end for which
    no readings had come yet, so that the last one stands."""

    s_s: np.ndarray
    accel_w_mps2: np.ndarray
    yaw_rad: np.ndarray
    noise_mps2: float
    unfelt_s: float = 0.0


@dataclass(frozen=True)
class MotionIncrement:
    """p1 = p0 + reach_s v0 + way_m + way_by_accel a0;  v1 = keep v0 + gain_mps + gain_by_accel a0;  a1 = lasting a0.

    a0 (5,) are both accelerations of V. ``cov`` (11, 11) of what that leaves out: position, velocity (both world axes),
    accelerations (heading's axes).
    ``inertial``: way and gain were measured, and turn with the heading bias.
    ``over``: height of the end above the ground, and AMSL of that ground, both as they were believed; all of the leg is
    in units of the height, and what it says is true of any. None: it is in metres."""

    reach_s: float
    keep: float
    way_m: np.ndarray
    gain_mps: np.ndarray
    way_by_accel: np.ndarray
    gain_by_accel: np.ndarray
    lasting: np.ndarray
    cov: np.ndarray
    inertial: bool
    over: tuple[float, float] | None = None
    lifted: bool = (
        False  # heights are above ground that no map tells, whose rise is in the height bias (custom_factors.py)
    )

    def predicted(self, p_m: np.ndarray, v: np.ndarray, heading_bias_rad: float) -> tuple[np.ndarray, np.ndarray]:
        """-> position (3,) and V at the end, from those at the beginning."""
        turn = local_rotation_up(heading_bias_rad if self.inertial else 0.0)
        p1 = p_m + self.reach_s * v[:3] + turn @ self.way_m + self.way_by_accel @ v[3:]
        v1 = self.keep * v[:3] + turn @ self.gain_mps + self.gain_by_accel @ v[3:]
        return p1, np.concatenate([v1, self.lasting * v[3:]])

    def by_before(self) -> np.ndarray:
        """(11, 8): of position and V at the end by V at the beginning."""
        by = np.zeros((3 + V_SIZE, V_SIZE))
        by[:3, :3], by[:3, 3:] = self.reach_s * np.eye(3), self.way_by_accel
        by[3:6, :3], by[3:6, 3:] = self.keep * np.eye(3), self.gain_by_accel
        by[6:, 3:] = np.diag(self.lasting)
        return by

    def above(self, height_m: float, ground_m: float) -> "MotionIncrement":
        """The same with its end at such a height above ground of this AMSL, of a camera that sees its way.

        A camera measures ways in heights. Told in metres, whatever the camera misjudges weighs the less in a leg the
        lower the flight is believed to be, and it sinks: to the ground where nobody felt the leg, by metres in minutes
        where an IMU did. In units of the height such noise is the same at any. What was felt still tells of metres. A
        leg that nobody felt compares heights a second with heights a second: one that forgets its course would have
        the vehicle slower at its end, and so nearer to the ground."""
        return replace(self, over=(height_m, ground_m))


def unmeasured_sigma(
    felt: bool, speed_mps: float, tilt_sigma_rad: float, launching: bool = False, turn_radps: float = 0.0
) -> np.ndarray:
    """(3,) 1-sigma of the acceleration that nobody measured, m/s^2. ``launching``: it has not been seen to fly yet.
    ``turn_radps``: of the heading. The course of a plane turns with it, that of a copter need not."""
    if not felt and launching:
        return LAUNCH_MPS2
    if not felt:
        level = float(np.hypot(max(MANOEUVRE_MPS2, MANOEUVRE_PER_SPEED * speed_mps), turn_radps * speed_mps))
        return np.array([level, level, CLIMB_MPS2])
    level = GRAVITY_MPS2 * tilt_sigma_rad * float(np.sqrt(WANDERING_SHARE))
    return np.array([level, level, ACCELEROMETER_MPS2])


def course_memory_s(speed_mps: float) -> float:
    """How long a drone keeps its course when nobody measures: so long that its manoeuvres leave its speed what it is,
    and take only the direction. 6 s at 5 m/s, 30 s for a fast one.

    The stationary variance of a velocity with memory T, driven by an acceleration of variance a^2 and memory M, is
    a^2 T^2 M / (T + M) for each of two axes; this solves it for T."""
    speed = max(speed_mps, LEAST_SPEED_MPS)
    share = float(unmeasured_sigma(False, speed, 0.0)[0] / speed) ** 2
    half = 0.25 / MANOEUVRE_S
    return (half + float(np.sqrt(half**2 + 0.5 * share))) / share


def integrate_motion(
    dt_s: float,
    felt: WorldAcceleration | None,
    yaws_rad: tuple[float, float],
    heading_bias_rad: float,
    speed_mps: float,
    tilt_sigma_rad: float,
    same_kind: bool,
    launching: bool = False,
    course_told: bool = False,
) -> MotionIncrement:
    """``yaws_rad``: true headings at both ends, used when nothing was felt. ``same_kind``: the leg before was measured,
    or not, like this one; else its acceleration says nothing about this one's. ``course_told``: by something else."""
    memory_s, course_s = (MANOEUVRE_S, course_memory_s(speed_mps)) if felt is None else (TILT_S, FOREVER_S)
    if course_told:
        course_s = FOREVER_S
    turn_radps = 0.0
    if felt is None:
        s = np.linspace(0.0, dt_s, POINTS)
        turned = (yaws_rad[1] - yaws_rad[0] + np.pi) % (2 * np.pi) - np.pi
        turn_radps = max(abs(turned) - TURN_RAD, 0.0) / dt_s
        yaw = yaws_rad[0] + turned * s / dt_s
        accel, noise = np.zeros((POINTS, 3)), 0.0
    else:
        s, accel, noise = felt.s_s, felt.accel_w_mps2, max(felt.noise_mps2, NOISE_FLOOR_MPS2)
        yaw = felt.yaw_rad - heading_bias_rad
    weight = np.zeros(len(s))  # trapezoids
    weight[1:] += 0.5 * np.diff(s)
    weight[:-1] += 0.5 * np.diff(s)
    to_way, to_gain = weight * _reach(dt_s - s, course_s), weight * np.exp(-(dt_s - s) / course_s)
    lasts = np.exp(-s / memory_s)
    heading = np.array([np.cos(yaw), np.sin(yaw), np.ones(len(yaw))])
    sigma = unmeasured_sigma(felt is not None, speed_mps, tilt_sigma_rad, launching, turn_radps)
    cov = _left_out(dt_s, memory_s, course_s, sigma, noise, float(yaw[-1]), speed_mps)
    if felt is not None:
        cov[3:6, 3:6] += (UNFELT_MPS2 * felt.unfelt_s) ** 2 * np.eye(3)
    steady = float(felt is not None)  # an error of the IMU: it moves nobody who is not led by one
    result = MotionIncrement(
        reach_s=float(_reach(np.array(dt_s), course_s)),
        keep=float(np.exp(-dt_s / course_s)),
        way_m=to_way @ accel,
        gain_mps=to_gain @ accel,
        way_by_accel=_turned(heading @ (to_way * lasts), steady * (heading @ to_way)),
        gain_by_accel=_turned(heading @ (to_gain * lasts), steady * (heading @ to_gain)),
        lasting=np.exp(-dt_s / np.array([memory_s] * 3 + [STEADY_S] * 2)),
        cov=cov,
        inertial=felt is not None,
    )
    return result if same_kind else _without_memory(result, sigma)


def unknown_cov() -> np.ndarray:
    """(8, 8) of V of a vehicle in the air of whose motion nothing is known."""
    return np.diag([*MAX_SPEED_SIGMA_MPS, *unmeasured_sigma(False, 0.0, 0.0), STEADY_MPS2, STEADY_MPS2]) ** 2


def standing_cov() -> np.ndarray:
    """(8, 8) of V of a vehicle whose motors may not turn."""
    return np.diag([STANDING_MPS] * 6 + [STEADY_MPS2] * 2) ** 2


def spread_after(way: MotionIncrement | None, velocity_cov: np.ndarray) -> np.ndarray:
    """Covariance (11, 11) of the step, and of V at its end, from that of V before it; ``way`` None: it stands."""
    if way is None:
        cov = np.zeros((3 + V_SIZE, 3 + V_SIZE))
        cov[:3, :3], cov[3:, 3:] = STANDING_M**2 * np.eye(3), standing_cov()
        return cov
    by_before = way.by_before()
    return np.asarray(by_before @ velocity_cov @ by_before.T + way.cov)


def believed(
    way: MotionIncrement, off_m: np.ndarray, spread: np.ndarray, seen: np.ndarray
) -> tuple[MotionIncrement, np.ndarray, np.ndarray]:
    """The leg as far as odometry bears it out, the covariance (11, 11) that both together leave, and by how much V (8,)
    at its end is then other than the leg led to.

    Odometry ended ``off_m`` (3,) from where the leg led; ``spread`` is the leg's, ``seen`` (3, 3) that of odometry."""
    d2 = float(off_m @ np.linalg.solve(spread[:3, :3] + seen, off_m))
    if d2 > GATE[3]:  # what velocity did not know: a gust, a manoeuvre, a picture whose time is not its own
        wider = (d2 / GATE[3] - 1.0) * way.cov
        way, spread = replace(way, cov=way.cov + wider), spread + wider
    gain = np.linalg.solve(spread[:3, :3] + seen, spread[:3, :]).T
    return way, spread - gain @ spread[:3, :], (gain @ off_m)[3:]


def with_velocity(spread: np.ndarray, velocity_cov: np.ndarray) -> np.ndarray:
    """``spread`` (11, 11) of a step and of V at its end, when V is known to ``velocity_cov`` (8, 8) after all."""
    gain = np.linalg.solve(spread[3:, 3:], spread[3:, :]).T
    return np.asarray(spread - gain @ (spread[3:, 3:] - velocity_cov) @ gain.T)


def _without_memory(known: MotionIncrement, sigma: np.ndarray) -> MotionIncrement:
    by_accel = known.by_before()[:, 3:6]
    steady = np.array([0.0, 0.0, 0.0, 1.0, 1.0])
    return replace(
        known,
        way_by_accel=known.way_by_accel * steady,
        gain_by_accel=known.gain_by_accel * steady,
        lasting=known.lasting * steady,
        cov=known.cov + by_accel @ np.diag(sigma**2) @ by_accel.T,
    )


def _reach(t_s: np.ndarray, memory_s: float) -> np.ndarray:
    return np.asarray(-np.expm1(-t_s / memory_s) * memory_s)


def _turned(wandering: np.ndarray, steady: np.ndarray) -> np.ndarray:
    """(3, 5): sums of weighted rotations from the heading's axes into the world, of which each (3,) is the sum of the
    cosines, of the sines, and of the weights."""
    (c, s, w), (c_steady, s_steady, _) = wandering.tolist(), steady.tolist()
    return np.array([[c, s, 0.0, c_steady, s_steady], [-s, c, 0.0, -s_steady, c_steady], [0.0, 0.0, w, 0.0, 0.0]])


def _left_out(
    dt_s: float,
    memory_s: float,
    course_s: float,
    sigma: np.ndarray,
    noise_mps2: float,
    yaw_end_rad: float,
    speed_mps: float,
) -> np.ndarray:
    """Covariance of a leg (11, 11), by quadrature over the moments at which the noise enters."""
    panels = int(np.ceil(dt_s / (2.0 * memory_s)))
    half_s = 0.5 * dt_s / panels
    t = (half_s * (_NODES + 1.0) + 2.0 * half_s * np.arange(panels)[:, None]).ravel()
    w = np.tile(half_s * _WEIGHTS, panels)
    rate = 1.0 / memory_s - 1.0 / course_s
    fading, keeping, reach = np.exp(-t / memory_s), np.exp(-t / course_s), _reach(t, course_s)
    # Of position, velocity, acceleration: t seconds after a unit kick of the acceleration, and a push of the velocity.
    kick = np.array([(reach - _reach(t, memory_s)) / rate, (keeping - fading) / rate, fading])
    push = np.array([reach, keeping, np.zeros(len(t))])
    by_kick, by_push = (kick * w) @ kick.T * (2.0 / memory_s), (push * w) @ push.T
    by_kick, by_push = by_kick[:, None, :, None], by_push[:, None, :, None]  # times (3, 1, 3): Kronecker's product
    wandering = by_kick * np.diag(sigma**2)[:, None] + by_push * (noise_mps2**2 * np.eye(3))[:, None]
    wandering = wandering.reshape(9, 9)
    wandering[:3, :3] += (0.02**2 + (CLOCK_JITTER_S * speed_mps) ** 2) * np.eye(3)
    to_heading = np.eye(9)
    to_heading[6:, 6:] = local_rotation_up(-yaw_end_rad).T
    cov = np.zeros((3 + V_SIZE, 3 + V_SIZE))
    cov[:9, :9] = to_heading @ wandering @ to_heading.T
    cov[9:, 9:] = -(STEADY_MPS2**2) * np.expm1(-2.0 * dt_s / STEADY_S) * np.eye(2)
    return cov
