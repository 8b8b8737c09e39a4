"""A grid of a geoid that is a plane, and its undulation."""

from pathlib import Path

import numpy as np
from pyproj import Transformer


def write_geoid(path: Path, west: float = 118.0, constant_m: float = 0.0) -> Path:
    """N = constant + 10 m + 2 m per degree east of 120 + 3 m per degree north of 20; NOAA's .gtx format."""
    lon_deg, lat_deg = np.meshgrid(west + 0.25 * np.arange(33), 18.0 + 0.25 * np.arange(33))
    values = (constant_m + 10.0 + 2.0 * (lon_deg - 120.0) + 3.0 * (lat_deg - 20.0)).astype(">f4")
    head = np.array([18.0, west, 0.25, 0.25], ">f8").tobytes() + np.array([33, 33], ">i4").tobytes()
    path.write_bytes(head + values.tobytes())
    return path


def undulation_m(column: float, row: float, constant_m: float = 0.0) -> float:
    x, y = 300_000.0 + 30.0 * (column + 0.5), 2_600_000.0 - 30.0 * (row + 0.5)
    lon_deg, lat_deg = Transformer.from_crs(32651, 4326, always_xy=True).transform(x, y)
    return constant_m + 10.0 + 2.0 * (lon_deg - 120.0) + 3.0 * (lat_deg - 20.0)
