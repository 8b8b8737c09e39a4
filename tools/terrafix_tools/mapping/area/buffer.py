"""Buffers of polygons and lines as a union of capsules around their edges, which avoids fragile offset curves."""

import math

import numpy as np

from terrafix_tools.mapping.area.polygons import EARTH, cut_edges, densify

HALF_CIRCLE_STEPS = 12  # the polygon circumscribes the circle, so the buffer is not narrower than asked; +0.9 % at most


def around_ring(ring: np.ndarray, distance_m: float) -> tuple[np.ndarray, ...]:
    """A polygon (n, 2) lon, lat and the band of width ``distance_m`` around its edge."""
    if distance_m <= 0:
        return (ring,)
    closed = densify(ring)
    return ring, *_capsules(closed, np.roll(closed, -1, axis=0), distance_m)


def around_line(line: np.ndarray, distance_m: float) -> tuple[np.ndarray, ...]:
    """The corridor along a line (n, 2) lon, lat; a circle for a single point."""
    if len(line) == 1:
        return tuple(_capsules(line, line, distance_m))
    pieces = np.concatenate([cut_edges(line[:-1], line[1:]), line[-1:]])
    return tuple(_capsules(pieces[:-1], pieces[1:], distance_m))


def _capsules(a: np.ndarray, b: np.ndarray, distance_m: float) -> list[np.ndarray]:
    """For each edge a[i] to b[i] a polygon around all points within the distance (geodesics of WGS84)."""
    azimuth_deg, back_deg, _ = EARTH.inv(a[:, 0], a[:, 1], b[:, 0], b[:, 1])
    turn_deg = np.linspace(-90.0, 90.0, HALF_CIRCLE_STEPS + 1)
    radius_m = distance_m / math.cos(math.pi / 2 / HALF_CIRCLE_STEPS)
    behind_deg = (np.asarray(azimuth_deg) + 180.0)[:, None] + turn_deg
    ahead_deg = (np.asarray(back_deg) + 180.0)[:, None] + turn_deg
    count = len(turn_deg)
    lon_deg = np.concatenate([np.repeat(a[:, :1], count, 1), np.repeat(b[:, :1], count, 1)], axis=1)
    lat_deg = np.concatenate([np.repeat(a[:, 1:], count, 1), np.repeat(b[:, 1:], count, 1)], axis=1)
    heading_deg = np.concatenate([behind_deg, ahead_deg], axis=1)
    x, y, _ = EARTH.fwd(lon_deg, lat_deg, heading_deg, np.full_like(lon_deg, radius_m))
    return list(np.stack([x, y], axis=2))
