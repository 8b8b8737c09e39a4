"""Relocalisation against old keyframes: loop closures, joined fragments, wrong ones, and what is claimed after them."""

import msgspec
import numpy as np
import pytest

from recorded_flight import seen_again
from simulated_flight import EstimatorRun, Flight, altered, blind, cov_of, error_m, sigma_m, t_ns, without_fix
from terrafix.core.gate import GATE
from terrafix.estimator.measurements.relocalization import GAINED, safe_fusion_measurement
from terrafix.messages import (
    Health,
    MeasurementVerdict,
    Message,
    Odometry,
    Prediction,
    SourceLabel,
    ThermalBand,
    Verdict,
)

FRAMES, MAP_UNTIL = 120, 10  # after a few map matches there is no map
GAP = range(60, 72)  # frames in which nothing is tracked, and after which a fragment begins
KEYFRAME, AGAIN = 57, 100  # the keyframe before the gap, and the frame that sees its ground again


def drifted(flight: Flight, end: int = AGAIN) -> EstimatorRun:
    """Flown up to frame ``end`` - 1, with map matches in the first frames alone."""
    return EstimatorRun().fly(flight, 0, MAP_UNTIL).fly(flight, MAP_UNTIL, end, without_fix)


def flight_of(seed: int) -> Flight:
    return Flight(FRAMES, seed=seed, fix_every=3, speed_mps=3.0)


def horizontal_m(run: EstimatorRun, flight: Flight, i: int) -> float:
    return float(np.hypot(*error_m(run.estimate(i), flight)[:2]))


def relocalized(flight: Flight, *, count: int = 2) -> EstimatorRun:
    run = fragment_after_gap(flight, AGAIN)
    for i in range(AGAIN, AGAIN + count):
        run.feed([*in_second_fragment(flight, i), seen_again(flight, KEYFRAME, i, fragment_id=1)])
    return run


def verdicts(run: EstimatorRun) -> list[MeasurementVerdict]:
    return list(run.verdicts("relocalization").values())


def test_the_second_of_two_relocalisations_that_agree_is_fused() -> None:
    run = relocalized(flight_of(1), count=3)
    assert [v.verdict for v in verdicts(run)] == [Verdict.UNCONFIRMED, Verdict.ACCEPTED, Verdict.ACCEPTED]
    assert f"keyframe {KEYFRAME} of fragment 0" in verdicts(run)[1].detail


def test_a_loop_closure_has_the_error_of_the_old_keyframe_and_claims_no_less() -> None:
    """Over several flights: drift, and the same after the relocalisation."""
    drifts, errors, d2 = [], [], []
    for seed in range(6):
        flight = flight_of(seed)
        run = relocalized(flight)
        last = AGAIN + 1
        kept = run.node.estimator.state.keyframes.get(KEYFRAME)  # type: ignore[union-attr]
        assert kept is not None
        kept_m2 = np.trace(
            (kept.view.pose.rotation().matrix() @ kept.view.cov[3:, 3:] @ kept.view.pose.rotation().matrix().T)[:2, :2]
        )
        after = run.estimate(last)
        assert 2.0 * sigma_m(after) ** 2 >= 0.99 * kept_m2
        assert sigma_m(after) < 0.8 * sigma_m(run.estimate(AGAIN - 1))
        drifts.append(horizontal_m(run, flight, AGAIN - 1))
        errors.append(horizontal_m(run, flight, last))
        off = error_m(after, flight)[:2]
        d2.append(float(off @ np.linalg.solve(cov_of(after)[:2, :2], off)))
    assert np.mean(errors) < 0.5 * np.mean(drifts)
    assert max(d2) < GATE[2] and np.mean(d2) < 4.0


def test_a_single_wrong_relocalisation_moves_nothing() -> None:
    flight = flight_of(2)
    run, same = fragment_after_gap(flight, AGAIN), fragment_after_gap(flight, AGAIN)
    run.feed([*in_second_fragment(flight, AGAIN), seen_again(flight, KEYFRAME, AGAIN, shown=70)])
    same.feed(in_second_fragment(flight, AGAIN))
    assert verdicts(run)[0].verdict in (Verdict.UNCONFIRMED, Verdict.INNOVATION)
    assert run.estimate(AGAIN).cov == same.estimate(AGAIN).cov
    assert (run.estimate(AGAIN).lat_deg, run.estimate(AGAIN).lon_deg) == (
        same.estimate(AGAIN).lat_deg,
        same.estimate(AGAIN).lon_deg,
    )


