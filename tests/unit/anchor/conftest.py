"""Fixtures of the tests of the anchor."""

import numpy as np
import pytest

from single_map_place import SIDE_M
from textured_ground import texture


@pytest.fixture(scope="session")
def ground() -> np.ndarray:
    """(H, W, 3) uint8: the ground that the map of a SingleMapPackage shows."""
    return texture(8, SIDE_M)
