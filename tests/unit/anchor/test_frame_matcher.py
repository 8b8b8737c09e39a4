"""A frame against the map: rotations and scales that are tried, and what look and fix make of a known place."""

import cv2
import numpy as np
import pytest

from ground import PINHOLE, FlatMap, rotation, texture, view
from terrafix.anchor.matching.frame_matcher import (
    LEARNED_INLIERS,
    MAX_HYPOTHESES,
    CorrelationResult,
    FrameMatcher,
    Hypothesis,
    View,
    _hypotheses,
)
from terrafix.anchor.matching.point_mass_filter import Belief, Surface
from terrafix.core.geodesy import local_rotation_up
from terrafix.core.pose import exp_so3, log_so3
from terrafix.messages import Verdict
from terrafix_engines.features.gradient import GradientDescriber

AGL_M = 100.0
CELL_M = 2.0  # of the belief
TRUE_M = np.array([22.0, -31.0, AGL_M])
TRUE_R = rotation(40.0)


def seen_from(
    e_m: float = 0.0,
    n_m: float = 0.0,
    *,
    r: np.ndarray = TRUE_R,
    agl_m: float = AGL_M,
    yaw_sigma_deg: float = 1.0,
    scale_sigma: float = 0.02,
    tilt_sigma_deg: float = 1.0,
) -> View:
    return View(
        e_m, n_m, r, agl_m, 0.0, float(np.radians(yaw_sigma_deg)), scale_sigma, float(np.radians(tilt_sigma_deg))
    )


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    return texture(8, 480.0)


@pytest.fixture(scope="module")
def frame(ground: np.ndarray) -> np.ndarray:
    return view(ground, PINHOLE, TRUE_R, TRUE_M)


@pytest.fixture(scope="module")
def matcher(ground: np.ndarray) -> FrameMatcher:
    return FrameMatcher(PINHOLE, FlatMap(ground), GradientDescriber())  # type: ignore[arg-type]


