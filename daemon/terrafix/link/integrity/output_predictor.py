"""Predicts an estimate to the present with the inertial increments since then (inertial_integrator.py), and grows its
covariance with the age. The same task as that of PX4's output predictor.

The autopilot's velocity is not used: it is computed by the EKF to which this position is sent. Feeding it back with
the delay of the camera path would close a loop that can oscillate. The attitude comes from the gyroscopes."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from terrafix.core.geodesy import rot_from_quat, yaw_of
from terrafix.core.inertial import GRAVITY_MPS2, covers
from terrafix.link.integrity.inertial_integrator import BUFFER_NS, MAX_ATTITUDE_AGE_NS, InertialIntegrator
from terrafix.messages import Imu, NavEstimate, VehicleState

# Indices of the position block in NavEstimate.cov, and of the rotation about up. [spec: row-major 6x6 covariance]
EE, EN, NN, UU, HEADING_VARIANCE = 0, 1, 7, 14, 35
WGS84_A_M = 6_378_137.0  # m, semi-major axis [spec: NIMA TR8350.2]
WGS84_E2 = 6.694379990141e-3  # first eccentricity squared [spec: NIMA TR8350.2]
# 1-sigma of the acceleration that the prediction leaves out, m/s^2, by what is known of the interval.
# With IMU readings: an attitude error of 2 degrees projects so much gravity into the horizontal. The result was
# compared with the truth of ArduPilot's firmware. [measured: docs/link.md]
ACCEL_SIGMA_IMU_MPS2 = 0.4
OUTPUT_HEADING_SIGMA_RAD = math.radians(5.0)  # rad; heading error, rotates the inertial increments; at least [tuned]
# With attitude alone a banked turn is known: what is left is gusts and speed changes of a plane. [tuned]
ACCEL_SIGMA_ATTITUDE_MPS2 = 0.5
# Share of the acceleration of a lean that is 1-sigma where the lean may, or may not, be a manoeuvre: a copter that
# leans brakes, turns, or holds its speed against drag and wind. All of it is three sigmas. [measured: docs/link.md]
LEAN_SHARE = 1.0 / 3.0
MAX_LEAN_RAD = math.radians(30.0)  # [spec: ArduPilot ANGLE_MAX, default]
# Where neither covers the interval, as after a gap of the telemetry or a restart of the link, the vehicle may lean as
# far as it can: 1.9 m/s^2
ACCEL_SIGMA_UNKNOWN_MPS2 = LEAN_SHARE * GRAVITY_MPS2 * math.tan(MAX_LEAN_RAD)
MIN_YAW_RATE_BASELINE_NS = 50_000_000  # ns; over shorter intervals noise of the yaw dominates its rate [tuned]


@dataclass(frozen=True)
class LateralAcceleration:
    """``right_mps2``: of the banked turn since an estimate, at the mean heading ``heading_rad``; ``sigma_mps2``:
    1-sigma of what the turn does not explain."""

    right_mps2: float
    heading_rad: float
    sigma_mps2: float


@dataclass(frozen=True)
class PredictedState:
    """An estimate predicted to ``t_ns`` (the present). ``age_s``: length of the prediction; ``inertial``: readings
    cover all of it."""

    t_ns: int
    age_s: float
    lat_deg: float
    lon_deg: float
    alt_amsl_m: float
    velocity_enu_mps: tuple[float, float, float]
    horizontal_sigma_m: float  # 1-sigma along the worst horizontal axis
    vertical_sigma_m: float
    speed_sigma_mps: float  # 1-sigma of the velocity in its worst direction
    inertial: bool


class InertialBuffer:
    """Attitudes and IMU readings of the last seconds (BUFFER_NS), for the motion from an estimate to the present."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, float, float, float]] = deque()  # t_ns; yaw, roll, pitch [rad]
        self._integrator = InertialIntegrator()

    def add_imu(self, imu: Imu) -> None:
        self._integrator.add_imu(imu)

    def delta(self, estimate: NavEstimate, now_ns: int) -> tuple[tuple[float, float, float], ...] | None:
        """-> (velocity increment [m/s], position increment that it causes [m]) since ``estimate``, in east, north, up
        by the heading of ``estimate``; None when readings or attitude are missing."""
        nearest = min(self._samples, key=lambda s: abs(s[0] - estimate.t_ns), default=None)
        increments = self._integrator.delta(estimate.t_ns, now_ns)
        if increments is None or nearest is None or abs(nearest[0] - estimate.t_ns) > MAX_ATTITUDE_AGE_NS:
            return None
        # The autopilot's heading is its compass; that of the estimate is corrected by map and odometry.
        correction_rad = yaw_of(rot_from_quat(estimate.q_w_b)) - nearest[1]
        c, s = math.cos(correction_rad), math.sin(correction_rad)
        return tuple((c * e + s * n, c * n - s * e, u) for e, n, u in increments)

    def add_attitude(self, state: VehicleState) -> None:
        if state.yaw_rad is None or state.roll_rad is None or state.pitch_rad is None:
            return
        self._integrator.add_attitude(state)
        if self._samples and state.t_ns <= self._samples[-1][0]:
            return
        self._samples.append((state.t_ns, state.yaw_rad, state.roll_rad, state.pitch_rad))
        while self._samples[-1][0] - self._samples[0][0] > BUFFER_NS:
            self._samples.popleft()

    def lateral_accel(self, since_ns: int, now_ns: int, speed_mps: float) -> LateralAcceleration | None:
        """-> acceleration across the heading since ``since_ns``; None: attitudes do not cover the time since then. A
        vehicle that rolls out of a corner now may have been in it before.

        A coordinated turn shows in two quantities: g tan(roll), and yaw rate times speed. The result is the smaller of
        the two when their signs agree, else zero: a multicopter that yaws on the spot or leans against the wind does
        not turn its velocity. What roll and pitch leave unexplained may be a manoeuvre (LEAN_SHARE)."""
        window = [s for s in self._samples if since_ns - MIN_YAW_RATE_BASELINE_NS <= s[0] <= now_ns]
        if not covers([s[0] for s in window], since_ns, now_ns, MAX_ATTITUDE_AGE_NS):
            return None
        (t0, yaw0, *_), (t1, yaw1, *_) = window[0], window[-1]
        yaw_change_rad = math.remainder(yaw1 - yaw0, math.tau)
        leans = [(_by_lean(roll), _by_lean(pitch)) for _, _, roll, pitch in window]
        by_roll = sum(right for right, _ in leans) / len(leans)
        # Over a shorter baseline the noise of the yaw would be its rate.
        by_yaw = yaw_change_rad / ((t1 - t0) * 1e-9) * speed_mps if t1 - t0 >= MIN_YAW_RATE_BASELINE_NS else 0.0
        accel = math.copysign(min(abs(by_yaw), abs(by_roll)), by_roll) if by_yaw * by_roll > 0 else 0.0
        left_mps2 = math.sqrt(sum((right - accel) ** 2 + ahead**2 for right, ahead in leans) / len(leans))
        sigma = math.hypot(ACCEL_SIGMA_ATTITUDE_MPS2, LEAN_SHARE * left_mps2)
        return LateralAcceleration(accel, yaw0 + yaw_change_rad / 2, sigma)


