"""Renders the chunks of a layer, in this process, in several, or on a cluster, and gives them back in order."""

import contextlib
import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Protocol

import cv2
import rasterio

from terrafix.core.errors import MapError
from terrafix_tools.mapping.pyramid import Chunk, ChunkRenderer, Place

CHUNKS_PER_WORKER = 4  # a process needs about two seconds to start: fewer chunks than this are not worth one
AHEAD = 3  # chunks in work or waiting, for each worker: what is finished too early stays in memory
GDAL_CACHE_MB = 256  # two rows of chunks of an image 20 000 px wide; GDAL's own choice is 5 % of the memory
GDAL_CACHES_MB = 1024  # of all workers together
MOST_WORKERS = 8  # chosen without being asked: each takes 150 to 300 MB

OpenRenderer = Callable[[], ChunkRenderer]


class Pending(Protocol):
    """A chunk that is being rendered."""

    def result(self) -> Chunk: ...


class Hands(Protocol):
    """Whoever renders chunks of one layer. Any chunk may be asked for in any order; each comes out the same."""

    def submit(self, place: Place) -> Pending: ...

    def count(self) -> int:
        """Chunks that are rendered at the same time."""
        ...


class Cluster(Protocol):
    """Other computers that lend their hands (`parallel_cluster.py`)."""

    def hands(self, open_renderer: OpenRenderer) -> contextlib.AbstractContextManager[Hands]: ...


def usual_workers() -> int:
    """One for each core that this process may use."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, MOST_WORKERS)


def render_chunks(
    open_renderer: OpenRenderer, places: list[Place], workers: int, cluster: Cluster | None = None
) -> Generator[Chunk, None, None]:
    """Chunks of all places, in their order, whoever renders them. ``open_renderer`` must be picklable.

    Raises what a renderer raises, and MapError when a worker process dies."""
    workers = min(workers, len(places) // CHUNKS_PER_WORKER)
    if cluster is None and workers <= 1:
        yield from map(open_renderer().render, places)
        return
    with cluster.hands(open_renderer) if cluster else _processes(open_renderer, workers) as hands:
        waiting: deque[Pending] = deque()
        for place in places:
            waiting.append(hands.submit(place))
            if len(waiting) >= AHEAD * hands.count():
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


@contextlib.contextmanager
def _processes(open_renderer: OpenRenderer, workers: int) -> Iterator[Hands]:
    # Spawned, not forked: GDAL's and OpenCV's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    cache_mb = max(32, min(GDAL_CACHE_MB, GDAL_CACHES_MB // workers))
    pool = ProcessPoolExecutor(workers, context, _start_worker, (open_renderer, cache_mb))
    try:
        yield _Processes(pool, workers)
    except BrokenProcessPool:
        raise MapError("a worker process died, perhaps for want of memory; build again with fewer --workers") from None
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


class _Processes:
    def __init__(self, pool: ProcessPoolExecutor, workers: int) -> None:
        self._pool, self._workers = pool, workers

    def submit(self, place: Place) -> Pending:
        # Ctrl-C reaches all processes, and the parent ends the others: a process that is started here never sees it,
        # not even while it imports. In the parent it waits for the end of this call.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            return self._pool.submit(_render, place)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def count(self) -> int:
        return self._workers


class _Worker:
    """What a worker process keeps between chunks."""

    open_renderer: OpenRenderer | None = None
    renderer: ChunkRenderer | None = None


def _start_worker(open_renderer: OpenRenderer, cache_mb: int) -> None:
    cv2.setNumThreads(1)  # one process for each core: threads would fight
    rasterio.Env(GDAL_CACHEMAX=cache_mb).__enter__()
    _Worker.open_renderer = open_renderer


def _render(place: Place) -> Chunk:
    if _Worker.renderer is None:  # not in _start_worker: what is raised there is lost
        assert _Worker.open_renderer is not None
        _Worker.renderer = _Worker.open_renderer()
    return _Worker.renderer.render(place)
