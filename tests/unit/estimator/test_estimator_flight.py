"""The estimator over simulated flights whose truth is known: accuracy, honesty, gates, absences, repetition."""

import msgspec
import numpy as np
import pytest

from map_matches import plane, with_pose, with_search
from simulated_flight import (
    FRAME_S,
    KEYFRAME_EVERY,
    ORIGIN,
    SPEED_MPS,
    Alter,
    EstimatorRun,
    Flight,
    altered,
    blind,
    cov_of,
    error_m,
    sigma_m,
    t_ns,
    without_fix,
    without_sight,
)
from terrafix.core.geodesy import rot_from_quat
from terrafix.core.pose import log_so3
from terrafix.messages import (
    CovarianceMode,
    Health,
    MapMatch,
    Message,
    NavEstimate,
    Odometry,
    Origin,
    Prediction,
    Refinement,
    SourceEnded,
    SourceLabel,
    ThermalBand,
    VehicleState,
    Verdict,
)


def health(band: ThermalBand) -> Health:
    return Health(t_ns=0, band=band, temperature_c=60.0, throttled=False, disk_free_mb=1000, cause="test")


# --- accuracy and honesty --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def long_flight() -> Flight:
    return Flight(300, seed=3)


@pytest.fixture(scope="module")
def long_run(long_flight: Flight) -> EstimatorRun:
    run = EstimatorRun().fly(long_flight, 0, 300)
    run.feed([SourceEnded(t_ns=t_ns(299), frames=300)])
    return run


@pytest.mark.slow
def test_the_position_is_right_in_the_whole_flight(long_flight: Flight, long_run: EstimatorRun) -> None:
    errors = [np.linalg.norm(error_m(long_run.estimate(i), long_flight)[:2]) for i in range(20, 300)]
    assert np.median(errors) < 4.0 and max(errors) < 15.0
    heights = [abs(error_m(long_run.estimate(i), long_flight)[2]) for i in range(20, 300)]
    assert np.median(heights) < 4.0


def test_the_covariance_is_consistent(long_flight: Flight, long_run: EstimatorRun) -> None:
    nees, inside = [], 0
    for i in range(10, 300):
        estimate = long_run.estimate(i)
        e = error_m(estimate, long_flight)[:2]
        nees.append(float(e @ np.linalg.solve(cov_of(estimate)[:2, :2], e)))
        inside += nees[-1] <= 5.991
    assert 0.5 < np.mean(nees) < 3.0  # 2 would be exact; the errors of neighbours are one error
    assert inside / len(nees) > 0.9


def test_every_covariance_is_one(long_run: EstimatorRun) -> None:
    for message in long_run.published:
        if isinstance(message, NavEstimate | Prediction):
            cov = np.array(message.cov).reshape(6, 6)
            assert np.allclose(cov, cov.T, rtol=1e-6, atol=1e-9)
            assert np.linalg.eigvalsh(cov).min() > 0.0


def test_the_attitude_is_right_and_its_sigma_consistent(long_flight: Flight, long_run: EstimatorRun) -> None:
    errors, claimed = [], []
    for i in range(20, 300):
        estimate = long_run.estimate(i)
        errors.append(log_so3(rot_from_quat(estimate.q_w_b) @ long_flight.r_w_b[i].T))
        claimed.append(cov_of(estimate).diagonal()[3:])
    assert np.degrees(np.abs(errors).max()) < 3.0
    assert (np.mean(np.square(errors) / claimed, axis=0) < 2.0).all()


def test_velocity_is_right(long_flight: Flight, long_run: EstimatorRun) -> None:
    errors = velocity_errors(long_flight, long_run)
    assert np.sqrt(np.mean(np.square(errors), axis=0)).max() < 1.7
    assert np.abs(np.mean(errors, axis=0)).max() < 0.4


def test_the_velocity_error_agrees_with_its_sigma(long_flight: Flight, long_run: EstimatorRun) -> None:
    """It goes to the autopilot as speed accuracy, and dead reckoning lives on it."""
    sigmas = np.array([long_run.estimate(i).velocity_sigma_mps for i in range(20, 299)])
    normalised = np.square(velocity_errors(long_flight, long_run)[:, :2] / sigmas[:, None])
    assert normalised.mean() < 2.0  # 1 would be exact


