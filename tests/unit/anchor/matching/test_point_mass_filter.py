"""Point-mass filter: effect of observations, motion and blur on the mass."""

import tracemalloc

import numpy as np
import pytest

from terrafix.anchor.matching.point_mass_filter import (
    MAX_HALF_CELLS,
    MODE_RADIUS_CELLS,
    Belief,
    Surface,
    _blurred,
    belief_cell_m,
)

HALF_M = 200.0
CELL_M = 2.0


def surface(peaks: list[tuple[float, float, float]], seed: int = 0, cell_m: float = 1.0) -> Surface:
    """Random alignment with peaks (e_m, n_m, z) of realistic width."""
    rng = np.random.default_rng(seed)
    side = round(2 * HALF_M / cell_m) + 1
    axis = np.arange(side) * cell_m - HALF_M
    z = rng.normal(0.0, 1.0, (side, side)).clip(-3.0, 3.0).astype(np.float32)
    for e_m, n_m, height in peaks:
        near = np.exp(-((axis[None, :] - e_m) ** 2 + (-axis[:, None] - n_m) ** 2) / (2 * 3.0**2))
        z = np.maximum(z, (height * near).astype(np.float32))
    return Surface(z, -HALF_M, HALF_M, cell_m)


def flat(value: float = 0.0) -> Surface:
    return Surface(np.full((401, 401), value, np.float32), -HALF_M, HALF_M, 1.0)


def mass_of(belief: Belief) -> float:
    return float(belief._mass.sum())


def test_a_belief_starts_with_the_given_mean_and_sigma() -> None:
    belief = Belief(30.0, -20.0, 15.0, CELL_M)
    mode = belief.mode()
    assert (mode.e_m, mode.n_m) == pytest.approx((30.0, -20.0), abs=CELL_M)
    ee, en, nn = belief.covariance()
    assert (ee**0.5, nn**0.5) == pytest.approx((15.0, 15.0), rel=0.05)
    assert abs(en) < 1.0


def test_mass_is_conserved_by_every_operation() -> None:
    belief = Belief(0.0, 0.0, 20.0, CELL_M)
    for i in range(16):
        belief.predict(3.0, -2.0, (0.0, 1.0, 30.0, 200.0)[i % 4])
        belief.update((surface([(0.0, 0.0, 4.0)], i),), 0.5)
        belief.fit_window(0.0)
        assert mass_of(belief) == pytest.approx(1.0, abs=1e-9)
        assert belief._mass.min() >= 0.0
        assert 0.0 < belief.mode().mass <= 1.0


def test_memory_does_not_grow_with_the_number_of_hypotheses() -> None:
    belief = Belief(0.0, 0.0, 500.0, CELL_M)
    one = surface([(0.0, 0.0, 4.0)])
    tracemalloc.start()
    try:
        belief.update((one,) * 40, 0.5)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 10 * belief._mass.nbytes


def test_one_observation_finds_the_position() -> None:
    belief = Belief(0.0, 0.0, 25.0, CELL_M)
    for i in range(3):
        belief.update((surface([(34.0, -22.0, 6.0)], i),), 1.0)
    mode = belief.mode()
    assert (mode.e_m, mode.n_m) == pytest.approx((34.0, -22.0), abs=3.0)
    assert mode.mass > 0.95


def test_two_similar_places_remain_two_modes() -> None:
    belief = Belief(0.0, 0.0, 40.0, CELL_M)
    for i in range(5):
        belief.update((surface([(40.0, 0.0, 6.0), (-40.0, 0.0, 6.0)], i),), 1.0)
    mode = belief.mode()
    assert 0.3 < mode.mass < 0.7
    assert mode.second_mass > 0.25
    ee, _, nn = belief.covariance()
    assert ee**0.5 > 25.0 > nn**0.5  # the covariance of the whole belief includes both modes


def test_a_mode_has_the_mass_within_its_radius_and_the_next_one_is_beyond_two_of_them() -> None:
    belief, rng = Belief(7.0, -3.0, 20.0, CELL_M), np.random.default_rng(4)
    mass = rng.random(belief._mass.shape)
    belief._mass, side = mass, len(mass)
    rows, columns = np.indices((side, side), sparse=True)
    for r, c in [(60, 50), (0, 0), (side - 1, 3), (40, side - 2)]:  # the border cuts the last three
        off = np.hypot(rows - r, columns - c)
        weights = mass / mass[off <= MODE_RADIUS_CELLS].sum() * (off <= MODE_RADIUS_CELLS)
        gathered = mass + 2.0 * side - off  # the largest values are near the mode
        before = gathered.copy()
        mode = belief._mode_at(r, c, gathered)
        assert mode.e_m == pytest.approx(belief._e0 + (weights * columns).sum() * CELL_M)
        assert mode.n_m == pytest.approx(belief._n0 - (weights * rows).sum() * CELL_M)
        assert mode.var_m2 == pytest.approx((weights * off**2).sum() / 2 * CELL_M**2)
        assert mode.second_mass == gathered[off > 2 * MODE_RADIUS_CELLS].max()
        assert (gathered == before).all()


