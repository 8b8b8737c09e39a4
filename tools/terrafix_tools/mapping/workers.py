"""The workers of `terrafix map build`: their decoding libraries, and the errors of a build."""

import contextlib
from collections.abc import Iterator

import cv2
import rasterio

from terrafix.core.errors import MapError
from terrafix_tools.mapping.package.pyramid import BUILT_WITH
from terrafix_tools.parallel.pool import Workload

MB = 1 << 20  # GDAL takes a small number from its configuration as megabytes, from rasterio every number as bytes
GDAL_CACHE_BYTES = 256 * MB  # two rows of chunks of an image 20 000 px wide; GDAL's default is 5 % of the memory
GDAL_CACHES_BYTES = 1024 * MB  # limit over all workers
LEAST_CACHE_BYTES = 32 * MB


@contextlib.contextmanager
def decoding(workers: int) -> Iterator[None]:
    """One thread of OpenCV, because there is one process per core, and this worker's share of GDAL's cache."""
    cv2.setNumThreads(1)
    with rasterio.Env(GDAL_CACHEMAX=max(LEAST_CACHE_BYTES, min(GDAL_CACHE_BYTES, GDAL_CACHES_BYTES // workers))):
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