def velocity_errors(flight: Flight, run: EstimatorRun) -> np.ndarray:
    """(N, 3) from frame 20 on."""
    true = (flight.p_m[21:] - flight.p_m[19:-2]) / (2 * FRAME_S)
    return np.array([run.estimate(i).velocity_enu_mps for i in range(20, 299)]) - true


def test_a_step_is_claimed_as_well_as_it_is_seen(long_flight: Flight, long_run: EstimatorRun) -> None:
    """The anchor's belief and searches live on it. How the ground rises, which no map tells here, is no part of it."""
    predictions = [m for m in long_run.published if isinstance(m, Prediction) and m.frame_id > 20]
    sigmas_m = np.sqrt([m.step_cov_m2[0] for m in predictions])
    errors_m = [
        m.step_m - np.diff(long_flight.p_m[m.frame_id - 1 : m.frame_id + 1], axis=0)[0, :2] for m in predictions
    ]
    assert np.mean(np.square(errors_m) / sigmas_m[:, None] ** 2) < 1.5
    assert np.median(sigmas_m) < 0.2 * SPEED_MPS * FRAME_S


def test_a_step_is_claimed_no_wider_for_lying_far_from_its_keyframe() -> None:
    """What stretches all of the way since the keyframe (here a height known to a fifth, no map) stretches a step by its
    own share: steps that are alike are claimed alike."""
    flight, run = Flight(9, seed=4), EstimatorRun()
    run.fly(flight, 0, 9, without_fix, msgspec.structs.replace(ORIGIN, agl_sigma_m=20.0))
    sigmas_m = [m.step_cov_m2[0] ** 0.5 for m in run.published if isinstance(m, Prediction) and m.frame_id]
    assert max(sigmas_m) < 1.3 * min(sigmas_m)
    assert min(sigmas_m) > 0.15 * SPEED_MPS * FRAME_S  # that fifth is claimed


def test_an_error_of_a_keyframe_is_in_one_step_and_not_in_each_one_from_it() -> None:
    """The rays of one keyframe are all aside, as when its tilt is wrong: the ways of its frames share that."""
    first = 7 * KEYFRAME_EVERY + 1
    end = first + KEYFRAME_EVERY
    flight = Flight(end, seed=6)
    run = EstimatorRun().fly(flight, 0, first)
    for i in range(first, end):
        for message in flight.messages(i):
            if isinstance(message, Odometry):
                pairs = [(a + 0.06, b, c, d) for a, b, c, d in message.two_view]
                run.feed([msgspec.structs.replace(message, two_view=pairs)])
            elif not isinstance(message, MapMatch):
                run.feed([message])
    predictions = {m.frame_id: m for m in run.published if isinstance(m, Prediction)}
    off_m = [
        np.hypot(*(np.array(predictions[i].step_m) - np.diff(flight.p_m[i - 1 : i + 1], axis=0)[0, :2]))
        for i in predictions
        if i
    ]
    assert run.verdicts("odometry")[end - 1].verdict is Verdict.ACCEPTED
    assert off_m[first - 1] > 4.0
    assert max(off_m[first:]) < 1.5


def test_refined_poses_are_no_worse_and_whole(long_flight: Flight, long_run: EstimatorRun) -> None:
    last = [m for m in long_run.published if isinstance(m, Refinement)][-1]
    assert sorted(p.frame_id for p in last.poses) == list(range(300))
    refined, immediate, turned = [], [], []
    for pose in last.poses:
        estimate = long_run.estimate(pose.frame_id)
        assert pose.q_w_c is not None and pose.fragment_id == estimate.fragment_id >= 0
        cov = np.reshape(pose.cov, (6, 6))
        off_rad = log_so3(rot_from_quat(pose.q_w_c) @ long_flight.r_w_c[pose.frame_id].T)
        turned.append(off_rad @ np.linalg.solve(cov[3:, 3:], off_rad))
        assert (cov[0, 0], cov[0, 1]) == pytest.approx((pose.sigma_e_m**2, pose.cov_en_m2))
        immediate.append(np.linalg.norm(error_m(estimate, long_flight)[:2]))
        moved = msgspec.structs.replace(estimate, lat_deg=pose.lat_deg, lon_deg=pose.lon_deg)
        refined.append(np.linalg.norm(error_m(moved, long_flight)[:2]))
    assert np.mean(refined) <= np.mean(immediate)
    assert 0.1 < np.mean(turned) < 6.0  # 3 is expected; neighbours share their errors


