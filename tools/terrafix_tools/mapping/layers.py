"""What goes into a map package: imagery layers, elevation and vectors, each with where it came from."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

import numpy as np
from pyproj import CRS

from terrafix.map.format import DemGrid

Bounds = tuple[float, float, float, float]  # x_min, y_min, x_max, y_max in the CRS
Feature = tuple[
    str, bytes, Mapping[str, str]
]  # table (roads, water, buildings), 2D WKB in WGS84 (lon, lat), attributes


class Imagery(Protocol):
    """North-up pixels in one projected CRS: pixel (r, c) covers [x_min + c pixel_x, y_max - r pixel_y).

    A context manager. ``ImagerySource`` is one; a mosaic of several sources is another."""

    @property
    def crs(self) -> CRS: ...
    @property
    def width_px(self) -> int: ...
    @property
    def height_px(self) -> int: ...
    @property
    def pixel_x(self) -> float: ...
    @property
    def pixel_y(self) -> float: ...
    @property
    def x_min(self) -> float: ...
    @property
    def y_max(self) -> float: ...
    @property
    def bounds(self) -> Bounds: ...
    @property
    def gsd_m(self) -> float:
        """Ground metres per pixel at the centre."""
        ...

    @property
    def has_mask(self) -> bool:
        """False: the source says nothing about validity, and a black or white collar is looked for."""
        ...

    def read(self, column: int, row: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
        """(height, width, 3) uint8 BGR and (height, width) uint8 mask of 0 and 255, of a window inside the image."""
        ...

    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class Elevation(Protocol):
    """Metres AMSL on a square north-up grid in the CRS that it was opened for. A context manager."""

    @property
    def grid(self) -> DemGrid: ...

    def read_tile(self, column: int, row: int) -> np.ndarray:
        """(256, 256) float32, NaN = void; tiles count from the grid's corner, beyond the grid is void."""
        ...

    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


@dataclass(frozen=True)
class LayerInput:
    """One layer of imagery. ``open`` must be picklable (a function or a ``functools.partial`` of a class): every
    worker process opens the imagery for itself."""

    open: Callable[[], Imagery]
    source: str  # file name, or what a person would call it
    source_sha256: str = ""  # of the file; empty: not one file
    where: str = ""  # its path, for messages; empty: ``source``
    date: str = ""  # YYYY-MM-DD; empty = unknown
    licence: str = ""
    ce90_m: float | None = None  # radius that holds 90 % of the errors of position, as the producer states it


@dataclass(frozen=True)
class ElevationInput:
    """Elevation; ``open`` gets the CRS and the bounds of the newest imagery layer."""

    open: Callable[[CRS, Bounds], Elevation]
    source: str
    licence: str = ""


@dataclass(frozen=True)
class VectorInput:
    """Features of all tables, in any order; read once."""

    features: Iterable[Feature]
    source: str
    date: str = ""
    licence: str = ""
