"""Tiles of the pyramid: the mean of the valid pixels out of four, and what a partly valid tile keeps."""

import cv2
import numpy as np
import pytest

from terrafix_tools.mapping.package.pyramid import encode, halve


def tile_of(valid_share: float, seed: int = 3) -> np.ndarray:
    """(256, 256, 4) uint8: random colours, zero where invalid, and the mask."""
    rng = np.random.default_rng(seed)
    tile = rng.integers(0, 256, (256, 256, 4), dtype=np.uint8)
    tile[:, :, 3] = 255
    tile[rng.random((256, 256)) >= valid_share] = 0
    return tile


@pytest.mark.parametrize("valid_share", [0.0, 0.3, 0.7, 1.0])
def test_a_halved_tile_has_the_rounded_mean_of_the_valid_pixels(valid_share: float) -> None:
    tile = tile_of(valid_share)
    wanted = np.zeros((128, 128, 4), np.uint8)
    for row in range(128):
        for column in range(128):
            four = tile[2 * row : 2 * row + 2, 2 * column : 2 * column + 2].reshape(4, 4).astype(int)
            valid = four[four[:, 3] > 0]
            if len(valid) >= 2:
                mean = (valid[:, :3].sum(axis=0) + len(valid) // 2) // len(valid)
                wanted[row, column] = [*mean, 255]
    np.testing.assert_array_equal(halve(tile), wanted)
    assert (halve(tile)[:, :, 3] > 0).any() == (valid_share > 0)


@pytest.mark.parametrize("lossless", [False, True])
def test_a_partly_valid_tile_is_kept_exactly(lossless: bool) -> None:
    tile = tile_of(0.6)
    read = cv2.imdecode(np.frombuffer(encode(tile, lossless=lossless), np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(read, tile)
