"""The local model of a map's distortion: what all frames see there is taken out, what one frame sees is not."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from terrafix.core.geodesy import quat_from_rot
from terrafix.messages import MapMatch, MapPose, Verdict
from terrafix_lab.accept.measuring.map_distortion import left_by_local_model, mean_px, residuals, shows_distortion
from terrafix_lab.accept.measuring.measures import MAP_FLOOR_PX, map_px
from terrafix_lab.accept.measuring.results import Verdict as RowVerdict

DOWN, HEIGHT_M, FOCAL_PX = np.diag([1.0, -1.0, -1.0]), 100.0, 700.0


def warp(map_m: np.ndarray) -> np.ndarray:
    """(N, 2) displacement of the map, 1 m, over 60 m."""
    return np.column_stack([np.sin(map_m[:, 1] / 10.0), np.cos(map_m[:, 0] / 10.0)])


def match(seed: int, *, warped: bool, noise_m: float) -> MapMatch:
    """A camera that looks down on the same ground as all others, with relief of 5 m."""
    rng = np.random.default_rng(seed)
    p_m = np.array([*rng.normal(0.0, 3.0, 2), HEIGHT_M])
    ground = np.column_stack([rng.uniform(-40.0, 40.0, (60, 2)), rng.normal(0.0, 5.0, 60)])
    in_c = (ground - p_m) @ DOWN
    xy = in_c[:, :2] / in_c[:, 2:]
    on_map = ground[:, :2] + (warp(ground[:, :2]) if warped else 0.0) + noise_m * rng.normal(size=(60, 2))
    rows = np.column_stack([xy, on_map, ground[:, 2], np.ones(60)]).tolist()
    pose = MapPose(p_c_in_w_m=tuple(p_m), q_w_c=quat_from_rot(DOWN), cov=tuple(np.eye(6).ravel()))  # type: ignore[arg-type]
    return MapMatch(
        t_ns=0, frame_id=seed, verdict=Verdict.ACCEPTED, matcher="gradient", pose=pose, matches=[tuple(r) for r in rows]
    )


def test_residuals_are_displacements_on_the_ground_and_pixels() -> None:
    """With the heights of the points: at one level, relief of 5 m would add 2 m."""
    found = residuals(match(1, warped=True, noise_m=0.0), FOCAL_PX)
    assert np.abs(found.off_m - warp(found.map_m - found.off_m)).max() < 1e-6
    expected_px = np.linalg.norm(found.off_m, axis=1).mean() / HEIGHT_M * FOCAL_PX
    assert abs(float(found.px.mean()) / expected_px - 1.0) < 0.05


def test_distortion_that_all_frames_see_is_taken_out_and_errors_of_one_frame_are_not() -> None:
    for warped, noise_m, least, most in ((True, 0.1, 0.0, 0.55), (False, 1.0, 0.9, 1.3)):
        frames = [residuals(match(i, warped=warped, noise_m=noise_m), FOCAL_PX) for i in range(12)]
        left = mean_px(frames, left_by_local_model(frames))
        whole = mean_px(frames, [f.off_m for f in frames])
        assert least < left / whole < most


def test_the_local_model_is_used_by_how_often_the_ground_was_matched_and_not_by_what_it_leaves() -> None:
    """With an error of the matches alone the model leaves more than there was; the rule is the same."""
    for warped, noise_m in ((True, 0.1), (False, 1.0)):
        often = [residuals(match(i, warped=warped, noise_m=noise_m), FOCAL_PX) for i in range(12)]
        assert shows_distortion(often) and not shows_distortion(often[:2])


@pytest.mark.parametrize(("frames", "less_distortion"), [(12, True), (2, False)])
def test_the_map_error_is_judged_by_one_rule_also_where_that_gives_the_larger_number(
    frames: int, less_distortion: bool
) -> None:
    """Errors of the matches alone: the local model adds noise."""
    matches = [match(i, warped=False, noise_m=1.0) for i in range(frames)]
    evidence: Any = SimpleNamespace(
        frames=[SimpleNamespace(match=one, fixed=True) for one in matches],
        origin=SimpleNamespace(camera=SimpleNamespace(fx=FOCAL_PX)),
    )
    found = [residuals(one, FOCAL_PX) for one in matches]
    whole, left = mean_px(found, [f.off_m for f in found]), mean_px(found, left_by_local_model(found))
    measured = map_px(evidence)
    assert left > whole * 1.02
    assert measured.value == pytest.approx(left if less_distortion else whole, rel=1e-6)


@pytest.mark.parametrize(("noise_m", "verdict"), [(0.05, RowVerdict.NOT_MEASURABLE), (3.0, None)])
def test_few_matches_of_a_warped_map_decide_only_what_its_distortion_cannot_change(
    noise_m: float, verdict: RowVerdict | None
) -> None:
    """Three frames over a map whose distortion is above the floor: without it the matches are good, or bad as well."""
    matches = [match(i, warped=True, noise_m=noise_m) for i in range(3)]
    evidence: Any = SimpleNamespace(
        frames=[SimpleNamespace(match=one, fixed=True) for one in matches],
        origin=SimpleNamespace(camera=SimpleNamespace(fx=FOCAL_PX)),
    )
    measured = map_px(evidence)
    assert measured.value is not None and measured.value > MAP_FLOOR_PX and measured.verdict is verdict
