"""Pictures inside of a page."""

import base64

import cv2
import numpy as np

VOID_BGR = (226, 230, 230)  # colour outside of the map


def data_uri(kind: str, coded: bytes) -> str:
    """``kind``: MIME type."""
    return f"data:{kind};base64,{base64.b64encode(coded).decode()}"


def jpeg_uri(image: np.ndarray, quality: int) -> str:
    """``image`` (h, w, 3): BGR. ``quality``: 0 to 100."""
    return data_uri("image/jpeg", cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes())
