"""Matchers without points of their own, from ONNX: EfficientLoFTR (Wang et al., CVPR 2024), LiteSAM and their like, by
what their manifest says. Such a network sees both pictures at once and says where it found the same."""

import numpy as np

from terrafix_engines.features.exported import in_pixels
from terrafix_engines.features.image_input import image_tensor
from terrafix_engines.features.pairs import PixelPairs
from terrafix_engines.manifest import Manifest
from terrafix_engines.runtime import Model, ModelRunError


class SemiDenseMatcher:
    def __init__(self, model: Model, manifest: Manifest) -> None:
        """``model`` was opened with the names that ``names`` gives."""
        assert manifest.image is not None and manifest.pair is not None
        self.name = manifest.name
        self.model, self._image, self._pair = model, manifest.image, manifest.pair

    @staticmethod
    def names(manifest: Manifest) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Inputs and outputs that are used."""
        assert manifest.image is not None and manifest.pair is not None
        pair = manifest.pair
        return (manifest.image.input, pair.second), (*pair.keypoints, pair.scores)

    def match(self, first: np.ndarray, second: np.ndarray) -> PixelPairs:
        """As ``PictureMatcher``. What was found in the filling of a picture is left out."""
        sizes = [picture.shape[:2] for picture in (first, second)]
        filled = self.model.side_lengths(max(h for h, _ in sizes), max(w for _, w in sizes))
        *found, scores = self.model.run(*(image_tensor(picture, self._image, *filled) for picture in (first, second)))
        confidence = scores.ravel()
        if any(points.size != 2 * len(confidence) for points in found):
            counts = " and ".join(str(points.size // 2) for points in found)
            raise ModelRunError(f"{self.name}: {counts} points, {len(confidence)} scores; check [pair] of its manifest")
        places = [in_pixels(p.reshape(-1, 2).astype(np.float32), self._pair.coordinates, filled) for p in found]
        inside = np.ones(len(confidence), bool)
        for xy_px, (height, width) in zip(places, sizes, strict=True):
            inside &= ((xy_px >= 0) & (xy_px <= (width - 1, height - 1))).all(1)
        return PixelPairs(places[0][inside], places[1][inside], confidence[inside])
