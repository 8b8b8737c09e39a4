"""Position mixture: withdrawal of a wrong position, relocalization, and modes of the belief."""

import msgspec
import numpy as np
import pytest

from map_matches import with_search
from simulated_flight import FRAME_S, ORIGIN, SPEED_MPS, EstimatorRun, Flight, cov_of, error_m, sigma_m
from terrafix.core.gate import MIN_COMPONENT_WEIGHT
from terrafix.estimator.integrity.position_hypotheses import PositionHypotheses
from terrafix.messages import (
    BeliefMode,
    BeliefSummary,
    MapMatch,
    Message,
    Refinement,
    SearchResult,
    SearchStep,
    SourceEnded,
    Verdict,
)

WRONG_M = (700.0, -500.0)
LOST_SIGMA_M = 900.0


def lost(match: MapMatch, step: SearchStep = SearchStep.WIDEN) -> MapMatch:
    return with_search(msgspec.structs.replace(match, verdict=Verdict.LOST, pose=None), step=step, sigma_m=LOST_SIGMA_M)


def silent(match: MapMatch) -> MapMatch:
    return msgspec.structs.replace(match, verdict=Verdict.BAD_IMAGE, pose=None)


def with_map(flight: Flight, i: int, match: MapMatch) -> list[Message]:
    return [m for m in flight.messages(i) if not isinstance(m, MapMatch)] + [match]


def flown_wrong(flight: Flight) -> EstimatorRun:
    """30 frames at a position with an error of 860 m and a small covariance, then ten matches with LOST."""
    run = EstimatorRun().fly(flight, 0, 1)
    for i in range(1, 30):
        run.feed(with_map(flight, i, flight.fix(i)))
    for i in range(30, 40):
        run.feed(with_map(flight, i, lost(flight.fix(i))))
    return run


def test_a_lost_match_inflates_the_position_covariance_to_the_lost_sigma() -> None:
    flight = Flight(60, seed=3)
    run = flown_wrong(flight)
    assert sigma_m(run.estimate(29)) < 10.0
    for i in range(30, 40):
        assert sigma_m(run.estimate(i)) > 0.99 * LOST_SIGMA_M
        assert run.verdicts("map")[i].verdict is Verdict.LOST
        assert run.verdicts("map")[i].detail == "lost; search: widen"
        assert run.verdicts("odometry")[i].verdict is Verdict.ACCEPTED  # odometry continues
        assert np.linalg.eigvalsh(cov_of(run.estimate(i))).min() > 0.0
    step = error_m(run.estimate(39), flight)[:2] - error_m(run.estimate(30), flight)[:2]
    assert np.linalg.norm(step) < 0.1 * 9 * FRAME_S * SPEED_MPS


def test_a_relocalized_match_resets_the_position_at_once() -> None:
    flight = Flight(60, seed=3, dem=True)
    run = flown_wrong(flight)
    found = with_search(flight.fix(40, WRONG_M), relocalized=True)
    run.feed(with_map(flight, 40, found))
    verdict = run.verdicts("map")[40]
    assert verdict.verdict is Verdict.ACCEPTED and "found 8" in verdict.detail
    assert np.linalg.norm(error_m(run.estimate(40), flight, WRONG_M)[:2]) < 20.0
    assert sigma_m(run.estimate(40)) < 15.0
    for i in range(41, 60):
        run.feed(with_map(flight, i, flight.fix(i, WRONG_M)))
        assert np.linalg.norm(error_m(run.estimate(i), flight, WRONG_M)[:2]) < 4 * sigma_m(run.estimate(i)) + 5.0
    assert sigma_m(run.estimate(59)) < 8.0


def test_a_relocalized_place_under_verification_keeps_its_lost_sigma_until_that_is_withdrawn() -> None:
    flight = Flight(60, seed=3, dem=True)
    run = flown_wrong(flight)
    found = with_search(flight.fix(40, WRONG_M), relocalized=True, sigma_m=700.0)
    run.feed(with_map(flight, 40, found))
    assert run.verdicts("map")[40].verdict is Verdict.ACCEPTED
    assert 700.0 <= sigma_m(run.estimate(40)) < 720.0
    run.feed(with_map(flight, 41, with_search(flight.fix(41, WRONG_M), sigma_m=200.0)))
    assert 200.0 <= sigma_m(run.estimate(41)) < 220.0
    run.feed(with_map(flight, 42, flight.fix(42, WRONG_M)))
    assert sigma_m(run.estimate(42)) < 15.0


