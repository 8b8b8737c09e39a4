"""Tests that download, need root or take minutes: only with TERRAFIX_NIGHTLY=1, as scripts/nightly sets it."""

import os

import pytest


@pytest.fixture(scope="session", autouse=True)
def nightly() -> None:
    if not os.environ.get("TERRAFIX_NIGHTLY"):
        pytest.skip("NIGHTLY: set TERRAFIX_NIGHTLY=1, or run scripts/nightly")
