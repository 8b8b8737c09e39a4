"""Relief of tens of metres per kilometre without a DEM."""

import numpy as np
import pytest

from seeds import seeds
from simulated_flight import EstimatorRun, Flight, cov_of, error_m, without_fix
from terrafix.estimator.models.terrain_roughness import ROUGHNESS_CANDIDATES, TerrainRoughness

FRAMES = 240


@pytest.fixture(scope="module", params=[0.0, 8.0, 25.0], ids=lambda hills_m: f"{hills_m:.0f} m")
def run(request: pytest.FixtureRequest) -> tuple[Flight, EstimatorRun]:
    flight = Flight(FRAMES, seed=5, hills_m=request.param)
    return flight, EstimatorRun().fly(flight, 0, FRAMES)


@pytest.mark.slow
def test_position_errors_over_hills_are_within_the_covariance(run: tuple[Flight, EstimatorRun]) -> None:
    flight, listener = run
    errors = np.array([error_m(listener.estimate(i), flight)[:2] for i in range(10, FRAMES)])
    covs = np.array([cov_of(listener.estimate(i))[:2, :2] for i in range(10, FRAMES)])
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covs), errors)
    assert (nees < 5.99).mean() > 0.9
    assert np.median(np.hypot(*errors.T)) < 6.0 and np.hypot(*errors.T).max() < 30.0


def test_height_above_ground_is_visual_and_amsl_height_is_barometric(run: tuple[Flight, EstimatorRun]) -> None:
    """The elevation of the ground between them is unknown."""
    flight, listener = run
    height_m = flight.p_m[:, 2] - flight.ground_m
    estimates = [listener.estimate(i) for i in range(10, FRAMES)]
    agl_off = np.array([one.agl_m - height_m[one.frame_id] for one in estimates])
    amsl_off = np.array([error_m(one, flight)[2] for one in estimates])
    sigma = np.sqrt([cov_of(one)[2, 2] for one in estimates])
    assert np.median(np.abs(agl_off)) < 8.0 and (np.abs(agl_off) < 3.0 * sigma).all()
    assert np.median(np.abs(amsl_off)) < 4.0 and (np.abs(amsl_off) < 3.0 * sigma).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", seeds(1, 3))
def test_height_without_map_matches_does_not_drift_down(seed: int) -> None:
    """Two minutes of odometry alone: factors in metres pulled the camera down to half of its height, with a sigma of
    8 %."""
    flight = Flight(300, seed=seed)
    listener = EstimatorRun().fly(flight, 0, 61).fly(flight, 61, flight.frames, without_fix)
    for i in range(60, flight.frames, 20):
        estimate = listener.estimate(i)
        assert abs(estimate.agl_m - flight.p_m[i, 2]) < 3.0 * np.sqrt(estimate.cov[14])
        off_m = error_m(estimate, flight)[:2]
        assert off_m @ np.linalg.solve(cov_of(estimate)[:2, :2], off_m) < 13.8  # chi-square, 2 dof, 99.9 %
    assert abs(listener.estimate(299).agl_m - flight.p_m[299, 2]) < 25.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", seeds(2, 3))
def test_hard_braking_without_imu_does_not_change_the_height(seed: int) -> None:
    """From 12 m/s to zero within a frame and off again, every ten seconds, without IMU. Gaussian increments kept the
    cruise velocity and changed the height instead, which scales the odometry: errors were twice as large."""
    flight = Flight(220, seed=seed, stop_and_go=True, telemetry=frozenset({"yaw", "height"}))
    listener = EstimatorRun().fly(flight, 0, 41).fly(flight, 41, flight.frames, without_fix)
    for i in range(40, flight.frames):
        estimate = listener.estimate(i)
        off_m = error_m(estimate, flight)[:2]
        assert off_m @ np.linalg.solve(cov_of(estimate)[:2, :2], off_m) < 2.5


def walked(rise: float, metres: float, roughness: TerrainRoughness, seed: int) -> list[float]:
    """Walk sigma after each level, measured with a 1-sigma of 4 m every 60 m."""
    rng = np.random.default_rng(seed)
    at_m = np.arange(0.0, metres, 60.0)
    level_m = np.cumsum(rng.normal(0.0, rise * np.sqrt(60.0), len(at_m)))
    estimates = []
    for at, level in zip(at_m, level_m, strict=True):
        roughness.update(np.array([0.0, at]), 100.0, float(level + rng.normal(0.0, 4.0)), 4.0)
        estimates.append(roughness.walk_sigma)
    return estimates


@pytest.mark.parametrize("rise", ROUGHNESS_CANDIDATES)
def test_the_roughness_estimate_converges_to_the_true_walk(rise: float) -> None:
    ends = [np.mean(walked(rise, 6000.0, TerrainRoughness(), seed)[-20:]) for seed in range(8)]
    assert 0.7 * rise < np.median(ends) < 2.5 * rise


def test_the_roughness_estimate_rises_where_hills_begin() -> None:
    plains, hills = [], []
    for seed in range(8):
        roughness = TerrainRoughness()
        plains.append(walked(0.0, 5000.0, roughness, seed)[-1])
        hills.append(max(walked(3.0, 1000.0, roughness, seed)))
    assert 0.3 < np.median(plains) < 0.8 and np.median(hills) > 1.5


def test_smooth_hills_are_not_taken_for_a_plain() -> None:
    """15 m up and down every 1500 m, slopes of 6 %: from frame to frame they rise by less than the error of a match,
    and were taken for nearly plain. A random walk with the same rise over 300 m has 0.7 m per root of a metre."""
    estimates = []
    for seed in range(8):
        roughness, rng = TerrainRoughness(), np.random.default_rng(seed)
        for at in np.arange(0.0, 4000.0, 22.0):
            level_m = 15.0 * np.sin(2.0 * np.pi * (at / 1500.0 + seed / 8.0)) + rng.normal(0.0, 2.0)
            roughness.update(np.array([0.0, at]), 100.0, float(level_m), 4.0)
            if at > 1000.0:
                estimates.append(roughness.walk_sigma)
    assert np.median(estimates) > 0.8 and np.quantile(estimates, 0.05) > 0.6


def test_the_walk_sigma_is_the_root_mean_square_over_the_candidates() -> None:
    """The mean square counts, because mountains are rare and high."""
    assert TerrainRoughness().walk_sigma == pytest.approx(np.sqrt(0.35 * 0.3**2 + 0.5 * 1.0**2 + 0.15 * 3.0**2))


def test_levels_of_the_same_ground_are_used_once() -> None:
    roughness = TerrainRoughness()
    for i in range(50):
        roughness.update(np.array([0.0, 0.5 * i]), 100.0, 20.0 * (i % 2), 4.0)
    assert roughness.walk_sigma == TerrainRoughness().walk_sigma
