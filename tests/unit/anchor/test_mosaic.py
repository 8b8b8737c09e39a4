"""Frames that odometry joins: one template, which stands out more than a frame, and only at the right heading."""

import numpy as np
import pytest

from ground import PINHOLE, FlatMap, rotation, texture, view
from terrafix.anchor.matching.frame_matcher import Hypothesis
from terrafix.anchor.matching.ncc import standardise
from terrafix.anchor.matching.orthorectify import rectify
from terrafix.anchor.relocalization.block_search import BLOCK_CELLS, Block, Template, WideSearch
from terrafix.anchor.relocalization.mosaic import MOST_FRAMES, Mosaic, _shifted
from terrafix.core.geodesy import local_rotation_up
from terrafix_engines.features.gradient import GradientDescriber

AGL_M, CELL_M = 100.0, 2.0
HEADING_ERROR_DEG = 12.0  # of the compass; odometry is laid on the same wrong heading
WAY_M = np.array([[-60.0, -40.0], [-30.0, -50.0], [0.0, -20.0], [35.0, -5.0]])
HYPOTHESES = (Hypothesis(0.0, 1.0), Hypothesis(float(np.radians(HEADING_ERROR_DEG)), 1.0))
HERE = Block(-BLOCK_CELLS // 2, -BLOCK_CELLS // 2)


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    return texture(8, 480.0)


def local_turn(deg: float) -> np.ndarray:
    return local_rotation_up(np.radians(deg))[:2, :2]


def flown(ground: np.ndarray, search: WideSearch, noise: float) -> tuple[Mosaic, list[Template]]:
    """The mosaic of the way, and the templates of its last frame alone."""
    mosaic, rng, alone = Mosaic(HYPOTHESES, CELL_M), np.random.default_rng(3), list[Template]()
    for p_m in WAY_M:
        true_r = rotation(40.0)
        picture = view(ground, PINHOLE, true_r, np.array([*p_m, AGL_M])).astype(float)
        picture = np.clip(picture + rng.normal(0.0, noise, picture.shape), 0, 255).astype(np.uint8)
        believed_r = local_rotation_up(np.radians(-HEADING_ERROR_DEG)) @ true_r
        frames = [
            rectify(picture, PINHOLE, local_rotation_up(h.yaw_rad) @ believed_r, AGL_M, CELL_M) for h in HYPOTHESES
        ]
        alone = [search.describe(frame) for frame in frames if frame is not None]
        mosaic.add(local_turn(-HEADING_ERROR_DEG) @ p_m, 0.0, alone, 1.0, 1e3)
    return mosaic, alone


def test_the_joint_look_stands_out_more_and_only_with_the_right_heading(ground: np.ndarray) -> None:
    search = WideSearch(FlatMap(ground), GradientDescriber())
    mosaic, alone = flown(ground, search, 60.0)
    joined = mosaic.templates()
    assert joined[1].mask.sum() > 1.2 * alone[1].mask.sum()
    z = {}
    for name, templates in (("alone", alone), ("joined", joined)):
        (look,) = search.look(templates, [HERE], CELL_M)
        z[name] = standardise(look.correlation)
        r, c = (int(v) for v in np.unravel_index(int(np.nanargmax(z[name])), z[name].shape))
        if name == "joined":
            assert (HERE.column + c) * CELL_M == pytest.approx(WAY_M[-1][0], abs=2 * CELL_M)
            assert -(HERE.row + r) * CELL_M == pytest.approx(WAY_M[-1][1], abs=2 * CELL_M)
            assert look.index[r, c] == 1
    assert np.nanmax(z["joined"]) > 1.1 * np.nanmax(z["alone"])


def blob(value: float = 1.0) -> Template:
    return Template(np.full((8, 10, 12), value, np.float32), np.ones((10, 12), bool), -12.0, 10.0)


def test_frames_meet_where_odometry_says_and_count_equally() -> None:
    mosaic = Mosaic((Hypothesis(0.0, 1.0),), CELL_M)
    mosaic.add(np.array([0.0, 0.0]), 0.0, [blob(1.0)], 1.0, 1e3)
    mosaic.add(np.array([8.0, -6.0]), 0.0, [blob(3.0)], 1.0, 1e3)  # 4 cells east, 3 south
    (joined,) = mosaic.templates()
    values = joined.descriptors[0]
    assert joined.mask.sum() == 120 + 120 - 7 * 8
    assert (values == 2.0).sum() == 7 * 8 and (values == 1.0).sum() == (values == 3.0).sum() == 120 - 56
    # The corner of the older frame, as seen from the newer one.
    assert (joined.e_min_m, joined.n_max_m) == (-12.0 - 8.0, 10.0 + 6.0)


def test_what_odometry_places_badly_is_left_out_and_so_is_what_is_old() -> None:
    mosaic = Mosaic((Hypothesis(0.0, 1.0),), CELL_M)
    mosaic.add(np.array([0.0, 0.0]), 0.0, [blob()], 5.0, 1e3)
    mosaic.add(np.array([8.0, 0.0]), 30.0, [blob()], 5.0, 1e3)
    (joined,) = mosaic.templates()
    assert joined.mask.sum() == 120
    for k in range(MOST_FRAMES + 3):
        mosaic.add(np.array([8.0 + 24.0 * k, 0.0]), 30.0, [blob()], 5.0, 1e3)
    (joined,) = mosaic.templates()
    assert joined.mask.sum() == 120 * MOST_FRAMES
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
