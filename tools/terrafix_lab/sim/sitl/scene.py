"""Generates the scene of a SITL flight: place, map, the camera's season, home."""

from dataclasses import dataclass
from pathlib import Path

from terrafix.core.geodesy import LocalFrame
from terrafix_lab.sim.flights.scene import scene_of_world
from terrafix_lab.sim.ground.draped_image import Ground
from terrafix_lab.sim.sitl.firmware import Home
from terrafix_lab.sim.sitl.setup import HEADING_DEG, place_of
from terrafix_lab.sim.world.mapped import CAMERA_SEASON, write_map
from terrafix_lab.sim.world.place import World
from terrafix_tools.mission.items import Mission


@dataclass(frozen=True)
class SitlScene:
    frame: LocalFrame
    ground: Ground  # as the camera sees it
    home: Home
    mission: Mission
    map_path: Path


def generate_scene(out: Path, place: World, mission: Mission) -> SitlScene:
    """Writes the map into ``out`` and returns the scene. Raises OutputError."""
    map_path = out / "map.gpkg"
    write_map(place, map_path, ce90_m=None)  # stated as for a real map
    # rendered completely in advance: in flight there is no time for it
    camera_scene = scene_of_world(place, place.render(CAMERA_SEASON))
    lat_deg, lon_deg = place_of(place)
    home_amsl_m = camera_scene.height()(*camera_scene.frame.to_local(lat_deg, lon_deg))
    return SitlScene(
        camera_scene.frame, camera_scene.ground, Home(lat_deg, lon_deg, home_amsl_m, HEADING_DEG), mission, map_path
    )
