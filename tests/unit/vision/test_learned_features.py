"""Features of a model instead of SIFT: images in any rotation, a model that fails, and which ones can be used."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import tiny_onnx
from terrafix.core.config import Config, Models, Vision
from terrafix.core.errors import ModelError
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.node import NodeContext
from terrafix.messages import Frame, ModelChange, ModelEvent, Odometry, Verdict
from terrafix.vision.learned_features import LearnedFeatures, LearnedMatcher
from terrafix.vision.node import VisionNode, make_node
from terrafix_engines.features import open_point_features
from terrafix_engines.features.keypoints import Keypoints, MutualNearestMatcher
from terrafix_engines.runtime import ModelFileError, ModelRunError
from textured_ground import PINHOLE, rotation, texture, view
from vision_origin import PINHOLE_ORIGIN as ORIGIN


class Upright:
    """Finds the bright pixels of an image. Descriptors: the grey level there, and which way is up in the image, by the
    brighter of its upper and lower half: not rotation-invariant."""

    name = "upright"

    def detect(self, image: np.ndarray, max_points: int) -> Keypoints:
        gray = image[:, :, 0].astype(np.float32)
        y, x = np.nonzero(gray > 100)
        level = gray[y, x] / 255.0 * np.pi / 2.0
        upper = gray[: len(gray) // 2].sum() > gray[len(gray) // 2 :].sum()
        descriptors = np.column_stack([np.cos(level), np.sin(level)]) if upper else np.zeros((len(x), 2))
        xy_px = np.column_stack([x, y]).astype(np.float32)
        return Keypoints(xy_px, level, descriptors.astype(np.float32), (gray.shape[1], gray.shape[0]))


class Failing(Upright):
    def __init__(self, works: int) -> None:
        self.works = works  # images that it describes before it fails

    def detect(self, image: np.ndarray, max_points: int) -> Keypoints:
        self.works -= 1
        if self.works < 0:
            raise ModelRunError("out of memory")
        return super().detect(image, max_points)


def dots() -> np.ndarray:
    """(60, 80) uint8: eight dots of different brightness in the upper half, off centre."""
    image = np.zeros((60, 80), np.uint8)
    for i, (x, y) in enumerate([(5, 3), (20, 8), (33, 5), (47, 20), (60, 11), (71, 25), (12, 22), (40, 12)]):
        image[y, x] = 110 + 18 * i
    return image


def frame_of(i: int) -> Frame:
    return Frame(t_ns=i * 10**9, frame_id=i, file="", width=PINHOLE.width, height=PINHOLE.height)


@pytest.mark.parametrize("turns", range(4))
def test_an_image_is_matched_in_any_rotation(turns: int) -> None:
    matcher, image = LearnedMatcher(Upright(), MutualNearestMatcher()), dots()
    turned = np.ascontiguousarray(np.rot90(image, turns))
    matches = matcher.match(matcher.describe(image), matcher.describe(turned))
    assert len(matches) == 8
    for (x, y), (x_turned, y_turned) in zip(matches.a_px.astype(int), matches.b_px.astype(int), strict=True):
        assert image[y, x] == turned[y_turned, x_turned] > 100


class Asked(MutualNearestMatcher):
    """A learned matcher that finds nothing and counts how often it is asked."""

    times = 0

    def match(self, first: Keypoints, second: Keypoints) -> tuple[np.ndarray, np.ndarray]:
        self.times += 1
        return np.zeros((0, 2), np.int64), np.zeros(0, np.float32)


@pytest.mark.parametrize(("points", "times"), [(8, 1), (199, 1), (200, 0)])
def test_the_learned_matcher_is_asked_for_the_pairs_of_images_that_nearest_neighbours_do_not_match(
    points: int, times: int
) -> None:
    descriptors = np.random.default_rng(1).normal(size=(points, 64)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    xy_px = np.random.default_rng(2).uniform(0.0, 400.0, (points, 2)).astype(np.float32)
    found = Keypoints(xy_px, np.ones(points, np.float32), descriptors, (400, 400))
    features = LearnedFeatures(xy_px, descriptors, np.ones(points, np.float32), (found,) * 4, (xy_px,) * 4)
    asked = Asked()
    matches = LearnedMatcher(Upright(), asked).match(features, features)
    assert (asked.times, len(matches)) == (times, 0 if times else points)


def test_the_strongest_points_are_the_coarse_ones() -> None:
    matcher = LearnedMatcher(Upright(), MutualNearestMatcher())
    features = matcher.describe(dots())
    coarse = features.coarse(0.5, 3)
    assert len(features) == 8 and len(coarse) == 3
    assert matcher.shared(coarse, features) == 3


def test_after_a_failure_of_the_model_odometry_continues_with_sift() -> None:
    ground, store = texture(1), MemoryFrameStore()
    node = VisionNode(store, learned=LearnedMatcher(Failing(1), MutualNearestMatcher()))
    list(node.on(ORIGIN))
    published = []
    for i, north_m in enumerate((0.0, 60.0, 110.0, 160.0)):  # too far apart to be tracked
        store.put(i, view(ground, PINHOLE, rotation(), np.array([0.0, north_m - 80.0, 100.0])))
        published += list(node.on(frame_of(i)))
    (event,) = (m for m in published if isinstance(m, ModelEvent))
    assert (event.t_ns, event.model, event.change) == (10**9, "upright, mutual nearest", ModelChange.GIVEN_UP)
    assert "out of memory; odometry continues with SIFT" in event.detail
    odometry = [m for m in published if isinstance(m, Odometry)]
    assert [m.verdict for m in odometry] == [Verdict.ACCEPTED] * 4
    assert [m.fragment_id for m in odometry] == [0, 1, 1, 1] and odometry[3].keyframe_id == 2


def context(features: str, folder: Path, epoch_ns: int | None = None) -> NodeContext:
    config = Config(vision=Vision(features=features), models=Models(folder=str(folder)))
    return NodeContext(config, MemoryFrameStore(1), None, folder, epoch_ns=epoch_ns)


def test_a_model_that_is_not_there_ends_the_start_and_is_replaced_by_sift_in_flight(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"\[vision\] features: .*xfeat\.onnx: not there; terrafix models fetch xfeat"):
        make_node(context("xfeat", tmp_path))
    node = make_node(context("xfeat", tmp_path, epoch_ns=5))
    list(node.on(ORIGIN))
    published = list(node.on(Frame(t_ns=7, frame_id=0, file="", width=640, height=360)))
    assert isinstance(published[0], ModelEvent)
    assert (published[0].t_ns, published[0].change) == (7, ModelChange.GIVEN_UP)
    assert make_node(context("sift", tmp_path)) is not None


def test_only_models_with_keypoints_can_be_used(tmp_path: Path) -> None:
    tiny_onnx.write(tmp_path, tiny_onnx.GLOBAL, b"no model")
    with pytest.raises(ModelFileError, match="the model 'means' has no keypoints: its role is global"):
        open_point_features("means", str(tmp_path))
    with pytest.raises(ModelFileError, match="no model is called 'sfit'"):
        open_point_features("sfit", str(tmp_path))


@pytest.mark.parametrize("name", ["xfeat", "lighterglue-l3"])
def test_photos_are_registered_with_a_model_that_the_configuration_names(
    name: str, data_set: Callable[[str], Path]
) -> None:
    """Two photos that overlap by half, the second one turned round."""
    folder = data_set("models/xfeat.onnx").parent
    data_set("models/lighterglue_L3.onnx")
    node, ground = make_node(context(name, folder)), texture(1)
    assert isinstance(node, VisionNode) and isinstance(node._frames, MemoryFrameStore)
    node._frames = MemoryFrameStore()
    list(node.on(ORIGIN))
    published = []
    for i, (north_m, yaw_deg) in enumerate(((-30.0, 0.0), (15.0, 176.0))):
        node._frames.put(i, view(ground, PINHOLE, rotation(yaw_deg), np.array([0.0, north_m, 100.0])))
        published += [m for m in node.on(frame_of(i)) if isinstance(m, Odometry)]
    assert published[1].verdict is Verdict.ACCEPTED and published[1].keyframe_id == 0
    pairs = np.array(published[1].two_view)
    turned = -(pairs[:, 2:] @ np.array([[np.cos(0.07), -np.sin(0.07)], [np.sin(0.07), np.cos(0.07)]]))
    assert np.median(np.linalg.norm(turned - pairs[:, :2] - np.median(turned - pairs[:, :2], axis=0), axis=1)) < 0.03
