"""Read one image file and say whether its pixels can be trusted.

OpenCV decodes a truncated JPEG without complaint and fills the rest with grey. Such an image must not pass: half of
its 'ground' would be invented. So the JPEG is walked to its end marker first, and grey fill is looked for after."""

import re
from pathlib import Path

import cv2
import msgspec
import numpy as np

from terrafix.messages import Camera

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
# Nothing in flight looks finer than a 330th of the height: 600 pixels across a lens of 84 degrees. A picture stays two
# and a half times as wide; 26 megapixels as they are stored would be 78 MB and half a second each.
LEAST_WIDTH_PX = 1500
_REDUCED = {2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4, 8: cv2.IMREAD_REDUCED_COLOR_8}


def reduction(width: int) -> int:
    """By how much pictures of this width are made smaller when they are read: 1, 2, 4 or 8."""
    return next((by for by in (8, 4, 2) if width >= by * LEAST_WIDTH_PX), 1)


def reduced(camera: Camera) -> Camera:
    """The camera of the pictures as ``read_image`` gives them, from that of the stored ones. A pixel that reaches
    beyond the rim counts as a whole one, as JPEG has it."""
    by = reduction(camera.width)
    return msgspec.structs.replace(
        camera,
        width=-(-camera.width // by),
        height=-(-camera.height // by),
        fx=camera.fx / by,
        fy=camera.fy / by,
        cx=(camera.cx + 0.5) / by - 0.5,
        cy=(camera.cy + 0.5) / by - 0.5,
    )


def read_image(path: Path, width: int, height: int) -> tuple[np.ndarray | None, str]:
    """-> (image (H, W, 3) uint8 BGR, "") or (None, why). ``width``, ``height``: of the stored picture; it is given as
    the camera ``reduced`` sees it. Orientation tags are ignored: pixels as they are stored."""
    try:
        data = path.read_bytes()
    except OSError as error:
        return None, f"cannot be read ({error.strerror})"
    return decode_image(data, width, height, reduction(width))


def decode_image(data: bytes, width: int, height: int, by: int = 1) -> tuple[np.ndarray | None, str]:
    """As read_image, for the bytes of a file; made smaller ``by`` 1, 2, 4 or 8."""
    if not data:
        return None, "file is empty"
    jpeg = data[:2] == b"\xff\xd8"
    if jpeg and not jpeg_is_whole(data):
        return None, "truncated JPEG: the end of the image is missing"
    how = _REDUCED.get(by, cv2.IMREAD_COLOR) if jpeg else cv2.IMREAD_COLOR
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), how | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        return None, f"cannot be decoded ({error.err})"
    if image is None:
        return None, "cannot be decoded as an image"
    in_file = by if jpeg else 1  # only JPEG knows how to decode a part of its waves
    if image.shape[:2] != (-(-height // in_file), -(-width // in_file)):
        is_width, is_height = image.shape[1] * in_file, image.shape[0] * in_file
        return None, f"{WRONG_SIZE}: {is_width}x{is_height}, the camera says {width}x{height}"
    if jpeg and _ends_in_grey_fill(image, GREY_BLOCK // by):
        return None, "corrupt JPEG: the decoder ran out of data and filled with grey"
    if in_file != by:
        whole = cv2.copyMakeBorder(image, 0, -height % by, 0, -width % by, cv2.BORDER_REPLICATE)
        image = cv2.resize(whole, None, fx=1 / by, fy=1 / by, interpolation=cv2.INTER_AREA)
    return image, ""


def _ends_in_grey_fill(image: np.ndarray, block: int) -> bool:
    """The last block has no data, and the first one has (a picture that is grey all over is just that)."""
    last, first = image[-block:, -block:], image[:block, :block]
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
