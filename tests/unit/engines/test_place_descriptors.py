"""Place descriptors: without weights, of learned dense features, and of a model with the role global."""

from pathlib import Path

import cv2
import numpy as np
import pytest

import tiny_onnx
from terrafix_engines.features.image_input import image_tensor
from terrafix_engines.manifest import ImageInput, ManifestError, read
from terrafix_engines.retrieval.places import (
    BINS,
    GlobalModelPlaces,
    PlaceDescriber,
    PooledGradientPlaces,
    disc,
    open_place_describer,
    pooled,
)
from terrafix_engines.runtime import ModelFileError, ModelRunError
from textured_ground import texture


def model_folder(folder: Path, manifest: str = tiny_onnx.GLOBAL) -> Path:
    tiny_onnx.write(folder, manifest, tiny_onnx.mean_colours(14))
    return folder


def ground() -> np.ndarray:
    return np.ascontiguousarray(texture(5, 100.0))


def square(image: np.ndarray, row: int, column: int, side: int) -> np.ndarray:
    return image[row : row + side, column : column + side]


@pytest.fixture(params=["pooled-gradient", "tiny", "means"])
def describer(request: pytest.FixtureRequest, tmp_path: Path) -> PlaceDescriber:
    if request.param == "tiny":
        tiny_onnx.write(tmp_path, tiny_onnx.XFEAT_LIKE, tiny_onnx.xfeat_like())
    return open_place_describer(request.param, str(model_folder(tmp_path)))


def test_a_vector_has_length_one_and_resembles_the_same_ground_most(describer: PlaceDescriber) -> None:
    side, image = describer.side_px, ground()
    places = [(r, c) for r in (0, 40, 60) for c in (0, 33, 70)]
    discs = describer.describe(np.array([square(image, r, c, side) for r, c in places]))
    assert discs.shape == (len(places), describer.size) and discs.dtype == np.float32
    assert np.linalg.norm(discs, axis=1) == pytest.approx(1.0, abs=1e-5)
    darker = cv2.convertScaleAbs(image, alpha=0.9)
    seen = describer.describe(np.array([square(darker, r + 1, c + 1, side) for r, c in places]))
    assert (np.argmax(seen @ discs.T, axis=1) == np.arange(len(places))).mean() >= 8 / 9


def test_ground_outside_the_disc_does_not_count(describer: PlaceDescriber) -> None:
    """A frame at another heading does not show the corners of the square."""
    side = describer.side_px
    image = square(ground(), 10, 10, side)
    other = np.where(disc(side, -4.0)[:, :, None] > 0, image, 255 - image)  # beyond the reach of the gradient's blur
    first, second = describer.describe(np.array([image, other.astype(np.uint8)]))
    tolerance = 0.97 if "xfeat" in describer.name or "tiny" in describer.name else 0.995  # cells of 8 px reach out
    assert float(first @ second) > tolerance
    inside = np.where(disc(side, side / 4)[:, :, None] > 0, 255 - image, image)
    inside = cv2.GaussianBlur(inside.astype(np.uint8), (0, 0), 3.0)
    assert float(first @ describer.describe(inside[None])[0]) < 0.98


def test_pooled_bins_are_weighted_means_without_the_mean_of_the_channel() -> None:
    channels = np.zeros((2, 8, 8), np.float32)
    channels[0, :4] = 1.0
    channels[1] = 0.7  # the same everywhere: no information
    vector = pooled(channels, np.ones((8, 8), np.float32)).reshape(2, BINS, BINS)
    assert vector[0, :2] == pytest.approx(1 / 4) and vector[0, 2:] == pytest.approx(-1 / 4)
    assert vector[1] == pytest.approx(0.0, abs=1e-6)
    assert not pooled(np.ones((2, 8, 8), np.float32), np.ones((8, 8), np.float32)).any()
    weights = np.zeros((8, 8), np.float32)
    weights[:, :4] = 1.0
    half = pooled(channels, weights).reshape(2, BINS, BINS)
    assert half[0, :2, :2] == pytest.approx(1 / np.sqrt(8)) and not half[:, :, 2:].any()


