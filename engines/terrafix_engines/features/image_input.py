"""Converts an image to the input tensor of a model, as its manifest specifies."""

import cv2
import numpy as np

from terrafix_engines.manifest import ImageInput


def image_tensor(image: np.ndarray, spec: ImageInput, height: int, width: int) -> np.ndarray:
    """(H, W, 3) uint8 BGR -> (1, C, height, width) float32, padded by reflection at the right and at the bottom."""
    bottom, right = height - image.shape[0], width - image.shape[1]
    padded = cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REFLECT_101)
    match spec.colour:
        case "gray":
            planes = cv2.cvtColor(padded, cv2.COLOR_BGR2GRAY)[None]
        case "rgb":
            planes = padded[:, :, ::-1].transpose(2, 0, 1)
        case "bgr":
            planes = padded.transpose(2, 0, 1)
    tensor = np.ascontiguousarray(planes[None], dtype=np.float32) * np.float32(spec.scale)
    if spec.mean:
        tensor -= np.array(spec.mean, np.float32)[:, None, None]
    if spec.std:
        tensor /= np.array(spec.std, np.float32)[:, None, None]
    return tensor