def test_each_measurement_has_its_verdict_and_each_frame_its_estimate(long_run: EstimatorRun) -> None:
    assert sorted(long_run.verdicts("odometry")) == list(range(300))
    assert sorted(long_run.verdicts("map")) == list(range(0, 300, 9))
    assert {v.verdict for v in long_run.verdicts("map").values()} == {Verdict.ACCEPTED}
    assert {m.frame_id for m in long_run.published if isinstance(m, NavEstimate)} == set(range(300))


def test_label_and_age_of_the_last_fix(long_run: EstimatorRun) -> None:
    at, next_one, later = (long_run.estimate(i) for i in (90, 91, 98))
    assert (at.source_label, at.last_anchor_age_ms) == (SourceLabel.SATELLITE_ANCHORED, 0)
    assert (next_one.source_label, next_one.last_anchor_age_ms) == (SourceLabel.SATELLITE_ANCHORED, 500)
    assert (later.source_label, later.last_anchor_age_ms) == (SourceLabel.VISUAL_PROPAGATED, 4000)


def test_before_the_first_fix_there_is_no_age() -> None:
    run = EstimatorRun().fly(Flight(4), 0, 4, without_fix)
    assert run.estimate(3).last_anchor_age_ms == -1
    assert run.estimate(3).source_label is SourceLabel.VISUAL_PROPAGATED
    assert sigma_m(run.estimate(3)) > ORIGIN.start_sigma_m * 0.9


def test_two_runs_publish_the_same() -> None:
    flight = Flight(40, seed=5)
    runs = [EstimatorRun() for _ in range(2)]
    for run in runs:
        run.feed(flight.all_messages())
    assert msgspec.json.encode(runs[0].published) == msgspec.json.encode(runs[1].published)


# --- seeing nothing ----------------------------------------------------------------------------------------


def test_sigma_grows_while_nothing_is_seen() -> None:
    flight = Flight(60, seed=1)
    run = EstimatorRun().fly(flight, 0, 40).fly(flight, 40, 60, without_sight)
    sigmas = [sigma_m(run.estimate(i)) for i in range(39, 60)]
    assert (np.diff(sigmas) > 0).all()
    assert sigmas[-1] > 3 * sigmas[0] and sigmas[-1] > 10.0
    assert {run.estimate(i).source_label for i in range(40, 60)} == {SourceLabel.DEAD_RECKONED}
    for i in range(40, 60):
        assert np.linalg.norm(error_m(run.estimate(i), flight)[:2]) < 3.5 * sigma_m(run.estimate(i)) * np.sqrt(2)


def test_odometry_alone_drifts_less_than_nothing_at_all() -> None:
    flight = Flight(60, seed=1)
    seen, unseen = (
        EstimatorRun().fly(flight, 0, 40).fly(flight, 40, 60, alter) for alter in (without_fix, without_sight)
    )
    assert sigma_m(seen.estimate(59)) < 0.5 * sigma_m(unseen.estimate(59))
    drift = np.linalg.norm(error_m(seen.estimate(59), flight)[:2])
    assert drift < 0.1 * 20 * FRAME_S * SPEED_MPS + 5.0


def test_after_a_gap_a_fix_brings_it_back() -> None:
    flight = Flight(80, seed=2)
    run = EstimatorRun().fly(flight, 0, 30).fly(flight, 30, 60, without_sight)
    lost = np.linalg.norm(error_m(run.estimate(59), flight)[:2])
    run.fly(flight, 60, 80)
    assert run.verdicts("map")[63].verdict is Verdict.ACCEPTED
    found = np.linalg.norm(error_m(run.estimate(79), flight)[:2])
    assert found < 8.0 and (found < lost or lost < 8.0)


