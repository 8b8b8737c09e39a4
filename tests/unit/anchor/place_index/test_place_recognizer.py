"""Place recognition of a frame, and the search of a map that is too large for small cells."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

import map_rasters
from map_packages import centre_of
from terrafix.anchor.matching.frame_matcher import FrameMatcher, Hypothesis, View
from terrafix.anchor.matching.map_layers import MapLayers
from terrafix.anchor.place_index.index import PlaceIndex
from terrafix.anchor.place_index.recognizer import PlaceMemory, PlaceRecognizer, squares_of
from terrafix.anchor.relocalization import block_search, map_search
from terrafix.anchor.relocalization.block_search import BLOCK_CELLS, Block, select_blocks
from terrafix.anchor.relocalization.map_search import MapSearch
from terrafix.core.camera import CameraCalibration
from terrafix.core.geodesy import local_rotation_up
from terrafix.map.null_model import DEFAULT_NULL, FalseAlarmBudget
from terrafix.map.package import LocalMap, MapPackage
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_engines.retrieval.places import PooledGradientPlaces
from terrafix_engines.runtime import ModelRunError
from terrafix_tools.mapping.build import build
from terrafix_tools.mapping.place_index import IndexOptions, write_index

AGL_M = 60.0
CAMERA = CameraCalibration(320, 240, 277.0, 277.0, 159.5, 119.5)  # 69 x 52 m of ground
NORTH_UP = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
HEADINGS = 24
HYPOTHESES = tuple(Hypothesis(2.0 * np.pi * k / HEADINGS, 1.0) for k in range(HEADINGS))
SMALL_BLOCK = 32
TRUE = 5  # the hypothesis whose heading is right
PLACE_M = np.array([70.0, -40.0])


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("map")
    return build(map_rasters.utm(folder / "m.tif", map_rasters.texture(800, 1000, seed=6)), folder / "m.gpkg")


@pytest.fixture(scope="module")
def memory(package: Path, tmp_path_factory: pytest.TempPathFactory) -> PlaceMemory:
    out = tmp_path_factory.mktemp("index") / "i"
    write_index([package], out, IndexOptions(AGL_M, "pooled-gradient"))
    return PlaceMemory(PlaceIndex.open(out), PooledGradientPlaces())


@pytest.fixture(scope="module")
def local(package: Path) -> LocalMap:
    return MapPackage.open(package).bind(centre_of(package))


@pytest.fixture(scope="module")
def matcher(local: LocalMap) -> FrameMatcher:
    return FrameMatcher(CAMERA, local, GradientDescriber())


@pytest.fixture(scope="module")
def recognizer(memory: PlaceMemory, package: Path) -> PlaceRecognizer:
    return PlaceRecognizer(memory, memory.index.header.layers[0], centre_of(package))


def predicted(agl_m: float = AGL_M) -> View:
    return View(0.0, 0.0, NORTH_UP, agl_m, 0.0, np.pi, 0.01, np.radians(1.0))


def seen(local: LocalMap, place_m: np.ndarray) -> np.ndarray:
    """The image of a camera at a place whose heading is that of the hypothesis TRUE."""
    r_w_c = local_rotation_up(HYPOTHESES[TRUE].yaw_rad) @ NORTH_UP
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1) @ r_w_c.T
    ground_m = place_m + rays[..., :2] * AGL_M
    image, _ = local.window(-200.0, 200.0, 2000, 2000, 0.2)
    columns, rows = ((ground_m[..., 0] + 200.0) / 0.2).astype(int), ((200.0 - ground_m[..., 1]) / 0.2).astype(int)
    return np.ascontiguousarray(image[rows, columns])


def test_the_true_camera_position_is_the_first_candidate(
    recognizer: PlaceRecognizer, local: LocalMap, matcher: FrameMatcher
) -> None:
    for place_m in (PLACE_M, np.array([-90.0, 55.0])):
        candidates = recognizer.candidates(seen(local, place_m), predicted(), HYPOTHESES, matcher)
        first = candidates[0]
        assert np.hypot(first.e_m - place_m[0], first.n_m - place_m[1]) < 10.0  # discs are 12 m apart
        assert first.score > 0.7 and candidates[50].score < first.score
        assert [c.score for c in candidates] == sorted((c.score for c in candidates), reverse=True)


def test_the_offset_of_the_disc_from_the_camera_is_removed(
    recognizer: PlaceRecognizer, local: LocalMap, matcher: FrameMatcher
) -> None:
    """A camera that looks 15 degrees to the side has the middle of its ground 24 m beside itself."""
    lean_rad = np.radians(15.0)
    cos, sin = np.cos(lean_rad), np.sin(lean_rad)
    leaning = NORTH_UP @ np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    view = View(0.0, 0.0, leaning, AGL_M, 0.0, np.pi, 0.01, np.radians(1.0))
    (rectified,) = matcher.rectify_all(np.zeros((240, 320, 3), np.uint8), view, HYPOTHESES[:1], 1.0, 1)
    assert rectified is not None
    squares = squares_of(rectified, 48)
    middle = rectified.e_min_m + float(np.nonzero(rectified.mask)[1].mean()) + 0.5
    assert 16.0 < middle < 32.0
    offsets = np.array([(square.east_m - middle, square.north_m) for square in squares])
    assert offsets == pytest.approx(np.array([(-3.0, 3.0), (3.0, 3.0), (-3.0, -3.0), (3.0, -3.0)]), abs=1.1)


def test_an_index_of_another_height_does_not_fit(recognizer: PlaceRecognizer, matcher: FrameMatcher) -> None:
    assert recognizer.fits(predicted(), HYPOTHESES, matcher)
    assert not recognizer.fits(predicted(40.0), HYPOTHESES, matcher)  # the frame is smaller than the disc
    assert recognizer.fits(predicted(100.0), HYPOTHESES, matcher)
    assert not recognizer.fits(predicted(180.0), HYPOTHESES, matcher)  # the disc is a small part of the frame


def test_a_layer_gets_a_recognizer_only_if_this_build_of_it_is_in_the_index(memory: PlaceMemory, package: Path) -> None:
    opened, frame = MapPackage.open(package), centre_of(package)
    with_index = MapLayers(opened, frame, CAMERA, GradientDescriber(), 10.0, None, memory)
    assert with_index.best.recognizer is not None
    assert MapLayers(opened, frame, CAMERA, GradientDescriber(), 10.0, None, None).best.recognizer is None
    opened.manifest = msgspec.structs.replace(opened.manifest, checksum="another build")
    assert MapLayers(opened, frame, CAMERA, GradientDescriber(), 10.0, None, memory).best.recognizer is None


def test_blocks_are_selected_in_the_order_of_the_places() -> None:
    blocks = [Block(r, c) for r in (-BLOCK_CELLS, 0) for c in (0, BLOCK_CELLS)]
    cell_m = 2.0
    north_west, south_east = (1.0, 1.0), (600.0, -1.0)
    outside = (-1.0, 1.0)
    assert select_blocks([south_east, outside, north_west, south_east], blocks, cell_m, 4) == [blocks[3], blocks[0]]
    assert select_blocks([south_east, north_west], blocks, cell_m, 1) == [blocks[3]]
    assert select_blocks([(511.9, -511.9)], blocks, cell_m, 4) == [blocks[2]]
    assert select_blocks([(512.0, -511.9)], blocks, cell_m, 4) == [blocks[3]]
    assert select_blocks([outside], blocks, cell_m, 4) == []


def only_a_few_blocks(matcher: FrameMatcher, monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of 32 cells, a quarter of which one joint correlation can afford."""
    for module in (map_search, block_search):
        monkeypatch.setattr(module, "BLOCK_CELLS", SMALL_BLOCK)
    hypotheses, cell_m = matcher.map_search_hypotheses(predicted()), 4.0
    monkeypatch.setattr(map_search, "MAX_WORK", 0.25 * len(hypotheses) * (400 * 500) / cell_m**2)


