"""Renders the pieces of a table on a Dask cluster: any number of computers with access to the same files.

A worker that dies loses only its own pieces: the scheduler reassigns them. The results are those of one computer,
because workers with other versions of the libraries that matter are rejected."""

import contextlib
import logging
import os
import platform
import re
import socket
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Iterator
from typing import Any, Generic

from distributed import CancelledError, Client, Future, KilledWorker
from distributed.comm.core import CommClosedError

from terrafix.core.errors import UsageError
from terrafix_tools.parallel.pool import OpenRenderer, Pending, Piece, Renderer, RenderPool, Wanted, Workload

CONNECT_S = 10.0  # time-out of the connection to the scheduler
WORKERS_S = 60.0  # time-out without any worker
GREETING_BYTES = 1 << 20  # upper bound of a greeting
POLL_WORKERS_S = 2.0  # polling interval while waiting for workers
ADDRESS = re.compile(r"tcp://([^/:\s]+|\[[0-9a-fA-F:.]+\]):(\d+)")


class DaskCluster:
    """A connection to the scheduler at ``address`` (tcp://host:port). A context manager."""

    def __init__(self, address: str, workload: Workload) -> None:
        """Raises UsageError: no scheduler at the address."""
        self._address, self._workload = address, workload
        for name in ("", ".client", ".core", ".comm", ".utils"):  # errors are reported below in one line
            logging.getLogger(f"distributed{name}").setLevel(logging.CRITICAL)
        check_address(address)
        try:
            self._client = Client(address, timeout=CONNECT_S, set_as_default=False, name=workload.name)
        except OSError as error:
            raise _no_scheduler(address, error) from None

    def __enter__(self) -> "DaskCluster":
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()

    def is_worthwhile(self, pieces: int, per_worker: int) -> bool:
        """Implements ``PoolProvider.is_worthwhile``: small tables do not need their file on other computers."""
        return pieces >= per_worker

    def prepare(self, pieces: int, per_worker: int) -> None:
        """Implements ``PoolProvider.prepare``."""

    def local_address(self) -> str:
        """IP address of this computer, as the workers of the scheduler reach it."""
        place = ADDRESS.fullmatch(self._address)
        assert place is not None
        with socket.create_connection((place[1].strip("[]"), int(place[2])), timeout=CONNECT_S) as peer:
            return str(peer.getsockname()[0])

    def run_program(self, module: str, words: list[str], environment: dict[str, str]) -> "Future[int]":
        """``python -m module words`` on a worker -> its exit code; on another one when the worker dies.

        The result raises ``error`` of the workload: the worker has other versions."""
        key = f"{self._workload.name}-{uuid.uuid4().hex}"
        expected = _built_with(self._workload)
        return self._client.submit(_run_program, module, words, environment, self._workload, expected, key=key)

    @contextlib.contextmanager
    def open_pool(self, open_renderer: OpenRenderer[Wanted, Piece]) -> Iterator[RenderPool[Wanted, Piece]]:
        """Implements ``PoolProvider.open_pool``. Raises ``died`` of the workload when workers die, and its ``error``
        when they are rejected or the scheduler is lost."""
        table = uuid.uuid4().hex
        try:
            yield _Remote(self._client, self._address, table, open_renderer, self._workload)
            self._client.run(_close_renderer, table, on_error="ignore")
        except KilledWorker:
            raise self._workload.died(
                f"{self._address}: workers died again and again at one piece, perhaps for want of memory; "
                "give each more of it, or one thread"
            ) from None
        except (CancelledError, CommClosedError):
            raise self._workload.error(
                f"{self._address}: the scheduler was lost; start it and {self._workload.again}"
            ) from None
        except ImportError as error:
            raise self._workload.error(
                f"{self._address}: a worker cannot run Terrafix ({error}); install the same version, with the extras "
                "'ground' and 'cluster', on every computer"
            ) from None


