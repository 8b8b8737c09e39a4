"""Localization by a single frame with a wide belief: patches select a mode or none."""

from typing import Any

import numpy as np
import pytest

from map_matches import position_of
from single_map_place import AGL_M, ORIGIN, SIDE_M, TRUE_M, R, SingleMapPackage, predicted
from terrafix.anchor.matching.frame_matcher import (
    AS_PREDICTED,
    CorrelationResult,
    FrameMatcher,
    Hypothesis,
    View,
)
from terrafix.anchor.matching.match_message import ground_cov_m2
from terrafix.anchor.matching.point_mass_filter import Belief, Mode
from terrafix.anchor.node import AnchorNode
from terrafix.anchor.verification.single_frame import ScoredMode, localize_single_frame
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.geodesy import local_rotation_up, rot_from_quat
from terrafix.map.null_model import FalseAlarmBudget
from terrafix.messages import MapMatch, Verdict
from terrafix_engines.features.gradient import GradientDescriber
from textured_ground import GSD_M, PINHOLE, FlatMap, texture, view

SHARE = FalseAlarmBudget().log_probability  # of the first frame
NEAR_M = (7.0, -5.0)  # offset of the mode from the true position


class SameResult(CorrelationResult):
    """Every place fits best with the predicted yaw and scale."""

    def best_at(self, e_m: float, n_m: float) -> tuple[Any, float]:
        return AS_PREDICTED, 4.0


def mode(e_m: float, n_m: float) -> Mode:
    return Mode(e_m, n_m, 0.1, 0.1, 9.0)


def selected_mode(
    ground: np.ndarray, frame: np.ndarray, modes: list[Mode], log_probability: float = SHARE
) -> tuple[Mode, np.ndarray] | None:
    source: Any = FlatMap(ground)
    matcher = FrameMatcher(PINHOLE, source, GradientDescriber())
    predicted = View(0.0, 0.0, R, AGL_M, 0.0, 0.03, 0.02, 0.03)
    found = localize_single_frame(frame, predicted, SameResult(Verdict.ACCEPTED), modes, matcher, log_probability)
    if found is None:
        return None
    assert found.fix is not None and found.fix.pnp.fit is not None
    return found.mode, found.fix.pnp.fit.p_c_in_w_m


def test_the_patches_select_the_right_mode(ground: np.ndarray) -> None:
    right = mode(TRUE_M[0] + NEAR_M[0], TRUE_M[1] + NEAR_M[1])
    found = selected_mode(ground, view(ground, PINHOLE, R, TRUE_M), [mode(-60.0, 40.0), mode(80.0, 70.0), right])
    assert found is not None and found[0] is right
    assert np.linalg.norm(found[1] - TRUE_M) < 3.0


def test_a_clear_correlation_selects_a_mode_that_patches_do_not_confirm(ground: np.ndarray) -> None:
    """The place is that of the mode: patches that agree little give no pose."""

    class ClearResult(CorrelationResult):
        def best_at(self, e_m: float, n_m: float) -> tuple[Any, float]:
            return Hypothesis(0.1, 1.0), 12.0 if (e_m, n_m) == (80.0, 70.0) else 3.0

    source: Any = FlatMap(ground)
    other, clear = view(texture(9, SIDE_M), PINHOLE, R, TRUE_M), mode(80.0, 70.0)
    found = localize_single_frame(
        other,
        View(0.0, 0.0, R, AGL_M, 0.0, 0.03, 0.02, 0.03),
        ClearResult(Verdict.ACCEPTED),
        [mode(-60.0, 40.0), clear],
        FrameMatcher(PINHOLE, source, GradientDescriber()),
        SHARE,
    )
    assert found is not None and found.mode is clear and found.fix is None
    assert np.allclose(found.view.r_w_c, local_rotation_up(0.1) @ R)


def test_a_place_without_a_pose_is_published_as_one_that_earlier_frames_have_no_part_in(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Belief, "update", lambda *_: 0.0)  # no evidence
    turned = View(float(TRUE_M[0]), float(TRUE_M[1]), local_rotation_up(0.1) @ R, AGL_M, 0.0, 0.03, 0.02, 0.03)
    unused: Any = None
    monkeypatch.setattr(
        "terrafix.anchor.localizer.localize_single_frame",
        lambda *of: ScoredMode(mode(*TRUE_M[:2]), turned, unused, 0.0, 0.0),
    )
    package: Any = SingleMapPackage(ground)
    frames = MemoryFrameStore(2)
    node = AnchorNode(frames, package, GradientDescriber(), 1.0)
    list(node.on(ORIGIN))
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    match, *_ = node.on(predicted(1, 90.0, at_m=TRUE_M))
    assert isinstance(match, MapMatch) and match.verdict is Verdict.ACCEPTED and match.pose is not None
    assert not match.position_only and match.pose.p_c_in_w_m[:2] == pytest.approx(TRUE_M[:2])
    assert np.allclose(rot_from_quat(match.pose.q_w_c), turned.r_w_c)
    sigma_m = np.sqrt(np.linalg.eigvalsh(ground_cov_m2(match.pose.cov, AGL_M)))
    assert (sigma_m >= np.hypot(3.0, 0.03 * AGL_M)).all() and (sigma_m < 0.1 * AGL_M).all()


