"""Carries an estimate forward to now: constant velocity, the turn that the attitude shows, covariance grown with age.

The autopilot's own velocity is not used: it comes from the filter that this position is sent to, and feeding it
back with the delay of the camera path closes a loop that can oscillate. Attitude comes from the gyroscopes."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from terrafix.messages import NavEstimate, VehicleState

GRAVITY_MPS2 = 9.81
WGS84_A_M = 6_378_137.0  # semi-major axis (NIMA TR8350.2)
WGS84_E2 = 6.694379990141e-3  # first eccentricity squared
# 1-sigma of the acceleration that constant velocity leaves out: gusts and speed changes when the turn is known
# from the attitude, half a standard-rate turn at 20 m/s (1 m/s^2) when it is not.
ACCEL_SIGMA_MPS2 = 0.5
ACCEL_SIGMA_BLIND_MPS2 = 1.0
ATTITUDE_MEMORY_NS = 4_000_000_000  # longer than any carry (fix.MAX_AGE_NS)
MIN_TURN_BASE_NS = 50_000_000  # below this, yaw noise over the time base is not a turn rate


@dataclass(frozen=True)
class Carried:
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
    """Yaw and roll of the last seconds, for the turn between an estimate and now."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, float, float]] = deque()

    def add(self, state: VehicleState) -> None:
        if state.yaw_rad is None or state.roll_rad is None:
            return
        if self._samples and state.t_ns <= self._samples[-1][0]:
            return
        self._samples.append((state.t_ns, state.yaw_rad, state.roll_rad))
        while self._samples[-1][0] - self._samples[0][0] > ATTITUDE_MEMORY_NS:
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


def carry(estimate: NavEstimate, now_ns: int, attitudes: Attitudes) -> Carried:
    """``estimate`` (at its ``t_ns``) -> the same vehicle at ``now_ns``, less certain by what is not known since."""
    age_s = max(0.0, (now_ns - estimate.t_ns) * 1e-9)
    ve, vn, vu = estimate.velocity_enu_mps
    turn = attitudes.lateral_accel(estimate.t_ns, now_ns, math.hypot(ve, vn))
    accel_sigma = ACCEL_SIGMA_BLIND_MPS2 if turn is None else ACCEL_SIGMA_MPS2
    right, heading = turn if turn is not None else (0.0, 0.0)
    ae, an = right * math.cos(heading), -right * math.sin(heading)  # right of the heading, in east and north
    lat_deg, lon_deg = offset(
        estimate.lat_deg,
        estimate.lon_deg,
        ve * age_s + 0.5 * ae * age_s**2,
        vn * age_s + 0.5 * an * age_s**2,
    )
    grown_m2 = (estimate.velocity_sigma_mps * age_s) ** 2 + (0.5 * accel_sigma * age_s**2) ** 2
    return Carried(
        t_ns=now_ns,
        age_s=age_s,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        alt_amsl_m=estimate.alt_amsl_m + vu * age_s,
        velocity_enu_mps=(ve + ae * age_s, vn + an * age_s, vu),
        horizontal_sigma_m=math.sqrt(worst_horizontal_variance(estimate.cov) + grown_m2),
        vertical_sigma_m=math.sqrt(max(0.0, estimate.cov[14]) + grown_m2),
        speed_sigma_mps=math.hypot(estimate.velocity_sigma_mps, accel_sigma * age_s),
    )


def worst_horizontal_variance(cov: Sequence[float]) -> float:
    """Largest eigenvalue (m^2) of the east-north block of a row-major 6x6 covariance.

    The autopilot squares one number and uses it on both axes, so the worst axis is the honest one."""
    ee, en, nn = cov[0], cov[1], cov[7]
    return max(0.0, (ee + nn) / 2 + math.hypot((ee - nn) / 2, en))


def _metres_per_degree(lat_deg: float) -> tuple[float, float]:
    """-> (along the meridian, along the parallel), from the radii of curvature of WGS84 (Snyder, PP 1395, p. 24)."""
    s = math.sin(math.radians(lat_deg))
    w2 = 1.0 - WGS84_E2 * s * s
    prime_vertical_m = WGS84_A_M / math.sqrt(w2)
    meridian_m = prime_vertical_m * (1.0 - WGS84_E2) / w2
    return math.radians(meridian_m), math.radians(prime_vertical_m) * max(1e-6, math.cos(math.radians(lat_deg)))


def offset(lat_deg: float, lon_deg: float, e_m: float, n_m: float) -> tuple[float, float]:
    """A point moved by metres east and north; good to 0.1 m over the hundreds of metres it is used for."""
    north, east = _metres_per_degree(lat_deg)
    return lat_deg + n_m / north, math.remainder(lon_deg + e_m / east, 360.0)


def distance_m(lat1_deg: float, lon1_deg: float, lat2_deg: float, lon2_deg: float) -> float:
    """Distance of two near points in metres; far ones come out as far, which is all that the gate asks."""
    north, east = _metres_per_degree((lat1_deg + lat2_deg) / 2)
    return math.hypot((lat2_deg - lat1_deg) * north, math.remainder(lon2_deg - lon1_deg, 360.0) * east)
