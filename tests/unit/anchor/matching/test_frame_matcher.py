"""Frame matcher: grid of hypotheses, correlation surface, and the fix at a known position."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from terrafix.anchor.matching import frame_matcher
from terrafix.anchor.matching.frame_matcher import (
    AS_PREDICTED,
    LEARNED_INLIERS,
    MAX_FINE_HYPOTHESES,
    MAX_HYPOTHESES,
    CorrelationResult,
    FrameMatcher,
    Hypothesis,
    View,
    hypotheses_of,
)
from terrafix.anchor.matching.match_message import pose_match
from terrafix.anchor.matching.point_mass_filter import Belief, Surface
from terrafix.core.geodesy import local_rotation_up
from terrafix.core.pose import exp_so3, log_so3
from terrafix.messages import MapMatch, MatchPlace, Verdict
from terrafix_engines.features import open_describer
from terrafix_engines.features.gradient import GradientDescriber
from textured_ground import PINHOLE, FlatMap, SlopedMap, rotation, texture, view

AGL_M = 100.0
CELL_M = 2.0  # of the belief
TRUE_M = np.array([22.0, -31.0, AGL_M])
TRUE_R = rotation(40.0)


def predicted_view(
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


def test_a_frame_is_halved_once_for_all_looks(
    matcher: FrameMatcher, frame: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    halve, calls = cv2.resize, list[tuple[int, ...]]()
    monkeypatch.setattr(cv2, "resize", lambda *a, **k: calls.append(a[0].shape) or halve(*a, **k))
    for turned in range(5):
        pyramid = matcher.pyramid(frame, matcher.gradients)
        matcher.rectify_all(pyramid, predicted_view(), [Hypothesis(0.3 * turned, 1.0)], 4.0, 1)
    assert len(calls) >= 2 and len(calls) == len(set(calls))


# --- the grid of hypotheses -----------------------------------------------------------------------


def test_known_yaw_and_scale_give_one_hypothesis() -> None:
    assert hypotheses_of(predicted_view(yaw_sigma_deg=1.0, scale_sigma=0.02)) == (Hypothesis(0.0, 1.0),)


@pytest.mark.parametrize(("yaw_sigma_deg", "scale_sigma"), [(3.0, 0.03), (8.0, 0.02), (2.0, 0.1), (10.0, 0.08)])
def test_the_grid_covers_one_and_a_half_sigmas(yaw_sigma_deg: float, scale_sigma: float) -> None:
    grid = hypotheses_of(predicted_view(yaw_sigma_deg=yaw_sigma_deg, scale_sigma=scale_sigma))
    yaws, scales = sorted({h.yaw_rad for h in grid}), sorted({h.scale for h in grid})
    assert len(grid) == len(yaws) * len(scales)  # the product of yaws and scales
    assert Hypothesis(0.0, 1.0) in grid
    tolerated_deg = 4.0  # tolerance of the descriptors
    assert np.degrees(yaws[-1]) + tolerated_deg >= 1.5 * yaw_sigma_deg
    assert scales[-1] + 0.05 >= 1.0 + 1.5 * scale_sigma
    assert np.degrees(np.diff(yaws)).max(initial=0.0) <= 2 * tolerated_deg
    assert yaws == pytest.approx([-y for y in reversed(yaws)])


def test_without_a_compass_all_yaws_are_hypotheses() -> None:
    grid = hypotheses_of(predicted_view(yaw_sigma_deg=170.0, scale_sigma=0.02))
    assert len(grid) <= MAX_HYPOTHESES
    yaws = np.sort(np.degrees([h.yaw_rad for h in grid if h.scale == 1.0]))
    assert yaws[0] <= -172.0 and yaws[-1] >= 172.0 and np.diff(yaws).max() <= 8.0


def test_without_compass_and_height_every_yaw_is_combined_with_every_scale() -> None:
    grid = hypotheses_of(predicted_view(yaw_sigma_deg=170.0, scale_sigma=0.4))
    yaws, scales = sorted({h.yaw_rad for h in grid}), sorted({h.scale for h in grid})
    assert MAX_HYPOTHESES < len(grid) == len(yaws) * len(scales) < 350
    assert yaws[0] <= np.radians(-172.0) and yaws[-1] >= np.radians(172.0) and np.diff(yaws).max() <= np.radians(13.0)
    assert scales[0] <= 0.63 and scales[-1] >= 1.6 and 1.0 in scales
    assert np.diff(np.log(scales)).max() <= 0.101


def test_hypotheses_above_the_limit_are_spread_over_consecutive_frames(matcher: FrameMatcher) -> None:
    grid = hypotheses_of(predicted_view(yaw_sigma_deg=170.0, scale_sigma=0.4))
    turns = [matcher._next_subset(grid) for _ in range(4)]
    assert max(len(turn) for turn in turns) < 1.1 * MAX_HYPOTHESES
    assert sorted((h.yaw_rad, h.scale) for turn in turns for h in turn) == sorted((h.yaw_rad, h.scale) for h in grid)
    assert 1.0 in {h.scale for h in turns[0]} and matcher._next_subset(grid) == turns[0]
    few = hypotheses_of(predicted_view(yaw_sigma_deg=8.0, scale_sigma=0.1))
    assert matcher._next_subset(few) == few == matcher._next_subset(few)


# --- correlation ----------------------------------------------------------------------------------


def test_the_place_stands_out(matcher: FrameMatcher, frame: np.ndarray) -> None:
    belief = Belief(0.0, 0.0, 25.0, CELL_M)
    result = matcher.correlate(frame, predicted_view(), belief)
    assert result.verdict is Verdict.ACCEPTED and len(result.surfaces) == len(result.hypotheses) == 1
    _, here = result.best_at(*TRUE_M[:2])
    _, elsewhere = result.best_at(-40.0, 50.0)
    assert here > 5.0 > elsewhere
    belief.update(result.surfaces, 1.0)
    mode = belief.mode()
    assert (mode.e_m, mode.n_m) == pytest.approx(tuple(TRUE_M[:2]), abs=4.0)


def test_shipped_weights_are_a_second_channel_where_the_position_is_not_known(
    matcher: FrameMatcher, ground: np.ndarray, frame: np.ndarray
) -> None:
    learned = FrameMatcher(PINHOLE, FlatMap(ground), open_describer("terrafix-1"))  # type: ignore[arg-type]
    belief = Belief(0.0, 0.0, 25.0, CELL_M)
    (alone,) = matcher.correlate(frame, predicted_view(), belief).surfaces
    both = learned.correlate(frame, predicted_view(), belief)
    row, column = np.unravel_index(np.nanargmax(both.surfaces[0].z), alone.z.shape)
    peak_m = alone.e0_m + column * alone.cell_m, alone.n0_m - row * alone.cell_m
    assert peak_m == pytest.approx(tuple(TRUE_M[:2]), abs=4.0)
    difference = np.nan_to_num(both.surfaces[0].z - alone.z)
    assert 0.3 < difference.std() < 1.5
    given = learned.correlate_as(frame, predicted_view(), belief, (AS_PREDICTED,))
    assert given.scores == both.scores  # other shapes of the image are compared with these
    known = replace(predicted_view(), sigma_m=10.0)
    np.testing.assert_array_equal(learned.correlate(frame, known, belief).surfaces[0].z, alone.z)


def test_a_second_surface_is_added_place_by_place_whatever_its_cells() -> None:
    """A peak of each at one place, and one of the second at another; unknown where the second one ends."""
    noise = np.random.default_rng(3).normal(0.0, 1.0, (2, 200, 200)).astype(np.float32)
    first, second = Surface(noise[0], -200.0, 200.0, 2.0), Surface(noise[1], -150.0, 240.0, 3.0)
    first.z[100, 50] = 6.0  # east -100, north 0
    second.z[79:82, 15:19] = 6.0  # the same
    second.z[30:33, 60:63] = 6.0
    found = CorrelationResult(Verdict.ACCEPTED, (first,), (Hypothesis(0.0, 1.0),))
    added = found.with_second(replace(found, surfaces=(second,))).surfaces[0]
    assert np.nanargmax(added.z) == np.ravel_multi_index((100, 50), added.z.shape)
    assert added.z[100, 50] > 6.0
    assert np.isnan(added.z[:, :24]).all() and np.isfinite(added.z[:, 26:]).all()  # the second begins at east -150
    other = replace(found, surfaces=(second,), hypotheses=(Hypothesis(0.1, 1.0),))
    assert found.with_second(other) is found


@pytest.mark.slow
def test_yaw_and_scale_are_found_with_the_position(matcher: FrameMatcher, frame: np.ndarray) -> None:
    off = local_rotation_up(np.radians(-14.0)) @ TRUE_R
    wrong = predicted_view(r=off, agl_m=AGL_M / 1.08, yaw_sigma_deg=12.0, scale_sigma=0.08)
    belief = Belief(0.0, 0.0, 25.0, CELL_M)
    result = matcher.correlate(frame, wrong, belief)
    hypothesis, score = result.best_at(*TRUE_M[:2])
    assert score > 5.0
    assert np.degrees(hypothesis.yaw_rad) == pytest.approx(14.0, abs=4.0)
    assert hypothesis.scale == pytest.approx(1.08, abs=0.05)


def test_correlation_off_the_map_is_outside_map(matcher: FrameMatcher, frame: np.ndarray) -> None:
    assert (
        matcher.correlate(frame, predicted_view(5000.0, 0.0), Belief(5000.0, 0.0, 20.0, CELL_M)).verdict
        is Verdict.OUTSIDE_MAP
    )


def test_a_camera_that_sees_the_sky_is_too_low(matcher: FrameMatcher, frame: np.ndarray) -> None:
    up = predicted_view(r=rotation(0.0, 150.0))
    assert matcher.correlate(frame, up, Belief(0.0, 0.0, 20.0, CELL_M)).verdict is Verdict.TOO_LOW
    assert matcher.fix(frame, up, Hypothesis(0.0, 1.0), 0.0, 0.0) is None


# --- the fix --------------------------------------------------------------------------------------------


def test_the_fix_at_a_known_position_gives_the_pose(matcher: FrameMatcher, frame: np.ndarray) -> None:
    fix = matcher.fix(frame, predicted_view(), Hypothesis(0.0, 1.0), float(TRUE_M[0]) + 3.0, float(TRUE_M[1]) - 2.0)
    assert fix is not None and fix.pnp.fit is not None and fix.pnp.verdict is Verdict.ACCEPTED
    assert np.linalg.norm(fix.pnp.fit.p_c_in_w_m - TRUE_M) < 1.5
    assert np.degrees(np.linalg.norm(log_so3(TRUE_R.T @ fix.pnp.fit.r_w_c))) < 0.6
    assert fix.pnp.inliers.mean() > 0.9 and not fix.refined
    assert fix.xy.shape == (len(fix.weights), 2) and fix.points_w_m.shape == (len(fix.weights), 3)


SLOPE, AMSL_M = (0.06, -0.03), 500.0


class PartlyKnownDem(SlopedMap):
    """The DEM is unknown west of the camera."""

    def elevation(self, e_m: np.ndarray, n_m: np.ndarray) -> np.ndarray | None:
        return np.where(e_m < TRUE_M[0], np.nan, super().elevation(e_m, n_m))


def over_slope(
    ground: np.ndarray, world: SlopedMap, slope: tuple[float, float] = SLOPE, r: np.ndarray = TRUE_R
) -> tuple[FrameMatcher, np.ndarray, View, np.ndarray]:
    """The matcher, a view of the slope from AGL_M above it, a plane through the ground below the camera as the
    prediction, and the true position (3,)."""
    below_m = float(np.dot(slope, TRUE_M[:2]))
    image = view(ground, PINHOLE, r, np.array([*TRUE_M[:2], below_m + AGL_M]), slope)
    believed = replace(predicted_view(*TRUE_M[:2].tolist(), r=r), ground_m=AMSL_M + below_m, sigma_m=10.0)
    matcher = FrameMatcher(PINHOLE, world, GradientDescriber())  # type: ignore[arg-type]
    return matcher, image, believed, np.array([*TRUE_M[:2], AMSL_M + below_m + AGL_M])


IN_A_TURN, STEEP = rotation(40.0, 2.0, 40.0), (0.2, -0.1)


@pytest.mark.parametrize(("slope", "r"), [(SLOPE, TRUE_R), (STEEP, IN_A_TURN)])
def test_the_matched_map_points_have_the_heights_of_the_dem(
    ground: np.ndarray, slope: tuple[float, float], r: np.ndarray
) -> None:
    """Taken for a plane, a slope of 6 % would tilt the pose by three degrees. In a turn 20 of 48 patches would match a
    frame that is projected on a plane, and its best place would be 3 m off."""
    matcher, image, believed, true_m = over_slope(ground, SlopedMap(ground, slope, AMSL_M), slope, r)
    belief = Belief(believed.e_m, believed.n_m, 20.0, CELL_M)
    belief.update(matcher.correlate(image, believed, belief).surfaces, 1.0)
    assert np.hypot(*(np.array([belief.mode().e_m, belief.mode().n_m]) - true_m[:2])) < 1.0
    fix = matcher.fix(image, believed, Hypothesis(0.0, 1.0), believed.e_m, believed.n_m)
    assert fix is not None and fix.pnp.verdict is Verdict.ACCEPTED
    e_m, n_m, up_m = fix.points_w_m.T
    assert up_m == pytest.approx(AMSL_M + slope[0] * e_m + slope[1] * n_m)
    assert np.ptp(up_m) > 4.0
    assert fix.pnp.fit is not None
    assert np.linalg.norm(fix.pnp.fit.p_c_in_w_m - true_m) < 0.5
    assert np.degrees(np.linalg.norm(log_so3(r.T @ fix.pnp.fit.r_w_c))) < 0.6
    place = MatchPlace(e_m=float(TRUE_M[0]), n_m=float(TRUE_M[1]), mass=1.0)
    empty = MapMatch(t_ns=0, frame_id=0, verdict=Verdict.ACCEPTED, matcher="gradient", place=place)
    published = np.array(pose_match(empty, fix, believed).matches)
    assert len(published) == fix.pnp.inliers.sum() > 40
    assert published[:, 4] == pytest.approx(AMSL_M + published[:, 2:4] @ slope)


def test_where_the_dem_is_unknown_matched_map_points_have_the_predicted_ground_height(ground: np.ndarray) -> None:
    matcher, image, believed, _ = over_slope(ground, PartlyKnownDem(ground, SLOPE, AMSL_M))
    fix = matcher.fix(image, believed, Hypothesis(0.0, 1.0), believed.e_m, believed.n_m)
    assert fix is not None
    e_m, n_m, up_m = fix.points_w_m.T
    unknown = e_m < TRUE_M[0]
    assert 3 <= unknown.sum() <= len(e_m) - 3
    assert (up_m[unknown] == believed.ground_m).all()
    assert up_m[~unknown] == pytest.approx((AMSL_M + SLOPE[0] * e_m + SLOPE[1] * n_m)[~unknown])


def test_an_unknown_tilt_is_found(ground: np.ndarray, matcher: FrameMatcher) -> None:
    """Nine degrees are 16 m at this height: the apparent position differs from the camera's position."""
    tilted = TRUE_R @ exp_so3(np.radians([9.0, 0.0, 0.0]))
    image = view(ground, PINHOLE, tilted, TRUE_M)
    # position from which a level camera would see the same ground
    apparent = TRUE_M[:2] + (tilted[:2, 2] / -tilted[2, 2]) * AGL_M
    fix = matcher.fix(image, predicted_view(tilt_sigma_deg=12.0), Hypothesis(0.0, 1.0), *apparent.tolist())
    assert fix is not None and fix.pnp.fit is not None and fix.refined
    assert np.degrees(np.linalg.norm(log_so3(tilted.T @ fix.pnp.fit.r_w_c))) < 1.5
    assert np.linalg.norm(fix.pnp.fit.p_c_in_w_m[:2] - TRUE_M[:2]) < 3.0


