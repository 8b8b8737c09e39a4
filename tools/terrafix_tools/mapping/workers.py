"""The workers of `terrafix map build`: their decoding libraries, and the errors of a build."""

import contextlib
from collections.abc import Iterator

import cv2
import rasterio

from terrafix.core.errors import MapError
from terrafix_tools.mapping.package.pyramid import BUILT_WITH
from terrafix_tools.parallel.pool import Workload

GDAL_CACHE_MB = 256  # two rows of chunks of an image 20 000 px wide; GDAL's default is 5 % of the memory
GDAL_CACHES_MB = 1024  # limit over all workers
LEAST_CACHE_MB = 32


@contextlib.contextmanager
def decoding(workers: int) -> Iterator[None]:
    """One thread of OpenCV, because there is one process per core, and this worker's share of GDAL's cache."""
    cv2.setNumThreads(1)
    with rasterio.Env(GDAL_CACHEMAX=max(LEAST_CACHE_MB, min(GDAL_CACHE_MB, GDAL_CACHES_MB // workers))):
        yield


def built_with() -> str:
    return BUILT_WITH


MAP_BUILD = Workload(
    name="terrafix-map-build",
    module="terrafix_tools.mapping.build",
    environment=decoding,
    built_with=built_with,
    error=MapError,
    died=MapError,
    again="build again",
)
