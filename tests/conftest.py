"""Fixtures for all tests."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

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
