"""Sim(3) merge: fragments of unknown place and size meet in the world, and wrong anchors do no harm."""

from dataclasses import replace

import numpy as np
import pytest

from terrafix.core.pose import exp_so3
from terrafix_tools.bench.merging import STEP_SIGMAS, Torn, measure, pose_errors, torn_flight
from terrafix_tools.finalise.sim3_pose_graph import merge
from terrafix_tools.finalise.submap_types import AbsoluteConstraint, MergedSubmaps, RelativeConstraint, Submap

CHI2_95_2 = 5.991


def nees(errors: np.ndarray, covs: np.ndarray) -> np.ndarray:
    """(M,) of errors (M, k) in covariances (M, k, k)."""
    return np.einsum("ni,ni->n", errors, np.linalg.solve(covs, errors[..., None])[..., 0])


def without(torn: Torn, *gone: int) -> list[AbsoluteConstraint]:
    """The anchors of all other fragments."""
    return [a for a in torn.anchors if a.fragment not in gone]


def seen_again(torn: Torn, first: tuple[int, int], second: tuple[int, int]) -> RelativeConstraint:
    """A relocalisation without error between keyframes of two fragments whose unit is the metre."""
    (a, i), (b, j) = first, second
    r_a, r_b = torn.r_w_c[a][i], torn.r_w_c[b][j]
    way = r_a.T @ (torn.p_w_m[b][j] - torn.p_w_m[a][i])
    return RelativeConstraint(first, second, r_a.T @ r_b, way, np.diag(STEP_SIGMAS**2), 1.0, 0.01)


def median_m(torn: Torn, merged: MergedSubmaps) -> float:
    return float(np.median(np.linalg.norm(pose_errors(torn, merged)[0][:, 3:], axis=1)))


def test_wrong_anchors_are_found_and_do_no_harm() -> None:
    torn = torn_flight(3, fragments=4, keyframes=60, wrong_share=0.125)
    merged = merge(torn.fragments, torn.anchors)
    assert torn.wrong.sum() == 3 and all(p is not None for p in merged.placements)
    assert not np.any(merged.anchors & torn.wrong)
    assert np.sum(~merged.anchors & ~torn.wrong) <= 1
    alone = merge(torn.fragments, torn.right_anchors())
    assert median_m(torn, merged) <= 1.1 * median_m(torn, alone)


def test_half_of_the_anchors_may_be_wrong_if_they_do_not_agree() -> None:
    torn = torn_flight(4, fragments=1, keyframes=100, wrong_share=0.4)
    merged = merge(torn.fragments, torn.anchors)
    assert not np.any(merged.anchors & torn.wrong)
    assert median_m(torn, merged) < 4.0


@pytest.mark.parametrize("scale_known", [True, False])
def test_what_it_claims_is_what_it_is_off(scale_known: bool) -> None:
    every, flat = [], []
    for seed in range(16):
        torn = torn_flight(seed, fragments=2, keyframes=40, scale_known=scale_known)
        errors, covs = pose_errors(torn, merge(torn.fragments, torn.anchors))
        every.append(nees(errors, covs))
        r = np.concatenate(torn.r_w_c)
        to_ground = r[:, :2, :]
        east_north = np.einsum("nij,nj->ni", to_ground, errors[:, 3:])
        flat.append(nees(east_north, to_ground @ covs[:, 3:, 3:] @ np.transpose(to_ground, (0, 2, 1))))
    assert 0.85 < float(np.mean(every)) / 6.0 < 1.2
    assert 0.92 < float(np.mean(np.concatenate(flat) <= CHI2_95_2)) < 0.98


def test_the_order_of_the_anchors_does_not_matter() -> None:
    torn = torn_flight(5, fragments=3, keyframes=40)
    order = np.random.default_rng(1).permutation(len(torn.anchors))
    merged, again = (merge(torn.fragments, anchors) for anchors in (torn.anchors, [torn.anchors[i] for i in order]))
    assert np.array_equal(merged.anchors[order], again.anchors)
    for one, other in zip(merged.placements, again.placements, strict=True):
        assert one is not None and other is not None
        assert np.array_equal(one.p_c_in_w_m, other.p_c_in_w_m) and np.array_equal(one.cov, other.cov)


