"""A place index: which discs of the map look like this one?"""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from terrafix.anchor.place_index.exact import ExactSearch
from terrafix.anchor.place_index.faiss_ivf import FaissSearch
from terrafix.anchor.place_index.format import (
    DEGREES,
    FAISS,
    POSITIONS,
    VECTORS,
    Header,
    IndexedLayer,
    map_array,
    read_header,
)
from terrafix.core.config import PlaceSearch
from terrafix.core.errors import MapError

# Vectors up to which every one is compared; beyond it FAISS searches: 100 km2 for flights at 120 m. The exact search is
# as fast below and needs no other library. [measured: docs/search.md]
MAX_EXACT = 200_000


class Backend(Protocol):
    """A search strategy."""

    name: str

    def search(self, queries: np.ndarray, count: int, allowed: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """``queries`` (Q, D) float32 unit vectors; ``allowed`` (N,) bool: the vectors that are searched, None: all.

        -> scalar products (Q, count), best first, and ids (Q, count); -inf and -1 where there are fewer."""


@dataclass(frozen=True)
class SimilarDisc:
    """``id``: number of the vector; ``query``: number of the query that it resembles most; ``score``: scalar
    product."""

    id: int
    query: int
    score: float


class PlaceIndex:
    def __init__(self, header: Header, backend: Backend, positions: np.ndarray) -> None:
        """``positions`` (N, 2) int32, as in the file."""
        self.header = header
        self.backend = backend
        self._positions = positions

    @classmethod
    def open(cls, folder: Path, search: PlaceSearch = "auto", *, verify: bool = True) -> "PlaceIndex":
        """``search``: "exact", "faiss", or "auto" by the number of vectors. ``verify``: the checksum of all files is
        compared. Raises MapError; UsageError: FAISS is needed and not installed."""
        header = read_header(folder, verify=verify)
        count = header.count
        if search == "auto":
            search = "exact" if count <= MAX_EXACT else "faiss"
        backend: Backend
        if search == "exact":
            backend = ExactSearch(map_array(folder / VECTORS, (count, header.size), np.float16))
        elif FAISS in header.files:
            backend = FaissSearch(folder / FAISS, count)
        else:
            raise MapError(f"{folder}: has no {FAISS}; make it: terrafix map index --faiss")
        return cls(header, backend, map_array(folder / POSITIONS, (count, 2), np.int32))

    def layer(self, checksum: str, table: str) -> IndexedLayer | None:
        """The indexed layer of a package with this checksum; None: it is not in the index."""
        return next((one for one in self.header.layers if (one.checksum, one.table) == (checksum, table)), None)

    def within(self, layer: IndexedLayer) -> np.ndarray | None:
        """The vectors (N,) bool of a layer; None: all are."""
        if layer.count == self.header.count:
            return None
        ids = np.arange(self.header.count)
        return np.asarray((ids >= layer.first) & (ids < layer.first + layer.count))

    def near(self, lat_deg: float, lon_deg: float, radius_deg: tuple[float, float]) -> np.ndarray:
        """The vectors (N,) bool in a box around a position. ``radius_deg``: half of its sides, latitude and
        longitude. For a position prior."""
        offset = self._positions * DEGREES - (lat_deg, lon_deg)
        offset[:, 1] = (offset[:, 1] + 180.0) % 360.0 - 180.0
        return np.asarray((np.abs(offset) <= radius_deg).all(axis=1))

    def position_deg(self, disc: int) -> tuple[float, float]:
        """Latitude and longitude of the centre of a disc."""
        lat, lon = self._positions[disc] * DEGREES
        return float(lat), float(lon)

    def layer_of(self, disc: int) -> IndexedLayer:
        return next(one for one in self.header.layers if one.first <= disc < one.first + one.count)

    def find(self, queries: np.ndarray, count: int, allowed: np.ndarray | None = None) -> list[SimilarDisc]:
        """The discs that resemble any of the queries (Q, D), at most ``count`` of each; best first, each once."""
        scores, ids = self.backend.search(queries, count, allowed)
        best: dict[int, SimilarDisc] = {}
        for query, (row, found) in enumerate(zip(scores, ids, strict=True)):
            for score, disc in zip(row, found, strict=True):
                if disc >= 0 and (int(disc) not in best or best[int(disc)].score < score):
                    best[int(disc)] = SimilarDisc(int(disc), query, float(score))
        return sorted(best.values(), key=lambda one: (-one.score, one.id))
