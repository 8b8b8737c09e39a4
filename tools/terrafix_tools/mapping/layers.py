"""Inputs of a map package: imagery layers, elevation and vectors, with their origin."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

import numpy as np
from pyproj import CRS

from terrafix.map.format import DemGrid, InputStatement
from terrafix_tools.mapping.area.polygons import Area
from terrafix_tools.mapping.imagery import Bounds, Imagery

Feature = tuple[
    str, bytes, Mapping[str, str]
]  # table (roads, water, buildings), 2D WKB in WGS84 (lon, lat), attributes


class Elevation(Protocol):
    """Metres AMSL on a square north-up grid in the requested CRS. A context manager."""

    @property
    def grid(self) -> DemGrid: ...
    @property
    def statement(self) -> InputStatement:
        """What the file was taken for."""
        ...

    def read_tile(self, column: int, row: int) -> np.ndarray:
        """(256, 256) float32, NaN = void. Tile indices start at the grid's corner; outside the grid is void."""
        ...

    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


@dataclass(frozen=True)
class LayerInput:
    """One imagery layer. ``open`` must be picklable (a function or a ``functools.partial`` of a class), because every
    worker process opens the imagery itself."""

    open: Callable[[], Imagery]
    source: str  # file name or title
    source_sha256: str = ""  # of the file; empty: not a single file
    where: str = ""  # its path, for messages; empty: ``source``
    date: str = ""  # YYYY-MM-DD; empty = unknown
    licence: str = ""
    ce90_m: float | None = None  # stated accuracy: radius that contains 90 % of the position errors


@dataclass(frozen=True)
class ElevationInput:
    """Elevation; ``open`` gets the CRS and the bounds of the newest layer."""

    open: Callable[[CRS, Bounds], Elevation]
    source: str
    licence: str = ""
    statement: InputStatement | None = None  # None: that of the opened elevation


@dataclass(frozen=True)
class VectorInput:
    """Features of all tables in any order; read once. ``drawn_in``: area in which they are also drawn as a layer."""

    features: Iterable[Feature]
    source: str
    date: str = ""
    licence: str = ""
    drawn_in: Area | None = None
    ce90_m: float | None = None  # stated accuracy of the drawn layer