def searched(local: LocalMap, matcher: FrameMatcher, recognizer: PlaceRecognizer | None) -> MapSearch:
    return MapSearch(local, matcher, AGL_M, None, DEFAULT_NULL, FalseAlarmBudget(), recognizer)


def test_a_map_that_is_too_large_is_searched_on_small_cells_where_the_index_proposes(
    local: LocalMap, matcher: FrameMatcher, recognizer: PlaceRecognizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A few of the blocks of this map are affordable: without the index cells are larger."""
    only_a_few_blocks(matcher, monkeypatch)
    image = seen(local, PLACE_M)
    coarse, selective = searched(local, matcher, None), searched(local, matcher, recognizer)
    for search in (coarse, selective):
        search.process_frame(image, predicted())
    assert selective._cell_m < coarse._cell_m
    assert 0 < selective._max_blocks < len(selective._blocks)
    best = selective.proposed[0]
    assert np.hypot(best.e_m - PLACE_M[0], best.n_m - PLACE_M[1]) < 6.0
    assert selective.candidate_count == coarse.candidate_count  # the selection is one over the whole map


def test_the_blocks_of_tracks_are_correlated_before_those_of_the_index(
    local: LocalMap, matcher: FrameMatcher, recognizer: PlaceRecognizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    only_a_few_blocks(matcher, monkeypatch)
    search = searched(local, matcher, recognizer)
    search.process_frame(seen(local, PLACE_M), predicted())
    track = search.tracker.tracks[0]
    track.e_m, track.n_m = -150.0, 120.0
    blocks = search._blocks_to_correlate(seen(local, PLACE_M), predicted())
    assert blocks[:1] == select_blocks([(-150.0, 120.0)], search._blocks, search._cell_m, 1)
    assert len(blocks) == search._max_blocks > 1


def test_a_map_that_is_small_enough_or_of_another_height_is_searched_without_the_index(
    local: LocalMap, matcher: FrameMatcher, recognizer: PlaceRecognizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = seen(local, PLACE_M)
    monkeypatch.setattr(PlaceRecognizer, "candidates", lambda *_: pytest.fail("the index was asked"))
    small = searched(local, matcher, recognizer)
    small.process_frame(image, predicted())
    only_a_few_blocks(matcher, monkeypatch)
    e_min, n_min, e_max, n_max = local.bounds_m
    work = len(small._hypotheses) * (e_max - e_min) * (n_max - n_min) / small._cell_m**2
    monkeypatch.setattr(map_search, "MAX_WORK", 1.01 * work)
    barely = searched(local, matcher, recognizer)
    barely.process_frame(image, predicted())
    assert barely._cell_m == small._cell_m and len(barely._blocks) > barely._max_blocks  # blocks reach beyond the map
    monkeypatch.setattr(map_search, "MAX_WORK", 1e5)
    searched(local, matcher, recognizer).process_frame(image, predicted(40.0))


def test_a_model_that_fails_costs_a_frame_and_the_search_goes_on_without_the_index(
    local: LocalMap, matcher: FrameMatcher, recognizer: PlaceRecognizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failed(*_: object) -> None:
        raise ModelRunError("out of memory")

    only_a_few_blocks(matcher, monkeypatch)
    monkeypatch.setattr(PlaceRecognizer, "candidates", failed)
    search, image = searched(local, matcher, recognizer), seen(local, PLACE_M)
    with pytest.raises(ModelRunError):
        search.process_frame(image, predicted())
    search.process_frame(image, predicted())
    coarse = searched(local, matcher, None)
    coarse.process_frame(image, predicted())
    assert search._cell_m == coarse._cell_m and search.proposed == coarse.proposed != []


def test_a_frame_for_which_the_index_has_no_place_is_not_correlated(
    local: LocalMap, matcher: FrameMatcher, recognizer: PlaceRecognizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    only_a_few_blocks(matcher, monkeypatch)
    monkeypatch.setattr(PlaceRecognizer, "candidates", lambda *_: [])
    search = searched(local, matcher, recognizer)
    assert search.process_frame(seen(local, PLACE_M), predicted()) is None
    assert search.proposed == [] and search.tracker.tracks == []
