"""Monte Carlo flights with false inputs: times and sizes of each."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from terrafix.messages import MapMatch, Prediction, SearchStep, Verdict
from terrafix_lab.montecarlo import lies as of
from terrafix_lab.montecarlo.fault import LIES, DrawnFault
from terrafix_lab.montecarlo.flown import Shot, SimulatedFlight, fly
from terrafix_lab.montecarlo.ground import Terrain
from terrafix_lab.montecarlo.lies import Lies, Search
from terrafix_lab.montecarlo.plan import FlightPlan, plan

SHORT_S = 60.0
FOUND = MapMatch(t_ns=0, frame_id=0, verdict=Verdict.ACCEPTED, matcher="gradient", inliers=20)
NOTHING = MapMatch(t_ns=0, frame_id=0, verdict=Verdict.AMBIGUOUS, matcher="gradient")
PREDICTION = Prediction(
    t_ns=0, frame_id=0, p_c_in_w_m=(0.0, 0.0, 100.0), q_w_c=(0.0, 1.0, 0.0, 0.0), cov=(0.0,) * 36, agl_m=100.0,
    agl_sigma_m=3.0, step_m=(0.0, 0.0), step_cov_m2=(1.0, 0.0, 0.0, 1.0))  # fmt: skip


def always(match: MapMatch) -> of.FindMatch:
    def find(prediction: Prediction, shot: Shot, *, usable: bool = True) -> MapMatch:
        return match

    return find


def flown(fault: DrawnFault, number: int = 0) -> tuple[FlightPlan, SimulatedFlight]:
    drawn = plan(5, number, fault=fault, duration_s=SHORT_S)
    return drawn, fly(drawn, Terrain(drawn.seed, drawn.hills_m, drawn.settled))


def test_each_false_input_has_its_probability_and_changes_nothing_else() -> None:
    plans = [plan(1, n, lie_share=0.05) for n in range(600)]
    for lie in LIES:
        assert 0.025 < np.mean([lie in p.lies for p in plans]) < 0.08, lie
    honest = [n for n, p in enumerate(plans) if not p.lies]
    assert all(plans[n] == plan(1, n) for n in honest[:20])
    lying = next(n for n, p in enumerate(plans) if p.lies == {DrawnFault.FROZEN})
    assert replace(plans[lying], lies=frozenset()) == plan(1, lying)
    assert plans[lying].fault is plan(1, lying).fault


def test_false_numbers_have_their_stated_sizes() -> None:
    def numbers(fault: DrawnFault, name: str) -> np.ndarray:
        drawn = [plan(1, n, fault=fault) for n in range(40)]
        assert all(p.lies == {fault} for p in drawn)
        return np.array([getattr(p, name) for p in drawn])

    assert set(np.round(numbers(DrawnFault.SCALE, "height_scale"), 2)) == {0.7, 1.3, 3.28, 0.3}
    assert set(np.round(np.degrees(numbers(DrawnFault.HEADING, "compass_rad")))) == {-90, 90, 180}
    described = 1.0 / (1.0 + numbers(DrawnFault.FOCAL, "focal_error"))  # over the true one
    assert 0.5 <= described.min() < 0.7 and 1.4 < described.max() <= 2.0
    lag_s = numbers(DrawnFault.STALE, "picture_lag_s")
    assert 0.2 <= lag_s.min() < 0.4 and 0.8 < lag_s.max() <= 1.0
    assert np.hypot(*numbers(DrawnFault.START, "start_error_m").T) == pytest.approx(300.0)
    assert set(numbers(DrawnFault.START, "start_sigma_m")) == {50.0}


def test_late_pictures_show_the_earlier_position() -> None:
    drawn, flight = flown(DrawnFault.STALE)
    for seen, true in list(zip(flight.pictures, flight.frames, strict=True))[2:]:
        assert seen.t_s == true.t_s
        behind_m = float(np.hypot(*(true.p_m - seen.p_m)[:2]))
        assert behind_m == pytest.approx(drawn.picture_lag_s * np.hypot(*true.velocity_mps[:2]), abs=1.5)
    _, honest = flown(DrawnFault.NONE)
    assert all(np.array_equal(a.p_m, b.p_m) for a, b in zip(honest.pictures, honest.frames, strict=True))


def test_a_frozen_camera_repeats_one_pose_with_new_times() -> None:
    drawn, flight = flown(DrawnFault.FROZEN)
    lies = Lies(drawn, flight)
    shown = [lies.picture(i) for i in range(len(flight.frames))]
    held = [i for i, shot in enumerate(shown) if not np.array_equal(shot.p_m, flight.frames[i].p_m)]
    assert held == list(range(held[0], held[-1] + 1)) and 14 <= len(held) <= 40
    assert all(np.array_equal(shown[i].p_m, flight.frames[held[0] - 1].p_m) for i in held)
    assert [shot.t_s for shot in shown] == [shot.t_s for shot in flight.frames]
    span = lies.span()
    assert span is not None and span.from_s == flight.frames[held[0] - 1].t_s


def test_foreign_motion_is_far_away_and_consistent_and_has_no_map_match() -> None:
    drawn, flight = flown(DrawnFault.FOREIGN)
    lies = Lies(drawn, flight)
    steps, foreign = [], []
    for i, true in enumerate(flight.frames):
        match = lies.match(i, PREDICTION, always(FOUND))
        if match.verdict is not Verdict.ACCEPTED:
            foreign.append(i)
            away_m = float(np.hypot(*(lies.picture(i).p_m - true.p_m)[:2]))
            assert away_m > 200.0
            assert lies.picture(i).p_m[2] == true.p_m[2]
    for i in foreign[1:]:
        own_m = np.hypot(*(flight.frames[i].p_m - flight.frames[i - 1].p_m)[:2])
        steps.append(float(np.hypot(*(lies.picture(i).p_m - lies.picture(i - 1).p_m)[:2]) / own_m))
    assert 5 <= len(foreign) <= 15 and np.std(steps) < 1e-6 and 0.5 <= steps[0] <= 3.0
    turned = lies.picture(foreign[0]).r_w_c
    assert turned.T @ turned == pytest.approx(np.eye(3), abs=1e-9)
    assert not np.allclose(turned, flight.frames[foreign[0]].r_w_c)


def test_over_the_map_of_another_town_a_fifth_of_the_frames_have_wrong_matches() -> None:
    drawn, flight = flown(DrawnFault.TOWN)
    lies, off = Lies(drawn, flight), []
    span = lies.span()
    assert span is not None
    after = [i for i, shot in enumerate(flight.frames) if shot.t_s >= span.from_s]
    for i in after * 20:  # enough matches to estimate a share
        match = lies.match(i, PREDICTION, always(FOUND))
        if match.pose is not None:
            off.append(float(np.hypot(*(np.array(match.pose.p_c_in_w_m) - flight.frames[i].p_m)[:2])))
    assert 0.15 < len(off) / (20 * len(after)) < 0.25
    assert min(off) > 30.0 and max(off) < 120.0
    assert 0.3 < np.mean(np.abs(np.diff(off)) < 8.0) < 0.8  # half of them agree with the one before
    assert lies.match(0, PREDICTION, always(FOUND)) == FOUND
    dark = msgspec.structs.replace(NOTHING, verdict=Verdict.BAD_IMAGE)
    assert all(lies.match(i, PREDICTION, always(dark)) == dark for i in after * 20)


def test_the_search_model_is_lost_without_matches_and_finds_a_visible_place() -> None:
    shot = Shot(0.0, np.array([300.0, 0.0, 100.0]), np.eye(3), np.eye(3), np.zeros(3))

    def visible(prediction: Prediction, shot: Shot, *, usable: bool = True) -> MapMatch:
        return FOUND if prediction.p_c_in_w_m[0] == 300.0 else NOTHING

    search = Search()
    matches = [search.update(NOTHING, PREDICTION, shot, visible) for _ in range(of.LOST_FRAMES + of.FOUND_FRAMES)]
    lost = [m.verdict is Verdict.LOST for m in matches]
    assert lost.index(True) == of.LOST_FRAMES - 1 and sum(lost) == of.FOUND_FRAMES - 1
    assert matches[of.LOST_FRAMES].search.sigma_m == 300.0 and matches[of.LOST_FRAMES].search.step is SearchStep.WIDEN
    found = matches[of.LOST_FRAMES + of.FOUND_FRAMES - 2]
    assert found.search.relocalized and found.search.step is SearchStep.MERGE and found.search.sigma_m == 0.0
    assert matches[-1] == NOTHING  # the counters restart
    blind = Search()
    never = [blind.update(NOTHING, PREDICTION, shot, always(NOTHING)) for _ in range(60)]
    assert not any(m.search.relocalized for m in never) and never[-1].verdict is Verdict.LOST
    reset = Search()
    looks = [reset.update(FOUND if i % 10 == 9 else NOTHING, PREDICTION, shot, visible) for i in range(60)]
    assert not any(m.verdict is Verdict.LOST for m in looks)


def test_frames_without_a_picture_are_no_evidence_against_the_position() -> None:
    shot = Shot(0.0, np.array([300.0, 0.0, 100.0]), np.eye(3), np.eye(3), np.zeros(3))
    dark = msgspec.structs.replace(NOTHING, verdict=Verdict.BAD_IMAGE)
    search = Search()
    assert all(search.update(dark, PREDICTION, shot, always(dark)) == dark for _ in range(4 * of.LOST_FRAMES))
    matches = [search.update(NOTHING, PREDICTION, shot, always(NOTHING)) for _ in range(of.LOST_FRAMES)]
    assert [m.verdict is Verdict.LOST for m in matches].index(True) == of.LOST_FRAMES - 1