def test_the_next_frame_discriminates_between_two_modes() -> None:
    belief = Belief(0.0, 0.0, 40.0, CELL_M)
    belief.update((surface([(40.0, 0.0, 6.0), (-40.0, 0.0, 6.0)]),), 1.0)
    belief.predict(20.0, 10.0, 1.0)
    belief.update((surface([(-20.0, 10.0, 6.0)], 1),), 1.0)
    mode = belief.mode()
    assert (mode.e_m, mode.n_m) == pytest.approx((-20.0, 10.0), abs=4.0)
    assert mode.mass > 0.9


@pytest.mark.parametrize(("east_m", "north_m"), [(7.0, 0.0), (0.0, -13.0), (131.3, 77.7)])
def test_prediction_shifts_the_belief(east_m: float, north_m: float) -> None:
    belief = Belief(5.0, 5.0, 10.0, CELL_M)
    before = belief.covariance()
    belief.predict(east_m, north_m, 0.0)
    mode = belief.mode()
    assert (mode.e_m, mode.n_m) == pytest.approx((5.0 + east_m, 5.0 + north_m), abs=0.2)
    assert belief.covariance() == pytest.approx(before)


@pytest.mark.parametrize("sigma_m", [3.0, 12.0, 40.0, 90.0])
def test_uncertain_motion_spreads_the_belief(sigma_m: float) -> None:
    belief = Belief(0.0, 0.0, 10.0, CELL_M)
    belief.fit_window(400.0)
    belief.predict(0.0, 0.0, sigma_m)
    ee, _, nn = belief.covariance()
    assert (ee**0.5, nn**0.5) == pytest.approx([np.hypot(10.0, sigma_m)] * 2, rel=0.08)


def test_a_wide_blur_equals_repeated_narrow_ones() -> None:
    rows, columns = np.mgrid[:241, :241]
    mass = sum(
        share * np.exp(-((rows - r) ** 2 + (columns - c) ** 2) / (2 * 5.0**2))
        for r, c, share in ((100, 130, 0.6), (140, 90, 0.4))
    )
    mass = mass / mass.sum()
    wide = _blurred(mass, 24.0)
    narrow = mass
    for _ in range(16):
        narrow = _blurred(narrow, 6.0)  # sigma^2 adds: 16 x 36 = 24^2
    wide, narrow = wide / wide.sum(), narrow / narrow.sum()
    assert np.abs(wide - narrow).sum() / 2 < 0.03  # total variation

    def centre(m: np.ndarray) -> tuple[float, float]:
        return float((m.sum(1) * np.arange(241)).sum()), float((m.sum(0) * np.arange(241)).sum())

    assert centre(wide) == pytest.approx(centre(mass), abs=1.0)


def test_no_position_is_excluded() -> None:
    """After a wrong start with full confidence, observations of the right position recover the belief."""
    belief = Belief(0.0, 0.0, 10.0, CELL_M)
    for i in range(20):
        belief.update((surface([(0.0, 0.0, 6.0)], i),), 1.0)
    assert belief.mode().mass > 0.99
    count = 0
    while np.hypot(belief.mode().e_m - 80.0, belief.mode().n_m - 50.0) > 5.0:
        belief.update((surface([(80.0, 50.0, 5.0)], 100 + count),), 1.0)
        count += 1
        assert count < 10
    assert count >= 2  # not with a single one


def test_a_low_weight_observation_changes_the_belief_little() -> None:
    full, repeated = Belief(0.0, 0.0, 40.0, CELL_M), Belief(0.0, 0.0, 40.0, CELL_M)
    peaks = [(40.0, 0.0, 5.0), (-40.0, 0.0, 4.0)]
    full.update((surface(peaks),), 1.0)
    repeated.update((surface(peaks),), 0.1)
    assert repeated.covariance()[0] > 2 * full.covariance()[0] or repeated.mode().mass < 0.5 * full.mode().mass


