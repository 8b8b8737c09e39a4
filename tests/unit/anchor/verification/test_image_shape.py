"""Posterior of images with one axis stretched, by how well each shape fits the map."""

import numpy as np
import pytest

from anchor_rig import started
from single_map_place import AGL_M, TRUE_M, R, predicted
from terrafix.anchor.verification.image_shape import (
    OTHER_SHAPES,
    SAME_SHAPE,
    STRETCHES,
    ImageShape,
    Stretch,
)
from terrafix.core.agreement import WRONG_SCORE
from terrafix.messages import MapMatch
from terrafix_lab.faults.pictures import scaled
from textured_ground import PINHOLE, view


def scores(**best: float) -> dict[Stretch, float]:
    """Of STRETCHES: 4.0, but of ``described``, ``x`` and ``y``, the axis that is stretched."""
    axes = {"described": (1.0, 1.0), "both": SAME_SHAPE[1], "x": (1.25, 1.0), "y": (1.0, 1.25)}
    return {**dict.fromkeys(STRETCHES, 4.0), **{axes[name]: score for name, score in best.items()}}


def test_images_that_fit_the_map_as_described_are_not_tested_again_until_one_fits_badly() -> None:
    shape = ImageShape()
    assert shape.is_due(9.0, 1.0)
    for _ in range(2):
        shape.add(scores(described=8.0))
    assert shape.ratio == 1.0 and shape.sigma_m(100.0) == 0.0
    assert not shape.is_due(WRONG_SCORE + 0.1, 1.0) and shape.is_due(WRONG_SCORE - 0.1, 1.0)


@pytest.mark.parametrize(("axis", "ratio"), [("x", 1.25), ("y", 0.8)])
def test_a_stretched_axis_widens_the_claim_at_once_and_is_named_when_it_is_certain(axis: str, ratio: float) -> None:
    shape, named = ImageShape(), []
    for _ in range(4):
        shape.add(scores(**{axis: 6.0}))
        named.append(shape.ratio)
        assert shape.sigma_m(100.0) > 15.0
    assert named == [None, None, ratio, ratio]
    assert shape.is_due(WRONG_SCORE + 0.1, 0.1) and not shape.is_due(WRONG_SCORE - 0.1, 0.1)
    for _ in range(3):
        shape.add(scores(described=8.0))
    assert shape.ratio == 1.0 and shape.sigma_m(100.0) == 0.0


def test_a_lead_that_wrong_places_have_is_no_evidence() -> None:
    shape = ImageShape()
    for _ in range(50):
        shape.add(scores(described=4.0, x=4.5))
    assert shape.ratio is None


def test_a_height_that_is_wrong_changes_both_axes_and_not_the_shape() -> None:
    shape = ImageShape()
    for _ in range(4):
        shape.add(scores(both=8.0, x=6.0))
    assert shape.ratio == 1.0 and shape.sigma_m(100.0) == 0.0


@pytest.mark.parametrize("of_image", [(1.0, 4.0 / 3.0), (4.0 / 3.0, 1.0), (1.0, 1.0)])
def test_the_anchor_names_images_that_are_squeezed_from_the_first_frame_on(
    ground: np.ndarray, of_image: tuple[float, float]
) -> None:
    """A quarter of the ground that counts in full is new in each frame."""
    node, frames = started(ground)
    squeezed = of_image != (1.0, 1.0)
    for i in range(1, 11):
        at_m = TRUE_M + np.array([8.0 * i, 0.0, 0.0])
        frames.put(i, scaled(*of_image)(view(ground, PINHOLE, R, at_m)))
        match, *_ = node.on(predicted(i, 5.0, at_m=at_m, step_m=8.0))
        assert isinstance(match, MapMatch)
        assert (match.search.sigma_m > 0.1 * AGL_M) is squeezed
    named = 1.0 if not squeezed else next(r for r, shapes in OTHER_SHAPES.items() if (r > 1.0) is (of_image[0] > 1.0))
    assert match.aspect_ratio == named


def test_the_same_ground_again_is_not_tested_again(ground: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    tested = list[int]()
    monkeypatch.setattr(ImageShape, "add", lambda *_: tested.append(i))
    node, frames = started(ground)
    for i in range(1, 8):
        frames.put(i, scaled(1.0, 4.0 / 3.0)(view(ground, PINHOLE, R, TRUE_M)))
        list(node.on(predicted(i, 5.0, at_m=TRUE_M)))
    assert tested == [1]
