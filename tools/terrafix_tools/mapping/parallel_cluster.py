"""Renders the pieces of a table on a Dask cluster: any number of computers that see the same files.

A worker that dies costs only its own pieces: the scheduler gives them to another one. The bytes are those of a build
on one computer, because a worker with other versions of what reads and encodes is refused."""

import contextlib
import logging
import platform
import re
import socket
import threading
import time
import uuid
from collections.abc import Iterator
from typing import Any, Generic

import cv2
import rasterio
from distributed import CancelledError, Client, Future, KilledWorker
from distributed.comm.core import CommClosedError

from terrafix.core.errors import MapError, UsageError
from terrafix_tools.mapping.parallel import GDAL_CACHE_MB, Hands, OpenRenderer, Pending, Piece, Renderer, Wanted
from terrafix_tools.mapping.pyramid import BUILT_WITH

CONNECT_S = 10.0  # a scheduler that is there answers in less
WORKERS_S = 60.0  # without any worker for so long: nobody will come
GREETING_BYTES = 1 << 20  # more than any greeting has
LOOK_S = 2.0  # between two looks whether there are workers
ADDRESS = re.compile(r"tcp://([^/:\s]+|\[[0-9a-fA-F:.]+\]):(\d+)")


class DaskCluster:
    """A connection to the scheduler at ``address`` (tcp://host:port). A context manager."""

    def __init__(self, address: str) -> None:
        """Raises UsageError: nobody answers there."""
        self._address = address
        place = ADDRESS.fullmatch(address)
        if not place:
            raise UsageError(
                f"--scheduler {address}: is no address; write it tcp://host:port, as 'dask scheduler' says it"
            )
        for name in ("", ".client", ".core", ".comm", ".utils"):  # what matters is said below, in one line
            logging.getLogger(f"distributed{name}").setLevel(logging.CRITICAL)
        try:
            _greet(place[1].strip("[]"), int(place[2]))
            self._client = Client(address, timeout=CONNECT_S, set_as_default=False, name="terrafix-map-build")
        except (OSError, OverflowError) as error:
            raise UsageError(
                f"--scheduler {address}: no Dask scheduler answers there ({error}); "
                "start one with 'dask scheduler', and workers with 'dask worker'"
            ) from None

    def __enter__(self) -> "DaskCluster":
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()

    def worth(self, pieces: int, per_worker: int) -> bool:
        """As ``parallel.Crew.worth``: what is small is not worth that other computers must have its file."""
        return pieces >= per_worker

    def get_ready(self, pieces: int, per_worker: int) -> None:
        """As ``parallel.Crew.get_ready``."""

    @contextlib.contextmanager
    def hands(self, open_renderer: OpenRenderer[Wanted, Piece]) -> Iterator[Hands[Wanted, Piece]]:
        """As ``parallel.Crew.hands``. Raises MapError: workers that die or are unfit, or the scheduler is lost."""
        table = uuid.uuid4().hex
        try:
            yield _Remote(self._client, self._address, table, open_renderer)
            self._client.run(_forget, table, on_error="ignore")
        except KilledWorker:
            raise MapError(
                f"{self._address}: workers died again and again at one piece, perhaps for want of memory; "
                "give each more of it, or one thread"
            ) from None
        except (CancelledError, CommClosedError):
            raise MapError(f"{self._address}: the scheduler was lost; start it and build again") from None
        except ImportError as error:
            raise MapError(
                f"{self._address}: a worker cannot run Terrafix ({error}); install the same version, with the extras "
                "'ground' and 'cluster', on every computer"
            ) from None


class _Remote(Generic[Wanted, Piece]):
    """Has the contract of ``parallel.Hands``."""

    def __init__(self, client: Client, address: str, table: str, open_renderer: OpenRenderer[Wanted, Piece]) -> None:
        self._client, self._address, self._table = client, address, table
        self._submitted = 0
        # A task, not scattered data: these are lost with the worker that holds them.
        self._open_renderer = client.submit(_same, open_renderer, key=f"terrafix-{table}")

    def submit(self, wanted: Wanted) -> Pending[Piece]:
        self._submitted += 1
        key = f"terrafix-{self._table}-{self._submitted}"
        task = self._client.submit(_render, self._table, self._open_renderer, wanted, _built_with(), key=key)
        return _Task(task, self)

    def count(self) -> int:
        return sum(self._client.nthreads().values())

    def wait_for_workers(self) -> None:
        """Raises MapError when there is none for a long time."""
        began_s = time.monotonic()
        while not self.count():
            if time.monotonic() - began_s > WORKERS_S:
                raise MapError(f"{self._address}: the scheduler has no workers; start some with 'dask worker'")
            time.sleep(LOOK_S)


class _Task(Generic[Piece]):
    def __init__(self, future: "Future[Piece]", remote: _Remote[Any, Piece]) -> None:
        self._future, self._remote = future, remote

    def result(self) -> Piece:
        while True:
            with contextlib.suppress(TimeoutError):
                return self._future.result(timeout=LOOK_S)
            self._remote.wait_for_workers()


def _greet(host: str, port: int) -> None:
    """Is it Dask that answers? A client that finds something else waits long and fails in many ways.

    Whoever listens in Dask speaks first: the length of what follows, little endian (distributed/comm/tcp.py).
    Raises OSError, OverflowError (a port that is none)."""
    with socket.create_connection((host, port), timeout=CONNECT_S) as peer:
        said = peer.recv(8)
    if len(said) < 8 or int.from_bytes(said, "little") > GREETING_BYTES:
        raise OSError("what answers is no Dask")


def _built_with() -> str:
    return f"{BUILT_WITH}, {platform.machine()}"


# What follows runs on the workers. GDAL's datasets belong to one thread; a worker may have several.
_renderers: dict[int, tuple[str, Renderer[Any, Any]]] = {}  # by thread: table, renderer


def _same(open_renderer: OpenRenderer[Wanted, Piece]) -> OpenRenderer[Wanted, Piece]:
    return open_renderer


def _render(table: str, open_renderer: OpenRenderer[Any, Any], wanted: Any, built_with: str) -> Any:
    thread = threading.get_ident()
    try:
        if _renderers.get(thread, ("",))[0] != table:
            if built_with != _built_with():
                raise MapError(f"has {_built_with()}, the computer that builds has {built_with}; make them the same")
            cv2.setNumThreads(1)  # the worker's threads share the cores already
            with rasterio.Env(GDAL_CACHEMAX=GDAL_CACHE_MB):
                _renderers[thread] = table, open_renderer()
        return _renderers[thread][1].render(wanted)
    except MapError as error:
        raise MapError(f"worker on {platform.node()}: {error}; workers need the same files at the same paths") from None


def _forget(table: str) -> None:
    """Closes what was opened for a table; after a failure that waits until the thread opens another one."""
    for thread, (kept, _) in list(_renderers.items()):
        if kept == table:
            del _renderers[thread]
