"""Fixtures for all tests."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import structlog

REPOSITORY = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Root of the shared test data (flights/, maps/, ...): TERRAFIX_DATA, or ../shared/data beside the repository."""
    root = Path(os.environ.get("TERRAFIX_DATA") or REPOSITORY.parent / "shared" / "data")
    if not root.is_dir():
        pytest.skip(f"TEST DATA MISSING: {root} is not there; set TERRAFIX_DATA to the folder with flights/ and maps/")
    return root


@pytest.fixture(scope="session")
def data_set(data_dir: Path) -> Callable[[str], Path]:
    """``data_set("flights/village-1")``: the path, or a skip that names the set."""

    def find(name: str) -> Path:
        path = data_dir / name
        if not path.exists():
            pytest.skip(f"TEST DATA MISSING: the set '{name}' is not in {data_dir}")
        return path

    return find


@pytest.fixture(scope="session", autouse=True)
def state_of_its_own(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What a test leaves for the next start is not found by another flight on this computer."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STATE_DIRECTORY", str(tmp_path_factory.mktemp("state")))
        yield


# Sleeps 5 ms again and again, and prints the longest delay of a wake-up [ms] when its input ends.
SLEEPER = """
import select, sys, time
worst_s, step_s = 0.0, 0.005
while True:
    began_s = time.monotonic()
    ended = select.select([sys.stdin], [], [], step_s)[0]
    if ended:
        break
    worst_s = max(worst_s, time.monotonic() - began_s - step_s)
print(1e3 * worst_s)
"""


@pytest.fixture
def stall_ms() -> Iterator[Callable[[], float]]:
    """``stall_ms()``: the longest delay with which this machine woke a sleeping process since the test began.

    A limit on time can be met only up to this delay. It is measured in a separate process, so that delays inside the
    tested process do not count."""
    with subprocess.Popen(
        [sys.executable, "-c", SLEEPER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as sleeper:
        assert sleeper.stdin is not None
        yield lambda: float(sleeper.communicate(timeout=60)[0])
        sleeper.stdin.close()


@pytest.fixture(autouse=True)
def logs_as_unconfigured() -> Iterator[None]:
    """A test that configures the logs leaves their level to no other test of its process."""
    yield
    structlog.reset_defaults()