def test_a_frame_is_blurred_once_for_all_headings(
    matcher: FrameMatcher, frame: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = [matcher.rectified(frame, seen_from(), [Hypothesis(0.3 * k, 1.0)], 2.0, 1)[0] for k in range(5)]
    blur, calls = cv2.GaussianBlur, []
    monkeypatch.setattr(cv2, "GaussianBlur", lambda *a: calls.append(a) or blur(*a))
    together = matcher.rectified(frame, seen_from(), [Hypothesis(0.3 * k, 1.0) for k in range(5)], 2.0, 1)
    assert len(calls) == 1
    for one, other in zip(alone, together, strict=True):
        assert one is not None and other is not None
        assert np.array_equal(one.image, other.image) and np.array_equal(one.mask, other.mask)


# --- the grid of hypotheses -----------------------------------------------------------------------


def test_what_is_known_is_not_searched() -> None:
    assert _hypotheses(seen_from(yaw_sigma_deg=1.0, scale_sigma=0.02)) == (Hypothesis(0.0, 1.0),)


@pytest.mark.parametrize(("yaw_sigma_deg", "scale_sigma"), [(3.0, 0.03), (8.0, 0.02), (2.0, 0.1), (10.0, 0.08)])
def test_the_grid_covers_one_and_a_half_sigmas(yaw_sigma_deg: float, scale_sigma: float) -> None:
    grid = _hypotheses(seen_from(yaw_sigma_deg=yaw_sigma_deg, scale_sigma=scale_sigma))
    yaws, scales = sorted({h.yaw_rad for h in grid}), sorted({h.scale for h in grid})
    assert len(grid) == len(yaws) * len(scales)  # every rotation with every scale
    assert Hypothesis(0.0, 1.0) in grid
    tolerated_deg = 4.0  # what the descriptors bear
    assert np.degrees(yaws[-1]) + tolerated_deg >= 1.5 * yaw_sigma_deg
    assert scales[-1] + 0.05 >= 1.0 + 1.5 * scale_sigma
    assert np.degrees(np.diff(yaws)).max(initial=0.0) <= 2 * tolerated_deg
    assert yaws == pytest.approx([-y for y in reversed(yaws)])


def test_no_compass_means_all_round() -> None:
    grid = _hypotheses(seen_from(yaw_sigma_deg=170.0, scale_sigma=0.02))
    assert len(grid) <= MAX_HYPOTHESES
    yaws = np.sort(np.degrees([h.yaw_rad for h in grid if h.scale == 1.0]))
    assert yaws[0] <= -172.0 and yaws[-1] >= 172.0 and np.diff(yaws).max() <= 8.0


def test_neither_compass_nor_height_means_every_heading_at_every_height() -> None:
    grid = _hypotheses(seen_from(yaw_sigma_deg=170.0, scale_sigma=0.4))
    yaws, scales = sorted({h.yaw_rad for h in grid}), sorted({h.scale for h in grid})
    assert MAX_HYPOTHESES < len(grid) == len(yaws) * len(scales) < 350
    assert yaws[0] <= np.radians(-172.0) and yaws[-1] >= np.radians(172.0) and np.diff(yaws).max() <= np.radians(13.0)
    assert scales[0] <= 0.63 and scales[-1] >= 1.6 and 1.0 in scales
    assert np.diff(np.log(scales)).max() <= 0.101


def test_one_frame_looks_at_no_more_than_it_can_pay_for_and_the_next_at_the_rest(matcher: FrameMatcher) -> None:
    grid = _hypotheses(seen_from(yaw_sigma_deg=170.0, scale_sigma=0.4))
    turns = [matcher._in_turn(grid) for _ in range(4)]
    assert max(len(turn) for turn in turns) < 1.1 * MAX_HYPOTHESES
    assert sorted((h.yaw_rad, h.scale) for turn in turns for h in turn) == sorted((h.yaw_rad, h.scale) for h in grid)
    assert 1.0 in {h.scale for h in turns[0]} and matcher._in_turn(grid) == turns[0]
    few = _hypotheses(seen_from(yaw_sigma_deg=8.0, scale_sigma=0.1))
    assert matcher._in_turn(few) == few == matcher._in_turn(few)


# --- looking ------------------------------------------------------------------------------------------


def test_the_place_stands_out(matcher: FrameMatcher, frame: np.ndarray) -> None:
    belief = Belief(0.0, 0.0, 25.0, CELL_M)
    look = matcher.look(frame, seen_from(), belief)
    assert look.verdict is Verdict.ACCEPTED and len(look.surfaces) == len(look.hypotheses) == 1
    _, here = look.best_at(*TRUE_M[:2])
    _, elsewhere = look.best_at(-40.0, 50.0)
    assert here > 5.0 > elsewhere
    belief.update(look.surfaces, 1.0)
    mode = belief.mode()
    assert (mode.e_m, mode.n_m) == pytest.approx(tuple(TRUE_M[:2]), abs=4.0)


def test_heading_and_scale_are_found_with_the_place(matcher: FrameMatcher, frame: np.ndarray) -> None:
    off = local_rotation_up(np.radians(-14.0)) @ TRUE_R
    wrong = seen_from(r=off, agl_m=AGL_M / 1.08, yaw_sigma_deg=12.0, scale_sigma=0.08)
    belief = Belief(0.0, 0.0, 25.0, CELL_M)
    look = matcher.look(frame, wrong, belief)
    hypothesis, score = look.best_at(*TRUE_M[:2])
    assert score > 5.0
    assert np.degrees(hypothesis.yaw_rad) == pytest.approx(14.0, abs=4.0)
    assert hypothesis.scale == pytest.approx(1.08, abs=0.05)


def test_looking_off_the_map(matcher: FrameMatcher, frame: np.ndarray) -> None:
    assert matcher.look(frame, seen_from(5000.0, 0.0), Belief(5000.0, 0.0, 20.0, CELL_M)).verdict is Verdict.OUTSIDE_MAP


def test_looking_at_the_sky(matcher: FrameMatcher, frame: np.ndarray) -> None:
    up = seen_from(r=rotation(0.0, 150.0))
    assert matcher.look(frame, up, Belief(0.0, 0.0, 20.0, CELL_M)).verdict is Verdict.TOO_LOW
    assert matcher.fix(frame, up, Hypothesis(0.0, 1.0), 0.0, 0.0) is None


# --- the fix --------------------------------------------------------------------------------------------


def test_the_pose_of_a_known_place(matcher: FrameMatcher, frame: np.ndarray) -> None:
    fix = matcher.fix(frame, seen_from(), Hypothesis(0.0, 1.0), float(TRUE_M[0]) + 3.0, float(TRUE_M[1]) - 2.0)
    assert fix is not None and fix.pnp.fit is not None and fix.pnp.verdict is Verdict.ACCEPTED
    assert np.linalg.norm(fix.pnp.fit.p_c_in_w_m - TRUE_M) < 1.5
    assert np.degrees(np.linalg.norm(log_so3(TRUE_R.T @ fix.pnp.fit.r_w_c))) < 0.6
    assert fix.pnp.inliers.mean() > 0.9
    assert fix.xy.shape == (len(fix.weights), 2) and fix.points_w_m.shape == (len(fix.weights), 3)


def test_a_tilt_that_nobody_knew_is_found(ground: np.ndarray, matcher: FrameMatcher) -> None:
    """Nine degrees, worth 16 m at this height: the camera is elsewhere than the picture seems to say."""
    tilted = TRUE_R @ exp_so3(np.radians([9.0, 0.0, 0.0]))
    picture = view(ground, PINHOLE, tilted, TRUE_M)
    apparent = TRUE_M[:2] + (tilted[:2, 2] / -tilted[2, 2]) * AGL_M  # where a level camera would see the same
    fix = matcher.fix(picture, seen_from(tilt_sigma_deg=12.0), Hypothesis(0.0, 1.0), *apparent.tolist())
    assert fix is not None and fix.pnp.fit is not None
    assert np.degrees(np.linalg.norm(log_so3(tilted.T @ fix.pnp.fit.r_w_c))) < 1.5
    assert np.linalg.norm(fix.pnp.fit.p_c_in_w_m[:2] - TRUE_M[:2]) < 3.0


def test_a_wrong_place_gives_no_pose(matcher: FrameMatcher, frame: np.ndarray) -> None:
    accepted = 0
    for e_m, n_m in ((-60.0, 40.0), (60.0, 60.0), (-50.0, -70.0), (80.0, -20.0), (0.0, 90.0)):
        fix = matcher.fix(frame, seen_from(), Hypothesis(0.0, 1.0), e_m, n_m)
        accepted += fix is not None and fix.pnp.verdict is Verdict.ACCEPTED
    assert accepted == 0


class Learned:
    """Stands in for a learned model: coarse cells, and it counts how often it is asked."""

    name, stride, channels = "xfeat", 8, 16

    def __init__(self) -> None:
        self.asked = 0

    def describe(self, image: np.ndarray) -> np.ndarray:
        self.asked += 1
        cells = cv2.resize(image, None, fx=1 / self.stride, fy=1 / self.stride, interpolation=cv2.INTER_AREA)
        gray = cv2.cvtColor(cells, cv2.COLOR_BGR2GRAY).astype(np.float32)
        return np.stack([np.roll(gray, (i, j), (0, 1)) for i in range(-2, 2) for j in range(-2, 2)]) / 255.0


def test_a_learned_model_is_asked_for_a_pose_where_gradients_have_none(
    ground: np.ndarray, frame: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    learned = Learned()
    both = FrameMatcher(PINHOLE, FlatMap(ground), learned)  # type: ignore[arg-type]
    place = seen_from(), Hypothesis(0.0, 1.0), *TRUE_M[:2].tolist()
    fix = both.fix(frame, *place)
    assert fix is not None and fix.pnp.verdict is Verdict.ACCEPTED and fix.cell_m < 1.0
    assert learned.asked == 0
    rng = np.random.default_rng(7)

    def noise(_self: object, image: np.ndarray) -> np.ndarray:
        return rng.normal(size=(8, *image.shape[:2])).astype(np.float32)

    monkeypatch.setattr(GradientDescriber, "describe", noise)
    changed = FrameMatcher(PINHOLE, FlatMap(ground), learned)  # type: ignore[arg-type]
    fix = changed.fix(frame, *place)
    assert learned.asked > 0
    assert fix is not None and fix.pnp.verdict is Verdict.ACCEPTED and fix.cell_m > 2.0
    assert fix.pnp.inliers.sum() >= LEARNED_INLIERS
    assert fix.pnp.fit is not None and np.linalg.norm(fix.pnp.fit.p_c_in_w_m - TRUE_M) < 3.0


def scales_scored(**z: float) -> CorrelationResult:
    """A look at scales of 0.92, 1 and 1.08 that fit as well as this at every position."""
    scored = {"small": 0.92, "same": 1.0, "large": 1.08}
    surfaces = tuple(Surface(np.full((5, 5), z[name], np.float32), -4.0, 4.0, 2.0) for name in scored)
    hypotheses = tuple(Hypothesis(0.0, scale) for scale in scored.values())
    return CorrelationResult(Verdict.ACCEPTED, surfaces, hypotheses, 100.0, 2.0)


def test_the_scale_that_fits_is_told_as_well_as_the_others_fit_worse() -> None:
    sharp, leaning = scales_scored(small=2.0, same=5.0, large=2.0), scales_scored(small=3.0, same=5.0, large=4.9)
    mean, variance = sharp.scale_at(0.0, 0.0) or (0.0, 0.0)
    assert mean == pytest.approx(1.0, abs=1e-3) and np.sqrt(variance) < 0.03  # a third of a step: it lies within half
    mean, less_sure = leaning.scale_at(0.0, 0.0) or (0.0, 0.0)
    assert 1.02 < mean < 1.04 and less_sure > 2.0 * variance


def test_scales_that_all_fit_alike_tell_next_to_nothing() -> None:
    """It is the prediction that chose them: taken for a measurement it would confirm itself look after look."""
    told = scales_scored(small=4.99, same=5.0, large=4.99).scale_at(0.0, 0.0)
    assert told is None or np.sqrt(told[1]) > 0.5


def test_a_scale_at_the_end_of_those_that_were_tried_is_not_told() -> None:
    assert scales_scored(small=3.0, same=4.0, large=5.0).scale_at(0.0, 0.0) is None
    assert scales_scored(small=5.0, same=4.0, large=3.0).scale_at(0.0, 0.0) is None


def test_twice_the_same(matcher: FrameMatcher, frame: np.ndarray) -> None:
    looks = [matcher.look(frame, seen_from(yaw_sigma_deg=8.0), Belief(0.0, 0.0, 25.0, CELL_M)) for _ in range(2)]
    for a, b in zip(looks[0].surfaces, looks[1].surfaces, strict=True):
        assert np.array_equal(a.z, b.z, equal_nan=True)
