"""Illumination and atmosphere between ground and camera: sun on slopes, clouds and their shadows, haze.

All effects are computed on the renderer's coarse grid of rays.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from terrafix_lab.sim.ground.relief import Relief
from terrafix_lab.sim.world.noise import periodic_noise

CLOUD_PX, CLOUD_M = 512, 16.0  # size of the cloud field and of its pixel: it repeats after 8 km
CLOUD_EDGE_WIDTH = 0.5  # distance, in units of the field, from the edge of a cloud to its full thickness
CLOUD_BGR = (244, 240, 238)
AIR_BGR = (226, 214, 204)
SHADOW = 0.45  # share of the light that a thick cloud blocks
DIFFUSE_LIGHT = 0.35  # share of diffuse light, independent of the slope
KOSCHMIEDER = 3.912  # optical depth at which a black object has 2 % contrast: the definition of visibility (WMO No. 8)


@dataclass(frozen=True)
class Weather:
    """The default is clear air, and the illumination that the ground image already has."""

    visibility_m: float = math.inf
    sun_azimuth_deg: float = 150.0
    sun_elevation_deg: float = 45.0
    # shading of slopes by this sun: for ground images in diffuse light, or for another time of day
    relight: bool = False
    cloud_cover: float = 0.0  # 0..1 share of the sky
    cloud_base_amsl_m: float = 1500.0  # below the camera they hide the ground; above it they only cast shadows
    cloud_opacity: float = 0.9
    wind_enu_mps: tuple[float, float] = (6.0, 3.0)  # of the clouds: east, north

    def sun_enu(self) -> np.ndarray:
        """Unit vector (3,) towards the sun."""
        azimuth, elevation = math.radians(self.sun_azimuth_deg), math.radians(self.sun_elevation_deg)
        level = math.cos(elevation)
        return np.array([level * math.sin(azimuth), level * math.cos(azimuth), math.sin(elevation)])


class Sky:
    """Weather of one flight: a function of position, time and seed."""

    def __init__(self, weather: Weather, relief: Relief, seed: int) -> None:
        self._weather, self._relief = weather, relief
        rng = np.random.default_rng([seed, 17])
        self._clouds = None
        if weather.cloud_cover > 0.0:
            field = periodic_noise(rng, CLOUD_PX, 14.0) + 0.35 * periodic_noise(rng, CLOUD_PX, 4.0)
            edge = float(np.quantile(field, 1.0 - min(weather.cloud_cover, 1.0)))
            self._clouds = np.clip((field - edge) / CLOUD_EDGE_WIDTH, 0.0, 1.0).astype(np.float32)

    def light(self, points_m: np.ndarray, t_s: float) -> np.ndarray | None:
        """Brightness factor (h, w) at ground points (h, w, 3); None: unchanged."""
        weather = self._weather
        if self._clouds is None and not weather.relight:
            return None
        sun = weather.sun_enu()
        light = np.ones(points_m.shape[:2])
        if weather.relight:
            east, north = self._relief.slope(points_m[..., 0], points_m[..., 1])
            facing = (sun[2] - east * sun[0] - north * sun[1]) / np.sqrt(1.0 + east**2 + north**2)
            direct = np.maximum(facing, 0.0) * ~self._relief.shaded(points_m, sun)
            light = DIFFUSE_LIGHT + (1.0 - DIFFUSE_LIGHT) * direct / sun[2]
        if self._clouds is not None:
            climb = np.maximum(weather.cloud_base_amsl_m - points_m[..., 2], 0.0) / sun[2]
            light = light * (1.0 - SHADOW * self._thickness(points_m[..., :2] + climb[..., None] * sun[:2], t_s))
        return light

    def cover(self, from_m: np.ndarray, rays: np.ndarray, t_s: float) -> np.ndarray | None:
        """Opacity (h, w) of clouds along rays (h, w, 3) from (..., 3); None: no clouds below."""
        drop_m = from_m[..., 2] - self._weather.cloud_base_amsl_m
        if self._clouds is None or np.max(drop_m) <= 0.0:
            return None
        down = np.maximum(-rays[..., 2], 0.05)
        at = from_m[..., :2] + rays[..., :2] * (drop_m / down)[..., None]
        return self._weather.cloud_opacity * self._thickness(at, t_s)

    def haze(self, distance_m: np.ndarray) -> np.ndarray | None:
        """Share (h, w) of air light over ``distance_m``; None: clear air."""
        if math.isinf(self._weather.visibility_m):
            return None
        return 1.0 - np.exp(-KOSCHMIEDER * np.minimum(distance_m, 1e6) / self._weather.visibility_m)

    def _thickness(self, points_m: np.ndarray, t_s: float) -> np.ndarray:
        """Cloud thickness 0..1 (h, w) at points (h, w, 2) of the cloud layer."""
        assert self._clouds is not None
        drift = np.array(self._weather.wind_enu_mps) * t_s
        px = (((points_m - drift) / CLOUD_M) % CLOUD_PX).astype(np.float32)
        return cv2.remap(self._clouds, px[..., 0], px[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)


def blend(image: np.ndarray, share: np.ndarray, bgr: tuple[int, int, int]) -> np.ndarray:
    """Blends a colour over an image (H, W, 3) uint8 with weight ``share`` (H, W) float32."""
    image_weight = cv2.merge([1.0 - share] * 3)
    colour = cv2.merge([share * np.float32(c) for c in bgr])
    return cv2.add(cv2.multiply(image, image_weight, dtype=cv2.CV_32F), colour, dtype=cv2.CV_8U)
