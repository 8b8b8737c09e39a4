"""LightGlue (Lindenberger et al., ICCV 2023) and similar from ONNX: a network that matches the keypoints of two images
jointly."""

import numpy as np

from terrafix_engines.features.keypoints import Keypoints
from terrafix_engines.manifest import Manifest, MatcherTensors
from terrafix_engines.runtime import Model, ModelRunError

MIN_POINTS = 8  # per image; fewer do not support a match, and some exports cannot process them


class LightGlueMatcher:
    def __init__(self, model: Model, manifest: Manifest) -> None:
        """``model`` was opened with the tensor names of ``names``."""
        assert manifest.matcher is not None
        self.name = manifest.name
        self.model, self._tensors = model, manifest.matcher

    @staticmethod
    def names(manifest: Manifest) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of the inputs and outputs in use."""
        assert manifest.matcher is not None
        tensors = manifest.matcher
        return (*tensors.keypoints, *tensors.descriptors), (tensors.matches, tensors.scores)

    def match(self, first: Keypoints, second: Keypoints) -> tuple[np.ndarray, np.ndarray]:
        if min(len(first.xy_px), len(second.xy_px)) < MIN_POINTS:
            return np.zeros((0, 2), np.int64), np.zeros(0, np.float32)
        coordinates_px = (model_coordinates(one, self._tensors)[None] for one in (first, second))
        matches, scores = self.model.run(*coordinates_px, first.descriptors[None], second.descriptors[None])
        pairs, confidence = decode_matches(matches, scores, self._tensors)
        counts = (len(first.xy_px), len(second.xy_px))
        if len(pairs) != len(confidence) or (pairs < 0).any() or (pairs >= counts).any():
            raise ModelRunError(f"{self.name}: matches points that do not exist; check [matcher] of its manifest")
        return pairs, confidence


def model_coordinates(points: Keypoints, spec: MatcherTensors) -> np.ndarray:
    """Keypoint coordinates (N, 2) float32 in the convention of the model."""
    if spec.coordinates == "pixels":
        return points.xy_px
    size = np.array(points.size_px, np.float32)
    return np.asarray((points.xy_px - size / 2.0) / (size.max() / 2.0), dtype=np.float32)


def decode_matches(matches: np.ndarray, scores: np.ndarray, spec: MatcherTensors) -> tuple[np.ndarray, np.ndarray]:
    """Model outputs -> (M, 2) int64 index pairs and (M,) float32 confidence."""
    confidence = scores.ravel().astype(np.float32)
    if spec.form == "pairs":
        return matches.reshape(-1, matches.shape[-1])[:, -2:].astype(np.int64), confidence
    partner = matches.ravel().astype(np.int64)
    own = np.flatnonzero(partner >= 0)
    return np.column_stack([own, partner[own]]), confidence[own]
