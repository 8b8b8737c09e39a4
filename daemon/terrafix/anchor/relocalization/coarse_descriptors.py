"""Coarse descriptors of the map's ground for the search.

They are read from the package if it stores them. Otherwise they are computed from its imagery on first use, in flight,
which takes seconds for 100 km2.
"""

import math

import numpy as np

from terrafix.anchor.matching.descriptor_cache import Describer, MapFeatures, MapWindows
from terrafix.map.descriptor_table import StoredDescriptors
from terrafix.map.package import LocalMap

# largest distance in octaves between the wanted scale and a stored one; beyond it descriptors are computed [tuned]
MAX_OCTAVES = 0.6


class CoarseDescriptors:
    """Same interface as ``MapFeatures``, for pixel sizes from ``gsd_m(wanted)`` only."""

    def __init__(self, source: MapWindows, describer: Describer) -> None:
        self._computed = MapFeatures(source, describer)
        self._stored = source.descriptors(describer.name) if isinstance(source, LocalMap) else None

    def gsd_m(self, wanted_m: float) -> float:
        """The stored scale nearest to the wanted one; the wanted one if none is near enough."""
        return _nearest(self._stored, wanted_m) or wanted_m

    def window(
        self, e_min_m: float, n_max_m: float, width: int, height: int, gsd_m: float
    ) -> tuple[np.ndarray, np.ndarray, float, float]:
        """As ``MapFeatures.window``."""
        if self._stored is not None and gsd_m in self._stored.gsds_m:
            return self._stored.window(e_min_m, n_max_m, width, height, gsd_m)
        return self._computed.window(e_min_m, n_max_m, width, height, gsd_m)


def has_stored_scale(source: LocalMap, name: str, wanted_m: float) -> bool:
    """Whether the package stores descriptors near this scale."""
    return _nearest(source.descriptors(name), wanted_m) is not None


def _nearest(stored: StoredDescriptors | None, wanted_m: float) -> float | None:
    scales_m = stored.gsds_m if stored else ()
    nearest_m = min(scales_m, key=lambda gsd_m: abs(math.log2(gsd_m / wanted_m)), default=math.inf)
    return nearest_m if abs(math.log2(nearest_m / wanted_m)) <= MAX_OCTAVES else None