def _by_lean(angle_rad: float) -> float:
    """Horizontal acceleration [m/s^2] of a vehicle that holds its height at this roll or pitch."""
    return GRAVITY_MPS2 * math.tan(max(-1.2, min(1.2, angle_rad)))


def predict_to(estimate: NavEstimate, now_ns: int, inertial: InertialBuffer) -> PredictedState:
    """``estimate`` (at its ``t_ns``) -> the vehicle's state at ``now_ns``, with process noise for the interval."""
    age_s = max(0.0, (now_ns - estimate.t_ns) * 1e-9)
    ve, vn, vu = estimate.velocity_enu_mps
    increments = inertial.delta(estimate, now_ns) if age_s > 0.0 else None
    heading_error_mps = heading_error_m = 0.0
    if increments is not None:
        delta_v, delta_p = increments
        accel_sigma = ACCEL_SIGMA_IMU_MPS2
        heading_sigma_rad = max(OUTPUT_HEADING_SIGMA_RAD, math.sqrt(max(0.0, estimate.cov[HEADING_VARIANCE])))
        heading_error_mps, heading_error_m = (heading_sigma_rad * math.hypot(v[0], v[1]) for v in increments)
    else:
        turn = inertial.lateral_accel(estimate.t_ns, now_ns, math.hypot(ve, vn))
        turn = turn or LateralAcceleration(0.0, 0.0, ACCEL_SIGMA_UNKNOWN_MPS2)
        right, heading, accel_sigma = turn.right_mps2, turn.heading_rad, turn.sigma_mps2
        ae, an = right * math.cos(heading), -right * math.sin(heading)  # right of the heading, in east and north
        delta_v, delta_p = (ae * age_s, an * age_s, 0.0), (0.5 * ae * age_s**2, 0.5 * an * age_s**2, 0.0)
    lat_deg, lon_deg = offset(estimate.lat_deg, estimate.lon_deg, ve * age_s + delta_p[0], vn * age_s + delta_p[1])
    process_noise_m2 = (
        (estimate.velocity_sigma_mps * age_s) ** 2 + (0.5 * accel_sigma * age_s**2) ** 2 + heading_error_m**2
    )
    return PredictedState(
        t_ns=now_ns,
        age_s=age_s,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        alt_amsl_m=estimate.alt_amsl_m + vu * age_s + delta_p[2],
        velocity_enu_mps=(ve + delta_v[0], vn + delta_v[1], vu + delta_v[2]),
        horizontal_sigma_m=math.sqrt(worst_horizontal_variance(estimate.cov) + process_noise_m2),
        vertical_sigma_m=math.sqrt(max(0.0, estimate.cov[UU]) + process_noise_m2) if estimate.amsl_known else math.inf,
        speed_sigma_mps=math.hypot(estimate.velocity_sigma_mps, accel_sigma * age_s, heading_error_mps),
        inertial=increments is not None,
    )


