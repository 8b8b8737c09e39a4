"""XFeat (Potje et al., CVPR 2024) from an ONNX file with the maps of its backbone: dense descriptors and keypoints."""

import cv2
import numpy as np

from terrafix_engines.features.image_input import image_tensor
from terrafix_engines.features.keypoints import Keypoints, select_strongest, unit_rows
from terrafix_engines.manifest import DENSE_INPUT, DENSE_OUTPUTS, Manifest
from terrafix_engines.runtime import Model

STRIDE = 8
INPUTS = (DENSE_INPUT,)
DESCRIPTORS_ONLY = DENSE_OUTPUTS[:1]
# From the authors' detectAndCompute: minimum keypoint probability, and the side of the non-maximum suppression window.
MIN_PROBABILITY = 0.05
NMS_SIDE_PX = 5


class XFeatDescriber:
    """Dense descriptors of XFeat, or of another model with its output: cells of the size that the manifest states."""

    name = "xfeat"
    grayscale = False
    context_px = 32  # cells at the border of a tile as in a larger image

    def __init__(self, model: Model, manifest: Manifest) -> None:
        """``model`` was opened with INPUTS and DESCRIPTORS_ONLY."""
        assert manifest.image is not None
        self.model, self._image = model, manifest.image
        (output,) = manifest.tensors(DESCRIPTORS_ONLY)
        _, channels, height, _ = output.shape
        assert isinstance(channels, int)
        self.channels, self.stride = channels, int(str(height).partition("/")[2])
        if self.stride != STRIDE:
            self.name = "own"

    def describe(self, image: np.ndarray) -> np.ndarray:
        """(H, W, 3) uint8 BGR -> (channels, H // stride, W // stride) float32, unit vectors. Raises ModelRunError."""
        height, width = image.shape[:2]
        tensor = image_tensor(image, self._image, *self.model.side_lengths(height, width))
        (descriptors,) = self.model.run(tensor)
        cells = descriptors[0][:, : height // self.stride, : width // self.stride]
        norm = np.sqrt(np.einsum("khw,khw->hw", cells, cells))
        return (cells / np.maximum(norm, 1e-6)).astype(np.float32)


class XFeatDetector:
    name = "xfeat"

    def __init__(self, model: Model, manifest: Manifest) -> None:
        """``model`` was opened with INPUTS and DENSE_OUTPUTS."""
        assert manifest.image is not None
        self.model, self._image = model, manifest.image

    def detect(self, image: np.ndarray, max_points: int) -> Keypoints:
        height, width = image.shape[:2]
        tensor = image_tensor(image, self._image, *self.model.side_lengths(height, width))
        descriptors, logits, reliability = (one[0] for one in self.model.run(tensor))
        heat = probabilities(logits)
        local_maximum = cv2.dilate(heat, np.ones((NMS_SIDE_PX, NMS_SIDE_PX), np.uint8))
        y, x = np.nonzero((heat == local_maximum) & (heat > MIN_PROBABILITY))
        xy_px = np.column_stack([x, y]).astype(np.float32)
        scores = heat[y, x] * sample(reliability, xy_px)[:, 0]
        strongest = select_strongest(xy_px, scores, (width, height), max_points)
        return Keypoints(
            xy_px[strongest],
            scores[strongest],
            unit_rows(sample(descriptors, xy_px[strongest])),
            size_px=(width, height),
        )


def probabilities(logits: np.ndarray) -> np.ndarray:
    """Keypoint logits (65, h, w): 64 pixels per cell, row by row, and "no keypoint" -> (8 h, 8 w) float32."""
    shifted = np.exp(logits - logits.max(0))
    pixels = (shifted / shifted.sum(0))[:-1]
    h, w = pixels.shape[1:]
    blocks = pixels.reshape(STRIDE, STRIDE, h, w).transpose(2, 0, 3, 1)
    return np.ascontiguousarray(blocks.reshape(h * STRIDE, w * STRIDE), dtype=np.float32)


def sample(cells: np.ndarray, xy_px: np.ndarray) -> np.ndarray:
    """Bilinear sampling of (C, h, w) cells of STRIDE pixels at pixels (N, 2) -> (N, C); edge cells are repeated."""
    h, w = cells.shape[1:]
    x = np.clip((xy_px[:, 0] + 0.5) / STRIDE - 0.5, 0.0, w - 1.0)
    y = np.clip((xy_px[:, 1] + 0.5) / STRIDE - 0.5, 0.0, h - 1.0)
    x0, y0 = np.minimum(x.astype(int), max(w - 2, 0)), np.minimum(y.astype(int), max(h - 2, 0))
    x1, y1 = np.minimum(x0 + 1, w - 1), np.minimum(y0 + 1, h - 1)
    fx, fy = x - x0, y - y0
    upper = cells[:, y0, x0] * (1 - fx) + cells[:, y0, x1] * fx
    lower = cells[:, y1, x0] * (1 - fx) + cells[:, y1, x1] * fx
    return np.asarray((upper * (1 - fy) + lower * fy).T)
