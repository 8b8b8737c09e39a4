"""Detectors whose ONNX export gives points: SuperPoint, ALIKED and their like, by what their manifest says."""

import numpy as np

from terrafix_engines.features.image_input import image_tensor
from terrafix_engines.features.keypoints import Keypoints, best_of, unit
from terrafix_engines.manifest import Coordinates, Manifest
from terrafix_engines.runtime import Model, ModelRunError


class ExportedDetector:
    def __init__(self, model: Model, manifest: Manifest) -> None:
        """``model`` was opened with the names that ``names`` gives."""
        assert manifest.image is not None and manifest.keypoints is not None
        self.name = manifest.name
        self.model, self._image, self._points = model, manifest.image, manifest.keypoints

    @staticmethod
    def names(manifest: Manifest) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Inputs and outputs that are used."""
        assert manifest.image is not None and manifest.keypoints is not None
        points = manifest.keypoints
        return (manifest.image.input,), (points.keypoints, points.scores, points.descriptors)

    def detect(self, image: np.ndarray, most: int) -> Keypoints:
        height, width = image.shape[:2]
        filled = self.model.side_lengths(height, width)
        found = self.model.run(image_tensor(image, self._image, *filled))
        keypoints, scores, descriptors = found[0], found[1].ravel(), found[2]
        descriptors = descriptors.reshape(descriptors.shape[-2:])
        if self._points.channels_first:
            descriptors = descriptors.T
        count = len(scores)
        if keypoints.size != 2 * count or len(descriptors) != count:
            raise ModelRunError(
                f"{self.name}: {keypoints.size // 2} keypoints, {count} scores, {len(descriptors)} descriptors; "
                "check [keypoints] of its manifest"
            )
        xy_px = in_pixels(keypoints.reshape(-1, 2).astype(np.float32), self._points.coordinates, filled)
        kept = best_of(xy_px, scores, (width, height), most)
        return Keypoints(xy_px[kept], scores[kept], unit(descriptors[kept]), size_px=(width, height))


def in_pixels(xy: np.ndarray, coordinates: Coordinates, filled: tuple[int, int]) -> np.ndarray:
    """(N, 2) as the model says them -> pixels of its input, which has ``filled`` (height, width)."""
    last = np.array([filled[1] - 1, filled[0] - 1], np.float32)
    match coordinates:
        case "signed":
            return np.asarray((xy + 1.0) / 2.0 * last, dtype=np.float32)
        case "unit":
            return np.asarray(xy * last, dtype=np.float32)
        case "pixels":
            return xy