@pytest.mark.parametrize(
    ("offset_m", "start_sigma_m", "recorded"), [(700.0, 15.0, True), (20.0, 15.0, False), (700.0, 5000.0, False)]
)
def test_a_contradiction_of_start_and_map_is_recorded(offset_m: float, start_sigma_m: float, recorded: bool) -> None:
    flight, run = Flight(6, seed=3), EstimatorRun()
    run.feed([msgspec.structs.replace(ORIGIN, start_sigma_m=start_sigma_m)])
    for i in range(5):
        run.feed(with_map(flight, i, lost(flight.fix(i))))
    run.feed(with_map(flight, 5, with_search(flight.fix(5, (offset_m, 0.0)), relocalized=True)))
    verdicts = run.verdicts("start")
    assert list(verdicts) == ([5] if recorded else [])
    if recorded:
        assert verdicts[5].verdict is Verdict.INNOVATION and "start and map are 7" in verdicts[5].detail


def test_a_later_relocalization_is_not_compared_with_the_start() -> None:
    flight = Flight(60, seed=3, dem=True)
    run = flown_wrong(flight)
    run.feed(with_map(flight, 40, with_search(flight.fix(40, WRONG_M), relocalized=True)))
    assert run.verdicts("start") == {}


def test_the_same_fix_without_relocalization_is_rejected() -> None:
    flight = Flight(60, seed=3)
    run = flown_wrong(flight)
    with_lost_sigma = with_search(flight.fix(40, WRONG_M), sigma_m=LOST_SIGMA_M)
    run.feed(with_map(flight, 40, with_lost_sigma))
    assert run.verdicts("map")[40].verdict is Verdict.INNOVATION
    assert sigma_m(run.estimate(40)) > 0.99 * LOST_SIGMA_M


def test_the_lost_sigma_of_the_anchor_inflates_the_horizontal_axes_only() -> None:
    hypotheses = PositionHypotheses()
    asked = SearchResult(step=SearchStep.ASK, sigma_m=LOST_SIGMA_M)
    assert hypotheses.on_match(Verdict.LOST, asked) == "lost; search: ask"
    _, cov = hypotheses.claim(np.eye(6))
    assert cov[0, 0] == 1.0 + LOST_SIGMA_M**2 and cov[2, 2] == 1.0
    assert hypotheses.on_match(Verdict.ACCEPTED, SearchResult(sigma_m=5.0)) == ""
    assert hypotheses.claim(np.eye(6))[1][1, 1] == 26.0
    hypotheses.on_match(Verdict.ACCEPTED, SearchResult())
    at_m, cov = hypotheses.claim(np.eye(6))
    assert (cov == np.eye(6)).all() and (at_m == 0.0).all()


HEIGHT_M, MODE_VAR_M2 = 100.0, 4.0
MODE_M2 = MODE_VAR_M2 + 3.0**2  # 3 % of the height: 1-sigma of a mode without tilt uncertainty
BELIEF = (50.0, 20.0), (9000.0, 0.0, 0.0, 400.0)  # mean and covariance of the belief; the estimate is at (10, 20)


def with_modes(sigma_m: float, *modes: tuple[float, float, float], cov: np.ndarray | None = None) -> PositionHypotheses:
    """An estimate at (10, 20) with ``sigma_m`` or ``cov`` (6, 6), and modes: offset east and north, mass."""
    hypotheses = PositionHypotheses()
    seen = [BeliefMode(e_m=10.0 + e, n_m=20.0 + n, mass=mass, variance_m2=MODE_VAR_M2) for e, n, mass in modes]
    cov = np.diag([sigma_m**2] * 3 + [0.0] * 3) if cov is None else cov
    belief = BeliefSummary(mean_m=BELIEF[0], cov_m2=BELIEF[1], modes=seen, mode_score=5.0)
    hypotheses.update_modes(belief, np.array([10.0, 20.0, HEIGHT_M]), cov, HEIGHT_M)
    return hypotheses


