"""Dense XFeat descriptors (Potje et al., CVPR 2024) from an ONNX file."""

from pathlib import Path

import cv2
import numpy as np

from terrafix_engines.runtime import Model

STRIDE = 8
MULTIPLE = 32  # the network needs sides that are multiples of this


class XFeatDescriber:
    name = "xfeat"
    stride = STRIDE
    channels = 64

    def __init__(self, path: Path) -> None:
        self._model = Model(path, inputs=("input",), outputs=("descriptors",))

    def describe(self, image: np.ndarray) -> np.ndarray:
        """(H, W, 3) uint8 BGR -> (64, H // 8, W // 8) float32, unit vectors."""
        height, width = image.shape[:2]
        pad_y, pad_x = -height % MULTIPLE, -width % MULTIPLE
        padded = cv2.copyMakeBorder(image, 0, pad_y, 0, pad_x, cv2.BORDER_REFLECT_101)
        tensor = np.ascontiguousarray(padded[:, :, ::-1].transpose(2, 0, 1)[None], dtype=np.float32) / 255.0
        (descriptors,) = self._model.run(tensor)
        cells = descriptors[0][:, : height // STRIDE, : width // STRIDE]
        norm = np.sqrt(np.einsum("khw,khw->hw", cells, cells))
        return (cells / np.maximum(norm, 1e-6)).astype(np.float32)