@pytest.mark.slow
@pytest.mark.parametrize("bad", [Verdict.BAD_IMAGE, Verdict.FEW_INLIERS, Verdict.NO_FEATURES])
def test_a_bad_frame_costs_that_frame_only(bad: Verdict) -> None:
    flight = Flight(40, seed=4)
    run = EstimatorRun().fly(flight, 0, 22)
    answers = run.feed([flight.messages(22)[0], blind(flight.messages(22)[1], bad)])
    assert run.verdicts("odometry")[22].verdict is bad
    assert any(isinstance(m, NavEstimate) for m in answers)  # the frame has a position, and it is honest
    assert any(isinstance(m, Prediction) for m in answers) == (bad is not Verdict.BAD_IMAGE)
    assert sigma_m(run.estimate(22)) > sigma_m(run.estimate(21))
    run.fly(flight, 23, 40)
    assert {run.verdicts("odometry")[i].verdict for i in range(23, 40)} == {Verdict.ACCEPTED}
    clean = EstimatorRun().fly(flight, 0, 40)
    for i in range(23, 40):
        with_it, without = (np.linalg.norm(error_m(r.estimate(i), flight)[:2]) for r in (run, clean))
        assert with_it < without + 3.0
        assert sigma_m(run.estimate(i)) < 1.3 * sigma_m(clean.estimate(i)) + 0.5


def test_a_keyframe_that_was_lost_is_replaced() -> None:
    """The frame that was to be the keyframe is bad, and later frames refer to one that the graph never had."""
    flight = Flight(40, seed=4)
    run = EstimatorRun().fly(flight, 0, 21).fly(flight, 22, 40)  # 21 never comes, and 22 to 24 refer to it
    verdicts = run.verdicts("odometry")
    assert Verdict.ACCEPTED not in {verdicts[i].verdict for i in (22, 23, 24)}
    # Frames that refer to a node which the graph never had are a fragment of their own until motion has joined it.
    assert {verdicts[i].verdict for i in range(28, 40)} == {Verdict.ACCEPTED}
    assert np.linalg.norm(error_m(run.estimate(39), flight)[:2]) < 10.0


# --- gates ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("away_m", [350.0, 80.0])
def test_a_fix_far_away_is_refused_and_the_next_right_one_taken(away_m: float) -> None:
    flight = Flight(60, seed=6)
    run = EstimatorRun().fly(flight, 0, 45)
    answers = run.feed([*altered(flight.messages(45), without_fix), flight.fix(45, (0.6 * away_m, 0.8 * away_m))])
    verdict = run.verdicts("map")[45]
    assert verdict.verdict is Verdict.INNOVATION
    assert verdict.mahalanobis2 is not None and verdict.mahalanobis2 > 22.5
    assert np.linalg.norm(error_m(run.estimate(45), flight)[:2]) < 12.0
    assert sum(isinstance(m, NavEstimate) for m in answers) == 1  # nothing new came of it
    run.feed([*altered(flight.messages(46), without_fix), flight.fix(46)])
    assert run.verdicts("map")[46].verdict is Verdict.ACCEPTED
    assert np.linalg.norm(error_m(run.estimate(46), flight)[:2]) < 8.0


def test_wrong_fixes_that_do_not_agree_are_all_refused() -> None:
    flight, rng = Flight(70, seed=7), np.random.default_rng(1)
    run = EstimatorRun().fly(flight, 0, 40)
    for i in range(40, 70):
        at = rng.uniform(-400.0, 400.0, 2) + np.sign(rng.normal(size=2)) * 100.0
        run.feed([*altered(flight.messages(i), without_fix), flight.fix(i, (float(at[0]), float(at[1])))])
        assert np.linalg.norm(error_m(run.estimate(i), flight)[:2]) < 40.0
    assert {run.verdicts("map")[i].verdict for i in range(40, 70)} == {Verdict.INNOVATION}


def test_one_mistake_seen_many_times_is_not_believed() -> None:
    """A hovering drone sees the same wrong place in every frame: that is one mistake, not evidence."""
    flight = Flight(60, seed=8, speed_mps=0.3)
    run = EstimatorRun().fly(flight, 0, 40)
    for i in range(40, 60):
        run.feed([*altered(flight.messages(i), without_fix), flight.fix(i, (200.0, 0.0))])
    assert {run.verdicts("map")[i].verdict for i in range(40, 60)} == {Verdict.INNOVATION}