def test_the_disc_touches_the_sides_of_its_square_less_the_rim() -> None:
    whole = disc(20, 0.0)
    assert whole[10, 0] == whole[0, 10] == 1.0 and whole[0, 0] == whole[2, 2] == 0.0
    assert whole.sum() == pytest.approx(np.pi * 100, rel=0.03)
    assert disc(20, 2.0)[10, 1] == 0.0 and disc(20, 2.0)[10, 2] == 1.0


def test_a_global_model_gets_the_normalised_disc(tmp_path: Path) -> None:
    """The vector of the test model is the mean of each colour of each 14 px, so the expected one is known."""
    describer = open_place_describer("means", str(model_folder(tmp_path)))
    assert isinstance(describer, GlobalModelPlaces) and (describer.side_px, describer.size) == (28, 12)
    image = square(ground(), 3, 5, 28)
    inside = disc(28, 0.0) > 0
    filled = np.where(inside[:, :, None], image, image[inside].mean(axis=0)).astype(np.uint8)
    values = (filled[:, :, ::-1] / 255.0 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    expected = values.reshape(2, 14, 2, 14, 3).mean(axis=(1, 3)).transpose(2, 0, 1).ravel()
    assert describer.describe(image[None])[0] == pytest.approx(expected / np.linalg.norm(expected), abs=1e-5)


def test_images_are_normalised_by_the_mean_and_deviation_of_the_manifest() -> None:
    image = np.full((2, 2, 3), (10, 20, 30), np.uint8)
    spec = ImageInput(input="x", colour="rgb", scale=0.1, mean=[1.0, 2.0, 3.0], std=[2.0, 1.0, 0.5])
    assert image_tensor(image, spec, 2, 2)[0, :, 0, 0] == pytest.approx([1.0, 0.0, -4.0])
    plain = ImageInput(input="x", colour="rgb", scale=0.1)
    assert image_tensor(image, plain, 2, 2)[0, :, 0, 0] == pytest.approx([3.0, 2.0, 1.0])


def test_names_differ_when_weights_differ(tmp_path: Path) -> None:
    """An index made with other weights must not be used."""
    first, second = tmp_path / "a", tmp_path / "b"
    for folder, seed in ((first, "never"), (second, "blue")):
        folder.mkdir()
        tiny_onnx.write(folder, tiny_onnx.XFEAT_LIKE, tiny_onnx.xfeat_like(seed))
    names = {open_place_describer("tiny", str(folder)).name for folder in (first, second)}
    assert len(names) == 2 and PooledGradientPlaces.name not in names


def test_models_that_cannot_describe_places_are_refused_in_one_line(tmp_path: Path) -> None:
    tiny_onnx.write(tmp_path, tiny_onnx.PAIR, b"no model")
    with pytest.raises(ModelFileError, match="its role is pair, not dense or global"):
        open_place_describer("both", str(tmp_path))
    with pytest.raises(ModelFileError, match=r"'nothing'.*or pooled-gradient"):
        open_place_describer("nothing", str(tmp_path))
    wrong = tiny_onnx.GLOBAL.replace("size = 12", "size = 13").replace("[1, 12]", '[1, "n"]')
    other = tmp_path / "other"
    other.mkdir()
    with pytest.raises(ModelRunError, match="a vector of 12 numbers, not 13"):
        open_place_describer("means", str(model_folder(other, wrong))).describe(ground()[None, :28, :28])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('[vector]\noutput = "vector"\nsize = 12\nside_px = 28\n', "", r"needs a section \[vector\]"),
        ('output = "vector"', 'output = "wrong"', "'wrong' is used"),
        ("std = [0.229, 0.224, 0.225]", "std = [0.2]", "must have 3 numbers"),
        ('colour = "rgb"', 'colour = "gray"', "must have 1 numbers"),
    ],
)
def test_an_inconsistent_manifest_of_a_global_model_is_refused(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    assert old in tiny_onnx.GLOBAL
    model_folder(tmp_path, tiny_onnx.GLOBAL.replace(old, new))
    with pytest.raises(ManifestError, match=message):
        read(tmp_path / "means.toml")