def test_a_fragment_without_anchors_is_said_to_have_no_place() -> None:
    torn = torn_flight(6, fragments=3, keyframes=30)
    merged = merge(torn.fragments, without(torn, 1))
    assert [p is None for p in merged.placements] == [False, True, False]
    assert merged.why[1] == "no anchor, and no relocalisation to a fragment that has one"


def test_one_anchor_places_a_fragment_whose_size_is_known_and_no_other() -> None:
    torn = torn_flight(7, fragments=2, keyframes=30, scale_known=True, wrong_share=0.0)
    one = [a for a in torn.anchors if a.fragment == 0][:1] + [a for a in torn.anchors if a.fragment == 1]
    assert merge(torn.fragments, one).placements[0] is not None
    unknown = [replace(torn.fragments[0], scale_sigma=None), torn.fragments[1]]
    merged = merge(unknown, one)
    assert merged.placements[0] is None and merged.why[0] == "1 anchor and no height: its size is not known"


def test_anchors_that_contradict_each_other_place_nothing() -> None:
    torn = torn_flight(8, fragments=1, keyframes=30, anchor_every=15, scale_known=True, wrong_share=0.5)
    assert len(torn.anchors) == 2
    merged = merge(torn.fragments, torn.anchors)
    assert merged.placements == [None] and "agree" in merged.why[0]


def test_a_relocalisation_carries_the_place_to_a_fragment_without_anchors() -> None:
    torn = torn_flight(9, fragments=2, keyframes=30, scale_known=True, wrong_share=0.0)
    for join in (seen_again(torn, (0, 25), (1, 3)), seen_again(torn, (1, 3), (0, 25))):
        merged = merge(torn.fragments, without(torn, 1), [join])
        assert merged.joins.tolist() == [True] and merged.placements[1] is not None
        errors, covs = pose_errors(torn, merged)
        assert np.linalg.norm(errors[:, 3:], axis=1).max() < 25.0
        assert float(np.mean(nees(errors, covs))) / 6.0 < 3.0
        assert covs[45, 3:, 3:].trace() > covs[15, 3:, 3:].trace()  # without anchors of its own it is known less well


def test_the_unit_of_a_joined_fragment_is_carried_over() -> None:
    torn = torn_flight(10, fragments=2, keyframes=30, scale_known=True, wrong_share=0.0)
    halved = _in_other_units(torn.fragments[1], 2.0)
    join = replace(seen_again(torn, (0, 25), (1, 3)), ratio=2.0)
    merged = merge([torn.fragments[0], halved], without(torn, 1), [join])
    placed = merged.placements[1]
    assert placed is not None and abs(float(np.median(placed.m_per_unit)) / 2.0 - 1.0) < 0.05
    assert np.linalg.norm(placed.p_c_in_w_m - torn.p_w_m[1], axis=1).max() < 30.0


def test_a_wrong_relocalisation_is_refused() -> None:
    torn = torn_flight(11, fragments=2, keyframes=30, scale_known=True, wrong_share=0.0)
    right = seen_again(torn, (0, 25), (1, 3))
    wrong = replace(
        right, p_b_in_a=right.p_b_in_a + np.array([120.0, 0.0, 0.0]), r_a_b=right.r_a_b @ exp_so3(np.array([0, 0, 1]))
    )
    merged = merge(torn.fragments, torn.anchors, [wrong, right])
    assert merged.joins.tolist() == [False, True]
    assert median_m(torn, merged) < 4.0


def _in_other_units(fragment: Submap, m_per_unit: float) -> Submap:
    cov = fragment.step_cov.copy()
    cov[:, 3:, 3:] /= m_per_unit**2
    return replace(fragment, p_c_in_f=fragment.p_c_in_f / m_per_unit, step_cov=cov, scale_sigma=None)


def test_the_row_of_the_benchmark() -> None:
    found = measure(400)
    ways = list(found["ways"].values())
    assert found["anchors"] == 40 and found["wrong_anchors"] == 2 and len(ways) == 3
    assert ways[0]["placed"] == 1.0 and ways[0]["max_m"] < 50.0 < ways[2]["max_m"]
