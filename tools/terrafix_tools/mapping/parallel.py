"""Renders the chunks of a layer, in this process or in several, and gives them back in order."""

import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool

import cv2
import rasterio

from terrafix.core.errors import MapError
from terrafix_tools.mapping.pyramid import Chunk, ChunkRenderer, Place

CHUNKS_PER_WORKER = 4  # a process needs about two seconds to start: fewer chunks than this are not worth one
AHEAD = 3  # chunks in work or waiting, for each worker: what is finished too early stays in memory
GDAL_CACHE_MB = 256  # two rows of chunks of an image 20 000 px wide; GDAL's own choice is 5 % of the memory
GDAL_CACHES_MB = 1024  # of all workers together

OpenRenderer = Callable[[], ChunkRenderer]


def available_cpus() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def render_chunks(open_renderer: OpenRenderer, places: list[Place], workers: int) -> Iterator[Chunk]:
    """Chunks of all places, in their order, whatever the number of workers. ``open_renderer`` must be picklable.

    Raises what a renderer raises, and MapError when a worker process dies."""
    workers = min(workers, len(places) // CHUNKS_PER_WORKER)
    if workers <= 1:
        yield from map(open_renderer().render, places)
        return
    # Spawned, not forked: GDAL's and OpenCV's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    cache_mb = max(32, min(GDAL_CACHE_MB, GDAL_CACHES_MB // workers))
    pool = ProcessPoolExecutor(workers, context, _start_worker, (open_renderer, cache_mb))
    waiting: deque[Future[Chunk]] = deque()
    try:
        for place in places:
            waiting.append(pool.submit(_render, place))
            if len(waiting) >= AHEAD * workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    except BrokenProcessPool:
        raise MapError("a worker process died, perhaps for want of memory; build again with fewer --workers") from None
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


class _Worker:
    """What a worker process keeps between chunks."""

    open_renderer: OpenRenderer | None = None
    renderer: ChunkRenderer | None = None


def _start_worker(open_renderer: OpenRenderer, cache_mb: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the parent ends the others
    cv2.setNumThreads(1)  # one process for each core: threads would fight
    rasterio.Env(GDAL_CACHEMAX=cache_mb).__enter__()
    _Worker.open_renderer = open_renderer


def _render(place: Place) -> Chunk:
    if _Worker.renderer is None:  # not in _start_worker: what is raised there is lost
        assert _Worker.open_renderer is not None
        _Worker.renderer = _Worker.open_renderer()
    return _Worker.renderer.render(place)
