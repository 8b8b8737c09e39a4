"""Mosaic of frames joined by odometry: one template with a higher peak than a frame, at the right heading only."""

import numpy as np
import pytest

from terrafix.anchor.matching.frame_matcher import Hypothesis
from terrafix.anchor.matching.ncc import standardise
from terrafix.anchor.matching.orthorectify import rectify
from terrafix.anchor.relocalization.block_search import BLOCK_CELLS, Block, BlockCorrelator, Template
from terrafix.anchor.relocalization.mosaic import MAX_MOSAIC_FRAMES, Mosaic, _shifted
from terrafix.core.geodesy import local_rotation_up
from terrafix_engines.features.gradient import GradientDescriber
from textured_ground import PINHOLE, FlatMap, rotation, texture, view

AGL_M, CELL_M = 100.0, 2.0
HEADING_ERROR_DEG = 12.0  # of the compass; odometry has the same heading error
PATH_M = np.array([[-60.0, -40.0], [-30.0, -50.0], [0.0, -20.0], [35.0, -5.0]])
HYPOTHESES = (Hypothesis(0.0, 1.0), Hypothesis(float(np.radians(HEADING_ERROR_DEG)), 1.0))
HERE = Block(-BLOCK_CELLS // 2, -BLOCK_CELLS // 2)


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    return texture(8, 480.0)


def local_turn(deg: float) -> np.ndarray:
    return local_rotation_up(np.radians(deg))[:2, :2]


def mosaic_of_path(ground: np.ndarray, correlator: BlockCorrelator, noise: float) -> tuple[Mosaic, list[Template]]:
    """The mosaic of the path, and the templates of its last frame alone."""
    mosaic, rng, alone = Mosaic(HYPOTHESES, CELL_M), np.random.default_rng(3), list[Template]()
    for p_m in PATH_M:
        true_r = rotation(40.0)
        image = view(ground, PINHOLE, true_r, np.array([*p_m, AGL_M])).astype(float)
        image = np.clip(image + rng.normal(0.0, noise, image.shape), 0, 255).astype(np.uint8)
        predicted_r = local_rotation_up(np.radians(-HEADING_ERROR_DEG)) @ true_r
        frames = [
            rectify(image, PINHOLE, local_rotation_up(h.yaw_rad) @ predicted_r, AGL_M, CELL_M) for h in HYPOTHESES
        ]
        alone = [correlator.describe(frame) for frame in frames if frame is not None]
        mosaic.add(local_turn(-HEADING_ERROR_DEG) @ p_m, 0.0, alone, 1.0, 1e3)
    return mosaic, alone


def test_the_mosaic_has_a_higher_peak_than_a_frame_and_only_with_the_right_heading(ground: np.ndarray) -> None:
    correlator = BlockCorrelator(FlatMap(ground), GradientDescriber())
    mosaic, alone = mosaic_of_path(ground, correlator, 60.0)
    joined = mosaic.templates()
    assert joined[1].mask.sum() > 1.2 * alone[1].mask.sum()
    z = {}
    for name, templates in (("alone", alone), ("joined", joined)):
        (result,) = correlator.correlate(templates, [HERE], CELL_M)
        z[name] = standardise(result.correlation)
        r, c = (int(v) for v in np.unravel_index(int(np.nanargmax(z[name])), z[name].shape))
        if name == "joined":
            assert (HERE.column + c) * CELL_M == pytest.approx(PATH_M[-1][0], abs=2 * CELL_M)
            assert -(HERE.row + r) * CELL_M == pytest.approx(PATH_M[-1][1], abs=2 * CELL_M)
            assert result.index[r, c] == 1
    assert np.nanmax(z["joined"]) > 1.1 * np.nanmax(z["alone"])


def blob(value: float = 1.0) -> Template:
    return Template(np.full((8, 10, 12), value, np.float32), np.ones((10, 12), bool), -12.0, 10.0)


def test_frames_are_joined_by_odometry_with_equal_weights() -> None:
    mosaic = Mosaic((Hypothesis(0.0, 1.0),), CELL_M)
    mosaic.add(np.array([0.0, 0.0]), 0.0, [blob(1.0)], 1.0, 1e3)
    mosaic.add(np.array([8.0, -6.0]), 0.0, [blob(3.0)], 1.0, 1e3)  # 4 cells east, 3 south
    (joined,) = mosaic.templates()
    values = joined.descriptors[0]
    assert joined.mask.sum() == 120 + 120 - 7 * 8
    assert (values == 2.0).sum() == 7 * 8 and (values == 1.0).sum() == (values == 3.0).sum() == 120 - 56
    # The corner of the older frame relative to the newer one.
    assert (joined.e_min_m, joined.n_max_m) == (-12.0 - 8.0, 10.0 + 6.0)


def test_frames_with_a_large_relative_sigma_or_beyond_the_limit_are_dropped() -> None:
    mosaic = Mosaic((Hypothesis(0.0, 1.0),), CELL_M)
    mosaic.add(np.array([0.0, 0.0]), 0.0, [blob()], 5.0, 1e3)
    mosaic.add(np.array([8.0, 0.0]), 30.0, [blob()], 5.0, 1e3)
    (joined,) = mosaic.templates()
    assert joined.mask.sum() == 120
    for k in range(MAX_MOSAIC_FRAMES + 3):
        mosaic.add(np.array([8.0 + 24.0 * k, 0.0]), 30.0, [blob()], 5.0, 1e3)
    (joined,) = mosaic.templates()
    assert joined.mask.sum() == 120 * MAX_MOSAIC_FRAMES
    mosaic.add(np.array([0.0, 0.0]), 30.0, [blob()], 5.0, 50.0)
    (joined,) = mosaic.templates()
    assert joined.mask.sum() == 120


def test_fractions_of_a_cell_move_the_centre_by_as_much() -> None:
    x = np.zeros((1, 7, 7), np.float32)
    x[0, 3, 2] = 2.0
    out = _shifted(x, 0.25, 0.6)[0]
    assert out.sum() == pytest.approx(2.0)
    rows, columns = np.mgrid[0:8, 0:8]
    assert (out * rows).sum() / 2.0 == pytest.approx(3.25) and (out * columns).sum() / 2.0 == pytest.approx(2.6)