def test_relocalisations_at_a_place_that_the_estimate_excludes_are_rejected_however_many_agree() -> None:
    flight = Flight(FRAMES, seed=2, fix_every=1)
    run = EstimatorRun().fly(flight, 0, 60)
    for i in range(60, 64):
        run.feed([*altered(flight.messages(i), without_fix), seen_again(flight, 30, i, shown=50)])
    found = verdicts(run)
    assert [v.verdict for v in found] == [Verdict.INNOVATION] * 4
    assert all(v.test_ratio is not None and v.test_ratio > 1.0 for v in found)
    assert horizontal_m(run, flight, 63) < 10.0


def test_a_relocalisation_that_disagrees_with_the_one_before_is_not_fused() -> None:
    flight = flight_of(3)
    run = fragment_after_gap(flight, AGAIN)
    run.feed([*in_second_fragment(flight, AGAIN), seen_again(flight, KEYFRAME, AGAIN)])
    wrong = seen_again(flight, KEYFRAME, AGAIN + 1, shown=KEYFRAME + 20)
    run.feed([*in_second_fragment(flight, AGAIN + 1), wrong])
    assert verdicts(run)[1].verdict in (Verdict.UNCONFIRMED, Verdict.INNOVATION)


@pytest.mark.parametrize(("keyframe", "frame"), [(KEYFRAME + 1, AGAIN), (9, 30)])
def test_unknown_keyframes_and_frames_out_of_the_window_are_stale(keyframe: int, frame: int) -> None:
    flight = flight_of(1)
    run = drifted(flight, AGAIN + 1)
    run.feed([seen_again(flight, keyframe, frame)])
    assert verdicts(run)[0].verdict is Verdict.STALE


def test_without_a_known_heading_no_relocalisation_is_fused() -> None:
    flight = Flight(40, seed=1, telemetry=frozenset({"attitude", "height"}))
    run = EstimatorRun().fly(flight, 0, 31, without_fix)
    run.feed([seen_again(flight, 27, 30)])
    assert verdicts(run)[0].verdict in (Verdict.NO_PREDICTION, Verdict.STALE)


def test_the_belief_of_the_anchor_moves_as_far_as_a_relocalisation_moves_the_estimate() -> None:
    flight = flight_of(4)
    run = relocalized(flight)
    run.feed(in_second_fragment(flight, AGAIN + 2))
    steps = {m.frame_id: np.array(m.step_m) for m in run.published if isinstance(m, Prediction)}
    places = {m.frame_id: np.array(m.p_c_in_w_m[:2]) for m in run.published if isinstance(m, Prediction)}
    assert steps[AGAIN + 2] == pytest.approx(places[AGAIN + 2] - places[AGAIN + 1], abs=1e-6)
    moved = np.linalg.norm(steps[AGAIN + 2] - (flight.p_m[AGAIN + 2] - flight.p_m[AGAIN + 1])[:2])
    assert moved > 1.0  # the drift


