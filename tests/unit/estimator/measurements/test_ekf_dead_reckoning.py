"""An estimator restarted in flight begins at the autopilot's dead-reckoned position, with its covariance."""

import math

import msgspec
import numpy as np
import pytest

from simulated_flight import ORIGIN, PLACE, EstimatorRun, Flight, blind, error_m, sigma_m, t_ns
from smoother_marginals import recorded_marginals
from terrafix.core.geodesy import LocalFrame
from terrafix.core.inertial import GRAVITY_MPS2
from terrafix.estimator.measurements.ekf_dead_reckoning import MAX_AHEAD_S, DeadReckoning
from terrafix.estimator.models.motion_model import TILT_CORRELATION_S, TILT_VARYING_SHARE
from terrafix.estimator.node import EstimatorNode
from terrafix.estimator.prior import EstimatorCheckpoint
from terrafix.messages import (
    CovarianceMode,
    EkfDeadReckoning,
    Health,
    NavEstimate,
    Odometry,
    Prediction,
    ThermalBand,
    Verdict,
)

KILLED, BACK = 61, 73  # frames: six seconds
LINK_LETS_MPS = 1.45  # velocity sigma below which the link sends a fix


@pytest.fixture(scope="module")
def flight() -> Flight:
    return Flight(90, seed=6, dem=True)


@pytest.fixture(scope="module")
def killed(flight: Flight, tmp_path_factory: pytest.TempPathFactory) -> EstimatorCheckpoint:
    last = EstimatorRun().checkpoint(flight, KILLED, tmp_path_factory.mktemp("run"))
    assert last is not None
    return last


def velocity(flight: Flight, i: int) -> np.ndarray:
    return (flight.p_m[i + 1] - flight.p_m[i - 1]) / ((t_ns(i + 1) - t_ns(i - 1)) * 1e-9)


def autopilot_dead_reckoning(flight: Flight, off_m: tuple[float, float] = (0.0, 0.0)) -> EkfDeadReckoning:
    """From the second last frame before the kill to the first after the restart, with an error of ``off_m``."""
    since, until = KILLED - 2, BACK
    v0, v1, dt_s = velocity(flight, since), velocity(flight, until), (t_ns(until) - t_ns(since)) * 1e-9
    way = flight.p_m[until] - flight.p_m[since] - v0 * dt_s + (*off_m, 0.0)
    lat_deg, lon_deg = PLACE.to_wgs84(*(float(m) for m in flight.p_m[since, :2]))
    return EkfDeadReckoning(
        t_ns=t_ns(until),
        duration_s=dt_s,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        velocity_enu_mps=(float(v0[0]), float(v0[1]), float(v0[2])),
        position_sigma_m=4.0,
        velocity_sigma_mps=0.4,
        delta_p_m=(float(way[0]), float(way[1])),
        delta_v_mps=(float(v1[0] - v0[0]), float(v1[1] - v0[1]), float(v1[2] - v0[2])),
    )


def resumed(
    flight: Flight,
    last: EstimatorCheckpoint | None,
    dead_reckoning: EkfDeadReckoning | None,
    *,
    received_first: bool = True,
    band: ThermalBand = ThermalBand.NORMAL,
) -> EstimatorRun:
    run = EstimatorRun()
    run.node = EstimatorNode(0, last)
    health = Health(t_ns=0, band=band, temperature_c=60.0, throttled=False, disk_free_mb=1000, cause="test")
    run.feed([ORIGIN, health])
    for i in range(BACK, flight.frames):
        messages = flight.messages(i)
        if i == BACK:
            messages = [blind(m) if isinstance(m, Odometry) else m for m in messages]
            if dead_reckoning is not None:
                messages = [dead_reckoning, *messages] if received_first else [*messages, dead_reckoning]
        run.feed(messages)
    return run


def test_after_a_restart_position_and_velocity_are_known_at_the_first_frame(
    flight: Flight, killed: EstimatorCheckpoint
) -> None:
    first = resumed(flight, killed, autopilot_dead_reckoning(flight)).estimate(BACK)
    assert sigma_m(first) < 7.0 and first.velocity_sigma_mps < LINK_LETS_MPS
    assert np.linalg.norm(error_m(first, flight)[:2]) < 3.0 * sigma_m(first)
    off_mps = np.array(first.velocity_enu_mps) - velocity(flight, BACK)
    assert np.linalg.norm(off_mps) < 3.0 * first.velocity_sigma_mps
    without = resumed(flight, killed, None).estimate(BACK)
    assert sigma_m(without) > 2.0 * sigma_m(first) and without.velocity_sigma_mps > 10.0


