"""Seeds of a test: one in every check, the others in the nightly run."""

from typing import Any

import pytest


def seeds(first: int, *nightly: int) -> list[Any]:
    """-> values of a parameter. ``first`` is in every check."""
    return [first, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in nightly)]
