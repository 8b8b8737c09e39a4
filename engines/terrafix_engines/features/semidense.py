"""Detector-free matchers from ONNX (EfficientLoFTR, Wang et al., CVPR 2024; LiteSAM and similar), configured by their
manifest. The network takes both images and outputs corresponding points."""

import numpy as np

from terrafix_engines.features.exported import to_pixels
from terrafix_engines.features.image_input import image_tensor
from terrafix_engines.features.pairs import PixelPairs
from terrafix_engines.manifest import Manifest
from terrafix_engines.runtime import Model, ModelRunError


class SemiDenseMatcher:
    def __init__(self, model: Model, manifest: Manifest) -> None:
        """``model`` was opened with the tensor names of ``names``."""
        assert manifest.image is not None and manifest.pair is not None
        self.name = manifest.name
        self.model, self._image, self._pair = model, manifest.image, manifest.pair

    @staticmethod
    def names(manifest: Manifest) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of the inputs and outputs in use."""
        assert manifest.image is not None and manifest.pair is not None
        pair = manifest.pair
        return (manifest.image.input, pair.second), (*pair.keypoints, pair.scores)

    def match(self, first: np.ndarray, second: np.ndarray) -> PixelPairs:
        """See ``PictureMatcher``. Points in the padding of an image are dropped."""
        sizes = [image.shape[:2] for image in (first, second)]
        padded_size = self.model.side_lengths(max(h for h, _ in sizes), max(w for _, w in sizes))
        *found, scores = self.model.run(*(image_tensor(image, self._image, *padded_size) for image in (first, second)))
        confidence = scores.ravel()
        if any(points.size != 2 * len(confidence) for points in found):
            counts = " and ".join(str(points.size // 2) for points in found)
            raise ModelRunError(f"{self.name}: {counts} points, {len(confidence)} scores; check [pair] of its manifest")
        coordinates_px = [
            to_pixels(p.reshape(-1, 2).astype(np.float32), self._pair.coordinates, padded_size) for p in found
        ]
        inside = np.ones(len(confidence), bool)
        for xy_px, (height, width) in zip(coordinates_px, sizes, strict=True):
            inside &= ((xy_px >= 0) & (xy_px <= (width - 1, height - 1))).all(1)
        return PixelPairs(coordinates_px[0][inside], coordinates_px[1][inside], confidence[inside])
