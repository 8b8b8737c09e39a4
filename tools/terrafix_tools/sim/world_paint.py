"""Draws a plan (world_layout) as it looks from above in one season: the ground, then shadows, then what stands on it.

Two seasons share every edge and hardly any grey value: crops, ploughing, leaves, sun, cars and exposure differ."""

import math
from dataclasses import dataclass, field

import cv2
import numpy as np

from terrafix_tools.sim.noise import periodic_noise
from terrafix_tools.sim.world_layout import DEM_MARGIN_M, DEM_POST_M, Layout
from terrafix_tools.sim.world_season import Bgr, Season
from terrafix_tools.sim.world_shapes import House, Line, Parcel
from terrafix_tools.sim.world_sprites import crown_sprites, stamp_cars, stamp_houses, stamp_trees

SHIFT = 4  # sub-pixel bits of OpenCV's drawing coordinates
TILE_PX = 1024  # noise repeats after this many pixels
NEUTRAL = 128  # value of the texture layer that changes nothing
SOIL_SIGMA_PX = (4.0, 12.0, 30.0, 90.0)  # patches of soil, which show through any crop
TRAM_M = 21.0  # distance of a sprayer's wheel tracks


@dataclass
class Canvas:
    """What grows while a season is drawn. ``gsd_m`` metres a pixel; arrays are (H, W[, 3]) uint8."""

    gsd_m: float
    season: Season
    colour: np.ndarray
    texture: np.ndarray
    shadow: np.ndarray
    soil: np.ndarray
    grain: np.ndarray
    rng: np.random.Generator
    sun_step: tuple[float, float] = field(init=False)  # metres of shadow (x, y) for a metre of height

    def __post_init__(self) -> None:
        azimuth, length = (
            math.radians(self.season.sun_azimuth_deg),
            1.0 / math.tan(math.radians(self.season.sun_elevation_deg)),
        )
        self.sun_step = (-math.sin(azimuth) * length, math.cos(azimuth) * length)

    def px(self, points_m: np.ndarray) -> np.ndarray:
        """Plan metres (N, 2) -> fixed-point pixels for OpenCV (N, 2) int32; pixel centres at whole numbers."""
        return np.round((points_m / self.gsd_m - 0.5) * (1 << SHIFT)).astype(np.int32)


def paint(layout: Layout, season: Season, gsd_m: float, seed: int) -> np.ndarray:
    """The place in one season: (H, W, 3) uint8 BGR, north up, ``gsd_m`` metres a pixel."""
    rng = np.random.default_rng([seed, 1 + season.key])
    shape = (round(layout.height_m / gsd_m), round(layout.width_m / gsd_m))
    soil_rng = np.random.default_rng([seed, 1])  # the soil stays where it is from season to season
    canvas = Canvas(
        gsd_m,
        season,
        colour=np.full((*shape, 3), season.meadow, np.uint8),
        texture=np.full(shape, NEUTRAL, np.uint8),
        shadow=np.full(shape, 255, np.uint8),
        soil=_tiled(np.sum([periodic_noise(soil_rng, TILE_PX, s) for s in SOIL_SIGMA_PX], axis=0), shape, 0.45),
        grain=_tiled(periodic_noise(rng, TILE_PX, 0.7) + 0.8 * periodic_noise(rng, TILE_PX, 3.0), shape, 0.7),
        rng=rng,
    )
    for parcel in layout.parcels:
        _field(canvas, parcel)
    for lot in layout.lots:
        _lot(canvas, lot)
    for line in sorted(layout.lines, key=lambda one: one.width_m):
        if line.kind in ("border", "track"):
            _line(canvas, line)
    water = _water(canvas, layout.river_m)
    for line in layout.lines:
        if line.kind in ("street", "road"):
            _line(canvas, line)
    stamp_cars(canvas.colour, canvas.rng, [one for one in layout.lines if one.kind in ("street", "road")], gsd_m)
    houses = [h for h in layout.houses if h.only in ("", season.name)]
    _shadows(canvas, houses, layout.trees)
    image = _ground(canvas, layout, water)
    stamp_houses(image, houses, season.sun_azimuth_deg, gsd_m, canvas.rng)
    palette = (
        season.broadleaf,
        ((36, 58, 40), (42, 66, 46)),
        ((48, 104, 88), *season.broadleaf[:2]),
        ((52, 96, 80), season.broadleaf[0]),
    )
    sprites = crown_sprites(canvas.rng, palette, season.sun_azimuth_deg, gsd_m)
    stamp_trees(image, layout.trees, sprites, gsd_m, canvas.rng)
    return _expose(image, season)


