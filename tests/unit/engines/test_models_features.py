"""Keypoints of XFeat and of models with a manifest, and their matching between two images."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import tiny_onnx
from terrafix_engines import manifest
from terrafix_engines.features import open_describer, open_detector, open_matcher
from terrafix_engines.features.exported import to_pixels
from terrafix_engines.features.image_input import image_tensor
from terrafix_engines.features.keypoints import (
    Keypoints,
    MutualNearestMatcher,
    PairMatcher,
    select_strongest,
    unit_rows,
)
from terrafix_engines.features.lightglue import decode_matches, model_coordinates
from terrafix_engines.features.xfeat import XFeatDescriber, probabilities, sample
from terrafix_engines.manifest import Coordinates, ImageInput, MatcherTensors
from terrafix_engines.runtime import ModelRunError
from terrafix_engines.store import StoredModel, stored_model
from textured_ground import texture

DETECTOR = tiny_onnx.described(
    """name = "points"
title = "an export of points"
role = "keypoints"
licence = "CC0"
[image]
input = "image"
colour = "gray"
multiple = 8
[keypoints]
keypoints = "kpts"
scores = "scores"
descriptors = "desc"
coordinates = "signed"
channels_first = true
""",
    {"image": [1, 1, "height", "width"]},
    {"kpts": [1, "points", 2], "scores": [1, "points"], "desc": [1, 4, "points"]},
)
MATCHER = tiny_onnx.described(
    """name = "glue"
