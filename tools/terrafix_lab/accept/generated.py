"""Ground of the generated world for scenarios, and the flight over it. The only file that depends on the world."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from pyproj import Transformer

from terrafix.messages import Camera
from terrafix_lab.sim.flights.folder import CAMERA, FRAME_HZ, ON_GIMBAL, Flight, plan_flight, write_flight
from terrafix_lab.sim.world import place as world
from terrafix_tools.mapping.build import build

MAP_LOOK, CAMERA_LOOK, WINTER_LOOK = "summer", "autumn", "winter"
WATER = (0.40, 0.75)  # share of the frames over the lake
LAKE_M = 330.0  # from the track to the shore: more than the footprint of a frame
WATER_BGR = (92, 84, 56)
WATER_WAVES = 3.0  # grey values, 1-sigma
LOW_CONTRAST = 1 / 8
HILLS_M = 60.0  # 1-sigma of the added relief, some 300 m in all; hills are a kilometre or so wide
HILL_SIGMA_POSTS = 40.0


@dataclass(frozen=True)
class GroundKind:
    """One kind of ground: changes to the looks of the place and to its relief."""

    looks: tuple[str, str] = (MAP_LOOK, CAMERA_LOOK)
    hills: bool = False
    lake: bool = False
    contrast: float = 1.0
    camera: Camera = CAMERA


KINDS = {
    "base": GroundKind(),
    "season": GroundKind(looks=(MAP_LOOK, WINTER_LOOK)),
    "low texture": GroundKind(contrast=LOW_CONTRAST),
    "water": GroundKind(lake=True),
    "hills": GroundKind(hills=True),
    "gimbal": GroundKind(camera=ON_GIMBAL),
}


def make(
    kind: str, folder: Path, *, seed: int, frames: int, progress: Callable[[int, int], None] | None = None
) -> None:
    """Writes ``folder``/flight (a flight folder), map.tif, dem.tif and map.gpkg. Raises OutputError."""
    folder.mkdir(parents=True, exist_ok=True)
    ground, place = KINDS[kind], world.generate(seed)
    if ground.hills:
        place = replace(place, layout=replace(place.layout, dem_amsl_m=_with_hills(place.dem_amsl_m, seed)))
    looks = [_flattened(place.render(name), ground.contrast) for name in ground.looks]
    flight = plan_flight(place, looks[1], frames / FRAME_HZ, camera=ground.camera)
    if ground.lake:
        lake = _lake(place, flight, looks[1].shape)
        looks = [_flooded(image, lake, [seed, number]) for number, image in enumerate(looks)]
        flight = plan_flight(place, looks[1], frames / FRAME_HZ)
    world.write_image(folder / "map.tif", place, looks[0])
    world.write_dem(folder / "dem.tif", place)
    build(folder / "map.tif", folder / "map.gpkg", dem=folder / "dem.tif")
    write_flight(folder / "flight", flight, "../map.tif", seed=seed, progress=progress)


def _with_hills(dem_amsl_m: np.ndarray, seed: int) -> np.ndarray:
    noise = cv2.GaussianBlur(np.random.default_rng([seed, 8]).normal(size=dem_amsl_m.shape), (0, 0), HILL_SIGMA_POSTS)
    return (dem_amsl_m + HILLS_M * noise / noise.std()).astype(np.float32)


def _flattened(image: np.ndarray, contrast: float) -> np.ndarray:
    mean = image.reshape(-1, 3).mean(axis=0)
    return image if contrast == 1.0 else np.clip(mean + contrast * (image - mean), 0, 255).astype(np.uint8)


def _lake(place: world.World, flight: Flight, shape: tuple[int, ...]) -> np.ndarray:
    """(H, W) uint8, 255 for water: around the track in the share WATER of the flight."""
    times_s = flight.frame_times_s()
    inside = times_s[round(WATER[0] * len(times_s)) : round(WATER[1] * len(times_s)) + 1]
    to_map = Transformer.from_crs(4326, world.EPSG, always_xy=True)
    px = []
    for t_s in inside.tolist():
        lat_deg, lon_deg = flight.frame.to_wgs84(*flight.path.state(t_s).p_b_in_w_m[:2].tolist())
        px.append(~place.utm_from_px @ to_map.transform(lon_deg, lat_deg))
    mask = np.zeros(shape[:2], np.uint8)
    track = np.round(np.array(px)).astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(mask, [track], False, 255, round(2 * LAKE_M / place.gsd_m))
    return mask


def _flooded(image: np.ndarray, lake: np.ndarray, seed: list[int]) -> np.ndarray:
    """With water where ``lake`` is set. Map and camera have different waves, drawn from ``seed``."""
    waves = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=lake.shape).astype(np.float32), (0, 0), 2.0)
    water = np.clip(np.array(WATER_BGR) + (WATER_WAVES * waves / waves.std())[..., None], 0, 255).astype(np.uint8)
    return np.where(lake[..., None] > 0, water, image)
