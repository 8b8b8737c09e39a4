"""Block correlation of a frame with a region of the map, compared with the exact correlation."""

import numpy as np
import pytest

from terrafix.anchor.matching.descriptor_cache import MapFeatures
from terrafix.anchor.matching.ncc import CorrelationWindow, standardise
from terrafix.anchor.matching.orthorectify import Rectified, rectify
from terrafix.anchor.relocalization.block_search import BLOCK_CELLS, Block, BlockCorrelator, blocks_of
from terrafix.core.geodesy import local_rotation_up
from terrafix_engines.features.gradient import GradientDescriber
from textured_ground import PINHOLE, FlatMap, rotation, texture, view

AGL_M, CELL_M = 100.0, 2.0
TRUE_M = np.array([62.0, -81.0, AGL_M])
TRUE_R = rotation(40.0)
HERE = Block(-BLOCK_CELLS // 2, -BLOCK_CELLS // 2)  # 512 m around (0, 0)


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    return texture(8, 480.0)


@pytest.fixture(scope="module")
def correlator(ground: np.ndarray) -> BlockCorrelator:
    return BlockCorrelator(FlatMap(ground), GradientDescriber())


def rectified_frame(ground: np.ndarray, turn_deg: float = 0.0, scale: float = 1.0) -> Rectified:
    """The frame, rectified with an error of yaw and scale."""
    camera_image = view(ground, PINHOLE, TRUE_R, TRUE_M)
    frame = rectify(camera_image, PINHOLE, local_rotation_up(np.radians(turn_deg)) @ TRUE_R, AGL_M * scale, CELL_M)
    assert frame is not None
    return frame


def place_of(block: Block, z: np.ndarray) -> tuple[float, float]:
    r, c = (int(v) for v in np.unravel_index(int(np.nanargmax(z)), z.shape))
    return (block.column + c) * CELL_M, -(block.row + r) * CELL_M


def test_the_place_stands_out(ground: np.ndarray, correlator: BlockCorrelator) -> None:
    (result,) = correlator.correlate([correlator.describe(rectified_frame(ground))], [HERE], CELL_M)
    assert place_of(HERE, result.correlation) == pytest.approx(tuple(TRUE_M[:2]), abs=2 * CELL_M)
    assert np.nanmax(standardise(result.correlation)) > 5.0


def test_block_correlation_approximates_the_exact_correlation(ground: np.ndarray, correlator: BlockCorrelator) -> None:
    frame = rectified_frame(ground)
    (result,) = correlator.correlate([correlator.describe(frame)], [HERE], CELL_M)
    height, width = (BLOCK_CELLS + side for side in frame.mask.shape)
    e_m, n_m = HERE.column * CELL_M + frame.e_min_m, -HERE.row * CELL_M + frame.n_max_m
    window, valid, e_m, n_m = MapFeatures(FlatMap(ground), GradientDescriber()).window(e_m, n_m, width, height, CELL_M)
    exact = standardise(CorrelationWindow(window, valid).correlate(correlator.describe(frame).descriptors, frame.mask))
    exact = exact[:BLOCK_CELLS, :BLOCK_CELLS]
    z = standardise(result.correlation)
    both = np.isfinite(exact) & np.isfinite(z)
    assert both.mean() > 0.1
    assert np.corrcoef(exact[both], z[both])[0, 1] > 0.95
    assert np.nanmax(z) == pytest.approx(float(np.nanmax(exact)), rel=0.25)


def test_the_index_gives_the_best_yaw_and_scale(ground: np.ndarray, correlator: BlockCorrelator) -> None:
    tried = [(-20.0, 1.0), (0.0, 0.8), (0.0, 1.0), (20.0, 1.0)]
    (result,) = correlator.correlate([correlator.describe(rectified_frame(ground, *t)) for t in tried], [HERE], CELL_M)
    best = np.unravel_index(int(np.nanargmax(result.correlation)), result.correlation.shape)
    assert tried[int(result.index[best])] == (0.0, 1.0)


def test_templates_in_several_chunks_give_the_same_result(
    ground: np.ndarray, correlator: BlockCorrelator, monkeypatch: pytest.MonkeyPatch
) -> None:
    templates = [correlator.describe(rectified_frame(ground, t)) for t in (-20.0, 0.0, 20.0)]
    (whole,) = correlator.correlate(templates, [HERE], CELL_M)
    monkeypatch.setattr("terrafix.anchor.relocalization.block_search.CHUNK_TEMPLATES", 2)
    (parted,) = correlator.correlate(templates, [HERE], CELL_M)
    assert np.array_equal(whole.correlation, parted.correlation, equal_nan=True) and np.array_equal(
        whole.index, parted.index
    )


def test_blocks_off_the_map_are_nan(ground: np.ndarray, correlator: BlockCorrelator) -> None:
    (result,) = correlator.correlate([correlator.describe(rectified_frame(ground))], [Block(5000, 5000)], CELL_M)
    assert np.isnan(result.correlation).all()


def test_no_descriptors_are_computed_off_the_map(ground: np.ndarray) -> None:
    class Counting(GradientDescriber):
        described = 0

        def describe(self, image: np.ndarray) -> np.ndarray:
            self.described += 1
            return super().describe(image)

    features = MapFeatures(FlatMap(ground), counting := Counting())
    beside, valid, _, _ = features.window(5000.0, 0.0, 300, 200, CELL_M)
    assert counting.described == 0 and not valid.any() and not beside.any() and beside.shape == (8, 200, 300)
    assert features.window(0.0, 0.0, 300, 200, CELL_M)[1].any() and counting.described > 0


def test_blocks_cover_the_bounds_once() -> None:
    bounds_m = (-700.0, -300.0, 900.0, 1100.0)
    blocks = blocks_of(bounds_m, CELL_M)
    side_m = BLOCK_CELLS * CELL_M
    assert len({(b.row, b.column) for b in blocks}) == len(blocks) == 4 * 3
    for e_m, n_m in ((-700.0, -300.0), (900.0, 1100.0), (0.0, 0.0), (899.0, -299.0)):
        inside = [
            b
            for b in blocks
            if b.column * CELL_M <= e_m <= b.column * CELL_M + side_m
            and -b.row * CELL_M - side_m <= n_m <= -b.row * CELL_M
        ]
        assert inside, (e_m, n_m)
