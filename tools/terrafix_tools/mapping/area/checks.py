"""Checks of an area before a download; every error says how to fix it."""

import numpy as np

from terrafix.core.errors import UsageError
from terrafix_tools.mapping.area.polygons import Area

POLAR_DEG = 84.0  # limit of Web Mercator and UTM; a compass is inaccurate beyond
LARGEST_KM2 = 20_000.0  # 20 km around a route of 300 km is 13,373 km2 [spec: RS-2 of the requirements]
MIN_DISTANCE_DEG = 1e-7  # about a centimetre: nearer points are duplicates
MAX_RING_POINTS = 20_000  # a polygon with more points is a coastline, not an area of operation


def check_ring(where: str, points: np.ndarray) -> np.ndarray:
    """Cleans the outline of a polygon (n, 2) lon, lat: not closed, without repeated points.

    Raises UsageError: too few points, no area, self-intersection, or as `check_points`."""
    check_points(where, points)
    keep = np.abs(points - np.roll(points, 1, axis=0)).max(axis=1) > MIN_DISTANCE_DEG
    ring = points[keep]
    if len(ring) < 3:
        raise UsageError(f"{where}: a polygon without area (fewer than three different points); draw at least three")
    crossing = _find_intersection(ring)
    if crossing is not None:
        lon_deg, lat_deg = crossing
        raise UsageError(
            f"{where}: the polygon crosses itself near {lat_deg:.5f}, {lon_deg:.5f}; draw it without loops"
        )
    x, y = (ring - ring.mean(axis=0)).T
    if abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))) / 2 < MIN_DISTANCE_DEG**2:
        raise UsageError(f"{where}: a polygon without area (all points on one line); draw one with an inside")
    return ring


def check_points(where: str, points: np.ndarray) -> None:
    """Raises UsageError: no points, not finite, not coordinates, or an edge across the antimeridian."""
    if not len(points):
        raise UsageError(f"{where}: contains no point; draw the area and save it again")
    if len(points) > MAX_RING_POINTS:
        raise UsageError(f"{where}: {len(points)} points in one outline, at most {MAX_RING_POINTS}; simplify it")
    wrong = ~np.isfinite(points).all(axis=1) | (np.abs(points) > (180.0, 90.0)).any(axis=1)
    if wrong.any():
        lon_deg, lat_deg = points[np.argmax(wrong)]
        raise UsageError(
            f"{where}: longitude {lon_deg:g}, latitude {lat_deg:g} is not a position; write degrees of WGS84"
        )
    if len(points) > 1 and np.abs(np.diff(points[:, 0])).max() > 180.0:
        raise UsageError(f"{where}: crosses the antimeridian (180 degrees); make one map for each side of it")


def check_area(area: Area, largest_km2: float = LARGEST_KM2) -> float:
    """Size of the buffered area in km2. Raises UsageError: polar, across the antimeridian, too large."""
    for ring in area.rings:
        if np.abs(np.diff(ring[:, 0])).max() > 180.0:
            raise UsageError(
                f"{area.name}: with its buffer it crosses the antimeridian (180 degrees); "
                "make it smaller, or one map for each side"
            )
    _, south, _, north = area.bounds_deg
    if max(abs(south), abs(north)) > POLAR_DEG:
        raise UsageError(
            f"{area.name}: with its buffer it reaches {max(south, north, key=abs):.2f} degrees of latitude; "
            f"maps end at {POLAR_DEG:g}"
        )
    size_km2 = area.size_km2()
    if size_km2 > largest_km2:
        raise UsageError(
            f"{area.name}: {size_km2:,.0f} km2 with its buffer, at most {largest_km2:,.0f}; "
            "give a smaller --buffer, or a mission with --corridor 2"
        )
    return size_km2


def _find_intersection(ring: np.ndarray) -> tuple[float, float] | None:
    """A point where two non-adjacent edges of the closed ring intersect, or None. Orientation test of all pairs."""
    a, b = ring, np.roll(ring, -1, axis=0)
    count = len(ring)
    low, high = np.minimum(a, b), np.maximum(a, b)
    for i in range(count - 1):
        last = count - 1 if i == 0 else count  # the last edge is adjacent to the first
        j = np.arange(i + 2, last)
        near = ((low[j] <= high[i]) & (high[j] >= low[i])).all(axis=1)
        j = j[near]
        if not len(j):
            continue
        side_a, side_b = _side(a[i], b[i], a[j]), _side(a[i], b[i], b[j])
        side_c, side_d = _side(a[j], b[j], a[i]), _side(a[j], b[j], b[i])
        met = (side_a * side_b <= 0) & (side_c * side_d <= 0)
        if met.any():
            other = j[np.argmax(met)]
            lon_deg, lat_deg = (a[i] + b[i] + a[other] + b[other]) / 4
            return float(lon_deg), float(lat_deg)
    return None


def _side(start: np.ndarray, end: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Sign of the side of the line start to end on which the point lies; 0 = on it. Broadcasts over (n, 2)."""
    edge, to = end - start, point - start
    return np.sign(edge[..., 0] * to[..., 1] - edge[..., 1] * to[..., 0])