def test_fixes_over_new_ground_that_agree_with_each_other_win() -> None:
    """The graph went astray; the map says so again and again along the way."""
    flight, offset = Flight(90, seed=9), (180.0, -140.0)
    run = EstimatorRun().fly(flight, 0, 30)
    restarted = -1
    for i in range(30, 90):
        fixes: list[Message] = [flight.fix(i, offset)] if i % 4 == 0 else []
        run.feed([*altered(flight.messages(i), without_fix), *fixes])
        if restarted < 0 and fixes and run.verdicts("map")[i].verdict is Verdict.ACCEPTED:
            restarted = i
    assert 40 <= restarted <= 70  # not on the first ones, and not never
    assert "restarted" in run.verdicts("map")[restarted].detail
    for i in (restarted, 89):
        assert np.linalg.norm(error_m(run.estimate(i), flight, offset)[:2]) < 10.0
    assert {run.verdicts("odometry")[i].verdict for i in range(restarted + 4, 90)} == {Verdict.ACCEPTED}


def coarsely_led(last: int) -> tuple[Flight, EstimatorRun, tuple[float, float]]:
    """Every fourth frame from 40 to ``last``, 24 m on each time, the belief's mode is elsewhere and no pose stands."""
    flight, away_m = Flight(80, seed=9), (180.0, -140.0)
    run = EstimatorRun().fly(flight, 0, 40)
    for i in range(40, 80):
        wrong: list[Message] = []
        if i % 4 == 0 and i <= last:
            wrong = [
                with_pose(msgspec.structs.replace(flight.fix(i, away_m), inliers=0, matches=[]), position_only=True)
            ]
        run.feed([*altered(flight.messages(i), without_fix), *wrong])
    return flight, run, away_m


def test_a_belief_that_went_astray_neither_moves_nor_widens_what_poses_have_placed() -> None:
    """A plane that landed over bare fields lost its fix so: four coarse matches 84 to 117 m aside, three of them
    over half a height, and below 30 m there are none that could speak against them."""
    flight, run, _ = coarsely_led(last=56)
    assert {run.verdicts("map")[i].verdict for i in range(40, 57, 4)} == {Verdict.INNOVATION}
    assert np.linalg.norm(error_m(run.estimate(57), flight)[:2]) < 12.0
    assert sigma_m(run.estimate(57)) < 15.0


def test_coarse_matches_that_would_find_a_position_do_and_the_old_place_is_not_forgotten() -> None:
    flight, run, away_m = coarsely_led(last=68)
    restarted = [i for i in range(40, 69, 4) if run.verdicts("map")[i].detail.startswith("restarted")]
    assert restarted == [60]  # the sixth, after 120 m at 100 m height
    estimate = run.estimate(62)
    assert np.linalg.norm(error_m(estimate, flight, away_m)[:2]) < 15.0
    off_m = error_m(estimate, flight)[:2]
    assert float(off_m @ np.linalg.solve(cov_of(estimate)[:2, :2], off_m)) < 9.0


def test_coarse_matches_confirm_another_place_that_poses_have_shown() -> None:
    """Rows led a flight aside, and where they end no pose stands."""
    flight, away_m = Flight(60, seed=9), (180.0, -140.0)
    run = EstimatorRun().fly(flight, 0, 40)
    for i in range(40, 60):
        wrong = flight.fix(i, away_m)
        if i >= 42:
            wrong = with_pose(msgspec.structs.replace(wrong, inliers=0, matches=[]), position_only=True)
        run.feed([*altered(flight.messages(i), without_fix), wrong])
    restarted = [i for i in range(40, 60) if run.verdicts("map")[i].detail.startswith("restarted")]
    assert len(restarted) == 1 and 48 < restarted[0] < 52  # after half of the height
    assert min(sigma_m(run.estimate(i)) for i in range(41, 60)) > 50.0


@pytest.mark.parametrize(("inliers", "second"), [(30, Verdict.ACCEPTED), (15, Verdict.INNOVATION)])
def test_a_start_that_nothing_confirmed_is_left_for_two_clear_poses(inliers: int, second: Verdict) -> None:
    flight, offset = Flight(40, seed=9, speed_mps=3.0), (120.0, -90.0)
    run = EstimatorRun()
    run.feed([ORIGIN])
    for i in range(40):
        fixes = [msgspec.structs.replace(flight.fix(i, offset), inliers=inliers)] if i in (20, 22) else []
        run.feed([*altered(flight.messages(i), without_fix), *fixes])
    assert run.verdicts("map")[20].verdict is Verdict.INNOVATION and run.verdicts("map")[22].verdict is second
    error = error_m(run.estimate(39), flight, offset)[:2]
    assert (np.linalg.norm(error) < 15.0) == (second is Verdict.ACCEPTED)
    assert sigma_m(run.estimate(39)) > 50.0  # it may still be the other one