def test_the_leading_mode_of_a_wide_belief_is_published_with_the_second_moments_about_it() -> None:
    hypotheses = with_modes(60.0, (300.0, 0.0, 0.7))
    at_m, cov = hypotheses.claim(np.diag([3600.0] * 3 + [0.01] * 3))
    assert at_m.tolist() == [300.0, 0.0] and hypotheses.is_multimodal
    assert cov[0, 0] == pytest.approx(
        0.3 * (3600.0 + 300.0**2) + 0.7 * MODE_M2
    )  # the prior has larger moments than the belief
    assert cov[1, 1] == pytest.approx(0.3 * 3600.0 + 0.7 * MODE_M2)
    assert cov[3, 3] == 0.01


def test_the_weight_of_a_mode_without_a_pose_is_limited() -> None:
    _, cov = with_modes(60.0, (300.0, 0.0, 0.99)).claim(np.diag([3600.0] * 3 + [0.01] * 3))
    assert cov[0, 0] == pytest.approx(0.2 * (3600.0 + 300.0**2) + 0.8 * MODE_M2)


@pytest.mark.parametrize(("mass", "second", "leads"), [(0.26, 0.1, True), (0.24, 0.06, False), (0.4, 0.17, False)])
def test_a_leading_mode_needs_a_minimum_mass_and_a_ratio_to_the_second_mode(
    mass: float, second: float, leads: bool
) -> None:
    at_m, _ = with_modes(60.0, (300.0, 0.0, mass), (-200.0, 0.0, second)).claim(np.diag([3600.0] * 3 + [0.01] * 3))
    assert at_m.tolist() == ([300.0, 0.0] if leads else [0.0, 0.0])


def test_without_a_leading_mode_the_moments_of_the_belief_about_the_estimate_are_published() -> None:
    at_m, cov = with_modes(60.0, (300.0, 0.0, 0.2)).claim(np.diag([3600.0] * 3 + [0.01] * 3))
    assert at_m.tolist() == [0.0, 0.0]
    assert cov[0, 0] == pytest.approx(9000.0 + 40.0**2) and cov[1, 1] == pytest.approx(400.0)


def test_a_belief_narrower_than_the_estimate_does_not_reduce_the_covariance() -> None:
    at_m, cov = with_modes(200.0, (30.0, 0.0, 0.2)).claim(np.diag([40000.0] * 3 + [0.01] * 3))
    assert at_m.tolist() == [0.0, 0.0] and cov[0, 0] == cov[1, 1] == 40000.0


def test_a_mode_elsewhere_does_not_move_the_position_of_a_placed_graph() -> None:
    at_m, cov = with_modes(5.0, (300.0, 0.0, 0.8)).claim(np.diag([25.0] * 3 + [0.01] * 3))
    assert at_m.tolist() == [0.0, 0.0]
    assert cov[0, 0] == pytest.approx(0.2 * 25.0 + 0.8 * (300.0**2 + MODE_M2))


def test_a_mode_at_a_placed_graph_and_one_of_negligible_weight_have_no_effect() -> None:
    hypotheses = with_modes(5.0, (10.0, -10.0, 0.9), (300.0, 0.0, 0.9 * MIN_COMPONENT_WEIGHT))
    at_m, cov = hypotheses.claim(np.eye(6))
    assert at_m.tolist() == [0.0, 0.0] and (cov == np.eye(6)).all() and not hypotheses.is_multimodal
    assert with_modes(5.0, (30.0, 0.0, 0.9)).is_multimodal


@pytest.mark.parametrize(("mass", "counts"), [(0.04, False), (0.06, True)])
def test_modes_below_5_percent_of_the_mass_are_ignored(mass: float, counts: bool) -> None:
    assert with_modes(5.0, (300.0, 0.0, mass)).is_multimodal is counts


@pytest.mark.parametrize(
    ("east_m", "north_m", "placed"), [(14.0, 14.0, True), (16.0, 16.0, False), (5.0, 16.0, False), (16.0, 5.0, False)]
)
def test_a_graph_is_placed_if_its_largest_sigma_is_below_15_percent_of_the_height(
    east_m: float, north_m: float, placed: bool
) -> None:
    cov = np.diag([east_m**2, north_m**2, 1.0, 0.0, 0.0, 0.0])
    at_m, _ = with_modes(0.0, (300.0, 0.0, 0.7), cov=cov).claim(cov)
    assert at_m.tolist() == ([0.0, 0.0] if placed else [300.0, 0.0])