def test_a_lower_false_alarm_probability_requires_more_evidence(ground: np.ndarray) -> None:
    frame, modes = view(ground, PINHOLE, R, TRUE_M), [mode(-60.0, 40.0), mode(80.0, 70.0), mode(*TRUE_M[:2])]
    assert selected_mode(ground, frame, modes) is not None
    assert selected_mode(ground, frame, modes, log_probability=-60.0) is None


def test_ground_that_is_not_on_the_map_selects_no_mode(ground: np.ndarray) -> None:
    other = view(texture(9, SIDE_M), PINHOLE, R, TRUE_M)
    assert selected_mode(ground, other, [mode(20.0 * e, 20.0 * n) for e in (-3, 0, 3) for n in (-3, 0, 3)]) is None
    assert selected_mode(ground, other, []) is None


def test_repeated_ground_selects_no_mode(ground: np.ndarray) -> None:
    half = ground[:, : round(220.0 / GSD_M)]
    twice = np.hstack([half, half])
    places = [np.array([e_m, 0.0, AGL_M]) for e_m in (-110.0, 110.0)]
    frame = view(twice, PINHOLE, R, places[0])
    elsewhere = [mode(places[0][0] + e_m, n_m) for e_m in (-60.0, 60.0) for n_m in (-70.0, 0.0, 70.0)]
    here, there = (mode(*place[:2]) for place in places)
    assert selected_mode(twice, frame, [here, there, *elsewhere]) is None
    assert selected_mode(twice, frame, [here, *elsewhere]) is not None
    assert selected_mode(twice, frame, [here]) is None, "nothing to compare it with"


@pytest.mark.slow
@pytest.mark.parametrize(("sigma_m", "verdict"), [(90.0, Verdict.ACCEPTED), (30.0, Verdict.AMBIGUOUS)])
def test_an_undecided_correlation_is_decided_by_patches_if_the_position_sigma_is_large(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch, sigma_m: float, verdict: Verdict
) -> None:
    monkeypatch.setattr(Belief, "update", lambda *_: 0.0)  # no evidence
    log_probabilities = list[float]()
    monkeypatch.setattr(
        "terrafix.anchor.localizer.localize_single_frame",
        lambda *of: log_probabilities.append(of[-1]) or localize_single_frame(*of),
    )
    package: Any = SingleMapPackage(ground)
    frames = MemoryFrameStore(2)
    node = AnchorNode(frames, package, GradientDescriber(), 1.0)
    list(node.on(ORIGIN))
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    near = predicted(1, sigma_m, at_m=TRUE_M + np.array([*NEAR_M, 0.0]))
    match, *_ = node.on(near)
    assert isinstance(match, MapMatch) and match.verdict is verdict
    assert log_probabilities == ([SHARE] if verdict is Verdict.ACCEPTED else [])
    if verdict is Verdict.ACCEPTED:
        assert np.linalg.norm(np.array(position_of(match)) - TRUE_M) < 3.0


def test_small_steps_add_up_to_the_new_ground_that_another_single_frame_needs(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A copter moves a few metres between two images; its frames are never a third of a footprint apart."""
    monkeypatch.setattr(Belief, "update", lambda *_: 0.0)  # no evidence
    tried, frame_id = list[int](), 0
    monkeypatch.setattr("terrafix.anchor.localizer.localize_single_frame", lambda *_: tried.append(frame_id))
    package: Any = SingleMapPackage(ground)
    frames = MemoryFrameStore(2)
    node = AnchorNode(frames, package, GradientDescriber(), 1.0)
    list(node.on(ORIGIN))
    for frame_id in range(1, 13):
        frames.put(frame_id, view(ground, PINHOLE, R, TRUE_M))
        list(node.on(predicted(frame_id, 90.0, step_m=0.0 if frame_id == 1 else 0.1 * AGL_M)))
    assert tried[0] == 1 and 2 not in tried
    assert 2 <= len(tried) <= 4, "12 steps are 1.1 heights of motion"
