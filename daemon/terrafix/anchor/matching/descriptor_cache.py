"""Dense descriptors of the map, computed tile by tile on first use and cached with least-recently-used eviction."""

from collections import OrderedDict
from typing import Protocol

import numpy as np

from terrafix.anchor.matching.descriptor_store import DescriptorStore

TILE_CELLS_PX = 256  # pixels of a tile's side; a multiple of every stride [tuned]
DESCRIPTOR_CACHE_BYTES = 33 * 1024 * 1024  # memory for the tiles of all layers, bytes: 31 tiles of gradients [tuned]
# A float16 of the same sign, exponent and mantissa, moved to where a float32 has them: the sign has come with it in too
# many copies, and the exponent is less than it should be by the difference of the two biases. [spec: IEEE 754]
_MANTISSA_SHIFT, _SIGN_ONCE, _EXPONENT_BIASES = 23 - 10, np.int32(-0x70000001), np.float32(2.0 ** (127 - 15))


class MapWindows(Protocol):
    """The part of the map that descriptors need; ``LocalMap`` implements it."""

    gsd_m: float

    def window(
        self, e_min_m: float, n_max_m: float, width_px: int, height_px: int, gsd_m: float
    ) -> tuple[np.ndarray, np.ndarray]: ...


class Describer(Protocol):
    """Dense feature extractor; one implementation per kind of feature."""

    name: str
    stride: int
    channels: int
    grayscale: bool  # ``describe`` takes grey images (H, W) as well
    context_px: int  # pixels around a cell on which its descriptor depends, a multiple of the stride

    def describe(self, image: np.ndarray) -> np.ndarray:
        """(H, W, 3) uint8 BGR -> (C, H // stride, W // stride) float32"""


class MapFeatures:
    def __init__(
        self,
        source: MapWindows,
        describer: Describer,
        cache_bytes: int = DESCRIPTOR_CACHE_BYTES,
        store: DescriptorStore | None = None,
    ) -> None:
        """``store``: file store in which tiles outlive this process."""
        self._source = source
        self.describer = describer
        self._store = store
        self._tiles: OrderedDict[tuple[float, int, int], tuple[np.ndarray, np.ndarray]] = OrderedDict()
        self._bytes, self._max_bytes = 0, cache_bytes

    def window(
        self, e_min_m: float, n_max_m: float, width: int, height: int, gsd_m: float
    ) -> tuple[np.ndarray, np.ndarray, float, float]:
        """``width`` x ``height`` cells (a cell is ``stride`` pixels of ``gsd_m``) with the north-west corner near
        (e_min_m, n_max_m), local metres.

        -> descriptors (C, height, width) float32, valid (height, width) bool, and the corner used: the nearest one on
        the grid of cells.
        """
        cell = gsd_m * self.describer.stride
        per_tile = TILE_CELLS_PX // self.describer.stride
        column, row = round(e_min_m / cell), round(-n_max_m / cell)
        valid = np.empty((height, width), bool)  # the tiles cover all of it
        out: np.ndarray | None = None
        for ty in range(row // per_tile, (row + height - 1) // per_tile + 1):
            for tx in range(column // per_tile, (column + width - 1) // per_tile + 1):
                tile, tile_valid = self._tile(gsd_m, tx, ty, cell, per_tile)
                y0, x0 = ty * per_tile - row, tx * per_tile - column
                ys = slice(max(y0, 0), min(y0 + per_tile, height))
                xs = slice(max(x0, 0), min(x0 + per_tile, width))
                if out is None:
                    out = np.empty((len(tile), height, width), np.float32)
                from_y = slice(ys.start - y0, ys.stop - y0)
                from_x = slice(xs.start - x0, xs.stop - x0)
                put_widened(tile[:, from_y, from_x], out[:, ys, xs])
                valid[ys, xs] = tile_valid[from_y, from_x]
        assert out is not None
        return out, valid, column * cell, -row * cell

    def _tile(self, gsd_m: float, tx: int, ty: int, cell: float, per_tile: int) -> tuple[np.ndarray, np.ndarray]:
        key = (gsd_m, tx, ty)
        name = f"{self.describer.name} {gsd_m!r} {tx} {ty}"
        if key in self._tiles:
            self._tiles.move_to_end(key)
            if self._store is not None:
                self._store.touch(name)
            return self._tiles[key]
        tile = None if self._store is None else self._store.read(name)
        if tile is None:
            tile = self._computed(gsd_m, tx, ty, cell, per_tile)
            if self._store is not None:
                self._store.write(name, *tile)
        self._tiles[key] = tile
        self._bytes += tile[0].nbytes + tile[1].nbytes
        while self._bytes > self._max_bytes and len(self._tiles) > 1:
            _, (old, old_valid) = self._tiles.popitem(last=False)
            self._bytes -= old.nbytes + old_valid.nbytes
        return tile

    def _computed(self, gsd_m: float, tx: int, ty: int, cell: float, per_tile: int) -> tuple[np.ndarray, np.ndarray]:
        stride, pad_px = self.describer.stride, self.describer.context_px
        side = TILE_CELLS_PX + 2 * pad_px
        image, ok = self._source.window(
            tx * per_tile * cell - pad_px * gsd_m, -ty * per_tile * cell + pad_px * gsd_m, side, side, gsd_m
        )
        inner = slice(pad_px // stride, pad_px // stride + per_tile)
        rim = slice(pad_px, pad_px + TILE_CELLS_PX)
        valid = np.asarray(ok[rim, rim].reshape(per_tile, stride, per_tile, stride).all(axis=(1, 3)))
        if valid.any():
            descriptors = self.describer.describe(image)[:, inner, inner]
            return np.where(valid, descriptors, 0.0).astype(np.float16), valid
        return np.zeros((self.describer.channels, *valid.shape), np.float16), valid  # no map data in this tile


def put_widened(half: np.ndarray, to: np.ndarray) -> None:
    """``half`` float16, finite, into ``to``, float32 of the same shape, exactly. ``to[:] = half`` takes four times as
    long in numpy, which converts one number after the other."""
    bits = half.view(np.int16).astype(np.int32)
    bits <<= _MANTISSA_SHIFT
    bits &= _SIGN_ONCE
    np.multiply(bits.view(np.float32), _EXPONENT_BIASES, out=to)
