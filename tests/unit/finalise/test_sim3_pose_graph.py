"""Sim(3) pose graph: submaps of unknown pose and scale are placed, and outliers are rejected."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from terrafix.core.gate import CHI2_95, GATE
from terrafix.core.pose import exp_so3
from terrafix.smoother.gnc import OutlierCandidate, marginals, solve, weighted
from terrafix.smoother.sim3_consensus import _Anchored, place
from terrafix.smoother.sim3_pose_graph import Sim3PoseGraph, merge
from terrafix.smoother.submap_types import AbsoluteConstraint, MergedSubmaps, RelativeConstraint, Submap
from terrafix_lab.bench.growth.merging import STEP_SIGMAS, SubmapFlight, make_submap_flight, measure, pose_errors
from terrafix_tools.score import nees_of


def without(flight: SubmapFlight, *gone: int) -> list[AbsoluteConstraint]:
    """-> the absolute constraints of all other submaps."""
    return [a for a in flight.anchors if a.submap not in gone]


def relocalisation(flight: SubmapFlight, first: tuple[int, int], second: tuple[int, int]) -> RelativeConstraint:
    """-> an error-free relative constraint between keyframes (submap, index) of two submaps of metric scale."""
    (a, i), (b, j) = first, second
    r_a, r_b = flight.r_w_c[a][i], flight.r_w_c[b][j]
    p_b_in_a_m = r_a.T @ (flight.p_w_m[b][j] - flight.p_w_m[a][i])
    return RelativeConstraint(first, second, r_a.T @ r_b, p_b_in_a_m, np.diag(STEP_SIGMAS**2), 1.0, 0.01)


def median_m(flight: SubmapFlight, merged: MergedSubmaps) -> float:
    return float(np.median(np.linalg.norm(pose_errors(flight, merged)[0][:, 3:], axis=1)))


def test_outlier_anchors_are_rejected_without_loss_of_accuracy() -> None:
    flight = make_submap_flight(3, submaps=4, keyframes=60, wrong_share=0.125)
    merged = merge(flight.submaps, flight.anchors)
    assert flight.wrong.sum() == 3 and all(p is not None for p in merged.placements)
    assert not np.any(merged.anchors & flight.wrong)
    assert np.sum(~merged.anchors & ~flight.wrong) <= 1
    right = [anchor for anchor, wrong in zip(flight.anchors, flight.wrong, strict=True) if not wrong]
    without_outliers = merge(flight.submaps, right)
    assert median_m(flight, merged) <= 1.1 * median_m(flight, without_outliers)


def test_an_anchor_places_a_submap_at_first_only_where_others_agree() -> None:
    flight = make_submap_flight(12, submaps=1, keyframes=40, scale_known=True, wrong_share=0.0)
    wrong = replace(flight.anchors[0], p_c_in_w_m=flight.anchors[0].p_c_in_w_m + 500.0)
    found = place(flight.submaps[0], [wrong, *flight.anchors[1:]])
    assert found is not None and np.abs(found.position(flight.submaps[0].p_c_in_f) - flight.p_w_m[0]).max() < 30.0


@pytest.mark.parametrize(("share", "inlier"), [(0.8, True), (1.25, False)])
def test_the_limit_of_an_outlier_is_that_of_its_squared_distance(share: float, inlier: bool) -> None:
    certain, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(0, np.zeros(1))
    certain.push_back(gtsam.PriorFactorVector(0, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, 1e-3)))

    def factor(weight: float) -> gtsam.NonlinearFactor:
        unit = gtsam.noiseModel.Isotropic.Sigma(1, weight**-0.5)
        return gtsam.PriorFactorVector(0, np.array([np.sqrt(share * GATE[6])]), unit)

    _, inliers = solve(certain, [OutlierCandidate(factor(1.0), factor, GATE[6])], values)
    assert inliers.tolist() == [inlier]


def test_an_outlier_is_readmitted_within_its_own_error_and_not_beyond() -> None:
    flight = make_submap_flight(12, submaps=1, keyframes=40, scale_known=True, wrong_share=0.0)
    graph = Sim3PoseGraph(flight.submaps, flight.anchors, [])
    certain, values = graph._chains()
    factors = [graph._anchor_factor(anchor) for anchor in flight.anchors]
    found, seen = marginals(weighted(certain, factors, np.ones(len(factors))), values), values.atSimilarity3(0)
    for aside_m, consistent in ((6.0, True), (30.0, False)):  # of a 1-sigma of 2 m, where the solution has less
        at_m = seen.translation() + np.array([aside_m, 0.0, 0.0])
        moved = replace(flight.anchors[0], r_w_c=seen.rotation().matrix(), p_c_in_w_m=at_m)
        assert graph._consistent(moved, values, found) is consistent


def test_what_supports_a_place_does_not_depend_on_the_unit_of_the_submap() -> None:
    flight = make_submap_flight(12, submaps=1, keyframes=40, scale_known=True, wrong_share=0.0)
    by_part = np.repeat([1.0, 30.0], 3)
    drifting = replace(flight.submaps[0], step_cov=flight.submaps[0].step_cov * np.outer(by_part, by_part))
    aside = [replace(a, p_c_in_w_m=a.p_c_in_w_m + np.array([8.0 * k, 0.0, 0.0])) for k, a in enumerate(flight.anchors)]
    supported = []
    for m_per_unit in (1.0, 50.0):
        anchored = _Anchored(_in_other_units(drifting, m_per_unit), aside)
        supported.append(anchored.support(anchored.proposed(0, m_per_unit), 0))
    assert supported == [len(aside)] * 2


def test_almost_half_of_the_anchors_may_be_inconsistent_outliers() -> None:
    flight = make_submap_flight(4, submaps=1, keyframes=100, wrong_share=0.4)
    merged = merge(flight.submaps, flight.anchors)
    assert not np.any(merged.anchors & flight.wrong)
    assert median_m(flight, merged) < 4.0


@pytest.mark.parametrize("scale_known", [True, False])
def test_the_covariance_is_consistent_with_the_errors(scale_known: bool) -> None:
    nees_6d, nees_horizontal = [], []
    for seed in range(16):
        flight = make_submap_flight(seed, submaps=2, keyframes=40, scale_known=scale_known)
        errors, covs = pose_errors(flight, merge(flight.submaps, flight.anchors))
        nees_6d.append(nees_of(errors, covs))
        r = np.concatenate(flight.r_w_c)
        to_ground = r[:, :2, :]
        east_north = np.einsum("nij,nj->ni", to_ground, errors[:, 3:])
        nees_horizontal.append(nees_of(east_north, to_ground @ covs[:, 3:, 3:] @ np.transpose(to_ground, (0, 2, 1))))
    assert 0.85 < float(np.mean(nees_6d)) / 6.0 < 1.2
    assert 0.92 < float(np.mean(np.concatenate(nees_horizontal) <= CHI2_95)) < 0.98


def test_the_result_does_not_depend_on_the_order_of_the_anchors() -> None:
    flight = make_submap_flight(5, submaps=3, keyframes=40)
    order = np.random.default_rng(1).permutation(len(flight.anchors))
    merged, again = (merge(flight.submaps, anchors) for anchors in (flight.anchors, [flight.anchors[i] for i in order]))
    assert np.array_equal(merged.anchors[order], again.anchors)
    for one, other in zip(merged.placements, again.placements, strict=True):
        assert one is not None and other is not None
        assert np.array_equal(one.p_c_in_w_m, other.p_c_in_w_m) and np.array_equal(one.cov, other.cov)


def test_a_submap_without_anchors_is_not_placed_and_has_a_reason() -> None:
    flight = make_submap_flight(6, submaps=3, keyframes=30)
    merged = merge(flight.submaps, without(flight, 1))
    assert [p is None for p in merged.placements] == [False, True, False]
    assert merged.why[1] == "no anchor, and no relocalisation to a submap that has one"


def test_one_anchor_places_only_a_submap_of_known_scale() -> None:
    flight = make_submap_flight(7, submaps=2, keyframes=30, scale_known=True, wrong_share=0.0)
    one = [a for a in flight.anchors if a.submap == 0][:1] + [a for a in flight.anchors if a.submap == 1]
    assert merge(flight.submaps, one).placements[0] is not None
    unknown = [replace(flight.submaps[0], scale_sigma=None), flight.submaps[1]]
    merged = merge(unknown, one)
    assert merged.placements[0] is None and merged.why[0] == "1 anchor and no height: its size is not known"


def test_contradicting_anchors_place_no_submap() -> None:
    flight = make_submap_flight(8, submaps=1, keyframes=30, anchor_every=15, scale_known=True, wrong_share=0.5)
    assert len(flight.anchors) == 2
    merged = merge(flight.submaps, flight.anchors)
    assert merged.placements == [None] and "agree" in merged.why[0]


def test_a_relocalisation_places_a_submap_without_anchors() -> None:
    flight = make_submap_flight(9, submaps=2, keyframes=30, scale_known=True, wrong_share=0.0)
    for join in (relocalisation(flight, (0, 25), (1, 3)), relocalisation(flight, (1, 3), (0, 25))):
        merged = merge(flight.submaps, without(flight, 1), [join])
        assert merged.joins.tolist() == [True] and merged.placements[1] is not None
        errors, covs = pose_errors(flight, merged)
        assert np.linalg.norm(errors[:, 3:], axis=1).max() < 25.0
        assert float(np.mean(nees_of(errors, covs))) / 6.0 < 3.0
        assert covs[45, 3:, 3:].trace() > covs[15, 3:, 3:].trace()  # it has no absolute constraints


def test_a_relocalisation_transfers_the_scale() -> None:
    flight = make_submap_flight(10, submaps=2, keyframes=30, scale_known=True, wrong_share=0.0)
    halved = _in_other_units(flight.submaps[1], 2.0)
    onward, back = relocalisation(flight, (0, 25), (1, 3)), relocalisation(flight, (1, 3), (0, 25))
    in_units = np.repeat([1.0, 0.5], 3)
    back = replace(back, p_b_in_a=back.p_b_in_a / 2.0, cov=back.cov * np.outer(in_units, in_units), ratio=0.5)
    for join in (replace(onward, ratio=2.0), back):
        placed = merge([flight.submaps[0], halved], without(flight, 1), [join]).placements[1]
        assert placed is not None and abs(float(np.median(placed.m_per_unit)) / 2.0 - 1.0) < 0.05
        assert np.linalg.norm(placed.p_c_in_w_m - flight.p_w_m[1], axis=1).max() < 30.0


def test_an_outlier_relocalisation_is_rejected() -> None:
    flight = make_submap_flight(11, submaps=2, keyframes=30, scale_known=True, wrong_share=0.0)
    inlier = relocalisation(flight, (0, 25), (1, 3))
    wrong = replace(
        inlier,
        p_b_in_a=inlier.p_b_in_a + np.array([120.0, 0.0, 0.0]),
        r_a_b=inlier.r_a_b @ exp_so3(np.array([0, 0, 1])),
    )
    merged = merge(flight.submaps, flight.anchors, [wrong, inlier])
    assert merged.joins.tolist() == [False, True]
    assert median_m(flight, merged) < 4.0


def _in_other_units(submap: Submap, m_per_unit: float) -> Submap:
    """-> a submap of metric scale in another, unknown unit of length."""
    cov = submap.step_cov.copy()
    cov[:, 3:, 3:] /= m_per_unit**2
    return replace(submap, p_c_in_f=submap.p_c_in_f / m_per_unit, step_cov=cov, scale_sigma=None)


def test_the_benchmark_measures_the_merge_of_a_flight() -> None:
    found = measure(400)
    assert found["anchors"] == 40 and found["wrong_anchors"] == 2
    assert found["placed"] == 1.0 and found["max_m"] < 50.0
