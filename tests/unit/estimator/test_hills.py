"""Ground that rises and falls by tens of metres in a kilometre, and no map tells."""

import numpy as np
import pytest

from simulated_flight import ORIGIN, Flight, Listener, cov_of, error_m
from terrafix.estimator.models.terrain_roughness import CANDIDATES, TerrainRoughness
from terrafix.messages import MapMatch

FRAMES = 240


@pytest.fixture(scope="module", params=[0.0, 8.0, 25.0], ids=lambda hills_m: f"{hills_m:.0f} m")
def run(request: pytest.FixtureRequest) -> tuple[Flight, Listener]:
    flight = Flight(FRAMES, seed=5, hills_m=request.param)
    return flight, Listener().fly(flight, 0, FRAMES)


@pytest.mark.slow
def test_the_claim_holds_over_them(run: tuple[Flight, Listener]) -> None:
    flight, told = run
    errors = np.array([error_m(told.estimate(i), flight)[:2] for i in range(10, FRAMES)])
    covs = np.array([cov_of(told.estimate(i))[:2, :2] for i in range(10, FRAMES)])
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covs), errors)
    assert (nees < 5.99).mean() > 0.9
    assert np.median(np.hypot(*errors.T)) < 6.0 and np.hypot(*errors.T).max() < 30.0


def test_heights_above_ground_and_sea_are_two(run: tuple[Flight, Listener]) -> None:
    """The one from pictures, the other from the barometer: the ground between them is not known."""
    flight, told = run
    height_m = flight.p_m[:, 2] - flight.ground_m
    said = [told.estimate(i) for i in range(10, FRAMES)]
    agl_off = np.array([one.agl_m - height_m[one.frame_id] for one in said])
    amsl_off = np.array([error_m(one, flight)[2] for one in said])
    sigma = np.sqrt([cov_of(one)[2, 2] for one in said])
    assert np.median(np.abs(agl_off)) < 8.0 and (np.abs(agl_off) < 3.0 * sigma).all()
    assert np.median(np.abs(amsl_off)) < 4.0 and (np.abs(amsl_off) < 3.0 * sigma).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3])
def test_without_map_fixes_the_height_does_not_sink(seed: int) -> None:
    """Two minutes by odometry alone: factors in metres pulled the camera down to half of its height, and claimed to
    know it to 8 %."""
    flight = Flight(300, seed=seed)
    told = Listener()
    told.hear([ORIGIN])
    for i in range(flight.frames):
        told.hear(m for m in flight.messages(i) if not (isinstance(m, MapMatch) and i > 60))
    for i in range(60, flight.frames, 20):
        said = told.estimate(i)
        assert abs(said.agl_m - flight.p_m[i, 2]) < 3.0 * np.sqrt(said.cov[14])
        off_m = error_m(said, flight)[:2]
        assert off_m @ np.linalg.solve(cov_of(said)[:2, :2], off_m) < 13.8  # chi-square, 2 degrees of freedom, 99.9 %
    assert abs(told.estimate(299).agl_m - flight.p_m[299, 2]) < 25.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3])
def test_one_that_brakes_hard_does_not_change_its_height(seed: int) -> None:
    """From 12 m/s to nothing within a frame and off again, every ten seconds, and nobody felt it. Legs that held on to
    the cruise pulled at the height instead, in which the camera sees the way: errors were twice as large."""
    flight = Flight(220, seed=seed, hovers=True, knows=frozenset({"yaw", "height"}))
    told = Listener()
    told.hear([ORIGIN])
    for i in range(flight.frames):
        told.hear(m for m in flight.messages(i) if not (isinstance(m, MapMatch) and i > 40))
    for i in range(40, flight.frames):
        said = told.estimate(i)
        off_m = error_m(said, flight)[:2]
        assert off_m @ np.linalg.solve(cov_of(said)[:2, :2], off_m) < 2.5


def walked(rise: float, metres: float, told: TerrainRoughness, seed: int) -> list[float]:
    """What it takes the ground for that is measured to 4 m, every 60 m."""
    rng = np.random.default_rng(seed)
    at_m = np.arange(0.0, metres, 60.0)
    level_m = np.cumsum(rng.normal(0.0, rise * np.sqrt(60.0), len(at_m)))
    taken_for = []
    for at, level in zip(at_m, level_m, strict=True):
        told.measured(np.array([0.0, at]), 100.0, float(level + rng.normal(0.0, 4.0)), 4.0)
        taken_for.append(told.rise)
    return taken_for


@pytest.mark.parametrize("rise", CANDIDATES)
def test_it_learns_how_rugged_the_ground_is(rise: float) -> None:
    ends = [np.mean(walked(rise, 6000.0, TerrainRoughness(), seed)[-20:]) for seed in range(8)]
    assert 0.7 * rise < np.median(ends) < 2.5 * rise


def test_where_hills_begin_it_forgets_the_plain() -> None:
    plains, hills = [], []
    for seed in range(8):
        told = TerrainRoughness()
        plains.append(walked(0.0, 5000.0, told, seed)[-1])
        hills.append(max(walked(3.0, 1000.0, told, seed)))
    assert 0.3 < np.median(plains) < 0.8 and np.median(hills) > 1.5


def test_smooth_hills_are_hills() -> None:
    """15 m up and down every 1500 m, slopes of 6 %: from frame to frame they rise by less than a match gets wrong, and
    were taken for half of a plain. A walk that rises as much on 300 m rises 0.7 m for each root of a metre."""
    taken_for = []
    for seed in range(8):
        told, rng = TerrainRoughness(), np.random.default_rng(seed)
        for at in np.arange(0.0, 4000.0, 22.0):
            level_m = 15.0 * np.sin(2.0 * np.pi * (at / 1500.0 + seed / 8.0)) + rng.normal(0.0, 2.0)
            told.measured(np.array([0.0, at]), 100.0, float(level_m), 4.0)
            if at > 1000.0:
                taken_for.append(told.rise)
    assert np.median(taken_for) > 0.8 and np.quantile(taken_for, 0.05) > 0.6


def test_what_the_candidates_leave_open_is_in_the_claim() -> None:
    """Of a rise of which nothing is known the mean square counts: mountains are rare, and high."""
    assert TerrainRoughness().rise == pytest.approx(np.sqrt(0.35 * 0.3**2 + 0.5 * 1.0**2 + 0.15 * 3.0**2))


def test_levels_of_the_same_ground_are_one() -> None:
    told = TerrainRoughness()
    for i in range(50):
        told.measured(np.array([0.0, 0.5 * i]), 100.0, 20.0 * (i % 2), 4.0)
    assert told.rise == TerrainRoughness().rise
