"""A service that computes nothing, and a browser, for the tests of the page."""

from collections.abc import Iterator

import pytest

from browser import Browser
from console_rig import Console, settings


@pytest.fixture(scope="module")
def console(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Console]:
    with Console(settings(tmp_path_factory.mktemp("console"))) as running:
        yield running


@pytest.fixture(scope="module")
def opened() -> Iterator[Browser]:
    with Browser() as window:
        yield window


@pytest.fixture
def window(opened: Browser) -> Browser:
    """With an empty page of 1400 px, and no errors of the one before."""
    opened.open("about:blank")
    opened.errors.clear()
    opened.resize(1400, 900)
    return opened