class _Remote(Generic[Wanted, Piece]):
    """Implements ``RenderPool``."""

    def __init__(
        self,
        client: Client,
        address: str,
        table: str,
        open_renderer: OpenRenderer[Wanted, Piece],
        workload: Workload,
    ) -> None:
        self._client, self._address, self._table, self._workload = client, address, table, workload
        self._submitted = 0
        # A task, not scattered data, which is lost with the worker that holds it.
        self._open_renderer = client.submit(_identity, open_renderer, key=f"terrafix-{table}")

    def submit(self, wanted: Wanted) -> Pending[Piece]:
        self._submitted += 1
        key = f"terrafix-{self._table}-{self._submitted}"
        expected = _built_with(self._workload)
        task = self._client.submit(_render, self._table, self._open_renderer, wanted, self._workload, expected, key=key)
        return _Task(task, self)

    def count(self) -> int:
        return sum(self._client.nthreads().values())

    def wait_for_workers(self) -> None:
        """Raises ``error`` of the workload when there is no worker within the time-out."""
        began_s = time.monotonic()
        while not self.count():
            if time.monotonic() - began_s > WORKERS_S:
                raise self._workload.error(
                    f"{self._address}: the scheduler has no workers; start some with 'dask worker'"
                )
            time.sleep(POLL_WORKERS_S)


class _Task(Generic[Piece]):
    def __init__(self, future: "Future[Piece]", remote: _Remote[Any, Piece]) -> None:
        self._future, self._remote = future, remote

    def result(self) -> Piece:
        while True:
            with contextlib.suppress(TimeoutError):
                return self._future.result(timeout=POLL_WORKERS_S)
            self._remote.wait_for_workers()


def check_address(address: str) -> None:
    """Raises UsageError: no scheduler at the address."""
    place = ADDRESS.fullmatch(address)
    if not place:
        raise UsageError(f"--scheduler {address}: not an address; write tcp://host:port, as 'dask scheduler' prints it")
    try:
        _check_scheduler(place[1].strip("[]"), int(place[2]))
    except (OSError, OverflowError) as error:
        raise _no_scheduler(address, error) from None


def _no_scheduler(address: str, error: Exception) -> UsageError:
    return UsageError(
        f"--scheduler {address}: no Dask scheduler answers there ({error}); "
        "start one with 'dask scheduler', and workers with 'dask worker'"
    )


def _check_scheduler(host: str, port: int) -> None:
    """Checks that a Dask scheduler listens there, because Dask's client waits long and fails in many ways otherwise.

    The listening side of Dask sends first: the length of the message, little endian (distributed/comm/tcp.py).
    Raises OSError, OverflowError (an invalid port)."""
    with socket.create_connection((host, port), timeout=CONNECT_S) as peer:
        greeting = peer.recv(8)
    if len(greeting) < 8 or int.from_bytes(greeting, "little") > GREETING_BYTES:
        raise OSError("the reply is not from Dask")


def _built_with(workload: Workload) -> str:
    return f"{workload.built_with()}, {platform.machine()}"


def _run_program(
    module: str, words: list[str], environment: dict[str, str], workload: Workload, built_with: str
) -> int:
    """Runs on a worker. The program ends with the thread that waits for it."""
    here = _built_with(workload)
    if built_with != here:
        raise workload.error(f"worker on {platform.node()}: has {here}, and not {built_with}; make them the same")
    command = [sys.executable, "-m", module, *words, "--parent", str(os.getpid())]
    return subprocess.run(command, env={**os.environ, **environment}, stdin=subprocess.DEVNULL, check=False).returncode


# The code below runs on the workers. GDAL's datasets belong to one thread; a worker may have several.
_renderers: dict[int, tuple[str, Renderer[Any, Any]]] = {}  # by thread: table, renderer


def _identity(open_renderer: OpenRenderer[Wanted, Piece]) -> OpenRenderer[Wanted, Piece]:
    return open_renderer


def _render(table: str, open_renderer: OpenRenderer[Any, Any], wanted: Any, workload: Workload, built_with: str) -> Any:
    thread = threading.get_ident()
    try:
        if _renderers.get(thread, ("",))[0] != table:
            here = _built_with(workload)
            if built_with != here:
                raise workload.error(f"has {here}, the computer that builds has {built_with}; make them the same")
            with workload.environment(1):
                _renderers[thread] = table, open_renderer()
        return _renderers[thread][1].render(wanted)
    except workload.error as error:
        raise workload.error(
            f"worker on {platform.node()}: {error}; workers need the same files at the same paths"
        ) from None


def _close_renderer(table: str) -> None:
    """Closes the renderer of a table; after a failure this happens when the thread opens another one."""
    for thread, (kept, _) in list(_renderers.items()):
        if kept == table:
            del _renderers[thread]
