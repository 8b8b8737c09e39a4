"""Scene of a simulated flight: a ground in the local frame, and its bounds."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pyproj import CRS, Transformer

from terrafix.core.geodesy import LocalFrame
from terrafix_lab.sim.ground.draped_image import Ground, drape, open_ground
from terrafix_lab.sim.world.place import EPSG, World
from terrafix_tools.mapping.source import ImagerySource
from terrafix_tools.mission.items import Box, HeightOf


@dataclass(frozen=True)
class Scene:
    frame: LocalFrame  # origin at the centre of the image
    ground: Ground
    box: Box  # inside the image

    def height(self) -> HeightOf:
        """Returns a function for the ground height of one point."""
        ground = self.ground

        def height_m(e_m: float, n_m: float) -> float:
            return float(ground.height_amsl_m(np.array([[e_m]]), np.array([[n_m]]))[0, 0])

        return height_m


def scene_of_place(place: World, season: str) -> Scene:
    """A generated place in a season (a key of SEASONS) of any size, rendered on demand."""
    frame = _frame(place)
    return Scene(frame, place.ground(season, frame), _box(place, frame))


def scene_of_world(place: World, camera_image_bgr: np.ndarray) -> Scene:
    """A generated place with the image ``camera_image_bgr``, in memory."""
    frame, crs = _frame(place), CRS.from_epsg(EPSG)
    ground = drape(camera_image_bgr, place.utm_from_px, place.dem_amsl_m, place.utm_from_dem, crs, frame)
    return Scene(frame, ground, _box(place, frame))


def scene_of_image(image: Path, dem: Path | None) -> Scene:
    """A georeferenced image over an elevation model; flat at 0 m without one. Raises MapError."""
    with ImagerySource(image) as source:
        x_min, y_min, x_max, y_max = source.bounds
        to_wgs84 = Transformer.from_crs(source.crs, 4326, always_xy=True)
        corners = [to_wgs84.transform(x, y)[::-1] for x in (x_min, x_max) for y in (y_min, y_max)]
        centre = to_wgs84.transform((x_min + x_max) / 2, (y_min + y_max) / 2)[::-1]
    frame = LocalFrame(*centre)
    box = _inside([frame.to_local(*corner) for corner in corners])
    return Scene(frame, open_ground(image, dem, frame), box)


def _frame(place: World) -> LocalFrame:
    return LocalFrame(*place.wgs84(place.layout.width_m / 2, place.layout.height_m / 2))


def _box(place: World, frame: LocalFrame) -> Box:
    corners = [place.wgs84(x, y) for x in (0.0, place.layout.width_m) for y in (0.0, place.layout.height_m)]
    return _inside([frame.to_local(*corner) for corner in corners])


def _inside(corners_m: list[tuple[float, float]]) -> Box:
    """Returns the box inside a slightly rotated rectangle, from its corners (any order)."""
    east, north = (np.sort(np.array(axis)) for axis in zip(*corners_m, strict=True))
    return Box(float(east[1]), float(north[1]), float(east[2]), float(north[2]))