def test_a_wrong_position_gives_no_pose(matcher: FrameMatcher, frame: np.ndarray) -> None:
    accepted = 0
    for e_m, n_m in ((-60.0, 40.0), (60.0, 60.0), (-50.0, -70.0), (80.0, -20.0), (0.0, 90.0)):
        fix = matcher.fix(frame, predicted_view(), Hypothesis(0.0, 1.0), e_m, n_m)
        accepted += fix is not None and fix.pnp.verdict is Verdict.ACCEPTED
    assert accepted == 0


class Learned:
    """Stand-in for a learned model with coarse cells; counts its calls."""

    name, stride, channels, grayscale, context_px = "xfeat", 8, 16, False, 32

    def __init__(self) -> None:
        self.calls = 0

    def describe(self, image: np.ndarray) -> np.ndarray:
        self.calls += 1
        cells = cv2.resize(image, None, fx=1 / self.stride, fy=1 / self.stride, interpolation=cv2.INTER_AREA)
        gray = cv2.cvtColor(cells, cv2.COLOR_BGR2GRAY).astype(np.float32)
        return np.stack([np.roll(gray, (i, j), (0, 1)) for i in range(-2, 2) for j in range(-2, 2)]) / 255.0


def test_the_learned_model_is_used_where_gradients_give_no_pose(
    ground: np.ndarray, frame: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    learned = Learned()
    both = FrameMatcher(PINHOLE, FlatMap(ground), learned)  # type: ignore[arg-type]
    place = predicted_view(), Hypothesis(0.0, 1.0), *TRUE_M[:2].tolist()
    fix = both.fix(frame, *place)
    assert fix is not None and fix.pnp.verdict is Verdict.ACCEPTED and fix.cell_m < 1.0
    assert learned.calls == 0
    rng = np.random.default_rng(7)

    def noise(_self: object, image: np.ndarray) -> np.ndarray:
        return rng.normal(size=(8, *image.shape[:2])).astype(np.float32)

    monkeypatch.setattr(GradientDescriber, "describe", noise)
    changed = FrameMatcher(PINHOLE, FlatMap(ground), learned)  # type: ignore[arg-type]
    fix = changed.fix(frame, *place)
    assert learned.calls > 0
    assert fix is not None and fix.pnp.verdict is Verdict.ACCEPTED and fix.cell_m > 2.0
    assert fix.pnp.inliers.sum() >= LEARNED_INLIERS
    assert fix.pnp.fit is not None and np.linalg.norm(fix.pnp.fit.p_c_in_w_m - TRUE_M) < 3.0


def scales_scored(**z: float) -> CorrelationResult:
    """Correlation result for the scales 0.92, 1 and 1.08 with these scores at every position."""
    scored = {"small": 0.92, "same": 1.0, "large": 1.08}
    surfaces = tuple(Surface(np.full((5, 5), z[name], np.float32), -4.0, 4.0, 2.0) for name in scored)
    hypotheses = tuple(Hypothesis(0.0, scale) for scale in scored.values())
    return CorrelationResult(Verdict.ACCEPTED, surfaces, hypotheses, 100.0, 2.0)


def test_the_variance_of_the_measured_scale_falls_with_the_contrast_of_the_scores() -> None:
    sharp, leaning = scales_scored(small=2.0, same=5.0, large=2.0), scales_scored(small=3.0, same=5.0, large=4.9)
    mean, variance = sharp.scale_at(0.0, 0.0) or (0.0, 0.0)
    # the true scale lies within half a step, whose 1-sigma is about a third of a step
    assert mean == pytest.approx(1.0, abs=1e-3) and np.sqrt(variance) < 0.03
    mean, less_sure = leaning.scale_at(0.0, 0.0) or (0.0, 0.0)
    assert 1.02 < mean < 1.04 and less_sure > 2.0 * variance


def test_nearly_equal_scores_give_no_precise_scale_measurement() -> None:
    """The scales are chosen by the prediction; as a measurement they would confirm it with every frame."""
    measured = scales_scored(small=4.99, same=5.0, large=4.99).scale_at(0.0, 0.0)
    assert measured is None or np.sqrt(measured[1]) > 0.5


def test_the_best_scale_at_the_end_of_the_grid_gives_no_measurement() -> None:
    assert scales_scored(small=3.0, same=4.0, large=5.0).scale_at(0.0, 0.0) is None
    assert scales_scored(small=5.0, same=4.0, large=3.0).scale_at(0.0, 0.0) is None


def test_of_many_hypotheses_the_best_are_correlated_on_fine_cells_and_find_the_place(
    matcher: FrameMatcher, frame: np.ndarray
) -> None:
    belief, wrong = Belief(0.0, 0.0, 30.0, CELL_M), local_rotation_up(np.radians(-7.0))
    few = matcher.correlate(frame, predicted_view(scale_sigma=0.06), belief)
    many = matcher.correlate(frame, predicted_view(r=wrong @ TRUE_R, yaw_sigma_deg=8.0, scale_sigma=0.06), belief)
    assert len(few.surfaces) < MAX_FINE_HYPOTHESES == len(many.surfaces) == len(set(many.hypotheses))
    assert many.cell_m == few.cell_m
    hypothesis, z = many.best_at(TRUE_M[0], TRUE_M[1])
    assert z > 5.0 and hypothesis == Hypothesis(pytest.approx(np.radians(7.0)), 1.0)  # type: ignore[arg-type]


def test_a_wide_window_is_correlated_on_means_of_fine_descriptors(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ground whose only structure is finer than the cells of the window: a map of larger pixels would show none."""
    fine = np.random.default_rng(4).integers(0, 255, (480, 480, 3), np.uint8)
    clods = cv2.resize(fine, (960, 960), interpolation=cv2.INTER_LINEAR)
    flat = (ground[:960, :960] * 0.0 + clods).astype(np.uint8)
    matcher, place_m = FrameMatcher(PINHOLE, FlatMap(flat), GradientDescriber()), np.array([22.0, -31.0, AGL_M])  # type: ignore[arg-type]
    seen, belief = view(flat, PINHOLE, TRUE_R, place_m), Belief(0.0, 0.0, 30.0, CELL_M)
    narrow = matcher.correlate(seen, predicted_view(), belief)
    monkeypatch.setattr(frame_matcher, "MAX_WINDOW_CELLS", int(2 * belief.half_m / narrow.cell_m / 3))
    wide = matcher.correlate(seen, predicted_view(), belief)
    assert wide.cell_m == 4.0 * narrow.cell_m
    assert wide.best_at(place_m[0], place_m[1])[1] > 6.0


def test_the_best_hypotheses_keep_their_order() -> None:
    surfaces = tuple(Surface(np.array([[0.0, z, np.nan]]), 0.0, 0.0, 1.0) for z in (3.0, 5.0, 1.0, 4.0))
    given = tuple(Hypothesis(0.1 * k, 1.0) for k in range(4))
    assert CorrelationResult(Verdict.ACCEPTED, surfaces, given).best_hypotheses(2) == (given[1], given[3])
