"""Wind and airspeed: estimated while odometry gives the velocity, and used consistently in a blackout."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, V

from inertial_flight import InertialFlight, flown
from terrafix.estimator.factors.airspeed import airspeed_factor
from terrafix.estimator.measurements.airspeed import (
    FUSION_TIMEOUT_S,
    GUST_S,
    MAX_UPDATE_SIGMA_MPS,
    WIND_WALK,
    AirspeedObservation,
    WindEstimator,
)
from terrafix.estimator.state import MOTION_SIZE
from terrafix.messages import Verdict

WIND_MPS, SCALE = np.array([4.0, -5.0]), 1.08
SEEN_MPS, STEP_S = 0.4, 0.5


class Plane:
    """Flies circles of a minute at 20 m/s in a wind with gusts and a random walk."""

    def __init__(self, seed: int, gust_mps: float = 1.0, turn_radps: float = 2 * np.pi / 60.0) -> None:
        self.rng = np.random.default_rng(seed)
        self.wind, self.gust_mps, self.turn_radps = WindEstimator(), gust_mps, turn_radps
        self.t_s, self.yaw_rad, self.gust, self.blows = 0.0, 0.0, np.zeros(2), WIND_MPS

    def fly(self) -> np.ndarray:
        """-> true velocity (3,) after a step."""
        self.t_s += STEP_S
        self.yaw_rad += self.turn_radps * STEP_S
        keep = np.exp(-STEP_S / GUST_S)
        self.gust = keep * self.gust + self.gust_mps * np.sqrt(1.0 - keep**2) * self.rng.normal(0.0, 1.0, 2)
        self.blows = self.blows + WIND_WALK * np.sqrt(STEP_S) * self.rng.normal(0.0, 1.0, 2)
        ahead = np.array([np.sin(self.yaw_rad), np.cos(self.yaw_rad)])
        return np.array([*(20.0 * ahead + self.blows + self.gust), 0.0])

    def seen(self, seconds: float, read_mps: float = 20.0 / SCALE) -> None:
        while seconds > 0.0:
            velocity = self.fly() + SEEN_MPS * self.rng.normal(0.0, 1.0, 3)
            self.wind.update(self.t_s, velocity, SEEN_MPS**2 * np.eye(3), read_mps, self.yaw_rad)
            seconds -= STEP_S

    def tells(self, read_mps: float = 20.0 / SCALE) -> AirspeedObservation | None:
        return self.wind.predict(self.t_s, read_mps, self.yaw_rad, 0.0)


def test_wind_and_airspeed_scale_are_estimated_consistently_in_turns() -> None:
    off2 = []
    for seed in range(40):
        plane = Plane(seed)
        plane.seen(120.0)
        air = plane.tells()
        assert air is not None
        off = air.wind_mps - plane.blows
        off2.append(float(off @ np.linalg.solve(air.common + air.changed, off)))
        assert air.still_mps == pytest.approx(20.0, abs=2.0)
    assert 0.5 < np.mean(off2) < 2.6  # 2 for an exactly consistent covariance


@pytest.mark.slow
@pytest.mark.parametrize("gap_s", [10.0, 60.0])
@pytest.mark.parametrize("gust_mps", [0.5, 1.5, 3.0])
def test_dead_reckoning_by_airspeed_is_consistent(gap_s: float, gust_mps: float) -> None:
    """At any gust level: it is estimated, too."""
    off2 = []
    for seed in range(40):
        plane = Plane(seed, gust_mps)
        plane.seen(200.0)
        since_s, off, cov = plane.t_s, np.zeros(2), np.zeros((2, 2))
        while plane.t_s < since_s + gap_s:
            velocity, air = plane.fly(), plane.tells()
            assert air is not None
            off += STEP_S * (velocity[:2] - air.velocity(0.0))
            cov += STEP_S**2 * air.cov(STEP_S, plane.t_s - since_s)
        off2.append(float(off @ np.linalg.solve(cov, off)))
    assert 0.3 < np.mean(off2) < 2.4


def test_no_airspeed_prediction_without_a_wind_estimate_or_below_flying_speed() -> None:
    plane = Plane(seed=1)
    assert plane.tells() is None
    plane.seen(60.0)
    assert plane.tells() is not None
    assert plane.tells(read_mps=3.0) is None
    assert plane.wind.predict(plane.t_s, None, 0.0, 0.0) is None
    assert plane.wind.predict(plane.t_s, 20.0, None, 0.0) is None
    assert plane.wind.predict(plane.t_s + 3600.0, 20.0, 0.0, 0.0) is None  # the wind has changed


def test_a_blocked_pitot_tube_is_rejected_and_the_scale_is_estimated_again() -> None:
    plane = Plane(seed=2)
    plane.seen(120.0)
    plane.seen(FUSION_TIMEOUT_S, read_mps=9.0)
    assert plane.tells() is None
    plane.seen(200.0, read_mps=18.0)
    air = plane.tells(read_mps=18.0)
    assert air is not None and float(np.sqrt(np.linalg.eigvalsh(air.common + air.changed)[-1])) < MAX_UPDATE_SIGMA_MPS
    assert np.linalg.norm(air.wind_mps - plane.blows) < 3.0


def test_the_airspeed_factor_has_the_expected_error_and_linearization() -> None:
    air = AirspeedObservation(20.0, 0.7, WIND_MPS, np.eye(2), np.eye(2), 1.0)
    factor = airspeed_factor(V(0), B(0), air.wind_mps, air.still_mps, air.yaw_rad, np.diag([4.0, 4.0]))
    values = gtsam.Values()
    values.insert(V(0), np.concatenate([air.velocity(0.1), np.zeros(MOTION_SIZE - 2)]))
    values.insert(B(0), np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0]))
    assert factor.error(values) == pytest.approx(0.0, abs=1e-12)
    values.update(B(0), np.array([0.0, 0.0, 0.15, 0.0, 0.0, 0.0]))  # 1 m/s across, at 2 m/s: half a sigma
    assert factor.error(values) == pytest.approx(0.125, rel=0.02)
    step = gtsam.VectorValues()
    step.insert(V(0), np.array([0.1, -0.2, *[0.0] * (MOTION_SIZE - 2)]))
    step.insert(B(0), np.array([0.0, 0.0, 1e-3, 0.0, 0.0, 0.0]))
    assert factor.linearize(values).error(step) == pytest.approx(factor.error(values.retract(step)), rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("imu", [True, False])
def test_airspeed_bounds_the_drift_of_a_40_s_blackout(imu: bool) -> None:
    blind = (70, 110)
    flights = [InertialFlight(seed=seed, seconds=112) for seed in (4, 5, 6)]
    with_air = [flown(flight, imu=imu, blind=blind, airspeed=True) for flight in flights]
    without = flown(flights[0], imu=imu, blind=blind)  # its sigma hardly differs between flights
    off_m = [np.linalg.norm(run.position_error_m[109]) for run in with_air]
    sigma_m = [np.linalg.norm(run.position_sigma_m[109]) for run in with_air]
    assert max(off_m) < 100.0 and np.mean(np.square(np.divide(off_m, sigma_m))) < 1.5
    assert np.mean(sigma_m) < (0.75 if imu else 0.3) * np.linalg.norm(without.position_sigma_m[109])


@pytest.mark.slow
@pytest.mark.parametrize("imu", [True, False])
@pytest.mark.parametrize("iced", [0.4, 0.7])
def test_an_icing_pitot_tube_in_a_blackout_keeps_the_estimate_consistent(imu: bool, iced: float) -> None:
    flight = InertialFlight(seed=4, seconds=112)
    run = flown(flight, imu=imu, blind=(70, 110), airspeed=True, iced=iced)
    far = np.linalg.norm(run.position_error_m, axis=1) / np.linalg.norm(run.position_sigma_m, axis=1)
    assert np.max(far) < 2.5


def test_every_airspeed_of_a_blackout_gets_a_verdict_with_its_innovation() -> None:
    blind = (70, 75)
    run = flown(InertialFlight(seed=4, seconds=76), imu=True, blind=blind, airspeed=True)
    verdicts = [v for v in run.verdicts if v.measurement == "airspeed"]
    assert [v.frame_id for v in verdicts][: len(range(*blind))] == list(range(*blind))
    for verdict in verdicts:
        assert verdict.verdict is Verdict.ACCEPTED and verdict.test_ratio is not None and verdict.test_ratio <= 1.0
        assert len(verdict.innovation) == len(verdict.innovation_variance) == 2
