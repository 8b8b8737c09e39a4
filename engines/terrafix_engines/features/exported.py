"""Detectors whose ONNX export outputs keypoints (SuperPoint, ALIKED and similar), configured by their manifest."""

import numpy as np

from terrafix_engines.features.image_input import image_tensor
from terrafix_engines.features.keypoints import Keypoints, select_strongest, unit_rows
from terrafix_engines.manifest import Coordinates, Manifest
from terrafix_engines.runtime import Model, ModelRunError


class ExportedDetector:
    def __init__(self, model: Model, manifest: Manifest) -> None:
        """``model`` was opened with the tensor names of ``names``."""
        assert manifest.image is not None and manifest.keypoints is not None
        self.name = manifest.name
        self.model, self._image, self._points = model, manifest.image, manifest.keypoints

    @staticmethod
    def names(manifest: Manifest) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of the inputs and outputs in use."""
        assert manifest.image is not None and manifest.keypoints is not None
        points = manifest.keypoints
        return (manifest.image.input,), (points.keypoints, points.scores, points.descriptors)

    def detect(self, image: np.ndarray, max_points: int) -> Keypoints:
        height, width = image.shape[:2]
        padded_size = self.model.side_lengths(height, width)
        found = self.model.run(image_tensor(image, self._image, *padded_size))
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
        xy_px = to_pixels(keypoints.reshape(-1, 2).astype(np.float32), self._points.coordinates, padded_size)
        strongest = select_strongest(xy_px, scores, (width, height), max_points)
        return Keypoints(
            xy_px[strongest], scores[strongest], unit_rows(descriptors[strongest]), size_px=(width, height)
        )


def to_pixels(xy: np.ndarray, coordinates: Coordinates, padded_size: tuple[int, int]) -> np.ndarray:
    """Keypoints (N, 2) in the model's convention -> pixels of its input of size ``filled`` (height, width)."""
    last = np.array([padded_size[1] - 1, padded_size[0] - 1], np.float32)
    match coordinates:
        case "signed":
            return np.asarray((xy + 1.0) / 2.0 * last, dtype=np.float32)
        case "unit":
            return np.asarray(xy * last, dtype=np.float32)
        case "pixels":
            return xy
