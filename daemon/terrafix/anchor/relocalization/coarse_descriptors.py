"""What the search of an unknown place asks of the map: descriptors of its ground on coarse cells.

They are read from the package where it has them, else computed from its imagery when they are first needed: that takes
seconds for 100 km2, in flight, in the first look."""

import math

import numpy as np

from terrafix.anchor.matching.descriptor_cache import Describer, MapFeatures, MapWindows
from terrafix.map.descriptor_table import StoredDescriptors
from terrafix.map.package import LocalMap

PAD_PX = 8  # context of a tile: gradients and their blur reach six pixels, and a whole map has many rims
OCTAVES = 0.6  # between the scale that is wanted and one that the package has: beyond this it is computed


class TileIndex:
    """Has the contract of ``MapFeatures``, for pixels of ``gsd_m(wanted)`` only."""

    def __init__(self, source: MapWindows, describer: Describer) -> None:
        self._computed = MapFeatures(source, describer, pad_px=PAD_PX)
        self._stored = source.descriptors(describer.name) if isinstance(source, LocalMap) else None

    def gsd_m(self, wanted_m: float) -> float:
        """The scale nearest to the wanted one that costs nothing; the wanted one where there is none."""
        return _nearest(self._stored, wanted_m) or wanted_m

    def window(
        self, e_min_m: float, n_max_m: float, width: int, height: int, gsd_m: float
    ) -> tuple[np.ndarray, np.ndarray, float, float]:
        """As ``MapFeatures.window``."""
        if self._stored is not None and gsd_m in self._stored.gsds_m:
            return self._stored.window(e_min_m, n_max_m, width, height, gsd_m)
        return self._computed.window(e_min_m, n_max_m, width, height, gsd_m)


def is_kept(source: LocalMap, name: str, wanted_m: float) -> bool:
    """Whether the package has descriptors near a scale, so that the search need not compute them."""
    return _nearest(source.descriptors(name), wanted_m) is not None


def _nearest(stored: StoredDescriptors | None, wanted_m: float) -> float | None:
    scales_m = stored.gsds_m if stored else ()
    nearest_m = min(scales_m, key=lambda gsd_m: abs(math.log2(gsd_m / wanted_m)), default=math.inf)
    return nearest_m if abs(math.log2(nearest_m / wanted_m)) <= OCTAVES else None