def test_a_place_that_was_found_late_is_carried_to_the_newest_frame() -> None:
    """A search answers about a frame from two seconds ago; the vehicle has flown on since."""
    flight, offset = Flight(60, seed=9), (480.0, -340.0)
    run = EstimatorRun().fly(flight, 0, 30).fly(flight, 30, 41, without_fix)
    found = with_search(flight.fix(36, offset), relocalized=True)
    estimates = [m for m in run.feed([found]) if isinstance(m, NavEstimate)]
    assert [(m.frame_id, m.last_anchor_age_ms) for m in estimates] == [(40, 2000)]
    for i in range(40, 60):
        if i > 40:
            run.feed(altered(flight.messages(i), without_fix))
        off_m = error_m(run.estimate(i), flight, offset)[:2]
        assert np.linalg.norm(off_m) < 15.0 + 0.5 * (i - 40)
        assert off_m @ np.linalg.solve(cov_of(run.estimate(i))[:2, :2], off_m) < 12.0
    assert {run.verdicts("odometry")[i].verdict for i in range(45, 60)} == {Verdict.ACCEPTED}


@pytest.mark.parametrize("why", [Verdict.AMBIGUOUS, Verdict.FEW_INLIERS, Verdict.OUTSIDE_MAP])
def test_what_the_anchor_refused_does_not_enter(why: Verdict) -> None:
    flight = Flight(30, seed=1)
    run = EstimatorRun().fly(flight, 0, 30)
    before = run.estimate(29)
    answers = run.feed([msgspec.structs.replace(flight.fix(29, (100.0, 0.0)), verdict=why)])
    assert run.verdicts("map")[29].verdict is why
    assert not any(isinstance(m, NavEstimate) for m in answers) and run.estimate(29) == before


# --- what is not known ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "knows", [set(), {"yaw"}, {"height"}, {"yaw", "height"}, {"yaw", "attitude"}, {"attitude", "height"}]
)
def test_whatever_is_missing_the_flight_goes_on(knows: set[str]) -> None:
    flight = Flight(70, seed=11, telemetry=frozenset(knows))
    run = EstimatorRun().fly(flight, 0, 70)
    assert {v.verdict for v in run.verdicts("map").values()} == {Verdict.ACCEPTED}
    errors = [np.linalg.norm(error_m(run.estimate(i), flight)[:2]) for i in range(30, 70)]
    assert np.median(errors) < 8.0 and max(errors) < 25.0
    for i in range(30, 70):
        e, cov = error_m(run.estimate(i), flight)[:2], cov_of(run.estimate(i))[:2, :2]
        assert e @ np.linalg.solve(cov, e) < 20.0


def test_no_telemetry_at_all() -> None:
    flight = Flight(40, seed=12)
    run = EstimatorRun().fly(flight, 0, 40, lambda m: None if isinstance(m, VehicleState) else m)
    assert np.linalg.norm(error_m(run.estimate(39), flight)[:2]) < 15.0


def test_nothing_is_published_before_the_origin() -> None:
    assert EstimatorRun().feed(Flight(3).messages(0)) == []


# --- covariance modes -------------------------------------------------------------------------------------------


def test_the_mode_changes_with_the_next_frame_and_back() -> None:
    flight = Flight(40, seed=2)
    run = EstimatorRun().fly(flight, 0, 15)
    run.feed([health(ThermalBand.CRITICAL)])
    run.fly(flight, 15, 25)
    run.feed([health(ThermalBand.NORMAL)])
    run.fly(flight, 25, 40)
    modes = [run.estimate(i).covariance_mode for i in range(40)]
    assert set(modes[15:25]) == {CovarianceMode.JACOBIAN}
    assert set(modes[:15] + modes[25:]) == {CovarianceMode.MARGINALS}
    calm = EstimatorRun().fly(flight, 0, 40)
    for i in range(25, 40):  # the switch leaves no trace but in how far legs seemed to be in their tail meanwhile
        assert sigma_m(run.estimate(i)) == pytest.approx(sigma_m(calm.estimate(i)), rel=0.05)


