"""Read one image file and say whether its pixels can be trusted.

OpenCV decodes a truncated JPEG without complaint and fills the rest with grey. Such an image must not pass: half of
its 'ground' would be invented. So the JPEG is walked to its end marker first, and grey fill is looked for after."""

import re
from pathlib import Path

import cv2
import numpy as np

# What is wrong with an image becomes a Frame.error; OpenCV's own lines on stderr would say it twice.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp"})
WRONG_SIZE = "wrong size"  # how an error begins when the pixels are whole, but not those of the camera
GREY_FILL = 128  # what libjpeg leaves in blocks that it has no data for: coefficient 0
GREY_BLOCK = 8  # side of a block in pixels; blocks are stored row by row, so the last one tells
# In entropy-coded data a marker is FF and anything but 00 (stuffing), FF (fill) and D0..D7 (restart). ITU T.81, B.1.1
_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")
_STANDALONE = frozenset({0x01, *range(0xD0, 0xD9)})  # markers without a length
_END_OF_IMAGE = 0xD9


def read_image(path: Path, width: int, height: int) -> tuple[np.ndarray | None, str]:
    """-> (image (H, W, 3) uint8 BGR, "") or (None, why). Orientation tags are ignored: pixels as they are stored."""
    try:
        data = path.read_bytes()
    except OSError as error:
        return None, f"cannot be read ({error.strerror})"
    return decode_image(data, width, height)


def decode_image(data: bytes, width: int, height: int) -> tuple[np.ndarray | None, str]:
    """As read_image, for the bytes of a file."""
    if not data:
        return None, "file is empty"
    jpeg = data[:2] == b"\xff\xd8"
    if jpeg and not jpeg_is_whole(data):
        return None, "truncated JPEG: the end of the image is missing"
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        return None, f"cannot be decoded ({error.err})"
    if image is None:
        return None, "cannot be decoded as an image"
    if image.shape[:2] != (height, width):
        return None, f"{WRONG_SIZE}: {image.shape[1]}x{image.shape[0]}, the camera says {width}x{height}"
    if jpeg and _ends_in_grey_fill(image):
        return None, "corrupt JPEG: the decoder ran out of data and filled with grey"
    return image, ""


def _ends_in_grey_fill(image: np.ndarray) -> bool:
    """The last block has no data, and the first one has (a picture that is grey all over is just that)."""
    last, first = image[-GREY_BLOCK:, -GREY_BLOCK:], image[:GREY_BLOCK, :GREY_BLOCK]
    return bool((last == GREY_FILL).all()) and not bool((first == GREY_FILL).all())


def jpeg_is_whole(data: bytes) -> bool:
    """Walks the segments of a JPEG to its end marker (a thumbnail's end marker inside APP1 does not count)."""
    at = 2
    while True:
        found = _MARKER.search(data, at)
        if found is None:
            return False
        marker, at = data[found.start() + 1], found.end()
        if marker == _END_OF_IMAGE:
            return True
        if marker in _STANDALONE:
            continue
        if at + 2 > len(data):
            return False
        at += int.from_bytes(data[at : at + 2], "big")
