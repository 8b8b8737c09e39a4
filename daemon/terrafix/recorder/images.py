"""Which images of a flight are recorded, and how they are coded."""

from dataclasses import dataclass

import cv2
import numpy as np

from terrafix.core.config import RecorderSection
from terrafix.messages import Frame, Message, Odometry

THUMBNAIL_QUALITY = 70  # JPEG, sufficient for visual inspection
FRAME_QUALITY = 92  # JPEG of a frame at full size
PNG_LEVEL = 1  # the fastest that compresses: 40 ms for full HD, where the default takes 200


@dataclass(frozen=True)
class ImagePolicy:
    settings: RecorderSection

    @property
    def thumbnails(self) -> bool:
        """Whether each frame has a thumbnail."""
        return self.settings.frames != "none"

    def full_frame(self, message: Message) -> int | None:
        """Id of the frame that is to be recorded at full size after ``message``; None: there is none."""
        if isinstance(message, Frame) and not message.error and self.settings.frames == "all":
            return message.frame_id
        if isinstance(message, Odometry) and message.becomes_keyframe and self.settings.frames == "keyframes":
            return message.frame_id
        return None

    def thumbnail(self, image: np.ndarray) -> bytes:
        return thumbnail_jpeg(image, self.settings.thumbnail_width_px)

    def encoded(self, image: np.ndarray) -> bytes:
        """(H, W, 3) uint8 BGR -> content of an image file of the configured format."""
        if self.settings.frame_format == "png":
            return bytes(cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL])[1])
        return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, FRAME_QUALITY])[1])


def thumbnail_jpeg(image: np.ndarray, width_px: int) -> bytes:
    """(H, W, 3) uint8 BGR -> JPEG of ``width_px``, or of the original width if that is smaller."""
    factor = min(1.0, width_px / image.shape[1])
    size = (max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    _, coded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, THUMBNAIL_QUALITY])
    return bytes(coded)
