"""Renders a part of a place (world/cells.py) from above in one season: ground, shadows, objects.

Two seasons share every edge and hardly any grey value: crops, ploughing, leaves, sun, cars and exposure differ. All
drawing is a function of the seed and of the position, so that parts join without a seam.
"""

import functools
import math

import cv2
import numpy as np

from terrafix_lab.sim.world.box_content import Piece, piece_of
from terrafix_lab.sim.world.canvas import NEUTRAL, Canvas, draw_field, draw_line, draw_lot, draw_shadows, draw_water
from terrafix_lab.sim.world.layout import DEM_MARGIN_M, DEM_POST_M, Layout
from terrafix_lab.sim.world.noise import smooth
from terrafix_lab.sim.world.season import Season
from terrafix_lab.sim.world.sprites import Sprites, crown_sprites, stamp_cars, stamp_houses, stamp_trees

SOIL_M = (2.0, 6.0, 15.0, 45.0)  # sizes (1-sigma) of soil patches, which are visible through any crop
GRAIN_M, FINE_PX = 1.5, 0.7  # tufts and clods; structure below the pixel size
MARGIN_M = 56.0  # around a part: the longest shadow of the lowest sun


class Painter:
    """Renders a place in one season, north up, ``gsd_m`` metres a pixel; also beyond the edges of the place."""

    def __init__(self, layout: Layout, season: Season, gsd_m: float) -> None:
        self._layout, self._season, self._gsd_m = layout, season, gsd_m
        self._sprites = _sprites(layout.seed, season, gsd_m)
        azimuth, elevation = math.radians(season.sun_azimuth_deg), math.radians(season.sun_elevation_deg)
        down, right = np.gradient(layout.dem_amsl_m, DEM_POST_M)
        lit = math.sin(elevation) + math.cos(elevation) * (-right * math.sin(azimuth) + down * math.cos(azimuth))
        self._hills = np.clip(NEUTRAL * lit / math.sin(elevation), 0, 255).astype(np.uint8)

    def paint(self, column: int, row: int, width: int, height: int) -> np.ndarray:
        """Returns the pixels (height, width, 3) uint8 BGR from (column, row) of the place, which may be negative."""
        margin = math.ceil(MARGIN_M / self._gsd_m)
        canvas = self._canvas(column - margin, row - margin, width + 2 * margin, height + 2 * margin)
        x0_m, y0_m = canvas.origin_px[0] * self._gsd_m, canvas.origin_px[1] * self._gsd_m
        size_m = (width + 2 * margin) * self._gsd_m, (height + 2 * margin) * self._gsd_m
        whole = self._draw(canvas, piece_of(self._layout.seed, x0_m, y0_m, *size_m))
        return np.ascontiguousarray(whole[margin : margin + height, margin : margin + width])

    def _canvas(self, column: int, row: int, width: int, height: int) -> Canvas:
        seed, season, gsd_m = self._layout.seed, self._season, self._gsd_m
        at = (column, row, width, height)
        soil = np.sum([smooth(seed + 301 + n, size / gsd_m, *at) for n, size in enumerate(SOIL_M)], axis=0)
        fine = smooth(seed + 401 + season.key, FINE_PX, *at)
        grain = fine + 0.8 * smooth(seed + 501 + season.key, max(GRAIN_M / gsd_m, 1.0), *at)
        return Canvas(
            gsd_m,
            season,
            (column, row),
            colour=np.full((height, width, 3), season.meadow, np.uint8),
            texture=np.full((height, width), NEUTRAL, np.uint8),
            shadow=np.full((height, width), 255, np.uint8),
            soil=_layer(soil, 0.45),  # the soil is the same in all seasons
            grain=_layer(grain, 0.7),
        )

    def _draw(self, canvas: Canvas, piece: Piece) -> np.ndarray:
        season, gsd_m = self._season, self._gsd_m
        for parcel in piece.parcels:
            draw_field(canvas, parcel)
        for lot in piece.lots:
            draw_lot(canvas, lot)
        for line in piece.lines:
            if line.kind in ("border", "track"):
                draw_line(canvas, line)
        water = np.zeros_like(canvas.texture)
        for river in piece.rivers:
            draw_water(canvas, river, water)
        roads = [one for one in piece.lines if one.kind in ("street", "road")]
        for line in roads:
            draw_line(canvas, line)
        stamp_cars(canvas.colour, season, roads, gsd_m)
        houses = [h for h in piece.houses if season.name not in h.absent]
        draw_shadows(canvas, houses, piece.trees)
        image = _ground(canvas, self._hills, water)
        stamp_houses(image, houses, season, gsd_m)
        stamp_trees(image, piece.trees, self._sprites, gsd_m)
        return _expose(image, season)


@functools.lru_cache(maxsize=8)
def _sprites(seed: int, season: Season, gsd_m: float) -> Sprites:
    palette = (
        season.broadleaf,
        ((36, 58, 40), (42, 66, 46)),
        ((48, 104, 88), *season.broadleaf[:2]),
        ((52, 96, 80), season.broadleaf[0]),
    )
    return crown_sprites(np.random.default_rng([seed, 1 + season.key]), palette, season.sun_azimuth_deg, gsd_m)


def _layer(noise: np.ndarray, weight: float) -> np.ndarray:
    """Converts noise to (H, W) uint8 around NEUTRAL, 32 grey values per standard deviation."""
    return np.clip(NEUTRAL + 32.0 * weight * noise, 0, 255).astype(np.uint8)


def _ground(canvas: Canvas, hills: np.ndarray, water: np.ndarray) -> np.ndarray:
    """Colour x texture x shadow x slope: (H, W, 3). ``hills``: illumination at the posts of the elevation model."""
    height, width = canvas.texture.shape
    canvas.texture[water > 0] = NEUTRAL
    dark = cv2.LUT(canvas.shadow, np.linspace(255 * canvas.season.shadow, 255, 256).astype(np.uint8))
    scale = canvas.gsd_m / DEM_POST_M
    margin = DEM_MARGIN_M / DEM_POST_M
    to_dem = np.array(
        [[scale, 0, margin + canvas.origin_px[0] * scale], [0, scale, margin + canvas.origin_px[1] * scale]]
    )
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    slope = cv2.warpAffine(hills, to_dem, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    light = cv2.multiply(cv2.multiply(canvas.texture, dark, scale=1 / 255), slope, scale=1 / NEUTRAL)
    return cv2.multiply(canvas.colour, cv2.merge([light, light, light]), scale=1 / NEUTRAL)


def _expose(image: np.ndarray, season: Season) -> np.ndarray:
    """Applies optics, atmosphere and exposure."""
    image = cv2.GaussianBlur(image, (3, 3), 0.6)
    grey = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
    image = cv2.addWeighted(image, season.saturation, grey, 1.0 - season.saturation, 0.0)
    ramp = np.linspace(0.0, 1.0, 256)
    lut = np.empty((1, 256, 3), np.uint8)
    for channel, (gain, air) in enumerate(zip(season.gain, (0.86, 0.82, 0.78), strict=True)):
        value = (ramp * gain) ** season.gamma * (1.0 - season.haze) + season.haze * air
        lut[0, :, channel] = np.clip(255.0 * value, 0, 255)
    return cv2.LUT(image, lut)
