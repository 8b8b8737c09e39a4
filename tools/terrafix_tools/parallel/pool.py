"""Renders the pieces of a table in this process, in several, or on a cluster, and returns them in order."""

import contextlib
import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import forkserver, resource_tracker
from types import TracebackType
from typing import Any, Generic, Protocol, TypeVar

from terrafix.core.errors import TerrafixError

CHUNKS_PER_WORKER = 8  # imagery chunks of 0.1 s; a process needs a second to start, fewer chunks do not compensate it
MAX_PENDING_PER_WORKER = (
    3  # pieces in progress or waiting per worker; limits the memory of pieces that are finished out of order
)
MAX_DEFAULT_WORKERS = 8  # of the default; each needs 150 to 300 MB

Piece = TypeVar("Piece")
RenderedPiece = TypeVar("RenderedPiece", covariant=True)
Wanted = TypeVar("Wanted")
PieceRequest = TypeVar("PieceRequest", contravariant=True)


@dataclass(frozen=True)
class Workload:
    """A kind of work: what its workers need, and which errors its failures raise. Picklable."""

    name: str  # of the client at a Dask scheduler
    module: str  # that the fork server imports once for all workers
    # Context in which pieces are rendered, by the number of worker processes on this computer.
    environment: Callable[[int], contextlib.AbstractContextManager[None]]
    built_with: Callable[[], str]  # versions that determine the result; those of other computers must be equal
    error: type[TerrafixError]  # of a renderer, and of a cluster that fails
    died: type[TerrafixError]  # of a worker that ends while it renders
    again: str  # what the user does after a failure


class Renderer(Protocol[PieceRequest, RenderedPiece]):
    """Renders one piece of a table: the tiles under one imagery tile, an elevation tile, descriptors of a block."""

    def render(self, wanted: PieceRequest) -> RenderedPiece: ...


class Pending(Protocol[RenderedPiece]):
    """A piece that is being rendered."""

    def result(self) -> RenderedPiece: ...


class RenderPool(Protocol[PieceRequest, RenderedPiece]):
    """A pool that renders pieces of one table. Pieces may be requested in any order; the result is the same."""

    def submit(self, wanted: PieceRequest) -> Pending[RenderedPiece]: ...

    def count(self) -> int:
        """Number of pieces that are rendered in parallel."""
        ...


OpenRenderer = Callable[[], Renderer[Wanted, Piece]]


class PoolProvider(Protocol):
    """Processes of this computer, or other computers (`cluster.py`), that provide pools."""

    def is_worthwhile(self, pieces: int, per_worker: int) -> bool:
        """True when this number of pieces is faster here than in the calling process."""
        ...

    def prepare(self, pieces: int, per_worker: int) -> None:
        """Announces a number of pieces: starts what takes time to start, if it is worthwhile."""
        ...

    def open_pool(
        self, open_renderer: OpenRenderer[Wanted, Piece]
    ) -> contextlib.AbstractContextManager[RenderPool[Wanted, Piece]]: ...


def default_workers() -> int:
    """One per core that this process may use, at most MAX_DEFAULT_WORKERS."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, MAX_DEFAULT_WORKERS)


def render_pieces(
    open_renderer: OpenRenderer[Wanted, Piece],
    wanted: Iterable[Wanted],
    pieces: int,
    crew: PoolProvider,
    *,
    per_worker: int = CHUNKS_PER_WORKER,
) -> Generator[Piece, None, None]:
    """Renders all ``wanted`` pieces, ``pieces`` in number, and yields them in that order. ``open_renderer`` and the
    wanted pieces must be picklable.

    ``per_worker``: no processes are started for fewer pieces per process.
    Raises what a renderer raises, and ``died`` of the workload when a worker process dies."""
    if not crew.is_worthwhile(pieces, per_worker):
        yield from map(open_renderer().render, wanted)
        return
    with crew.open_pool(open_renderer) as pool:
        waiting: deque[Pending[Piece]] = deque()
        for one in wanted:
            waiting.append(pool.submit(one))
            if len(waiting) >= MAX_PENDING_PER_WORKER * pool.count():
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


class Processes:
    """Up to ``most`` processes of this computer, started when needed and reused for every table of a package; for less
    work than ``least`` processes have, none. A context manager."""

    def __init__(self, most: int, workload: Workload, *, least: int = 2) -> None:
        self._most, self._least = most, least
        self._workload = workload
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

    def is_worthwhile(self, pieces: int, per_worker: int) -> bool:
        """Implements ``PoolProvider.is_worthwhile``; the first True fixes the number of processes."""
        if self._pool is not None:
            return pieces >= self._least
        self._count = min(self._most, pieces // per_worker)
        return self._count >= self._least

    def prepare(self, pieces: int, per_worker: int) -> None:
        """Implements ``PoolProvider.prepare``: the fork server imports its modules in the meantime."""
        if self.is_worthwhile(pieces, per_worker):
            multiprocessing.set_forkserver_preload(self._preloaded())
            with _block_interrupt():
                forkserver.ensure_running()

    @contextlib.contextmanager
    def open_pool(self, open_renderer: OpenRenderer[Wanted, Piece]) -> Iterator[RenderPool[Wanted, Piece]]:
        """Implements ``PoolProvider.open_pool``."""
        if self._pool is None:
            # Not forked from this process, because GDAL's and OpenCV's threads do not survive a fork. The fork server
            # has only imported modules, which saves half a second per process.
            multiprocessing.set_forkserver_preload(self._preloaded())
            context = multiprocessing.get_context("forkserver")
            initial = (self._workload.environment, self._count)
            self._pool = ProcessPoolExecutor(self._count, context, _start_worker, initial)
        self._tables += 1
        try:
            yield _ProcessPool(self._pool, self._count, self._tables, open_renderer)
        except BrokenProcessPool:
            raise self._workload.died(
                f"a worker process died, perhaps for want of memory; {self._workload.again} with fewer --workers"
            ) from None

    def _preloaded(self) -> list[str]:
        return ["__main__", self._workload.module]


class _ProcessPool(Generic[Wanted, Piece]):
    def __init__(
        self, pool: ProcessPoolExecutor, count: int, table: int, open_renderer: OpenRenderer[Wanted, Piece]
    ) -> None:
        self._pool, self._count = pool, count
        self._table, self._open_renderer = table, open_renderer

    def submit(self, wanted: Wanted) -> Pending[Piece]:
        with _block_interrupt():
            return self._pool.submit(_render, self._table, self._open_renderer, wanted)

    def count(self) -> int:
        return self._count


@contextlib.contextmanager
def _block_interrupt() -> Iterator[None]:
    """Blocks SIGINT while processes start: Ctrl-C reaches all processes, and the parent ends the others. Processes that
    are started in this context ignore it, even during imports; in the parent it is pending until the end."""
    resource_tracker.ensure_running()  # otherwise it is started inside and unblocks the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Worker:
    """State of a worker process between pieces: the renderer of the most recent table, and what it works in."""

    environment: contextlib.AbstractContextManager[None] | None = None
    table = 0
    renderer: Renderer[Any, Any] | None = None


def _start_worker(environment: Callable[[int], contextlib.AbstractContextManager[None]], count: int) -> None:
    _Worker.environment = environment(count)
    _Worker.environment.__enter__()


def _render(table: int, open_renderer: OpenRenderer[Any, Any], wanted: Any) -> Any:
    if _Worker.renderer is None or _Worker.table != table:
        _Worker.renderer = None  # closes its file before the next one is opened
        _Worker.renderer, _Worker.table = open_renderer(), table
    return _Worker.renderer.render(wanted)