def test_the_tilt_uncertainty_widens_modes_and_belief() -> None:
    """At 100 m, 0.2 rad about north are 20 m to the east; 0.1 rad about east are 10 m to the north."""
    tilted = np.diag([3600.0, 3600.0, 1.0, 0.1**2, 0.2**2, 0.0])
    cov = np.diag([3600.0] * 3 + [0.01] * 3)
    lever_m2 = (
        with_modes(60.0, (300.0, 0.0, 0.7), cov=tilted).claim(cov)[1]
        - with_modes(60.0, (300.0, 0.0, 0.7)).claim(cov)[1]
    )
    assert np.diag(lever_m2)[:2] == pytest.approx([0.7 * 20.0**2, 0.7 * 10.0**2])
    belief_m2 = with_modes(60.0, (300.0, 0.0, 0.2), cov=tilted).claim(cov)[1]
    assert np.diag(belief_m2)[:2] == pytest.approx([9000.0 + 40.0**2 + 20.0**2, 400.0 + 10.0**2])
    near = np.diag([25.0, 25.0, 1.0, 0.1**2, 0.2**2, 0.0])
    assert (
        not with_modes(5.0, (60.0, 0.0, 0.9), cov=near).is_multimodal
        and with_modes(5.0, (60.0, 0.0, 0.9)).is_multimodal
    )


def test_two_modes_elsewhere_and_a_placed_estimate_are_weighted_by_mass() -> None:
    at_m, cov = with_modes(5.0, (300.0, 0.0, 0.3), (0.0, -400.0, 0.2)).claim(np.diag([25.0] * 3 + [0.01] * 3))
    assert at_m.tolist() == [0.0, 0.0]
    assert cov[0, 0] == pytest.approx(0.5 * 25.0 + 0.3 * (300.0**2 + MODE_M2) + 0.2 * MODE_M2)
    assert cov[1, 1] == pytest.approx(0.5 * 25.0 + 0.3 * MODE_M2 + 0.2 * (400.0**2 + MODE_M2))


@pytest.mark.parametrize(
    ("sigma_m", "modes"),
    [
        (60.0, [(300.0, 0.0, 0.7)]),  # a leading mode
        (60.0, [(300.0, 0.0, 0.2)]),  # a wide belief without one
        (200.0, [(30.0, 0.0, 0.7)]),  # a prior wider than the belief
        (14.0, [(300.0, 0.0, 0.4), (0.0, 300.0, 0.5)]),  # modes elsewhere and a placed graph
    ],
)
def test_the_published_covariance_is_positive_definite_for_correlated_position_and_attitude(
    sigma_m: float, modes: list[tuple[float, float, float]]
) -> None:
    cov = np.diag([sigma_m**2] * 2 + [4.0] + [0.01] * 3)
    for place, angle in ((0, 4), (1, 3)):
        cov[place, angle] = cov[angle, place] = 0.99 * sigma_m * 0.1
    _, published = with_modes(sigma_m, *modes).claim(cov)
    assert np.linalg.eigvalsh(published).min() > 0.0 and (published == published.T).all()


def test_a_mode_elsewhere_widens_with_the_estimate_and_does_not_narrow_with_it() -> None:
    hypotheses = with_modes(5.0, (300.0, 0.0, 0.4))
    published = [hypotheses.claim(np.diag([var_m2] * 3 + [0.01] * 3))[1][1, 1] for var_m2 in (25.0, 125.0, 5.0)]
    assert published == pytest.approx(
        [0.6 * 25.0 + 0.4 * MODE_M2, 0.6 * 125.0 + 0.4 * (MODE_M2 + 100.0), 3.0 + 0.4 * MODE_M2]
    )


@pytest.mark.parametrize("mass", [0.7, 0.2])
def test_between_matches_the_belief_widens_with_the_estimate(mass: float) -> None:
    hypotheses = with_modes(60.0, (300.0, 0.0, mass))
    wide, wider = np.diag([3600.0] * 3 + [0.01] * 3), np.diag([3600.0, 5000.0] + [3600.0] + [0.01] * 3)
    at_m, before = hypotheses.claim(wide)
    now_m, now = hypotheses.claim(wider)
    assert now_m.tolist() == at_m.tolist()
    assert now[:2, :2] - before[:2, :2] == pytest.approx(np.diag([0.0, 1400.0]))


def test_an_accepted_match_clears_all_modes() -> None:
    hypotheses = with_modes(60.0, (300.0, 0.0, 0.7))
    hypotheses.on_match_accepted()
    assert (hypotheses.claim(np.eye(6))[1] == np.eye(6)).all()