def _tiled(noise: np.ndarray, shape: tuple[int, int], weight: float) -> np.ndarray:
    """(H, W) uint8 around NEUTRAL, 32 grey values for one deviation."""
    tile = np.clip(NEUTRAL + 32.0 * weight * noise, 0, 255).astype(np.uint8)
    repeat = (-(-shape[0] // TILE_PX), -(-shape[1] // TILE_PX))
    return np.ascontiguousarray(np.tile(tile, repeat)[: shape[0], : shape[1]])


def _window(canvas: Canvas, outline_m: np.ndarray) -> tuple[tuple[slice, slice], np.ndarray] | None:
    """The part of the image around an outline, and the mask (bool) of its inside."""
    height, width = canvas.texture.shape
    px = outline_m / canvas.gsd_m
    x0, y0 = np.maximum(np.floor(px.min(axis=0)).astype(int) - 1, 0)
    x1, y1 = np.minimum(np.ceil(px.max(axis=0)).astype(int) + 2, (width, height))
    if x1 <= x0 or y1 <= y0:
        return None
    mask = np.zeros((y1 - y0, x1 - x0), np.uint8)
    corner = np.array([x0, y0]) << SHIFT
    cv2.fillPoly(mask, [canvas.px(outline_m) - corner.astype(np.int32)], 255, cv2.LINE_8, SHIFT)
    return (slice(y0, y1), slice(x0, x1)), mask.astype(bool)


def _field(canvas: Canvas, parcel: Parcel) -> None:
    season = canvas.season
    rng = np.random.default_rng([parcel.key, season.key])
    if parcel.kind == "crop":
        colour, rows = season.crops[int(rng.integers(len(season.crops)))]
    else:
        colour, rows = (season.forest_floor, 0.0) if parcel.kind == "wood" else (season.meadow, rng.uniform(0.0, 0.05))
    mean = np.clip(np.array(colour) * rng.normal(1.0, 0.07) + rng.normal(0.0, 2.5, 3), 0, 255)
    found = _window(canvas, parcel.outline_m)
    if found is None:
        return
    window, mask = found
    canvas.colour[window][mask] = np.round(mean).astype(np.uint8)
    soil_gain, grain_gain = rng.choice([-0.7, 0.7]), rng.uniform(0.25, 0.5)
    soil, grain = canvas.soil[window], canvas.grain[window]
    patch = cv2.addWeighted(soil, soil_gain, grain, grain_gain, NEUTRAL * (1.0 - soil_gain - grain_gain))
    if rows:
        patch = cv2.add(patch, _rows(mask.shape, parcel.row_angle_rad, rows, canvas.gsd_m, rng), dtype=cv2.CV_8U)
    np.copyto(canvas.texture[window], patch, where=mask)


def _rows(shape: tuple[int, ...], angle: float, strength: float, gsd_m: float, rng: np.random.Generator) -> np.ndarray:
    """Crop rows and wheel tracks along ``angle``: (h, w) int16, added to the texture layer."""
    steps = 256  # samples of one period between two wheel tracks
    across_m = np.arange(steps) / steps * TRAM_M
    row_m = TRAM_M / rng.integers(7, 12)
    profile = NEUTRAL * strength * np.sin(2 * math.pi * across_m / row_m + rng.uniform(0, 6.0))
    for wheel_m in (9.5, 11.5):
        profile -= NEUTRAL * 0.16 * np.exp(-(((across_m - wheel_m) / 0.45) ** 2))
    scale = steps * gsd_m / TRAM_M
    x = (np.arange(shape[1]) * (-math.sin(angle) * scale) + rng.uniform(0, steps)).astype(np.float32)
    y = (np.arange(shape[0]) * (math.cos(angle) * scale)).astype(np.float32)
    phase = (x[None, :] + y[:, None]).astype(np.int32) & (steps - 1)
    return np.round(profile).astype(np.int16)[phase]


def _lot(canvas: Canvas, lot: Parcel) -> None:
    rng = np.random.default_rng([lot.key, canvas.season.key])
    paved = lot.kind == "yard" or rng.random() < 0.12
    base = np.array((150, 160, 164) if paved else canvas.season.meadow)
    colour = np.clip(base * rng.normal(1.0, 0.10) + rng.normal(0, 2.5, 3), 0, 255).astype(int).tolist()
    cv2.fillPoly(canvas.colour, [canvas.px(lot.outline_m)], colour, cv2.LINE_8, SHIFT)
    fence = (np.array(colour) * 0.72).astype(int).tolist()
    cv2.polylines(canvas.colour, [canvas.px(lot.outline_m)], True, fence, 2, cv2.LINE_AA, SHIFT)
    centre = lot.outline_m.mean(axis=0)
    drive = np.stack([centre, lot.outline_m[:2].mean(axis=0)])
    if lot.kind == "garden":
        cv2.polylines(
            canvas.colour, [canvas.px(drive)], False, (168, 174, 178), round(3.0 / canvas.gsd_m), cv2.LINE_AA, SHIFT
        )


def _line(canvas: Canvas, line: Line) -> None:
    points = [canvas.px(line.points_m)]

    def stroke(colour: Bgr, width_m: float, layer: np.ndarray) -> None:
        cv2.polylines(layer, points, False, colour, max(1, round(width_m / canvas.gsd_m)), cv2.LINE_AA, SHIFT)

    verge = canvas.season.meadow
    if line.kind == "border":
        stroke(_dimmed(verge, 0.86), line.width_m, canvas.colour)
    elif line.kind == "track":
        stroke(verge, line.width_m + 3.0, canvas.colour)
        stroke((138, 160, 172), line.width_m, canvas.colour)
        stroke(verge, 0.9, canvas.colour)  # grass between the wheel tracks
    else:
        stroke(_dimmed(verge, 0.95), line.width_m + 4.0, canvas.colour)
        stroke((128, 126, 124), line.width_m, canvas.colour)
        if line.kind == "road":
            stroke((176, 178, 178), 0.4, canvas.colour)
    if line.kind != "border":
        stroke((NEUTRAL, NEUTRAL, NEUTRAL), line.width_m, canvas.texture)


def _dimmed(colour: Bgr, factor: float) -> Bgr:
    return round(colour[0] * factor), round(colour[1] * factor), round(colour[2] * factor)


def _water(canvas: Canvas, river: np.ndarray) -> np.ndarray:
    """Draws river and lake; -> mask (H, W) uint8."""
    mask = np.zeros_like(canvas.texture)
    middle, half = river[:, :2], river[:, 2:] / 2
    along = np.gradient(middle, axis=0)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.hypot(along[:, 0], along[:, 1])[:, None]
    for spread_m, colour in ((6.0, (56, 96, 80)), (1.5, (110, 136, 146)), (0.0, canvas.season.water)):
        reach = half + spread_m
        outline = np.concatenate([middle + normal * reach, (middle - normal * reach)[::-1]])
        cv2.fillPoly(canvas.colour, [canvas.px(outline)], colour, cv2.LINE_AA, SHIFT)
    cv2.fillPoly(mask, [canvas.px(outline)], 255, cv2.LINE_AA, SHIFT)
    return mask


def _shadows(canvas: Canvas, houses: list[House], trees: np.ndarray) -> None:
    step = np.array(canvas.sun_step)
    for house in houses:
        corners = house_corners(house)
        hull = cv2.convexHull(np.concatenate([corners, corners + step * house.height_m]).astype(np.float32))
        cv2.fillConvexPoly(canvas.shadow, canvas.px(hull.reshape(-1, 2)), 0, cv2.LINE_AA, SHIFT)
    feet, tips = canvas.px(trees[:, :2]), canvas.px(trees[:, :2] + step * trees[:, 3:4] * 0.75)
    width = np.maximum(1, np.round(trees[:, 2] * 1.7 / canvas.gsd_m).astype(int))
    for foot, tip, thick in zip(feet.tolist(), tips.tolist(), width.tolist(), strict=True):
        cv2.line(canvas.shadow, foot, tip, 0, thick, cv2.LINE_8, SHIFT)
    cv2.blur(canvas.shadow, (3, 3), canvas.shadow)


def house_corners(house: House) -> np.ndarray:
    """(4, 2) plan metres; the ridge runs along the first edge."""
    c, s = math.cos(house.angle_rad), math.sin(house.angle_rad)
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (house.length_m / 2, house.width_m / 2)
    return half @ np.array([[c, s], [-s, c]]) + house.centre_m


def _ground(canvas: Canvas, layout: Layout, water: np.ndarray) -> np.ndarray:
    """Colour x texture x shadow x slope: (H, W, 3)."""
    season = canvas.season
    height, width = canvas.texture.shape
    canvas.texture[water > 0] = NEUTRAL
    dark = cv2.LUT(canvas.shadow, np.linspace(255 * season.shadow, 255, 256).astype(np.uint8))
    azimuth, elevation = math.radians(season.sun_azimuth_deg), math.radians(season.sun_elevation_deg)
    down, right = np.gradient(layout.dem_amsl_m, DEM_POST_M)
    lit = math.sin(elevation) + math.cos(elevation) * (-right * math.sin(azimuth) + down * math.cos(azimuth))
    slope = np.clip(NEUTRAL * lit / math.sin(elevation), 0, 255).astype(np.uint8)
    to_dem = np.array(
        [
            [canvas.gsd_m / DEM_POST_M, 0, DEM_MARGIN_M / DEM_POST_M],
            [0, canvas.gsd_m / DEM_POST_M, DEM_MARGIN_M / DEM_POST_M],
        ]
    )
    hills = cv2.warpAffine(slope, to_dem, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    light = cv2.multiply(cv2.multiply(canvas.texture, dark, scale=1 / 255), hills, scale=1 / NEUTRAL)
    return cv2.multiply(canvas.colour, cv2.merge([light, light, light]), scale=1 / NEUTRAL)


def _expose(image: np.ndarray, season: Season) -> np.ndarray:
    """The optics, the air and the film."""
    image = cv2.GaussianBlur(image, (3, 3), 0.6)
    grey = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
    image = cv2.addWeighted(image, season.saturation, grey, 1.0 - season.saturation, 0.0)
    ramp = np.linspace(0.0, 1.0, 256)
    lut = np.empty((1, 256, 3), np.uint8)
    for channel, (gain, air) in enumerate(zip(season.gain, (0.86, 0.82, 0.78), strict=True)):
        value = (ramp * gain) ** season.gamma * (1.0 - season.haze) + season.haze * air
        lut[0, :, channel] = np.clip(255.0 * value, 0, 255)
    return cv2.LUT(image, lut)
