"""Descriptor cache: what it holds in memory, and that windows have the numbers that were computed."""

import numpy as np

from terrafix.anchor.matching.descriptor_cache import DESCRIPTOR_CACHE_BYTES, MapFeatures, put_widened


class Tiles:
    """A map whose pixels do not matter."""

    gsd_m = 0.5

    def window(
        self, e_min_m: float, n_max_m: float, width_px: int, height_px: int, gsd_m: float
    ) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros((height_px, width_px, 3), np.uint8), np.ones((height_px, width_px), bool)


class Numbers:
    """Descriptors of two channels, other ones for each tile."""

    name, stride, channels, grayscale, context_px = "numbers", 8, 2, False, 32

    def __init__(self) -> None:
        self.described = 0

    def describe(self, image: np.ndarray) -> np.ndarray:
        self.described += 1
        h, w = image.shape[0] // self.stride, image.shape[1] // self.stride
        return np.random.default_rng(self.described).normal(size=(self.channels, h, w)).astype(np.float32)


TILE_BYTES = 32 * 32 * (2 * Numbers.channels + 1)  # float16 and the mask


def held_bytes(features: MapFeatures) -> int:
    return sum(tile.nbytes + valid.nbytes for tile, valid in features._tiles.values())


def test_every_finite_float16_is_widened_exactly() -> None:
    """All of them: both signs, subnormal numbers, zero."""
    half = np.arange(2**16, dtype=np.uint16).view(np.float16).reshape(256, 256)
    half = np.where(np.isfinite(half), half, np.float16(0.0))
    out = np.full((300, 300), np.nan, np.float32)
    put_widened(half, out[20:276, 10:266])
    assert np.array_equal(out[20:276, 10:266], half.astype(np.float32))
    assert np.isnan(out).sum() == 300 * 300 - 256 * 256, "only the given part is written"


def test_a_window_over_four_tiles_has_the_descriptors_as_computed() -> None:
    features = MapFeatures(Tiles(), Numbers())
    out, valid, e_m, n_m = features.window(-64.0, 64.0, 32, 32, 0.5)
    assert (out.shape, out.dtype, e_m, n_m) == ((2, 32, 32), np.float32, -64.0, 64.0) and valid.all()
    first = np.random.default_rng(1).normal(size=(2, 40, 40)).astype(np.float16)[:, 4:36, 4:36]
    assert np.array_equal(out[:, :16, :16], first[:, 16:, 16:].astype(np.float32)), "the south-east of the first tile"


def test_the_cache_holds_no_more_than_its_limit_in_bytes_and_keeps_what_was_used_last() -> None:
    features = MapFeatures(Tiles(), numbers := Numbers(), cache_bytes=3 * TILE_BYTES + 100)
    for column in (0, 1, 2, 0, 3):
        features.window(column * 128.0 + 1.0, -1.0, 1, 1, 0.5)
        assert held_bytes(features) <= 3 * TILE_BYTES
    assert numbers.described == 4
    features.window(1.0, -1.0, 1, 1, 0.5)
    assert numbers.described == 4, "the first tile was used after the second one, which has gone instead"
    features.window(129.0, -1.0, 1, 1, 0.5)
    assert numbers.described == 5


def test_the_limit_of_the_cache_is_in_memory_of_31_tiles_of_gradients() -> None:
    tile = 8 * 256 * 256 * 2 + 256 * 256
    assert DESCRIPTOR_CACHE_BYTES // tile == 31 and DESCRIPTOR_CACHE_BYTES < 35e6
