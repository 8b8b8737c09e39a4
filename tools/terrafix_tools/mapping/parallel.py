"""Renders the pieces of a table, in this process, in several, or on a cluster, and gives them back in order."""

import contextlib
import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import forkserver, resource_tracker
from types import TracebackType
from typing import Any, Generic, Protocol, TypeVar

import cv2
import rasterio

from terrafix.core.errors import MapError

CHUNKS_PER_WORKER = 4  # of imagery; a process needs about two seconds to start: fewer are not worth one
AHEAD = 3  # pieces in work or waiting, for each worker: what is finished too early stays in memory
GDAL_CACHE_MB = 256  # two rows of chunks of an image 20 000 px wide; GDAL's own choice is 5 % of the memory
GDAL_CACHES_MB = 1024  # of all workers together
PRELOADED = ["__main__", "terrafix_tools.mapping.build"]  # what a process needs, imported once for all of them
MOST_WORKERS = 8  # chosen without being asked: each takes 150 to 300 MB

Piece = TypeVar("Piece")
Made = TypeVar("Made", covariant=True)
Wanted = TypeVar("Wanted")
Asked = TypeVar("Asked", contravariant=True)


class Renderer(Protocol[Asked, Made]):
    """Makes one piece of a table: the tiles under one tile of imagery, a tile of elevation, descriptors of a block."""

    def render(self, wanted: Asked) -> Made: ...


class Pending(Protocol[Made]):
    """A piece that is being rendered."""

    def result(self) -> Made: ...


class Hands(Protocol[Asked, Made]):
    """Whoever renders pieces of one table. Any piece may be asked for in any order; each comes out the same."""

    def submit(self, wanted: Asked) -> Pending[Made]: ...

    def count(self) -> int:
        """Pieces that are rendered at the same time."""
        ...


OpenRenderer = Callable[[], Renderer[Wanted, Piece]]


class Crew(Protocol):
    """Processes of this computer, or other computers (`parallel_cluster.py`), that lend their hands."""

    def worth(self, pieces: int, per_worker: int) -> bool:
        """Whether so many pieces go faster through these hands than in the process that asks."""
        ...

    def get_ready(self, pieces: int, per_worker: int) -> None:
        """So many will be asked for soon: begins what takes time to start, if they are worth it."""
        ...

    def hands(
        self, open_renderer: OpenRenderer[Wanted, Piece]
    ) -> contextlib.AbstractContextManager[Hands[Wanted, Piece]]: ...


def usual_workers() -> int:
    """One for each core that this process may use."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, MOST_WORKERS)


def render_pieces(
    open_renderer: OpenRenderer[Wanted, Piece],
    wanted: Iterable[Wanted],
    pieces: int,
    crew: Crew,
    *,
    per_worker: int = CHUNKS_PER_WORKER,
) -> Generator[Piece, None, None]:
    """All that is wanted, ``pieces`` of them, in that order, whoever renders them. ``open_renderer`` and what is wanted
    must be picklable.

    ``per_worker``: with fewer pieces for each of them, no processes are started.
    Raises what a renderer raises, and MapError when a worker process dies."""
    if not crew.worth(pieces, per_worker):
        yield from map(open_renderer().render, wanted)
        return
    with crew.hands(open_renderer) as hands:
        waiting: deque[Pending[Piece]] = deque()
        for one in wanted:
            waiting.append(hands.submit(one))
            if len(waiting) >= AHEAD * hands.count():
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


class Processes:
    """Up to ``most`` processes of this computer, started when they are first worth it and kept for every table of a
    package. A context manager."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._count = 0
        self._pool: ProcessPoolExecutor | None = None
        self._tables = 0

    def __enter__(self) -> "Processes":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)

    def worth(self, pieces: int, per_worker: int) -> bool:
        """As ``Crew.worth``; decides how many processes there are when it says yes for the first time."""
        if self._pool is not None:
            return pieces > 1
        self._count = min(self._most, pieces // per_worker)
        return self._count > 1

    def get_ready(self, pieces: int, per_worker: int) -> None:
        """As ``Crew.get_ready``: the server that processes are forked from imports meanwhile."""
        if self.worth(pieces, per_worker):
            multiprocessing.set_forkserver_preload(PRELOADED)
            with _no_interrupt():
                forkserver.ensure_running()

    @contextlib.contextmanager
    def hands(self, open_renderer: OpenRenderer[Wanted, Piece]) -> Iterator[Hands[Wanted, Piece]]:
        """As ``Crew.hands``."""
        if self._pool is None:
            cache_mb = max(32, min(GDAL_CACHE_MB, GDAL_CACHES_MB // self._count))
            # Not forked from here: GDAL's and OpenCV's threads do not survive it. The server has only imported, which
            # would cost each process half a second.
            multiprocessing.set_forkserver_preload(PRELOADED)
            context = multiprocessing.get_context("forkserver")
            self._pool = ProcessPoolExecutor(self._count, context, _start_worker, (cache_mb,))
        self._tables += 1
        try:
            yield _Hands(self._pool, self._count, self._tables, open_renderer)
        except BrokenProcessPool:
            raise MapError(
                "a worker process died, perhaps for want of memory; build again with fewer --workers"
            ) from None


class _Hands(Generic[Wanted, Piece]):
    def __init__(
        self, pool: ProcessPoolExecutor, count: int, table: int, open_renderer: OpenRenderer[Wanted, Piece]
    ) -> None:
        self._pool, self._count = pool, count
        self._table, self._open_renderer = table, open_renderer

    def submit(self, wanted: Wanted) -> Pending[Piece]:
        with _no_interrupt():
            return self._pool.submit(_render, self._table, self._open_renderer, wanted)

    def count(self) -> int:
        return self._count


@contextlib.contextmanager
def _no_interrupt() -> Iterator[None]:
    """Ctrl-C reaches all processes, and the parent ends the others: one that is started within never sees it, not even
    while it imports. In the parent it waits for the end."""
    resource_tracker.ensure_running()  # else it is started within, and that lets interrupts through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Worker:
    """What a worker process keeps between pieces: the renderer of the table that it worked on last."""

    table = 0
    renderer: Renderer[Any, Any] | None = None


def _start_worker(cache_mb: int) -> None:
    cv2.setNumThreads(1)  # one process for each core: threads would fight
    rasterio.Env(GDAL_CACHEMAX=cache_mb).__enter__()


def _render(table: int, open_renderer: OpenRenderer[Any, Any], wanted: Any) -> Any:
    if _Worker.renderer is None or _Worker.table != table:
        _Worker.renderer = None  # its file is closed before the next one is opened
        _Worker.renderer, _Worker.table = open_renderer(), table
    return _Worker.renderer.render(wanted)