# --- restarts ------------------------------------------------------------------------------------------------------


def test_the_same_origin_again_changes_nothing() -> None:
    flight = Flight(30, seed=3)
    once, twice = EstimatorRun().fly(flight, 0, 30), EstimatorRun().fly(flight, 0, 20)
    assert twice.feed([msgspec.json.decode(msgspec.json.encode(ORIGIN), type=Origin)]) == []
    twice.fly(flight, 20, 30)
    assert msgspec.json.encode(once.published) == msgspec.json.encode(twice.published)


def test_another_origin_begins_another_flight() -> None:
    flight = Flight(30, seed=3)
    run = EstimatorRun().fly(flight, 0, 20)
    run.feed([msgspec.structs.replace(ORIGIN, t_ns=5)])
    run.feed(altered(flight.messages(20), without_fix))
    estimate = run.estimate(20)
    assert estimate.last_anchor_age_ms == -1 and sigma_m(estimate) > 10.0


def of_map(**changes: object) -> Alter:
    """Map matches with other fields."""
    return lambda m: msgspec.structs.replace(m, **changes) if isinstance(m, MapMatch) else m


def test_the_error_of_the_map_is_added_once_a_map_has_placed_us() -> None:
    """... in position, whole, and not before: a start coordinate does not come from the map."""
    exact, off = (EstimatorRun().fly(Flight(30), 0, 30, of_map(map_sigma_m=sigma_m)) for sigma_m in (0.0, 5.0))
    first = [next(m for m in run.published if isinstance(m, NavEstimate)) for run in (exact, off)]
    assert first[0].cov == first[1].cov
    added = cov_of(off.estimate(29)) - cov_of(exact.estimate(29))
    assert added[0, 0] == pytest.approx(added[1, 1], rel=0.05)
    assert 25.0 <= added[0, 0] < 30.0  # and a little for what that error bends within one picture


def test_over_hills_odometry_is_trusted_less() -> None:
    """What the ground departs from the plane moves all tracked points together: it does not average out."""
    flight, claims = Flight(30), []
    for relief_m in (0.0, 8.0):
        run = EstimatorRun().fly(flight, 0, 10, of_map(ground=plane(0.0, relief_m=relief_m)))
        claims.append(sigma_m(run.fly(flight, 10, 30, without_fix).estimate(29)))
    assert claims[1] > 1.1 * claims[0]


def test_a_vehicle_that_is_not_armed_stays_where_it_was() -> None:
    """Nothing can be tracked on the ground; a minute there must not look like a minute of flight."""
    claims = {}
    for armed in (False, True):
        run = EstimatorRun()
        run.feed([ORIGIN])
        for i in range(120):
            state = VehicleState(t_ns=t_ns(i), source="mavlink", yaw_rad=0.3, pitch_rad=0.0, roll_rad=0.0, armed=armed)
            run.feed([state, Odometry(t_ns=t_ns(i), frame_id=i, keyframe_id=i, verdict=Verdict.NO_FEATURES)])
        claims[armed] = sigma_m(run.estimate(119))
    assert claims[False] < ORIGIN.start_sigma_m + 2.0
    assert claims[True] > 3.0 * claims[False]


def test_telemetry_that_begins_after_the_first_frame_is_a_new_beginning() -> None:
    """At a start in the air the first picture may come before the autopilot's first words."""
    flight = Flight(40, seed=5)
    run = EstimatorRun()
    run.feed([ORIGIN])
    for i in range(40):
        messages = flight.messages(i)
        if i == 0:
            messages = [m for m in messages if not isinstance(m, VehicleState | MapMatch)]
        run.feed(altered(messages, without_fix) if i < 3 else messages)
    errors = [float(np.linalg.norm(error_m(run.estimate(i), flight)[:2])) for i in range(10, 40)]
    heights = [abs(error_m(run.estimate(i), flight)[2]) for i in range(1, 40)]
    assert max(errors) < 15.0 and max(heights) < 30.0
