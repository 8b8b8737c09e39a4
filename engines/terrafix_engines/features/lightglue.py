"""LightGlue (Lindenberger et al., ICCV 2023) and its like from ONNX: a network that sees all points of two pictures at
once joins them."""

import numpy as np

from terrafix_engines.features.keypoints import Keypoints
from terrafix_engines.manifest import Manifest, MatcherTensors
from terrafix_engines.runtime import Model, ModelRunError

FEWEST_POINTS = 8  # of a picture: fewer decide nothing, and some exports cannot take them


class LightGlueMatcher:
    def __init__(self, model: Model, manifest: Manifest) -> None:
        """``model`` was opened with the names that ``names`` gives."""
        assert manifest.matcher is not None
        self.name = manifest.name
        self.model, self._tensors = model, manifest.matcher

    @staticmethod
    def names(manifest: Manifest) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Inputs and outputs that are used."""
        assert manifest.matcher is not None
        tensors = manifest.matcher
        return (*tensors.keypoints, *tensors.descriptors), (tensors.matches, tensors.scores)

    def match(self, first: Keypoints, second: Keypoints) -> tuple[np.ndarray, np.ndarray]:
        if min(len(first.xy_px), len(second.xy_px)) < FEWEST_POINTS:
            return np.zeros((0, 2), np.int64), np.zeros(0, np.float32)
        places = (placed(one, self._tensors)[None] for one in (first, second))
        matches, scores = self.model.run(*places, first.descriptors[None], second.descriptors[None])
        pairs, confidence = as_pairs(matches, scores, self._tensors)
        counts = (len(first.xy_px), len(second.xy_px))
        if len(pairs) != len(confidence) or (pairs < 0).any() or (pairs >= counts).any():
            raise ModelRunError(f"{self.name}: joins points that are not there; check [matcher] of its manifest")
        return pairs, confidence


def placed(points: Keypoints, spec: MatcherTensors) -> np.ndarray:
    """(N, 2) float32 as the model wants its keypoints."""
    if spec.coordinates == "pixels":
        return points.xy_px
    size = np.array(points.size_px, np.float32)
    return np.asarray((points.xy_px - size / 2.0) / (size.max() / 2.0), dtype=np.float32)


def as_pairs(matches: np.ndarray, scores: np.ndarray, spec: MatcherTensors) -> tuple[np.ndarray, np.ndarray]:
    """What the model says -> (M, 2) int64 and (M,) float32."""
    confidence = scores.ravel().astype(np.float32)
    if spec.form == "pairs":
        return matches.reshape(-1, matches.shape[-1])[:, -2:].astype(np.int64), confidence
    partner = matches.ravel().astype(np.int64)
    own = np.flatnonzero(partner >= 0)
    return np.column_stack([own, partner[own]]), confidence[own]
