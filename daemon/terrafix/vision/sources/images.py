"""Reads an image file and checks that its pixels are complete.

OpenCV decodes a truncated JPEG without an error and fills the rest with grey; such an image must be rejected, because
part of its ground is not real. So the JPEG segments are parsed up to the end marker, and the result is checked for
grey fill."""

import io
import re
import warnings
from pathlib import Path

import cv2
import msgspec
import numpy as np
from PIL import Image as HeaderReader
from PIL import UnidentifiedImageError

from terrafix.messages import Camera

# The error goes into Frame.error; OpenCV's messages on stderr would repeat it.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp"})
WRONG_SIZE = "wrong size"  # prefix of the error when the image is complete but has not the size of the camera
# What macOS and Windows leave beside photos: "._DJI_0001.JPG" has the icon and the labels of a file, and no picture.
HIDDEN = "."
GREY_FILL = 128  # libjpeg's value of blocks without data: coefficient 0
GREY_BLOCK = 8  # side of a block in pixels; blocks are stored row by row, so checking the last one is sufficient
# In entropy-coded data a marker is FF followed by anything but 00 (stuffing), FF (fill), D0..D7 (restart), T.81 B.1.1.
_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")
_STANDALONE = frozenset({0x01, *range(0xD0, 0xD9)})  # markers without a length field
_END_OF_IMAGE = 0xD9
PNG_HEAD = b"\x89PNG\r\n\x1a\n"  # PNG specification 5.2; then chunks of length, type, data, checksum (5.3)
# Nothing in flight uses a finer resolution than a 330th of the height, which is 600 pixels across a lens of 84 degrees.
# A reduced image keeps two and a half times that; a full one of 26 megapixels would take 78 MB and half a second.
MIN_WIDTH_PX = 1500
_REDUCED = {2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4, 8: cv2.IMREAD_REDUCED_COLOR_8}


def is_image_name(name: str) -> bool:
    """Whether a file with this name is an image by its suffix, and not hidden."""
    return Path(name).suffix.lower() in IMAGE_SUFFIXES and not name.startswith(HIDDEN)


def image_files(folder: Path) -> list[Path]:
    """The images of a folder in the order of their names. Raises OSError."""
    return sorted(path for path in folder.iterdir() if is_image_name(path.name) and path.is_file())


def downscale_factor(width: int) -> int:
    """Downscale factor for images of this width when they are read: 1, 2, 4 or 8."""
    return next((by for by in (8, 4, 2) if width >= by * MIN_WIDTH_PX), 1)


def downscaled_camera(camera: Camera) -> Camera:
    """The camera of images as ``read_image`` returns them, from the camera of the stored images. Sizes are rounded up,
    as JPEG does."""
    by = downscale_factor(camera.width)
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
    """-> (image (H, W, 3) uint8 BGR, "") or (None, error). ``width``, ``height``: of the stored image; the result has
    the size of the ``downscaled_camera``. Orientation tags are ignored: pixels as they are stored."""
    try:
        data = path.read_bytes()
    except OSError as error:
        return None, f"cannot be read ({error.strerror})"
    return decode_image(data, width, height, downscale_factor(width))


def decode_image(data: bytes, width: int, height: int, by: int = 1) -> tuple[np.ndarray | None, str]:
    """Same as ``read_image``, for the bytes of a file and a downscale factor ``by`` of 1, 2, 4 or 8."""
    if not data:
        return None, "file is empty"
    # Before the pixels are decoded: a file of 100 kB may state a size whose pixels take gigabytes.
    stated = stated_size(data)
    if stated is None:
        return None, "cannot be decoded as an image"
    if stated != (width, height):
        return None, f"{WRONG_SIZE}: {stated[0]}x{stated[1]}, the camera says {width}x{height}"
    if data.startswith(PNG_HEAD) and not png_is_complete(data):
        return None, "truncated PNG: a chunk reaches beyond the end of the file"
    jpeg = data[:2] == b"\xff\xd8"
    if jpeg and not jpeg_is_complete(data):
        return None, "truncated JPEG: the end of the image is missing"
    flags = _REDUCED.get(by, cv2.IMREAD_COLOR) if jpeg else cv2.IMREAD_COLOR
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        return None, f"cannot be decoded ({error.err})"
    if image is None:
        return None, "cannot be decoded as an image"
    decoder_factor = by if jpeg else 1  # only the JPEG decoder can downscale
    if image.shape[:2] != (-(-height // decoder_factor), -(-width // decoder_factor)):
        is_width, is_height = image.shape[1] * decoder_factor, image.shape[0] * decoder_factor
        return None, f"{WRONG_SIZE}: {is_width}x{is_height}, the camera says {width}x{height}"
    if jpeg and _ends_in_grey_fill(image, GREY_BLOCK // by):
        return None, "corrupt JPEG: the decoder ran out of data and filled with grey"
    if decoder_factor != by:
        padded = cv2.copyMakeBorder(image, 0, -height % by, 0, -width % by, cv2.BORDER_REPLICATE)
        image = cv2.resize(padded, None, fx=1 / by, fy=1 / by, interpolation=cv2.INTER_AREA)
    return image, ""


def stated_size(data: bytes) -> tuple[int, int] | None:
    """(width, height) in the header of an image file; None: its header cannot be read."""
    try:
        with warnings.catch_warnings(action="ignore"), HeaderReader.open(io.BytesIO(data)) as header:
            return header.size
    except HeaderReader.DecompressionBombError:
        return None  # larger than OpenCV decodes (terrafix/__init__.py)
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError):
        return None  # Pillow raises these for broken headers


def _ends_in_grey_fill(image: np.ndarray, block: int) -> bool:
    """True when the last block is grey fill and the first is not (an image may be grey all over)."""
    last, first = image[-block:, -block:], image[:block, :block]
    return bool((last == GREY_FILL).all()) and not bool((first == GREY_FILL).all())


def png_is_complete(data: bytes) -> bool:
    """True when the chunks of a PNG lie in the file, up to its end chunk. OpenCV allocates the length that a chunk
    states before it reads: up to 4 GB."""
    at = len(PNG_HEAD)
    while at + 12 <= len(data):
        length, kind = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        at += 12 + length
        if kind == b"IEND":
            return at <= len(data)
    return False


def jpeg_is_complete(data: bytes) -> bool:
    """True when a JPEG's segments end with its end marker. End markers inside a segment (thumbnail) do not count."""
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
