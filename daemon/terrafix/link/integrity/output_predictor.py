"""Carries an estimate forward to now, by what the inertial sensors felt since (inertial_integrator.py), covariance
grown with age.

The autopilot's own velocity is not used: it comes from the filter that this position is sent to, and feeding it
back with the delay of the camera path closes a loop that can oscillate. Attitude comes from the gyroscopes."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from terrafix.core.geodesy import rot_from_quat, yaw_of
from terrafix.link.integrity.inertial_integrator import GRAVITY_MPS2, MEMORY_NS, InertialIntegrator
from terrafix.messages import Imu, NavEstimate, VehicleState

WGS84_A_M = 6_378_137.0  # semi-major axis (NIMA TR8350.2)
WGS84_E2 = 6.694379990141e-3  # first eccentricity squared
# 1-sigma of the acceleration that is left out. Felt: an attitude that is 2 degrees off lets so much of gravity in, and
# the heading's error turns what was felt. Only the turn is known, from the attitude: a plane's gusts and changes of
# speed; a copter that leans to a corner does ten times that, and is the reason why its readings are asked for. Nothing:
# half a standard-rate turn at 20 m/s.
ACCEL_SIGMA_FELT_MPS2 = 0.4
HEADING_SIGMA_RAD = math.radians(5.0)
ACCEL_SIGMA_MPS2 = 0.5
ACCEL_SIGMA_BLIND_MPS2 = 1.0
MIN_TURN_BASE_NS = 50_000_000  # below this, yaw noise over the time base is not a turn rate


@dataclass(frozen=True)
class PredictedState:
    """An estimate at the moment ``t_ns`` (the present)."""

    t_ns: int
    age_s: float
    lat_deg: float
    lon_deg: float
    alt_amsl_m: float
    velocity_enu_mps: tuple[float, float, float]
    horizontal_sigma_m: float  # 1-sigma along the worst horizontal axis
    vertical_sigma_m: float
    speed_sigma_mps: float  # 1-sigma per axis


class Attitudes:
    """Yaw and roll of the last seconds, for the turn between an estimate and now; and what was felt
    (inertial_integrator.py)."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, float, float]] = deque()
        self._felt = InertialIntegrator()

    def add_imu(self, imu: Imu) -> None:
        self._felt.add(imu)

    def gained(self, estimate: NavEstimate, now_ns: int) -> tuple[tuple[float, float, float], ...] | None:
        """Velocity and way (east, north, up) that were felt since ``estimate``, by its heading; None: unknown."""
        said = min(self._samples, key=lambda s: abs(s[0] - estimate.t_ns), default=None)
        felt = self._felt.since(estimate.t_ns, now_ns)
        if felt is None or said is None:
            return None
        # The autopilot's heading is its compass; the estimate's is what map and odometry made of that.
        turn_rad = yaw_of(rot_from_quat(estimate.q_w_b)) - said[1]
        c, s = math.cos(turn_rad), math.sin(turn_rad)
        return tuple((c * e + s * n, c * n - s * e, u) for e, n, u in felt)

    def add(self, state: VehicleState) -> None:
        if state.yaw_rad is None or state.roll_rad is None:
            return
        self._felt.turn(state)
        if self._samples and state.t_ns <= self._samples[-1][0]:
            return
        self._samples.append((state.t_ns, state.yaw_rad, state.roll_rad))
        while self._samples[-1][0] - self._samples[0][0] > MEMORY_NS:
            self._samples.popleft()

    def lateral_accel(self, since_ns: int, now_ns: int, speed_mps: float) -> tuple[float, float] | None:
        """(acceleration to the right in m/s^2, mean heading in rad) since ``since_ns``; None: attitude not known.

        A banked turn shows twice: g tan(roll), and yaw rate times speed. The smaller of the two when they agree
        in sign, zero otherwise: a multicopter that yaws on the spot or leans against the wind is not turning."""
        window = [s for s in self._samples if s[0] >= since_ns - MIN_TURN_BASE_NS]
        if not window or now_ns - window[-1][0] > MIN_TURN_BASE_NS * 4:
            return None
        (t0, yaw0, _), (t1, yaw1, _) = window[0], window[-1]
        if t1 - t0 < MIN_TURN_BASE_NS:
            return 0.0, yaw1
        turned_rad = math.remainder(yaw1 - yaw0, math.tau)
        by_yaw = turned_rad / ((t1 - t0) * 1e-9) * speed_mps
        by_roll = GRAVITY_MPS2 * math.tan(max(-1.2, min(1.2, sum(s[2] for s in window) / len(window))))
        accel = math.copysign(min(abs(by_yaw), abs(by_roll)), by_roll) if by_yaw * by_roll > 0 else 0.0
        return accel, yaw0 + turned_rad / 2