def test_positions_outside_the_map_count_slightly_worse_than_random_alignment() -> None:
    belief = Belief(0.0, 0.0, 30.0, CELL_M)
    z = flat().z.copy()
    z[:, :200] = np.nan  # the west is off the map
    belief.update((Surface(z, -HALF_M, HALF_M, 1.0),), 1.0)
    west = float(belief._mass[:, : belief._mass.shape[1] // 2].sum())
    assert 0.05 < west < 0.95


def test_of_several_hypotheses_the_best_counts_in_each_cell() -> None:
    belief = Belief(0.0, 0.0, 25.0, CELL_M)
    belief.update((flat(), surface([(20.0, 20.0, 6.0)]), flat(-2.0)), 1.0)
    assert (belief.mode().e_m, belief.mode().n_m) == pytest.approx((20.0, 20.0), abs=4.0)


@pytest.mark.parametrize("cell_m", [0.5, 1.0, 2.0, 5.0])
def test_the_peak_position_does_not_depend_on_the_cell_size(cell_m: float) -> None:
    belief = Belief(0.0, 0.0, 25.0, CELL_M)
    for i in range(3):
        belief.update((surface([(30.0, -10.0, 7.0)], i, cell_m),), 1.0)
    assert (belief.mode().e_m, belief.mode().n_m) == pytest.approx((30.0, -10.0), abs=max(3.0, cell_m))


def test_confirm_raises_only_the_given_mode() -> None:
    belief = Belief(0.0, 0.0, 40.0, CELL_M)
    belief.update((surface([(40.0, 0.0, 5.0), (-40.0, 0.0, 5.0)]),), 1.0)
    before = belief.mode()
    belief.confirm(before, 20.0)
    after = belief.mode()
    assert after.mass > before.mass and after.second_mass < before.second_mass
    assert (after.e_m, after.n_m) == pytest.approx((before.e_m, before.n_m), abs=MODE_RADIUS_CELLS * CELL_M / 2)
    assert mass_of(belief) == pytest.approx(1.0)


def test_the_window_follows_the_belief_and_is_bounded() -> None:
    belief = Belief(0.0, 0.0, 20.0, CELL_M)
    for _ in range(30):
        belief.predict(50.0, 0.0, 60.0)
        belief.fit_window(0.0)
    assert belief.half_m <= 1502.0
    assert len(belief._mass) <= 1503
    mode_e, _ = belief.centre
    assert mode_e == pytest.approx(1500.0, abs=10.0)
    belief.update((Surface(np.full((5, 5), np.nan, np.float32), 0.0, 0.0, 1.0),), 1.0)  # no information
    assert mass_of(belief) == pytest.approx(1.0)


@pytest.mark.parametrize("cell_m", [1.0, 4.0])
def test_set_cell_keeps_the_positions_of_all_modes(cell_m: float) -> None:
    belief = Belief(0.0, 0.0, 40.0, CELL_M)
    belief.update((surface([(52.0, 30.0, 6.0), (-40.0, -10.0, 5.5)]),), 1.0)
    before, cov = belief.mode(), belief.covariance()
    belief.set_cell(cell_m)
    after = belief.mode()
    assert mass_of(belief) == pytest.approx(1.0)
    assert belief.cell_m == cell_m
    assert (after.e_m, after.n_m) == pytest.approx((before.e_m, before.n_m), abs=max(2.0, cell_m))
    assert np.sqrt(belief.covariance()[0]) == pytest.approx(np.sqrt(cov[0]), rel=0.1)
    belief.update((surface([(52.0, 30.0, 6.0)], 1),), 1.0)  # updates continue to work
    assert (belief.mode().e_m, belief.mode().n_m) == pytest.approx((52.0, 30.0), abs=max(4.0, cell_m))


def test_the_cell_size_follows_the_height() -> None:
    sizes = [belief_cell_m(agl_m, 0.5) for agl_m in (30.0, 60.0, 100.0, 150.0, 300.0, 1000.0)]
    assert sizes == sorted(sizes)
    assert sizes[0] == 1.0 and belief_cell_m(100.0, 0.5) == 2.0 and sizes[-1] >= 16.0
    assert belief_cell_m(30.0, 8.0) >= 8.0  # not finer than the correlation's cells


def test_the_cell_size_of_a_wide_window_is_bounded() -> None:
    """A height near zero under a belief as wide as the map would need 133 GB."""
    belief = Belief(0.0, 0.0, 300.0, 8.0)
    half_m = belief.half_m
    belief.set_cell(0.05)
    assert belief.half_m == pytest.approx(half_m, rel=0.02) and belief.half_m / belief.cell_m <= MAX_HALF_CELLS + 1


def test_the_uniform_share_of_a_start_covers_the_whole_window() -> None:
    narrow, wide = Belief(0.0, 0.0, 20.0, 1.0), Belief(0.0, 0.0, 20.0, 1.0, uniform_share=0.01, min_half_m=300.0)
    assert narrow.half_m < 150.0 and wide.half_m == pytest.approx(300.0, abs=1.0)
    assert mass_of(wide) == pytest.approx(1.0)
    far = wide._mass[:100, :100]  # 200 m and more from the start, 10 sigmas
    assert far.sum() == pytest.approx(0.01 * far.size / wide._mass.size, rel=0.01)


def test_a_position_beyond_the_sigma_of_a_start_is_found_by_two_observations() -> None:
    belief = Belief(0.0, 0.0, 20.0, 1.0, uniform_share=1.0 / 400.0, min_half_m=160.0)
    there = surface([(140.0, 30.0, 6.0)])
    belief.update((there,), 1.0)
    belief.update((there,), 1.0)
    mode = belief.mode()
    assert np.hypot(mode.e_m - 140.0, mode.n_m - 30.0) < 2.0 and mode.mass > 0.5
