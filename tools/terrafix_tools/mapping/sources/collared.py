"""A raster without a mask as part of a mosaic: its collar is searched once and cached beside the downloads."""

import hashlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from terrafix_tools.mapping.mosaic.collar import BLEED_PX, TRIM_PX, Collar, find_collar
from terrafix_tools.mapping.mosaic.compositing import Opener
from terrafix_tools.mapping.source import ImagerySource

Bar = Callable[[str, int | None], Callable[[], None]]


class Collared(ImagerySource):
    """An ImagerySource with a known collar."""

    def __init__(self, path: Path, collar_path: Path) -> None:
        super().__init__(path)
        self._collar = Collar(collar_path)
        self.has_mask = True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._collar.close()
        super().__exit__(kind, error, trace)

    def read(self, column: int, row: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
        margin = BLEED_PX + TRIM_PX
        left, top = max(column - margin, 0), max(row - margin, 0)
        right, bottom = min(column + width + margin, self.width_px), min(row + height + margin, self.height_px)
        image, mask = super().read(left, top, right - left, bottom - top)
        self._collar.remove(image, mask, left, top)
        inner = slice(row - top, row - top + height), slice(column - left, column - left + width)
        return np.ascontiguousarray(image[inner]), np.ascontiguousarray(mask[inner])


def raster_opener(path: Path, cache: Path, bar: Bar) -> Opener:
    """Opener of a raster. Raises MapError: not an image, or not georeferenced."""
    path, cache = path.absolute(), cache.absolute()  # a worker may have another working directory
    with ImagerySource(path) as source:
        if source.has_mask:
            return partial(ImagerySource, path)
        stat = path.stat()
        key = hashlib.sha256(f"{path.resolve()}|{stat.st_size}|{stat.st_mtime_ns}".encode()).hexdigest()[:16]
        cached = cache / f"collar-{key}.tif"
        if cached.is_file():
            return partial(Collared, path, cached)
        cache.mkdir(parents=True, exist_ok=True)
        part = cache / f".{cached.name}.part.tif"
        try:
            collar = find_collar(source, part, bar)
            if collar is None:
                return partial(ImagerySource, path)
            collar.close()
            part.replace(cached)
        finally:
            part.unlink(missing_ok=True)
    return partial(Collared, path, cached)