def predict_to(estimate: NavEstimate, now_ns: int, attitudes: Attitudes) -> PredictedState:
    """``estimate`` (at its ``t_ns``) -> the same vehicle at ``now_ns``, less certain by what is not known since."""
    age_s = max(0.0, (now_ns - estimate.t_ns) * 1e-9)
    ve, vn, vu = estimate.velocity_enu_mps
    felt = attitudes.gained(estimate, now_ns) if age_s > 0.0 else None
    turned_mps = turned_m = 0.0
    if felt is not None:
        gain, way = felt
        accel_sigma = ACCEL_SIGMA_FELT_MPS2
        turned_mps, turned_m = (HEADING_SIGMA_RAD * math.hypot(v[0], v[1]) for v in felt)
    else:
        turn = attitudes.lateral_accel(estimate.t_ns, now_ns, math.hypot(ve, vn))
        accel_sigma = ACCEL_SIGMA_BLIND_MPS2 if turn is None else ACCEL_SIGMA_MPS2
        right, heading = turn if turn is not None else (0.0, 0.0)
        ae, an = right * math.cos(heading), -right * math.sin(heading)  # right of the heading, in east and north
        gain, way = (ae * age_s, an * age_s, 0.0), (0.5 * ae * age_s**2, 0.5 * an * age_s**2, 0.0)
    lat_deg, lon_deg = offset(estimate.lat_deg, estimate.lon_deg, ve * age_s + way[0], vn * age_s + way[1])
    grown_m2 = (estimate.velocity_sigma_mps * age_s) ** 2 + (0.5 * accel_sigma * age_s**2) ** 2 + turned_m**2
    return PredictedState(
        t_ns=now_ns,
        age_s=age_s,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        alt_amsl_m=estimate.alt_amsl_m + vu * age_s + way[2],
        velocity_enu_mps=(ve + gain[0], vn + gain[1], vu + gain[2]),
        horizontal_sigma_m=math.sqrt(worst_horizontal_variance(estimate.cov) + grown_m2),
        vertical_sigma_m=math.sqrt(max(0.0, estimate.cov[14]) + grown_m2),
        speed_sigma_mps=math.hypot(estimate.velocity_sigma_mps, accel_sigma * age_s, turned_mps),
    )


def worst_horizontal_variance(cov: Sequence[float]) -> float:
    """Largest eigenvalue (m^2) of the east-north block of a row-major 6x6 covariance.

    The autopilot squares one number and uses it on both axes, so the worst axis is the honest one."""
    ee, en, nn = cov[0], cov[1], cov[7]
    return max(0.0, (ee + nn) / 2 + math.hypot((ee - nn) / 2, en))


def metres_per_degree(lat_deg: float) -> tuple[float, float]:
    """-> (along the meridian, along the parallel), from the radii of curvature of WGS84 (Snyder, PP 1395, p. 24)."""
    s = math.sin(math.radians(lat_deg))
    w2 = 1.0 - WGS84_E2 * s * s
    prime_vertical_m = WGS84_A_M / math.sqrt(w2)
    meridian_m = prime_vertical_m * (1.0 - WGS84_E2) / w2
    return math.radians(meridian_m), math.radians(prime_vertical_m) * max(1e-6, math.cos(math.radians(lat_deg)))


def offset(lat_deg: float, lon_deg: float, e_m: float, n_m: float) -> tuple[float, float]:
    """A point moved by metres east and north; good to 0.1 m over the hundreds of metres it is used for."""
    north, east = metres_per_degree(lat_deg)
    return lat_deg + n_m / north, math.remainder(lon_deg + e_m / east, 360.0)


def apart_m(start: tuple[float, float], end: tuple[float, float]) -> tuple[float, float]:
    """From one place (latitude, longitude [deg]) to another near it: metres east and north."""
    north, east = metres_per_degree((start[0] + end[0]) / 2)
    return math.remainder(end[1] - start[1], 360.0) * east, (end[0] - start[0]) * north


def distance_m(lat1_deg: float, lon1_deg: float, lat2_deg: float, lon2_deg: float) -> float:
    """Distance of two near points in metres; far ones come out as far, which is all that the gate asks."""
    return math.hypot(*apart_m((lat1_deg, lon1_deg), (lat2_deg, lon2_deg)))
