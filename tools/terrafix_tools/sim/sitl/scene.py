"""What is generated for a flight on ArduPilot's firmware: the place, its map, the camera's season, home."""

from dataclasses import dataclass
from pathlib import Path

from terrafix.core.geodesy import LocalFrame
from terrafix_tools.mission.mission import Mission
from terrafix_tools.sim.flights.scene import scene_of_world
from terrafix_tools.sim.ground.ground import Ground
from terrafix_tools.sim.sitl.firmware import Home
from terrafix_tools.sim.sitl.setup import HEADING_DEG, place_of
from terrafix_tools.sim.world.mapped import CAMERA_SEASON, write_map
from terrafix_tools.sim.world.place import World


@dataclass(frozen=True)
class Scene:
    frame: LocalFrame
    ground: Ground  # as the camera sees it
    home: Home
    mission: Mission
    map_path: Path


def generate_scene(out: Path, place: World, mission: Mission) -> Scene:
    """Writes the map into ``out``. Raises OutputError."""
    map_path = out / "map.gpkg"
    write_map(place, map_path, ce90_m=None)  # as a real map would be taken for
    seen = scene_of_world(place, place.look(CAMERA_SEASON))  # whole in memory: in flight there is no time to paint
    lat_deg, lon_deg = place_of(place)
    home_amsl_m = seen.height()(*seen.frame.to_local(lat_deg, lon_deg))
    return Scene(seen.frame, seen.ground, Home(lat_deg, lon_deg, home_amsl_m, HEADING_DEG), mission, map_path)
