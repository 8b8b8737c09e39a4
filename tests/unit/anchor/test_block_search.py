"""One frame against a region of the map: the same measurement as the exact correlation, in blocks."""

import numpy as np
import pytest

from ground import PINHOLE, FlatMap, rotation, texture, view
from terrafix.anchor.matching.descriptor_cache import MapFeatures
from terrafix.anchor.matching.ncc import Searchable, standardise
from terrafix.anchor.matching.orthorectify import Rectified, rectify
from terrafix.anchor.relocalization.block_search import BLOCK_CELLS, Block, WideSearch, blocks_of
from terrafix.core.geodesy import local_rotation_up
from terrafix_engines.features.gradient import GradientDescriber

AGL_M, CELL_M = 100.0, 2.0
TRUE_M = np.array([62.0, -81.0, AGL_M])
TRUE_R = rotation(40.0)
HERE = Block(-BLOCK_CELLS // 2, -BLOCK_CELLS // 2)  # 512 m around (0, 0)


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    return texture(8, 480.0)


@pytest.fixture(scope="module")
def search(ground: np.ndarray) -> WideSearch:
    return WideSearch(FlatMap(ground), GradientDescriber())


def seen(ground: np.ndarray, turn_deg: float = 0.0, scale: float = 1.0) -> Rectified:
    """The frame, rectified as if heading and height were off by this."""
    picture = view(ground, PINHOLE, TRUE_R, TRUE_M)
    frame = rectify(picture, PINHOLE, local_rotation_up(np.radians(turn_deg)) @ TRUE_R, AGL_M * scale, CELL_M)
    assert frame is not None
    return frame


def place_of(block: Block, z: np.ndarray) -> tuple[float, float]:
    r, c = (int(v) for v in np.unravel_index(int(np.nanargmax(z)), z.shape))
    return (block.column + c) * CELL_M, -(block.row + r) * CELL_M


def test_the_place_stands_out(ground: np.ndarray, search: WideSearch) -> None:
    (look,) = search.look([search.describe(seen(ground))], [HERE], CELL_M)
    assert place_of(HERE, look.correlation) == pytest.approx(tuple(TRUE_M[:2]), abs=2 * CELL_M)
    assert np.nanmax(standardise(look.correlation)) > 5.0


def test_it_measures_what_the_exact_correlation_measures(ground: np.ndarray, search: WideSearch) -> None:
    frame = seen(ground)
    (look,) = search.look([search.describe(frame)], [HERE], CELL_M)
    height, width = (BLOCK_CELLS + side for side in frame.mask.shape)
    e_m, n_m = HERE.column * CELL_M + frame.e_min_m, -HERE.row * CELL_M + frame.n_max_m
    window, valid, e_m, n_m = MapFeatures(FlatMap(ground), GradientDescriber()).window(e_m, n_m, width, height, CELL_M)
    exact = standardise(Searchable(window, valid).search(search.describe(frame).descriptors, frame.mask))
    exact = exact[:BLOCK_CELLS, :BLOCK_CELLS]
    z = standardise(look.correlation)
    both = np.isfinite(exact) & np.isfinite(z)
    assert both.mean() > 0.1
    assert np.corrcoef(exact[both], z[both])[0, 1] > 0.95
    assert np.nanmax(z) == pytest.approx(float(np.nanmax(exact)), rel=0.25)


def test_it_says_which_heading_and_scale_fit(ground: np.ndarray, search: WideSearch) -> None:
    tried = [(-20.0, 1.0), (0.0, 0.8), (0.0, 1.0), (20.0, 1.0)]
    (look,) = search.look([search.describe(seen(ground, *t)) for t in tried], [HERE], CELL_M)
    best = np.unravel_index(int(np.nanargmax(look.correlation)), look.correlation.shape)
    assert tried[int(look.index[best])] == (0.0, 1.0)


def test_more_templates_than_are_held_at_a_time(
    ground: np.ndarray, search: WideSearch, monkeypatch: pytest.MonkeyPatch
) -> None:
    templates = [search.describe(seen(ground, t)) for t in (-20.0, 0.0, 20.0)]
    (whole,) = search.look(templates, [HERE], CELL_M)
    monkeypatch.setattr("terrafix.anchor.relocalization.block_search.AT_ONCE", 2)
    (parted,) = search.look(templates, [HERE], CELL_M)
    assert np.array_equal(whole.correlation, parted.correlation, equal_nan=True) and np.array_equal(
        whole.index, parted.index
    )


def test_off_the_map_nothing_is_known(ground: np.ndarray, search: WideSearch) -> None:
    (look,) = search.look([search.describe(seen(ground))], [Block(5000, 5000)], CELL_M)
    assert np.isnan(look.correlation).all()


def test_what_lies_beside_the_map_is_not_described(ground: np.ndarray) -> None:
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
