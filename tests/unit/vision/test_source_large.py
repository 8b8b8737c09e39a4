"""Large images are downscaled when they are read: the same rays, the same errors, a fraction of the memory."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from terrafix.core.camera import CameraCalibration
from terrafix.core.frames import MIN_SLOTS, MemoryFrameStore
from terrafix.messages import Camera
from terrafix.vision.sources.images import decode_image, downscale_factor, downscaled_camera, read_image

WIDTH, HEIGHT = 3105, 2071  # neither is a multiple of a block, nor of two
CAMERA = Camera(
    width=WIDTH, height=HEIGHT, fx=2600.0, fy=2610.0, cx=1548.0, cy=1030.0, distortion=(0.01, -0.02, 0.0, 0.0)
)
DOTS = np.array([[150.0, 200.0], [2900.5, 1900.0], [1548.0, 1030.0], [3000.0, 60.25]])


def dotted() -> np.ndarray:
    """(HEIGHT, WIDTH, 3): soft bright dots on dark ground."""
    picture = np.full((HEIGHT, WIDTH, 3), 20, np.uint8)
    for x, y in DOTS:
        columns, rows = np.arange(int(x) - 40, int(x) + 41), np.arange(int(y) - 40, int(y) + 41)
        dot = np.exp(-((columns[None, :] - x) ** 2 + (rows[:, None] - y) ** 2) / (2 * 9.0**2))
        picture[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += (200 * dot[..., None]).astype(np.uint8)
    return picture


def middles(image: np.ndarray, near: np.ndarray, reach: int) -> np.ndarray:
    """(N, 2) centroids of the brightness around each point."""
    found = []
    for x, y in near:
        x0, y0 = round(x) - reach, round(y) - reach
        part = image[y0 : y0 + 2 * reach + 1, x0 : x0 + 2 * reach + 1, 0].astype(float) - 20.0
        rows, columns = np.mgrid[0 : part.shape[0], 0 : part.shape[1]]
        part = np.clip(part - 5.0, 0.0, None)
        found.append((x0 + (part * columns).sum() / part.sum(), y0 + (part * rows).sum() / part.sum()))
    return np.array(found)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_rays_through_the_downscaled_camera_are_unchanged(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    cv2.imwrite(str(path), dotted())
    image, error = read_image(path, WIDTH, HEIGHT)
    small = CameraCalibration.of(downscaled_camera(CAMERA))
    assert error == "" and image is not None
    assert image.shape == (small.height, small.width, 3) == (1036, 1553, 3)
    stored = CameraCalibration.of(CAMERA)
    rays = stored.normalise(DOTS)
    seen = small.normalise(middles(image, (DOTS + 0.5) / 2 - 0.5, 20))
    assert np.abs(seen - rays).max() < 0.06 / stored.fx  # a twentieth of a stored pixel


@pytest.mark.parametrize("width, by", [(640, 1), (2999, 1), (3000, 2), (4000, 2), (6252, 4), (12_000, 8), (40_000, 8)])
def test_the_downscale_factor_keeps_the_minimum_width(width: int, by: int) -> None:
    assert downscale_factor(width) == by
    camera = downscaled_camera(Camera(width=width, height=width, fx=1.0, fy=1.0, cx=0.0, cy=0.0))
    assert camera.width >= min(width, 1500) and (camera.width == width) is (by == 1)


def test_an_image_of_another_size_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    cv2.imwrite(str(path), np.zeros((HEIGHT, 3600, 3), np.uint8))
    image, error = read_image(path, WIDTH, HEIGHT)
    assert image is None and error.startswith("wrong size") and f"says {WIDTH}x{HEIGHT}" in error


def test_grey_fill_is_detected_in_a_downscaled_image() -> None:
    noise = np.random.default_rng(1).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    data = cv2.imencode(".jpg", noise)[1].tobytes()
    image, error = decode_image(data[: len(data) // 2] + b"\xff\xd9", WIDTH, HEIGHT, 2)
    assert image is None and "ran out of data" in error


def test_the_frame_store_keeps_fewer_large_frames() -> None:
    store = MemoryFrameStore()
    for i in range(7):
        store.put(i, np.zeros((4168, 6252, 3), np.uint8))
    assert [i for i in range(7) if store.get(i) is not None] == list(range(7 - MIN_SLOTS, 7))


def png_that_states(width: int, height: int) -> bytes:
    """A PNG of 100 bytes whose header states a size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    pixels = zlib.compress(bytes(1000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def test_an_image_that_states_another_size_is_not_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    def decoded(*_: object) -> None:
        raise AssertionError("the pixels were decoded")

    monkeypatch.setattr(cv2, "imdecode", decoded)
    image, error = decode_image(png_that_states(12_000, 10_000), WIDTH, HEIGHT, 2)
    assert image is None and error == f"wrong size: 12000x10000, the camera says {WIDTH}x{HEIGHT}"


@pytest.mark.parametrize("side", [20_000, 100_000])
def test_an_image_larger_than_any_camera_gives_is_not_decoded(side: int) -> None:
    image, error = decode_image(png_that_states(side, side), side, side, 8)
    assert image is None and "cannot be decoded" in error
