"""Roads, water and buildings of a generated place as features of a map, with the errors of a map that volunteers drew.

Positions are off by a smooth error that neighbours share, as of the imagery that was traced, and by one of each object.
Some objects are missing, and some are outdated: houses are those of the map's season, and a few roads have moved.
"""

import math
from collections.abc import Iterator

import numpy as np
from pyproj import CRS, Transformer

from terrafix_lab.sim.world.box_content import piece_of
from terrafix_lab.sim.world.canvas import house_corners
from terrafix_lab.sim.world.place import EPSG, NORTH_M, WEST_M, World
from terrafix_tools.mapping.layers import Feature
from terrafix_tools.mapping.vectors.tags import line_wkb, polygon_wkb

SHARED_M, SHARED_LENGTH_M = 2.0, 700.0  # 1-sigma per axis of the shared error, and its wavelength
OWN_M = 1.5  # 1-sigma per axis of the error of one object
FEATURES_CE90_M = 2.146 * math.hypot(SHARED_M, OWN_M)  # radius that contains 90 % of the errors: 5.4 m
MISSING_SHARE = 0.10
MOVED_SHARE, MOVED_M = 0.05, 25.0  # roads that are outdated on the map, and how far
ROAD_KINDS = {"road": "tertiary", "street": "residential", "track": "track"}  # values of the key highway


def mapped_features(place: World, season: str) -> Iterator[Feature]:
    """Features of the whole place, houses of ``season`` (a key of SEASONS); the same for the same place."""
    rng = np.random.default_rng([place.seed, 77])
    to_wgs84 = Transformer.from_crs(CRS.from_epsg(EPSG), CRS.from_epsg(4326), always_xy=True)
    phases = rng.uniform(0.0, 2 * math.pi, (2, 2))

    def placed(points_m: np.ndarray, own_m: np.ndarray) -> list[tuple[float, float]]:
        angles = 2 * math.pi / SHARED_LENGTH_M * points_m[:, None, :] + phases
        shared_m = SHARED_M * np.sin(angles).sum(axis=2)
        x_m, y_m = (points_m + shared_m + own_m).T
        lon_deg, lat_deg = to_wgs84.transform(WEST_M + x_m, NORTH_M - y_m)
        return [(float(lon), float(lat)) for lon, lat in zip(lon_deg, lat_deg, strict=True)]

    def own() -> np.ndarray | None:
        """Error of the next object, (2,) metres; None: it is missing on the map."""
        missing, error_m = rng.random() < MISSING_SHARE, rng.normal(0.0, OWN_M, 2)
        return None if missing else error_m

    piece = piece_of(place.seed, 0.0, 0.0, place.layout.width_m, place.layout.height_m)
    for line in piece.lines:
        if line.kind in ROAD_KINDS and (error_m := own()) is not None:
            moved_m = rng.normal(0.0, MOVED_M, 2) if rng.random() < MOVED_SHARE else np.zeros(2)
            yield "roads", line_wkb(placed(line.points_m, error_m + moved_m)), {"kind": ROAD_KINDS[line.kind]}
    for river in piece.rivers:
        yield "water", polygon_wkb([placed(_closed(_banks(river)), rng.normal(0.0, OWN_M, 2))]), {"kind": "water"}
    for house in piece.houses:
        if season not in house.absent and (error_m := own()) is not None:
            yield "buildings", polygon_wkb([placed(_closed(house_corners(house)), error_m)]), {"kind": "yes"}


def _banks(river: np.ndarray) -> np.ndarray:
    """Outline (2 N, 2) of a river (N, 3): x, y, width."""
    centre_line, half = river[:, :2], river[:, 2:] / 2
    along = np.gradient(centre_line, axis=0)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.hypot(along[:, 0], along[:, 1])[:, None]
    return np.concatenate([centre_line + normal * half, (centre_line - normal * half)[::-1]])


def _closed(outline: np.ndarray) -> np.ndarray:
    return np.concatenate([outline, outline[:1]])