def test_while_hot_a_relocalisation_improves_the_propagated_covariance_without_marginals(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    flight = flight_of(5)
    run = fragment_after_gap(flight, AGAIN)
    hot = Health(
        t_ns=t_ns(AGAIN), band=ThermalBand.HOT, temperature_c=85.0, throttled=False, disk_free_mb=None, cause="test"
    )
    run.feed([hot, *in_second_fragment(flight, AGAIN), seen_again(flight, KEYFRAME, AGAIN)])
    assert run.node.estimator is not None
    before = sigma_m(run.estimate(AGAIN))
    monkeypatch.setattr(run.node.estimator.graph, "covariance", lambda node: pytest.fail("a marginal is computed"))
    last = AGAIN + 1
    run.feed([*in_second_fragment(flight, last), seen_again(flight, KEYFRAME, last)])
    assert verdicts(run)[-1].verdict is Verdict.ACCEPTED
    assert sigma_m(run.estimate(last)) < 0.8 * before


def fragment_after_gap(flight: Flight, end: int) -> EstimatorRun:
    run = drifted(flight, GAP[0])
    for i in range(GAP[0], end):
        run.feed(in_second_fragment(flight, i))
    return run


def in_second_fragment(flight: Flight, i: int) -> list[Message]:
    messages: list[Message] = []
    for m in altered(flight.messages(i), without_fix):
        if isinstance(m, Odometry):
            if i in GAP:
                m = blind(m)
            elif i == GAP[-1] + 1:
                m = Odometry(t_ns=m.t_ns, frame_id=i, keyframe_id=i, verdict=Verdict.ACCEPTED, becomes_keyframe=True)
                m = msgspec.structs.replace(m, fragment_id=1)
            elif m.keyframe_id <= GAP[-1]:
                m = blind(m)
            else:
                m = msgspec.structs.replace(m, fragment_id=1)
        messages.append(m)
    return messages


def test_a_fragment_without_inertial_readings_is_fused_but_stays_disconnected() -> None:
    flight = flight_of(6)
    run = fragment_after_gap(flight, AGAIN)
    first, last = run.estimate(GAP[-1] + 1), run.estimate(AGAIN - 1)
    assert run.verdicts("odometry")[AGAIN - 1].verdict is Verdict.ACCEPTED
    assert (first.fragment_id, last.fragment_id) == (1, 1) and not first.joined and not last.joined
    assert last.source_label is SourceLabel.DEAD_RECKONED
    verdict = run.verdicts("odometry")[AGAIN - 1]
    assert (verdict.fragment_id, verdict.joined) == (1, False)


def test_no_velocity_bridges_the_gap_before_a_disconnected_fragment() -> None:
    """What the fragment tells of its own velocity must not make the way through the gap more certain."""
    flight = flight_of(6)
    run = fragment_after_gap(flight, AGAIN)
    unseen = sigma_m(run.estimate(GAP[-1] + 1))
    assert all(sigma_m(run.estimate(i)) > 0.97 * unseen for i in range(GAP[-1] + 1, AGAIN))
    assert unseen > 1.5 * sigma_m(run.estimate(GAP[0] - 1))


def test_a_relocalisation_joins_a_fragment_to_the_flight_without_a_map() -> None:
    flight = flight_of(6)
    run = fragment_after_gap(flight, AGAIN)
    for i in (AGAIN, AGAIN + 1):
        run.feed([*in_second_fragment(flight, i), seen_again(flight, KEYFRAME, i, fragment_id=1)])
    found = run.verdicts("relocalization")
    assert (found[AGAIN].verdict, found[AGAIN].joined) == (Verdict.UNCONFIRMED, False)
    assert (found[AGAIN + 1].verdict, found[AGAIN + 1].joined) == (Verdict.ACCEPTED, True)
    after = run.estimate(AGAIN + 1)
    assert after.joined and after.source_label is SourceLabel.VISUAL_PROPAGATED
    assert horizontal_m(run, flight, AGAIN + 1) < 3.5 * sigma_m(after)
    assert sigma_m(after) < 0.5 * sigma_m(run.estimate(AGAIN - 1))


def test_a_relocalisation_within_a_disconnected_fragment_does_not_join_it() -> None:
    flight = flight_of(6)
    run = fragment_after_gap(flight, AGAIN + 10)
    own_keyframe = GAP[-1] + 1
    for i in (AGAIN + 10, AGAIN + 11):
        run.feed([*in_second_fragment(flight, i), seen_again(flight, own_keyframe, i, fragment_id=1)])
    assert not run.estimate(AGAIN + 11).joined


def test_a_map_pose_joins_a_fragment() -> None:
    flight = flight_of(6)
    run = fragment_after_gap(flight, AGAIN)
    run.feed([*in_second_fragment(flight, AGAIN), flight.fix(AGAIN)])
    found = run.verdicts("map")[AGAIN]
    assert (found.verdict, found.fragment_id, found.joined) == (Verdict.ACCEPTED, 1, True)
    assert run.estimate(AGAIN).joined and run.estimate(AGAIN).source_label is SourceLabel.SATELLITE_ANCHORED


def test_safe_fusion_takes_each_component_from_the_better_source() -> None:
    ours, theirs = np.diag([100.0, 4.0]), np.diag([1.0, 100.0])
    value, cov = safe_fusion_measurement(np.array([7.0, 5.0]), ours, theirs)
    information = np.linalg.inv(ours) + np.linalg.inv(cov)
    fused = np.linalg.inv(information)
    assert np.diag(fused) == pytest.approx([1.0, 4.0], rel=1e-4)
    assert fused @ np.linalg.solve(cov, value) == pytest.approx([7.0, 0.0], abs=1e-3)


def test_safe_fusion_leaves_a_component_that_is_hardly_better() -> None:
    ours = np.diag([1.0, 1.0])
    theirs = np.diag([GAINED * 1.01, GAINED * 0.99])
    value, cov = safe_fusion_measurement(np.array([3.0, 3.0]), ours, theirs)
    fused = np.linalg.inv(np.linalg.inv(ours) + np.linalg.inv(cov))
    assert np.diag(fused) == pytest.approx([1.0, GAINED * 0.99], rel=1e-3)
    assert fused @ np.linalg.solve(cov, value) == pytest.approx([0.0, 3.0], abs=1e-3)


def test_safe_fusion_is_the_same_in_rotated_axes() -> None:
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    ours, theirs, residual = np.diag([100.0, 4.0]), np.diag([1.0, 100.0]), np.array([7.0, 5.0])
    value, cov = safe_fusion_measurement(residual, ours, theirs)
    turned_value, turned_cov = safe_fusion_measurement(turn @ residual, turn @ ours @ turn.T, turn @ theirs @ turn.T)
    assert turned_value == pytest.approx(turn @ value)
    assert np.linalg.inv(turned_cov) == pytest.approx(turn @ np.linalg.inv(cov) @ turn.T, abs=1e-6)
