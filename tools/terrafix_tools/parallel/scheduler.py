"""The Dask cluster of ``--scheduler``: `cluster.py`, which only the extra ``cluster`` can import."""

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

from terrafix.core.errors import UsageError
from terrafix_tools.installation import install_command
from terrafix_tools.parallel.pool import Workload

if TYPE_CHECKING:
    from terrafix_tools.parallel.cluster import DaskCluster


def connect(address: str, workload: Workload) -> "DaskCluster":
    """The Dask cluster of ``--scheduler``. Raises UsageError: Dask is not installed, or no scheduler answers."""
    with _dask_named():
        from terrafix_tools.parallel.cluster import DaskCluster
    return DaskCluster(address, workload)


def check_scheduler(address: str) -> None:
    """Raises UsageError as ``connect``, which a program calls later."""
    with _dask_named():
        from terrafix_tools.parallel.cluster import check_address
    check_address(address)


@contextlib.contextmanager
def _dask_named() -> Iterator[None]:
    try:
        yield
    except ModuleNotFoundError as error:
        raise UsageError(f"--scheduler needs {error.name}; install it: {install_command('cluster')}") from None
