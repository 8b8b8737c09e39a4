"""A raster without a mask: its collar is searched once, for a mosaic into the folder beside the downloads.

That of an image that is warped (in degrees, rotated, south-up) is searched on the image's own pixels."""

import contextlib
import hashlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import rasterio
from rasterio.windows import Window

from terrafix_tools.mapping.mosaic.collar import BLEED_PX, BLOCK_PX, TRIM_PX, Collar, find_collar
from terrafix_tools.mapping.mosaic.compositing import Opener
from terrafix_tools.mapping.source import ImagerySource

Bar = Callable[[str, int | None], Callable[[], None]]


class Collared(ImagerySource):
    """An ImagerySource with a known collar."""

    def __init__(self, path: Path, collar_path: Path) -> None:
        super().__init__(path)
        self._collar = Collar(collar_path)
        self.has_mask = True

    def close(self) -> None:
        self._collar.close()
        super().close()

    def read(self, column: int, row: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
        return read_without_collar(self, self._collar, column, row, width, height)


def raster_opener(path: Path, cache: Path, bar: Bar) -> Opener:
    """Opener of a raster. Raises MapError: not an image, or not georeferenced."""
    path, cache = path.absolute(), cache.absolute()  # a worker may have another working directory
    with ImagerySource(path) as source:
        if source.file_has_mask:
            return partial(ImagerySource, path)
        stat = path.stat()
        key = hashlib.sha256(f"{path.resolve()}|{stat.st_size}|{stat.st_mtime_ns}".encode()).hexdigest()[:16]
        cached = cache / f"{'hidden' if source.warped else 'collar'}-{key}.tif"
        opener = partial(ImagerySource, path, hidden=cached) if source.warped else partial(Collared, path, cached)
        if cached.is_file():
            return opener
        cache.mkdir(parents=True, exist_ok=True)
        part = cache / f".{cached.name}.part.tif"
        try:
            if source.warped:
                found = write_hidden(path, part, bar)
            else:
                collar = find_collar(source, part, bar)
                found = collar is not None
                if collar is not None:
                    collar.close()
            if not found:
                return partial(ImagerySource, path)
            part.replace(cached)
        finally:
            part.unlink(missing_ok=True)
    return opener


def write_hidden(path: Path, out: Path, bar: Bar) -> bool:
    """Writes a raster on the image's own pixels that is 1 in its collar; False: it has none, and nothing is written."""
    labelled = out.with_name(f".{out.name}.collar.tif")
    try:
        with ImagerySource(path, raw=True) as source, rasterio.open(path) as file:
            collar = find_collar(source, labelled, bar)
            if collar is None:
                return False
            profile = {"driver": "GTiff", "count": 1, "dtype": "uint8", "nbits": 1, "compress": "deflate"}
            profile |= {"tiled": True, "blockxsize": 256, "blockysize": 256, "BIGTIFF": "IF_SAFER", "SPARSE_OK": True}
            profile |= {"width": source.width_px, "height": source.height_px, "crs": file.crs}
            with contextlib.closing(collar), rasterio.open(out, "w", transform=file.transform, **profile) as hidden:
                for row in range(0, source.height_px, BLOCK_PX):
                    for column in range(0, source.width_px, BLOCK_PX):
                        size = min(BLOCK_PX, source.width_px - column), min(BLOCK_PX, source.height_px - row)
                        mask = read_without_collar(source, collar, column, row, *size)[1]
                        if not mask.all():
                            hidden.write((mask == 0).astype(np.uint8), 1, window=Window(column, row, *size))
    finally:
        labelled.unlink(missing_ok=True)
    return True


def read_without_collar(
    source: ImagerySource, collar: Collar, column: int, row: int, width: int, height: int
) -> tuple[np.ndarray, np.ndarray]:
    """A window with the collar and its smear invalid; as ``Imagery.read``."""
    margin = BLEED_PX + TRIM_PX
    left, top = max(column - margin, 0), max(row - margin, 0)
    right, bottom = min(column + width + margin, source.width_px), min(row + height + margin, source.height_px)
    image, mask = ImagerySource.read(source, left, top, right - left, bottom - top)
    collar.remove(image, mask, left, top)
    inner = slice(row - top, row - top + height), slice(column - left, column - left + width)
    return np.ascontiguousarray(image[inner]), np.ascontiguousarray(mask[inner])
