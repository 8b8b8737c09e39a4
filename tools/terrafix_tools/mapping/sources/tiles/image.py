"""Validates and decodes one tile from a file or a server."""

from pathlib import Path

import cv2
import numpy as np

from terrafix.core.errors import MapError

JPEG, PNG, WEBP = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"RIFF"
PNG_END = b"IEND\xaeB`\x82"
TAIL_BYTES = 64  # some servers append a few bytes after the end marker


class TileDamage(Exception):
    """Why the bytes are not a complete image. Caught by callers that know the tile index."""


def check_complete(data: bytes) -> None:
    """Raises TileDamage. Needed because decoders are lenient: they silently fill a truncated JPEG with grey."""
    if not data:
        raise TileDamage("empty answer")
    if data.startswith(JPEG):
        whole = b"\xff\xd9" in data[-TAIL_BYTES:]
    elif data.startswith(PNG):
        whole = PNG_END in data[-TAIL_BYTES:]
    elif data.startswith(WEBP) and data[8:12] == b"WEBP":
        whole = len(data) >= 8 + int.from_bytes(data[4:8], "little")
    else:
        start = data[:40].decode("ascii", "replace").strip().replace("\n", " ")
        raise TileDamage(f"neither JPEG, PNG nor WebP (starts with '{start}')")
    if not whole:
        raise TileDamage(f"cut off after {len(data)} bytes")


def decode(data: bytes, side_px: int) -> np.ndarray:
    """(side, side, 4) uint8 BGR and mask of 0 and 255. Raises TileDamage: incomplete, not decodable, another size."""
    check_complete(data)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise TileDamage("does not decode")
    if image.shape[:2] != (side_px, side_px):
        raise TileDamage(f"is {image.shape[1]}x{image.shape[0]} px, not {side_px}: set tile_px of the source")
    if image.dtype == np.uint16:
        image = (image.astype(np.uint16) >> 8).astype(np.uint8)  # 16-bit PNG
    if image.ndim == 2:
        image = image[:, :, None]
    out = np.empty((side_px, side_px, 4), np.uint8)
    channels = image.shape[2]
    out[:, :, :3] = image[:, :, :3] if channels >= 3 else image[:, :, :1]
    # Partly transparent pixels are at the edge of a mosaic; their colour is blended with the void.
    out[:, :, 3] = np.where(image[:, :, -1] == 255, 255, 0) if channels in (2, 4) else 255
    return out


def image_side(data: bytes, path: Path) -> int:
    """Side of a tile in px. Raises MapError."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if image is None or image.shape[0] != image.shape[1]:
        raise MapError(f"{path}: its tiles are not square images (JPEG, PNG or WebP); check the source")
    return int(image.shape[0])