def test_the_leading_mode_is_published_while_the_graph_has_no_pose() -> None:
    """A start with an error of 300 m and a sigma of 100 m; ambiguous matches with the heaviest mode at the truth."""
    flight = Flight(12, seed=3)
    run = EstimatorRun()
    run.feed([msgspec.structs.replace(ORIGIN, start_sigma_m=100.0, lat_deg=ORIGIN.lat_deg, lon_deg=ORIGIN.lon_deg)])
    for i in range(12):
        at = flight.p_m[i] + np.array([300.0, 0.0, 0.0])  # the position on the map
        mode = BeliefMode(e_m=float(at[0]), n_m=float(at[1]), mass=0.7, variance_m2=MODE_VAR_M2)
        belief = BeliefSummary(mean_m=(mode.e_m, mode.n_m), cov_m2=(0.0,) * 4, modes=[mode], mode_score=5.0)
        match = msgspec.structs.replace(flight.fix(i), verdict=Verdict.AMBIGUOUS, belief=belief)
        run.feed(with_map(flight, i, match))
    error = error_m(run.estimate(11), flight, (300.0, 0.0))[:2]
    assert np.linalg.norm(error) < 25.0
    assert 80.0 < sigma_m(run.estimate(11)) < 250.0


def flown_without_a_pose(start_sigma_m: float, frames: int) -> tuple[Flight, EstimatorRun]:
    """Textured ground is correlated with the map in each frame from the start on, and no pose is found."""
    flight, run = Flight(frames + 2, seed=3), EstimatorRun()
    run.feed([msgspec.structs.replace(ORIGIN, start_sigma_m=start_sigma_m)])
    for i in range(frames):
        run.feed(with_map(flight, i, msgspec.structs.replace(flight.fix(i), verdict=Verdict.FEW_INLIERS, pose=None)))
    return flight, run


@pytest.mark.parametrize(("start_sigma_m", "away_m"), [(20.0, 160.0), (90.0, 500.0)])
def test_a_start_where_correlations_find_no_pose_may_be_as_wrong_as_eight_of_its_sigmas(
    start_sigma_m: float, away_m: float
) -> None:
    _, run = flown_without_a_pose(start_sigma_m, 6)
    first, last = sigma_m(run.estimate(0)), sigma_m(run.estimate(5))
    wrong = (last**2 - first**2) / (away_m**2 / 3.0)  # probability, of a uniform distribution
    assert 0.1 < wrong < 0.75


def test_the_first_pose_on_the_map_ends_the_doubt_about_the_start() -> None:
    flight, run = flown_without_a_pose(20.0, 6)
    for i in (6, 7):
        run.feed(with_map(flight, i, flight.fix(i)))
    assert sigma_m(run.estimate(7)) < 15.0


def test_a_lost_sigma_of_an_ambiguous_match_inflates_the_covariance_before_the_place_is_lost() -> None:
    flight = Flight(30, seed=3)
    run = EstimatorRun().fly(flight, 0, 20)
    match = msgspec.structs.replace(flight.fix(20), verdict=Verdict.AMBIGUOUS, search=SearchResult(sigma_m=134.0))
    run.feed(with_map(flight, 20, match))
    run.feed(with_map(flight, 21, match))
    assert sigma_m(run.estimate(21)) > 134.0


def test_an_unknown_start_has_its_full_sigma_from_the_first_frame_and_the_flight_is_refined() -> None:
    flight = Flight(30, seed=3)
    run = EstimatorRun()
    run.feed([msgspec.structs.replace(ORIGIN, start_sigma_m=5000.0)])
    run.feed(flight.messages(0)[:2])
    for i in range(1, 10):
        run.feed(with_map(flight, i, lost(flight.fix(i)) if i % 2 else silent(flight.fix(i))))
    assert min(sigma_m(run.estimate(i)) for i in range(10)) > 5000.0
    run.feed(with_map(flight, 10, with_search(flight.fix(10, WRONG_M), relocalized=True)))
    for i in range(11, 30):
        run.feed(with_map(flight, i, flight.fix(i, WRONG_M)))
    assert np.linalg.norm(error_m(run.estimate(29), flight, WRONG_M)[:2]) < 10.0
    run.feed([SourceEnded(t_ns=0, frames=30)])
    (refined,) = [m for m in run.published if isinstance(m, Refinement)]
    assert [pose.frame_id for pose in refined.poses] == list(range(10, 30))  # before the find, nothing places them
