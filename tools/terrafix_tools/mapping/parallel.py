"""Renders the pieces of a table, in this process, in several, or on a cluster, and gives them back in order."""

import contextlib
import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Generic, Protocol, TypeVar

import cv2
import rasterio

from terrafix.core.errors import MapError
from terrafix_tools.mapping.pyramid import Place

CHUNKS_PER_WORKER = 4  # of imagery; a process needs about two seconds to start: fewer are not worth one
AHEAD = 3  # pieces in work or waiting, for each worker: what is finished too early stays in memory
GDAL_CACHE_MB = 256  # two rows of chunks of an image 20 000 px wide; GDAL's own choice is 5 % of the memory
GDAL_CACHES_MB = 1024  # of all workers together
MOST_WORKERS = 8  # chosen without being asked: each takes 150 to 300 MB

Piece = TypeVar("Piece")
Made = TypeVar("Made", covariant=True)


class Renderer(Protocol[Made]):
    """Makes one piece of a table: the tiles under one tile of imagery, or a tile of elevation."""

    def render(self, place: Place) -> Made: ...


class Pending(Protocol[Made]):
    """A piece that is being rendered."""

    def result(self) -> Made: ...


class Hands(Protocol[Made]):
    """Whoever renders pieces of one table. Any piece may be asked for in any order; each comes out the same."""

    def submit(self, place: Place) -> Pending[Made]: ...

    def count(self) -> int:
        """Pieces that are rendered at the same time."""
        ...


OpenRenderer = Callable[[], Renderer[Piece]]


class Cluster(Protocol):
    """Other computers that lend their hands (`parallel_cluster.py`)."""

    def hands(self, open_renderer: OpenRenderer[Piece]) -> contextlib.AbstractContextManager[Hands[Piece]]: ...


def usual_workers() -> int:
    """One for each core that this process may use."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, MOST_WORKERS)


def render_pieces(
    open_renderer: OpenRenderer[Piece],
    places: list[Place],
    workers: int,
    cluster: Cluster | None = None,
    *,
    per_worker: int = CHUNKS_PER_WORKER,
) -> Generator[Piece, None, None]:
    """Pieces of all places, in their order, whoever renders them. ``open_renderer`` must be picklable.

    ``per_worker``: with fewer pieces for each of them, fewer processes are started.
    Raises what a renderer raises, and MapError when a worker process dies."""
    workers = min(workers, len(places) // per_worker)
    if cluster is None and workers <= 1:
        yield from map(open_renderer().render, places)
        return
    with cluster.hands(open_renderer) if cluster else _processes(open_renderer, workers) as hands:
        waiting: deque[Pending[Piece]] = deque()
        for place in places:
            waiting.append(hands.submit(place))
            if len(waiting) >= AHEAD * hands.count():
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


@contextlib.contextmanager
def _processes(open_renderer: OpenRenderer[Piece], workers: int) -> Iterator[Hands[Piece]]:
    # Spawned, not forked: GDAL's and OpenCV's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    cache_mb = max(32, min(GDAL_CACHE_MB, GDAL_CACHES_MB // workers))
    pool = ProcessPoolExecutor(workers, context, _start_worker, (open_renderer, cache_mb))
    try:
        hands: _Processes[Piece] = _Processes(pool, workers)
        yield hands
    except BrokenProcessPool:
        raise MapError("a worker process died, perhaps for want of memory; build again with fewer --workers") from None
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


class _Processes(Generic[Piece]):
    def __init__(self, pool: ProcessPoolExecutor, workers: int) -> None:
        self._pool, self._workers = pool, workers

    def submit(self, place: Place) -> Pending[Piece]:
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
    """What a worker process keeps between pieces."""

    open_renderer: OpenRenderer[Any] | None = None
    renderer: Renderer[Any] | None = None


def _start_worker(open_renderer: OpenRenderer[Any], cache_mb: int) -> None:
    cv2.setNumThreads(1)  # one process for each core: threads would fight
    rasterio.Env(GDAL_CACHEMAX=cache_mb).__enter__()
    _Worker.open_renderer = open_renderer


def _render(place: Place) -> Any:
    if _Worker.renderer is None:  # not in _start_worker: what is raised there is lost
        assert _Worker.open_renderer is not None
        _Worker.renderer = _Worker.open_renderer()
    return _Worker.renderer.render(place)