def test_under_thermal_throttle_dead_reckoning_after_a_restart_needs_no_marginal(
    flight: Flight, killed: EstimatorCheckpoint, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And it tells position and velocity as it does in the normal band."""
    dead_reckoning = autopilot_dead_reckoning(flight)
    cool = resumed(flight, killed, dead_reckoning).estimate(BACK)
    computed = recorded_marginals(monkeypatch)
    run = resumed(flight, killed, dead_reckoning, band=ThermalBand.HOT)
    assert computed == []
    assert run.verdicts("dead_reckoning")[BACK].verdict is Verdict.ACCEPTED
    hot = run.estimate(BACK)
    assert hot.covariance_mode is CovarianceMode.JACOBIAN
    assert sigma_m(hot) == pytest.approx(sigma_m(cool), rel=0.05)
    assert hot.velocity_sigma_mps == pytest.approx(cool.velocity_sigma_mps, rel=0.05)


def test_late_dead_reckoning_is_fused_at_the_second_frame(flight: Flight, killed: EstimatorCheckpoint) -> None:
    """The prediction tells the anchor, whose belief is as wide as the first position, to begin at the new one."""
    late = msgspec.structs.replace(autopilot_dead_reckoning(flight), t_ns=t_ns(BACK) + round(MAX_AHEAD_S * 1e9) + 1)
    run = resumed(flight, killed, late)
    assert sigma_m(run.estimate(BACK)) > 15.0
    assert sigma_m(run.estimate(BACK + 1)) < 7.0
    first, second, third = [m for m in run.published if isinstance(m, Prediction)][:3]
    assert first.prior_t_ns == 0 and second.prior_t_ns == third.prior_t_ns == second.t_ns
    assert second.cov[0] < 0.2 * first.cov[0]


@pytest.mark.parametrize("received_first", [True, False])
def test_dead_reckoning_slightly_after_a_frame_is_fused_at_that_frame(
    flight: Flight, killed: EstimatorCheckpoint, received_first: bool
) -> None:
    moment_s = 0.2
    dead_reckoning = autopilot_dead_reckoning(flight)
    way_m = (np.array(dead_reckoning.velocity_enu_mps) + dead_reckoning.delta_v_mps)[:2] * moment_s
    late = msgspec.structs.replace(
        dead_reckoning,
        t_ns=dead_reckoning.t_ns + round(moment_s * 1e9),
        duration_s=dead_reckoning.duration_s + moment_s,
        delta_p_m=tuple(
            np.add(dead_reckoning.delta_p_m, way_m - np.array(dead_reckoning.velocity_enu_mps[:2]) * moment_s)
        ),
    )
    run = resumed(flight, killed, late, received_first=received_first)
    first = [m for m in run.published if isinstance(m, NavEstimate) and m.frame_id == BACK][-1]
    assert first.t_ns == t_ns(BACK)
    assert sigma_m(first) < 7.0 and first.velocity_sigma_mps < LINK_LETS_MPS
    assert np.linalg.norm(error_m(first, flight)[:2]) < 3.0 * sigma_m(first)
    off_mps = np.array(first.velocity_enu_mps) - velocity(flight, BACK)
    assert np.linalg.norm(off_mps) < 3.0 * first.velocity_sigma_mps


def test_dead_reckoning_before_the_origin_is_used(flight: Flight, killed: EstimatorCheckpoint) -> None:
    """The link may start before vision, which publishes the Origin."""
    run = EstimatorRun()
    run.node = EstimatorNode(0, killed)
    run.feed([autopilot_dead_reckoning(flight), ORIGIN])
    run.feed([blind(m) if isinstance(m, Odometry) else m for m in flight.messages(BACK)])
    first = run.estimate(BACK)
    assert sigma_m(first) < 7.0 and first.velocity_sigma_mps < LINK_LETS_MPS


def test_dead_reckoning_propagates_backwards_and_forwards() -> None:
    """Its covariance follows from that of the velocity, whose error has the same sign backwards."""
    frame = LocalFrame(48.0, 11.0)
    lat_deg, lon_deg = frame.to_wgs84(0.0, 0.0)
    dead_reckoning = EkfDeadReckoning(
        t_ns=2_000_000_000,
        duration_s=2.0,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        velocity_enu_mps=(20.0, 0.0, 0.0),
        position_sigma_m=4.0,
        velocity_sigma_mps=2.0,
        delta_p_m=(0.0, 0.0),
        delta_v_mps=(0.0, 0.0, 0.0),
    )
    coast = DeadReckoning.of(dead_reckoning, frame)
    tilts_rad = (math.radians(0.7), math.radians(0.7))
    back, end, on = (coast.until(2.0 + s, None, 0.3, 0.0, tilts_rad) for s in (-0.25, 0.0, 0.25))
    assert np.allclose([back.at_m[0], end.at_m[0], on.at_m[0]], [35.0, 40.0, 45.0], atol=0.3)
    assert np.allclose(back.velocity_mps, on.velocity_mps, atol=0.5)
    sigmas = [float(np.sqrt(c.cov_m2[0, 0])) for c in (back, end, on)]
    assert sigmas[0] < sigmas[1] < sigmas[2] and sigmas[0] == pytest.approx(np.hypot(4.0, 2.0 * 1.75), rel=0.1)


def test_dead_reckoning_with_a_jump_is_rejected(flight: Flight, killed: EstimatorCheckpoint) -> None:
    with_jump = resumed(flight, killed, autopilot_dead_reckoning(flight, off_m=(400.0, 0.0)))
    without = resumed(flight, killed, None)
    assert with_jump.estimate(BACK).cov == without.estimate(BACK).cov
    (verdict,) = with_jump.verdicts("dead_reckoning").values()
    assert verdict.verdict is Verdict.INNOVATION and verdict.test_ratio is not None and verdict.test_ratio > 1.0
    assert np.linalg.norm(verdict.innovation) > 300.0
    assert without.verdicts("dead_reckoning") == {}
    assert all(m.prior_t_ns == 0 for m in with_jump.published if isinstance(m, Prediction))


def test_without_a_checkpoint_dead_reckoning_is_not_used(flight: Flight) -> None:
    """Without an earlier estimate it is unknown whether this is the same flight."""
    run, without = resumed(flight, None, autopilot_dead_reckoning(flight)), resumed(flight, None, None)
    assert run.estimate(BACK).cov == without.estimate(BACK).cov


@pytest.mark.slow
@pytest.mark.parametrize("duration_s", [3.0, 6.0, 20.0])
def test_dead_reckoning_is_consistent_with_the_stated_tilt_sigma(duration_s: float) -> None:
    """The tilt error of the filter, and with it the gravity error, is a first-order process."""
    rng, frame, tilt_rad = np.random.default_rng(5), LocalFrame(48.0, 11.0), math.radians(0.7)
    nees, step_s = [], 0.02
    for _ in range(300):
        n = round(duration_s / step_s)
        drift = np.zeros((n, 2))
        drift[0] = rng.normal(0.0, 1.0, 2)
        keep = math.exp(-step_s / TILT_CORRELATION_S)
        for i in range(1, n):
            drift[i] = keep * drift[i - 1] + math.sqrt(1.0 - keep**2) * rng.normal(0.0, 1.0, 2)
        wrong = GRAVITY_MPS2 * tilt_rad * math.sqrt(TILT_VARYING_SHARE) * drift
        gain = np.cumsum(wrong, axis=0) * step_s
        way = gain.sum(axis=0) * step_s
        v0_off, p0_off = rng.normal(0.0, 0.4, 2), rng.normal(0.0, 4.0, 2)
        lat_deg, lon_deg = frame.to_wgs84(*(float(m) for m in p0_off))
        dead_reckoning = EkfDeadReckoning(
            t_ns=round(duration_s * 1e9),
            duration_s=duration_s,
            lat_deg=lat_deg,
            lon_deg=lon_deg,
            velocity_enu_mps=(20.0 + float(v0_off[0]), float(v0_off[1]), 0.0),
            position_sigma_m=4.0,
            velocity_sigma_mps=0.4,
            delta_p_m=(float(way[0]), float(way[1])),
            delta_v_mps=(float(gain[-1, 0]), float(gain[-1, 1]), 0.0),
        )
        got = DeadReckoning.of(dead_reckoning, frame).until(duration_s, None, 0.3, 0.0, (tilt_rad, tilt_rad))
        off_m, off_mps = got.at_m - (20.0 * duration_s, 0.0), got.velocity_mps[:2] - (20.0, 0.0)
        of_position = off_m @ np.linalg.solve(got.cov_m2, off_m)
        nees.append([of_position, off_mps @ np.linalg.solve(got.velocity_cov[:2, :2], off_mps)])
    position, speed = np.mean(nees, axis=0)
    assert 1.2 < position < 2.4 and 1.2 < speed < 2.4
