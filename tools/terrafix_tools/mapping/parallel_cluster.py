"""Renders the pieces of a table on a Dask cluster: any number of computers with access to the same files.

A worker that dies loses only its own pieces: the scheduler reassigns them. The bytes are those of a build on one
computer, because workers with other versions of the decoding and encoding libraries are rejected."""

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
from terrafix_tools.mapping.package.pyramid import BUILT_WITH
from terrafix_tools.mapping.parallel import GDAL_CACHE_MB, OpenRenderer, Pending, Piece, Renderer, RenderPool, Wanted

CONNECT_S = 10.0  # time-out of the connection to the scheduler
WORKERS_S = 60.0  # time-out without any worker
GREETING_BYTES = 1 << 20  # upper bound of a greeting
POLL_WORKERS_S = 2.0  # polling interval while waiting for workers
ADDRESS = re.compile(r"tcp://([^/:\s]+|\[[0-9a-fA-F:.]+\]):(\d+)")


class DaskCluster:
    """A connection to the scheduler at ``address`` (tcp://host:port). A context manager."""

    def __init__(self, address: str) -> None:
        """Raises UsageError: no scheduler at the address."""
        self._address = address
        place = ADDRESS.fullmatch(address)
        if not place:
            raise UsageError(
                f"--scheduler {address}: not an address; write tcp://host:port, as 'dask scheduler' prints it"
            )
        for name in ("", ".client", ".core", ".comm", ".utils"):  # errors are reported below in one line
            logging.getLogger(f"distributed{name}").setLevel(logging.CRITICAL)
        try:
            _check_scheduler(place[1].strip("[]"), int(place[2]))
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

    def is_worthwhile(self, pieces: int, per_worker: int) -> bool:
        """Implements ``parallel.Crew.worth``: small tables do not need their file on other computers."""
        return pieces >= per_worker

    def prepare(self, pieces: int, per_worker: int) -> None:
        """Implements ``parallel.Crew.get_ready``."""

    @contextlib.contextmanager
    def open_pool(self, open_renderer: OpenRenderer[Wanted, Piece]) -> Iterator[RenderPool[Wanted, Piece]]:
        """Implements ``parallel.Crew.hands``. MapError: workers die or are rejected, or the scheduler is lost."""
        table = uuid.uuid4().hex
        try:
            yield _Remote(self._client, self._address, table, open_renderer)
            self._client.run(_close_renderer, table, on_error="ignore")
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
    """Implements ``parallel.Hands``."""

    def __init__(self, client: Client, address: str, table: str, open_renderer: OpenRenderer[Wanted, Piece]) -> None:
        self._client, self._address, self._table = client, address, table
        self._submitted = 0
        # A task, not scattered data, which is lost with the worker that holds it.
        self._open_renderer = client.submit(_identity, open_renderer, key=f"terrafix-{table}")

    def submit(self, wanted: Wanted) -> Pending[Piece]:
        self._submitted += 1
        key = f"terrafix-{self._table}-{self._submitted}"
        task = self._client.submit(_render, self._table, self._open_renderer, wanted, _built_with(), key=key)
        return _Task(task, self)

    def count(self) -> int:
        return sum(self._client.nthreads().values())

    def wait_for_workers(self) -> None:
        """Raises MapError when there is no worker within the time-out."""
        began_s = time.monotonic()
        while not self.count():
            if time.monotonic() - began_s > WORKERS_S:
                raise MapError(f"{self._address}: the scheduler has no workers; start some with 'dask worker'")
            time.sleep(POLL_WORKERS_S)


class _Task(Generic[Piece]):
    def __init__(self, future: "Future[Piece]", remote: _Remote[Any, Piece]) -> None:
        self._future, self._remote = future, remote

    def result(self) -> Piece:
        while True:
            with contextlib.suppress(TimeoutError):
                return self._future.result(timeout=POLL_WORKERS_S)
            self._remote.wait_for_workers()


def _check_scheduler(host: str, port: int) -> None:
    """Checks that a Dask scheduler listens there, because Dask's client waits long and fails in many ways otherwise.

    The listening side of Dask sends first: the length of the message, little endian (distributed/comm/tcp.py).
    Raises OSError, OverflowError (an invalid port)."""
    with socket.create_connection((host, port), timeout=CONNECT_S) as peer:
        greeting = peer.recv(8)
    if len(greeting) < 8 or int.from_bytes(greeting, "little") > GREETING_BYTES:
        raise OSError("the reply is not from Dask")


def _built_with() -> str:
    return f"{BUILT_WITH}, {platform.machine()}"


# The code below runs on the workers. GDAL's datasets belong to one thread; a worker may have several.
_renderers: dict[int, tuple[str, Renderer[Any, Any]]] = {}  # by thread: table, renderer


def _identity(open_renderer: OpenRenderer[Wanted, Piece]) -> OpenRenderer[Wanted, Piece]:
    return open_renderer


def _render(table: str, open_renderer: OpenRenderer[Any, Any], wanted: Any, built_with: str) -> Any:
    thread = threading.get_ident()
    try:
        if _renderers.get(thread, ("",))[0] != table:
            if built_with != _built_with():
                raise MapError(f"has {_built_with()}, the computer that builds has {built_with}; make them the same")
            cv2.setNumThreads(1)  # the worker's threads already use all cores
            with rasterio.Env(GDAL_CACHEMAX=GDAL_CACHE_MB):
                _renderers[thread] = table, open_renderer()
        return _renderers[thread][1].render(wanted)
    except MapError as error:
        raise MapError(f"worker on {platform.node()}: {error}; workers need the same files at the same paths") from None


def _close_renderer(table: str) -> None:
    """Closes the renderer of a table; after a failure this happens when the thread opens another one."""
    for thread, (kept, _) in list(_renderers.items()):
        if kept == table:
            del _renderers[thread]
