"""Conversion of match results into MapMatch."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from map_matches import pose_of
from terrafix.anchor.matching.frame_matcher import PatchFix, View
from terrafix.anchor.matching.match_message import mode_match, pose_match, relocalized_match
from terrafix.anchor.matching.point_mass_filter import Mode
from terrafix.core.geodesy import quat_from_rot
from terrafix.core.pnp import INLIER_THRESHOLD, PNP_MIN_INLIERS, SEARCH_RADIUS, map_pose, solve, solved
from terrafix.core.pose import PoseFit
from terrafix.messages import MapMatch, MatchPlace, PnpInput, Verdict

DOWN = np.diag([1.0, -1.0, -1.0])
VIEW = View(0.0, 0.0, DOWN, 100.0, 50.0, 0.0, 0.0, 0.0)
HERE_M = np.array([3.0, -4.0, 150.0])
GIVEN = PnpInput(
    q_w_c=quat_from_rot(DOWN),
    agl_m=100.0,
    sigma_floor=0.0015,
    threshold=INLIER_THRESHOLD,
    search_radius=SEARCH_RADIUS,
    min_inliers=PNP_MIN_INLIERS,
)
BEFORE = MapMatch(
    t_ns=0, frame_id=3, verdict=Verdict.LOST, matcher="gradient", place=MatchPlace(e_m=0.0, n_m=0.0, mass=0.95)
)
COUNT, WRONG = 30, 4


def fix_of(given: PnpInput | None) -> tuple[PatchFix, PoseFit]:
    """A fix with ``WRONG`` of ``COUNT`` matches at other places, and its pose. ``given`` None: of another method."""
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(-50.0, 50.0, (COUNT, 2)), rng.uniform(48.0, 52.0, COUNT)])
    in_c = (points - HERE_M) @ DOWN
    xy = in_c[:, :2] / in_c[:, 2:] + rng.normal(0.0, 0.001, (COUNT, 2))
    points[:WRONG, :2] += 7.0
    weights = rng.uniform(0.5, 1.0, COUNT)
    found = solve(points, xy, weights, GIVEN)
    assert found.fit is not None and found.inliers.sum() == COUNT - WRONG
    return PatchFix(xy, points, weights, found, 0.5, given), found.fit


def test_the_position_of_a_mode_carries_nothing_of_a_pose_that_was_rejected_there() -> None:
    rejected = MapMatch(
        t_ns=0, frame_id=3, verdict=Verdict.DEGENERATE, matcher="gradient", inliers=9, reprojection_px=2.0, pnp=GIVEN,
        matches=[(0.1, 0.2, 40.0, 30.0, 50.0, 1.0)] * 9)  # fmt: skip
    match = mode_match(rejected, Mode(20.0, -10.0, 0.95, 0.01, 4.0), 2.0, VIEW, None)
    assert match.verdict is Verdict.ACCEPTED and match.position_only
    assert (match.matches, match.inliers, match.reprojection_px, match.pnp) == ([], 0, 0.0, None)
    assert match.pose is not None and match.pose.p_c_in_w_m == (20.0, -10.0, 150.0)
    assert solved(match) is match


def test_all_matches_of_a_pnp_pose_are_published_and_the_pose_is_left_to_the_estimator() -> None:
    fix, fit = fix_of(GIVEN)
    match = pose_match(BEFORE, fix, VIEW)
    assert (match.verdict, match.pose, match.pnp) == (Verdict.ACCEPTED, None, GIVEN)
    assert np.array_equal(np.array(match.matches), np.column_stack([fix.xy, fix.points_w_m, fix.weights]))
    assert match.inliers == COUNT - WRONG and not match.refined
    assert pose_match(BEFORE, replace(fix, refined=True), VIEW).refined
    assert match.reprojection_px == pytest.approx(np.sqrt(np.mean(fit.residuals**2)) * 100.0 / 0.5)


def test_the_estimator_finds_the_pose_by_which_the_anchor_has_judged_to_the_last_bit() -> None:
    fix, fit = fix_of(GIVEN)
    received = msgspec.msgpack.decode(msgspec.msgpack.encode(pose_match(BEFORE, fix, VIEW)), type=MapMatch)
    found = solved(received)
    assert (found.verdict, found.pose, found.inliers) == (Verdict.ACCEPTED, map_pose(fit), COUNT - WRONG)
    assert np.array_equal(np.array(found.matches)[:, :2], fix.xy[fix.pnp.inliers])
    assert found.pnp is None and solved(found) is found


def test_a_pose_of_another_method_is_published_with_the_matches_that_agree_with_it() -> None:
    fix, fit = fix_of(None)
    match = pose_match(BEFORE, fix, VIEW)
    assert (match.verdict, match.pose, match.pnp) == (Verdict.ACCEPTED, map_pose(fit), None)
    assert np.array_equal(np.array(match.matches)[:, 2:5], fix.points_w_m[fix.pnp.inliers])
    assert solved(match) is match


@pytest.mark.parametrize("given", [GIVEN, None])
def test_a_pose_far_from_its_place_is_degenerate_and_is_not_solved(given: PnpInput | None) -> None:
    elsewhere = msgspec.structs.replace(BEFORE, place=MatchPlace(e_m=40.0, n_m=0.0, mass=0.95))
    match = pose_match(elsewhere, fix_of(given)[0], VIEW)
    assert (match.verdict, match.inliers) == (Verdict.DEGENERATE, COUNT - WRONG)
    assert solved(match) is match


def test_a_fix_without_a_pose_has_its_verdict_and_nothing_to_solve() -> None:
    fix, _ = fix_of(GIVEN)
    few = replace(fix, pnp=replace(fix.pnp, verdict=Verdict.FEW_INLIERS, fit=None))
    match = pose_match(BEFORE, few, VIEW)
    assert (match.verdict, match.inliers) == (Verdict.FEW_INLIERS, COUNT - WRONG)
    assert (match.matches, match.pnp, match.pose) == ([], None, None)
    assert pose_match(BEFORE, None, VIEW).verdict is Verdict.DEGENERATE


@pytest.mark.parametrize("given", [GIVEN, None])
def test_the_pose_of_a_search_is_given_because_it_knows_more_than_the_matches(given: PnpInput | None) -> None:
    fix, fit = fix_of(given)
    match = relocalized_match(BEFORE, fix, VIEW, (6.0, 0.0))
    assert match.search.relocalized and match.pnp is None and len(match.matches) == COUNT - WRONG
    pose = pose_of(match)
    assert pose.p_c_in_w_m == map_pose(fit).p_c_in_w_m
    wider = np.array(pose.cov).reshape(6, 6) - np.array(map_pose(fit).cov).reshape(6, 6)
    assert np.diag(wider)[:2] == pytest.approx([2.0**2 + 36.0, 2.0**2])
    few = replace(fix, pnp=replace(fix.pnp, verdict=Verdict.FEW_INLIERS, fit=None))
    assert relocalized_match(BEFORE, few, VIEW, (6.0, 0.0)).pose is None