def worst_horizontal_variance(cov: Sequence[float]) -> float:
    """Largest eigenvalue (m^2) of the east-north block of a row-major 6x6 covariance.

    The autopilot squares one number and uses it on both axes, so that only the worst axis covers both."""
    ee, en, nn = cov[EE], cov[EN], cov[NN]
    return max(0.0, (ee + nn) / 2 + math.hypot((ee - nn) / 2, en))


def metres_per_degree(lat_deg: float) -> tuple[float, float]:
    """-> (along the meridian, along the parallel) [m], from WGS84's radii of curvature (Snyder, PP 1395, p. 24)."""
    s = math.sin(math.radians(lat_deg))
    w2 = 1.0 - WGS84_E2 * s * s
    prime_vertical_m = WGS84_A_M / math.sqrt(w2)
    meridian_m = prime_vertical_m * (1.0 - WGS84_E2) / w2
    return math.radians(meridian_m), math.radians(prime_vertical_m) * max(1e-6, math.cos(math.radians(lat_deg)))


def offset(lat_deg: float, lon_deg: float, e_m: float, n_m: float) -> tuple[float, float]:
    """-> (latitude, longitude) [deg] of the point ``e_m`` east and ``n_m`` north of the given one, as ArduPilot's
    Location::offset; error below 0.1 m over the hundreds of metres for which it is used."""
    north, east = metres_per_degree(lat_deg)
    return lat_deg + n_m / north, math.remainder(lon_deg + e_m / east, 360.0)


def east_north_m(start: tuple[float, float], end: tuple[float, float]) -> tuple[float, float]:
    """-> (east, north) [m] of ``end`` from the near point ``start``; both (latitude, longitude) [deg]."""
    north, east = metres_per_degree((start[0] + end[0]) / 2)
    return math.remainder(end[1] - start[1], 360.0) * east, (end[0] - start[0]) * north


def distance_m(lat1_deg: float, lon1_deg: float, lat2_deg: float, lon2_deg: float) -> float:
    """Distance of two near points [m]. It is not exact for far points, but large, which is enough for a gate."""
    return math.hypot(*east_north_m((lat1_deg, lon1_deg), (lat2_deg, lon2_deg)))
