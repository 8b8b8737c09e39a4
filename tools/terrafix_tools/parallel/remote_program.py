"""A program on a worker of a Dask cluster, and packets to and from it.

The program connects to the computer that asked for it; both prove that they have the secret of this one program, which
only the cluster knows. When the worker dies, the scheduler starts the program on another one, which connects anew."""

import os
import queue
import secrets
import threading
from multiprocessing import AuthenticationError
from multiprocessing.connection import Client, Connection, Listener, wait
from types import TracebackType
from typing import TYPE_CHECKING, Any

from terrafix_tools.parallel.pool import Workload
from terrafix_tools.parallel.scheduler import connect

if TYPE_CHECKING:
    from distributed import Future

SECRET = "TERRAFIX_PROGRAM_SECRET"  # environment variable of the program
SECRET_BYTES = 32
PACKET_BYTES = 64 << 20  # longest packet; the messages of a frame have some 100 kB
POLL_S = 1.0  # between looks at what became of the program


class ProgramEnded(Exception):
    """``code``: exit code of the program; negative: the signal that ended it."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class NewConnection(Exception):
    """The program was started anew, on another worker."""


class RemoteProgram:
    """``python -m module`` on a worker of the cluster at ``address``. A context manager: it ends with it."""

    def __init__(self, address: str, workload: Workload, module: str) -> None:
        """Raises UsageError: no scheduler, or no Dask."""
        self._workload = workload
        self._cluster = connect(address, workload)
        secret = secrets.token_bytes(SECRET_BYTES)
        self._listener = Listener((self._cluster.local_address(), 0), authkey=secret)
        host, port = self._listener.address
        self._accepted: queue.Queue[Connection[Any, Any]] = queue.Queue()
        threading.Thread(target=self._accept, daemon=True).start()
        self._connection: Connection[Any, Any] | None = None
        environment = {SECRET: secret.hex(), "OMP_NUM_THREADS": "1"}
        self._future: Future[int] = self._cluster.run_program(module, ["--to", f"{host}:{port}"], environment)

    def __enter__(self) -> "RemoteProgram":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._connection is not None:
            self._connection.close()
        self._listener.close()
        self._future.cancel()
        self._cluster.__exit__()

    def _accept(self) -> None:
        while True:
            try:
                self._accepted.put(self._listener.accept())
            except (AuthenticationError, EOFError, ConnectionError):
                continue  # somebody else
            except OSError:
                return  # closed

    def wait_for_start(self) -> None:
        """Until it has connected, for the first time or anew. Raises ProgramEnded."""
        while True:
            try:
                self._connection = self._accepted.get(timeout=POLL_S)
                return
            except queue.Empty:
                self._check()

    def receive(self) -> bytes:
        """The next packet. Raises ProgramEnded; NewConnection: after ``wait_for_start`` all begins anew."""
        assert self._connection is not None
        while not wait([self._connection], timeout=POLL_S):
            if not self._accepted.empty():
                raise NewConnection
            self._check()
        try:
            return self._connection.recv_bytes(PACKET_BYTES)
        except (EOFError, OSError):
            raise NewConnection from None

    def send(self, packet: bytes) -> None:
        """Raises NewConnection."""
        assert self._connection is not None
        try:
            self._connection.send_bytes(packet)
        except OSError:
            raise NewConnection from None

    def _check(self) -> None:
        """Raises ProgramEnded, ``error`` of the workload."""
        if self._future.status in ("pending", "lost"):
            return
        if self._future.status == "finished":
            raise ProgramEnded(self._future.result())
        failed = self._future.exception()
        if isinstance(failed, self._workload.error):
            raise failed
        if isinstance(failed, ImportError):
            raise self._workload.error(
                f"a worker cannot run Terrafix ({failed}); install the same version on every computer"
            )
        raise ProgramEnded(1)  # workers died again and again


def connection_of(to: str) -> "Connection[Any, Any]":
    """The other end, in the program. Raises OSError, AuthenticationError."""
    host, _, port = to.rpartition(":")
    return Client((host, int(port)), authkey=bytes.fromhex(os.environ.pop(SECRET)))