title = "an export of a matcher"
role = "matcher"
licence = "CC0"
[matcher]
features = "points"
keypoints = ["k0", "k1"]
descriptors = ["d0", "d1"]
matches = "m"
scores = "s"
form = "index"
""",
    {"k0": [1, "points0", 2], "k1": [1, "points1", 2], "d0": [1, "points0", 4], "d1": [1, "points1", 4]},
    {"m": [1, "matches"], "s": [1, "matches"]},
    {"m": "int64"},
)
DataSet = Callable[[str], Path]


def stored(folder: Path, text: str, content: bytes) -> StoredModel:
    path = tiny_onnx.write(folder, text, content)
    return stored_model(manifest.read(path.with_suffix(".toml")), folder)


def keypoint_model(
    keypoints: np.ndarray,
    scores: np.ndarray,
    descriptors: np.ndarray,
    size: tuple[int, int] | tuple[str, str] = ("h", "w"),
) -> bytes:
    """``size``: height and width of its images."""
    outputs = {"kpts": keypoints[None], "scores": scores[None], "desc": descriptors[None]}
    inputs: dict[str, tuple[tiny_onnx.Shape, str]] = {"image": ([1, 1, *size], "float32")}
    return tiny_onnx.constants(inputs, {name: values.astype(np.float32) for name, values in outputs.items()})


THREE_POINTS = np.zeros((3, 2)), np.ones(3), np.ones((4, 3))


def exported(folder: Path, keypoints: np.ndarray, scores: np.ndarray, descriptors: np.ndarray) -> StoredModel:
    return stored(folder, DETECTOR, keypoint_model(keypoints, scores, descriptors))


def test_an_image_is_converted_as_the_manifest_specifies() -> None:
    image = np.zeros((2, 3, 3), np.uint8)
    image[0, 2] = (10, 20, 30)
    for colour, planes in (("rgb", (30, 20, 10)), ("bgr", (10, 20, 30))):
        tensor = image_tensor(image, ImageInput(input="i", colour=colour, scale=0.5), 2, 4)
        assert tensor.shape == (1, 3, 2, 4) and tensor.dtype == np.float32
        assert [float(v) for v in tensor[0, :, 0, 2]] == [v / 2 for v in planes]
        assert not tensor[0, :, 0, 3].any()  # the reflection of column 1
    gray = image_tensor(image, ImageInput(input="i", colour="gray", scale=1.0), 2, 3)
    assert gray.shape == (1, 1, 2, 3) and gray[0, 0, 0, 2] == round(0.114 * 10 + 0.587 * 20 + 0.299 * 30)


def test_the_65_logits_of_a_cell_are_its_pixels_by_row_and_no_keypoint() -> None:
    logits = np.zeros((65, 3, 4), np.float32)
    logits[64] = 20.0
    logits[8 * 5 + 2, 1, 3] = 30.0
    heat = probabilities(logits)
    assert heat.shape == (24, 32)
    assert np.unravel_index(int(heat.argmax()), heat.shape) == (8 + 5, 24 + 2)
    assert heat.max() > 0.99 and np.sort(heat.ravel())[-2] < 1e-6


def test_cell_maps_are_sampled_at_cell_centres() -> None:
    y, x = np.mgrid[0:4, 0:6].astype(np.float32)
    cells = np.stack([x, y])
    at = np.array([[3.5, 3.5], [11.5, 3.5], [7.5, 19.5], [0.0, 0.0], [47.0, 31.0]], np.float32)
    expected = [[0, 0], [1, 0], [0.5, 2], [0, 0], [5, 3]]  # the centre of cell k is pixel 8 k + 3.5; edge cells repeat
    assert np.allclose(sample(cells, at), expected)


def test_keypoint_coordinates_of_all_conventions_are_converted_to_pixels() -> None:
    corners = np.array([[-1.0, -1.0], [1.0, 1.0], [0.0, 0.0]], np.float32)
    expected = [[0, 0], [639, 479], [319.5, 239.5]]
    given: tuple[tuple[Coordinates, np.ndarray], ...]
    given = (("signed", corners), ("unit", (corners + 1) / 2), ("pixels", np.array(expected)))
    for coordinates, xy in given:
        assert np.allclose(to_pixels(xy, coordinates, (480, 640)), expected)


def test_the_strongest_keypoints_inside_the_image_are_selected() -> None:
    xy = np.array([[0, 0], [9, 4], [9.2, 4], [5, -0.1], [3, 3]], np.float32)
    assert select_strongest(xy, np.array([0.1, 0.5, 0.9, 0.9, 0.5]), (10, 5), 3).tolist() == [1, 4, 0]


def test_mutual_nearest_neighbours_find_the_permutation_and_no_false_matches() -> None:
    rng = np.random.default_rng(2)
    first = unit_rows(rng.normal(size=(40, 32)))
    order = rng.permutation(40)[:30]
    second = unit_rows(np.vstack([first[order] + rng.normal(0, 0.02, (30, 32)), rng.normal(size=(20, 32))]))
    pairs, scores = MutualNearestMatcher().match(points(first), points(second))
    assert sorted(map(tuple, pairs.tolist())) == sorted((int(k), i) for i, k in enumerate(order))
    assert scores.min() > 0.9
    nobody = points(np.zeros((0, 32), np.float32))
    assert len(MutualNearestMatcher().match(nobody, points(first))[0]) == 0


def points(descriptors: np.ndarray, xy_px: np.ndarray | None = None) -> Keypoints:
    count = len(descriptors)
    xy_px = np.zeros((count, 2), np.float32) if xy_px is None else xy_px
    return Keypoints(xy_px, np.ones(count, np.float32), descriptors, (640, 480))


def test_a_matcher_uses_the_coordinates_and_pair_format_of_its_manifest() -> None:
    def spec(**more: str) -> MatcherTensors:
        common = {"features": "f", "keypoints": ["a", "b"], "descriptors": ["c", "d"], "matches": "m", "scores": "s"}
        return manifest.msgspec.convert(common | more, MatcherTensors)

    given = points(np.zeros((2, 4), np.float32), np.array([[320.0, 240.0], [640.0, 0.0]], np.float32))
    assert np.allclose(model_coordinates(given, spec()), [[0, 0], [1, -0.75]])
    assert np.allclose(model_coordinates(given, spec(coordinates="pixels")), given.xy_px)
    scores = np.array([0.5, 0.25], np.float32)
    for matches in ([[3, 1], [4, 2]], [[0, 3, 1], [0, 4, 2]]):
        pairs, confidence = decode_matches(np.array(matches), scores, spec())
        assert pairs.tolist() == [[3, 1], [4, 2]] and confidence.tolist() == [0.5, 0.25]
    pairs, confidence = decode_matches(np.array([[-1, 7, -1, 0]]), np.array([[0.0, 0.5, 0.0, 1.0]]), spec(form="index"))
    assert pairs.tolist() == [[1, 7], [3, 0]] and confidence.tolist() == [0.5, 1.0]


def test_a_keypoint_model_runs_by_its_manifest(tmp_path: Path) -> None:
    # 90 x 60 is padded to 96 x 64: signed coordinates refer to that, and points in the padding are dropped.
    xy_px = np.array([[10.0, 20.0], [89.0, 59.0], [93.0, 10.0]])
    signed = xy_px / [95.0, 63.0] * 2 - 1
    descriptors = np.random.default_rng(1).normal(size=(4, 3))
    detector = open_detector(exported(tmp_path, signed, np.array([0.2, 0.9, 1.0]), descriptors))
    found = detector.detect(np.zeros((60, 90, 3), np.uint8), 10)
    assert detector.name == "points" and found.size_px == (90, 60)
    assert np.allclose(found.xy_px, [[89, 59], [10, 20]], atol=1e-3)
    assert np.allclose(found.descriptors, unit_rows(descriptors.T[[1, 0]]), atol=1e-6)
    assert len(detector.detect(np.zeros((60, 90, 3), np.uint8), 1).xy_px) == 1


def test_a_matcher_runs_by_its_manifest_and_must_not_match_missing_keypoints(tmp_path: Path) -> None:
    inputs: dict[str, tuple[tiny_onnx.Shape, str]] = {
        name: ([1, count, size], "float32")
        for name, count, size in (("k0", "a", 2), ("k1", "b", 2), ("d0", "a", 4), ("d1", "b", 4))
    }
    partner = np.full((1, 9), -1, np.int64)
    partner[0, 3] = 8
    outputs = {"m": partner, "s": np.full((1, 9), 0.7, np.float32)}
    matcher = open_matcher(stored(tmp_path, MATCHER, tiny_onnx.constants(inputs, outputs)))
    first, second = points(np.ones((9, 4), np.float32)), points(np.ones((12, 4), np.float32))
    pairs, scores = matcher.match(first, second)
    assert pairs.tolist() == [[3, 8]] and np.allclose(scores, 0.7)
    with pytest.raises(ModelRunError, match="glue: matches points that do not exist"):
        matcher.match(first, points(np.ones((8, 4), np.float32)))
    assert len(matcher.match(first, points(np.ones((7, 4), np.float32)))[0]) == 0


def test_a_model_of_fixed_size_pads_small_images_and_rejects_larger_ones(tmp_path: Path) -> None:
    content = keypoint_model(*THREE_POINTS, (64, 96))
    detector = open_detector(stored(tmp_path, DETECTOR.replace('"height", "width"', "64, 96"), content))
    assert len(detector.detect(np.zeros((60, 90, 3), np.uint8), 10).xy_px) == 3
    with pytest.raises(ModelRunError, match="takes images of 96x64 px, not 97x60"):
        detector.detect(np.zeros((60, 97, 3), np.uint8), 10)


def test_swapped_outputs_in_a_keypoint_manifest_are_reported(tmp_path: Path) -> None:
    text = DETECTOR.replace("channels_first = true\n", "").replace(
        'shape = [1, 4, "points"]', 'shape = [1, "rows", "columns"]'
    )
    detector = open_detector(stored(tmp_path, text, keypoint_model(*THREE_POINTS)))
    with pytest.raises(ModelRunError, match=r"points: 3 keypoints, 3 scores, 4 descriptors; check \[keypoints\]"):
        detector.detect(np.zeros((64, 64, 3), np.uint8), 10)


def test_contradictions_in_a_pair_manifest_are_reported(tmp_path: Path) -> None:
    other = tiny_onnx.PAIR.replace('name = "image1"\nshape = [1, 1,', 'name = "image1"\nshape = [1, 3,')
    for text, reason in (
        (other, "'image1' must have the shape of 'image0'"),
        (tiny_onnx.PAIR.replace('second = "image1"', 'second = "right"'), "'right' is used, but neither"),
        (
            tiny_onnx.PAIR.split("[pair]")[0] + "[[inputs]]" + tiny_onnx.PAIR.split("[[inputs]]", 1)[1],
            r"a section \[pair\]",
        ),
    ):
        with pytest.raises(manifest.ManifestError, match=reason):
            stored(tmp_path, text, b"no model")


@pytest.fixture
def real(data_set: DataSet, tmp_path: Path) -> Path:
    for name in ("xfeat", "lighterglue_L3"):
        shutil.copy(data_set(f"models/{name}.onnx"), tmp_path)
    return tmp_path


def test_xfeat_by_name_equals_xfeat_by_path(real: Path) -> None:
    image = texture(3, 40.0)[:90, :130]
    by_name = open_describer("xfeat", str(real))
    by_path = open_describer(str(real / "xfeat.onnx"), str(real / "nothing"))
    assert isinstance(by_name, XFeatDescriber) and isinstance(by_path, XFeatDescriber)
    found = by_name.describe(image)
    assert found.shape == (64, 11, 16) and np.array_equal(found, by_path.describe(image))
    assert np.allclose(np.linalg.norm(found, axis=0), 1.0, atol=1e-4)


@pytest.mark.parametrize("glue", ["", "lighterglue-l3"])
def test_real_features_find_the_shift_between_two_images(real: Path, glue: str) -> None:
    ground = texture(4, 120.0)
    known = manifest.read_all(real)
    detector = open_detector(stored_model(known["xfeat"], real))
    matcher: PairMatcher = open_matcher(stored_model(known[glue], real)) if glue else MutualNearestMatcher()
    first, second = ground[40:296, 60:316], ground[53:309, 37:293]
    one, two = detector.detect(first, 300), detector.detect(second, 300)
    pairs, _ = matcher.match(one, two)
    moved = two.xy_px[pairs[:, 1]] - one.xy_px[pairs[:, 0]]
    # A descriptor covers a cell of 8 px: a match may be a neighbour within the cell.
    right = np.hypot(*(moved - [23, -13]).T) < 8.0
    assert right.sum() >= 50 and right.mean() > 0.8
    assert np.hypot(*(np.median(moved, axis=0) - [23, -13])) < 1.0
