"""Drawing of fields, lots, roads, water and shadows of a generated place on a canvas."""

import math
from dataclasses import dataclass, field

import cv2
import numpy as np

from terrafix_lab.sim.world.season import Bgr, Season
from terrafix_lab.sim.world.shapes import House, Line, Parcel

SHIFT = 4  # sub-pixel bits of OpenCV's drawing coordinates
NEUTRAL = 128  # value of the texture layer with factor 1
WHEEL_TRACK_SPACING_M = 21.0  # spacing of a sprayer's wheel tracks
ROWS_MAX_GSD_M = 1.0  # with larger pixels crop rows are not resolved and would alias


@dataclass
class Canvas:
    """Layers of a season while it is drawn. ``gsd_m`` metres a pixel; arrays are (H, W[, 3]) uint8."""

    gsd_m: float
    season: Season
    origin_px: tuple[int, int]  # of the canvas in the place; coordinates of drawn objects are relative to it
    colour: np.ndarray
    texture: np.ndarray
    shadow: np.ndarray
    soil: np.ndarray
    grain: np.ndarray
    sun_step: tuple[float, float] = field(init=False)  # shadow vector (x, y), m per metre of height

    def __post_init__(self) -> None:
        azimuth, length = (
            math.radians(self.season.sun_azimuth_deg),
            1.0 / math.tan(math.radians(self.season.sun_elevation_deg)),
        )
        self.sun_step = (-math.sin(azimuth) * length, math.cos(azimuth) * length)

    def px(self, points_m: np.ndarray) -> np.ndarray:
        """Converts metres (N, 2) to fixed-point pixels for OpenCV (N, 2) int32; pixel centres at integers."""
        return np.round((points_m / self.gsd_m - 0.5) * (1 << SHIFT)).astype(np.int32)


def _window(canvas: Canvas, outline_m: np.ndarray) -> tuple[tuple[slice, slice], np.ndarray] | None:
    """Returns the image window around an outline, and the mask (bool) of its inside; None when it is outside."""
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


def draw_field(canvas: Canvas, parcel: Parcel) -> None:
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
    if rows and canvas.gsd_m < ROWS_MAX_GSD_M:
        patch = cv2.add(patch, _rows(canvas, window, parcel.row_angle_rad, rows, rng), dtype=cv2.CV_8U)
    np.copyto(canvas.texture[window], patch, where=mask)


def _rows(
    canvas: Canvas, window: tuple[slice, slice], angle: float, strength: float, rng: np.random.Generator
) -> np.ndarray:
    """Crop rows and wheel tracks along ``angle`` in a window of the canvas: (h, w) int16, added to texture."""
    steps = 256  # samples of one period between two wheel tracks
    across_m = np.arange(steps) / steps * WHEEL_TRACK_SPACING_M
    row_m = WHEEL_TRACK_SPACING_M / rng.integers(7, 12)
    profile = NEUTRAL * strength * np.sin(2 * math.pi * across_m / row_m + rng.uniform(0, 6.0))
    for wheel_m in (9.5, 11.5):
        profile -= NEUTRAL * 0.16 * np.exp(-(((across_m - wheel_m) / 0.45) ** 2))
    scale = steps * canvas.gsd_m / WHEEL_TRACK_SPACING_M
    columns = np.arange(window[1].start, window[1].stop) + canvas.origin_px[0]
    rows = np.arange(window[0].start, window[0].stop) + canvas.origin_px[1]
    x = columns * (-math.sin(angle) * scale) % steps
    y = (rows * (math.cos(angle) * scale) + rng.uniform(0, steps)) % steps
    phase = (x.astype(np.float32)[None, :] + y.astype(np.float32)[:, None]).astype(np.int32) & (steps - 1)
    return np.round(profile).astype(np.int16)[phase]


def draw_lot(canvas: Canvas, lot: Parcel) -> None:
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


def draw_line(canvas: Canvas, line: Line) -> None:
    points = [canvas.px(line.points_m)]

    def stroke(colour: Bgr, width_m: float, layer: np.ndarray) -> None:
        cv2.polylines(layer, points, False, colour, max(1, round(width_m / canvas.gsd_m)), cv2.LINE_AA, SHIFT)

    verge = canvas.season.meadow
    if line.kind == "border":
        stroke(_dim(verge, 0.86), line.width_m, canvas.colour)
    elif line.kind == "track":
        stroke(verge, line.width_m + 3.0, canvas.colour)
        stroke((138, 160, 172), line.width_m, canvas.colour)
        stroke(verge, 0.9, canvas.colour)  # grass between the wheel tracks
    else:
        stroke(_dim(verge, 0.95), line.width_m + 4.0, canvas.colour)
        stroke((128, 126, 124), line.width_m, canvas.colour)
        if line.kind == "road":
            stroke((176, 178, 178), 0.4, canvas.colour)
    if line.kind != "border":
        stroke((NEUTRAL, NEUTRAL, NEUTRAL), line.width_m, canvas.texture)


def _dim(colour: Bgr, factor: float) -> Bgr:
    return round(colour[0] * factor), round(colour[1] * factor), round(colour[2] * factor)


def draw_water(canvas: Canvas, river: np.ndarray, mask: np.ndarray) -> None:
    """Draws river and lakes, also into ``mask`` (H, W) uint8."""
    centre_line, half = river[:, :2], river[:, 2:] / 2
    along = np.gradient(centre_line, axis=0)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.hypot(along[:, 0], along[:, 1])[:, None]
    for spread_m, colour in ((6.0, (56, 96, 80)), (1.5, (110, 136, 146)), (0.0, canvas.season.water)):
        half_width = half + spread_m
        outline = np.concatenate([centre_line + normal * half_width, (centre_line - normal * half_width)[::-1]])
        cv2.fillPoly(canvas.colour, [canvas.px(outline)], colour, cv2.LINE_AA, SHIFT)
    cv2.fillPoly(mask, [canvas.px(outline)], 255, cv2.LINE_AA, SHIFT)


def draw_shadows(canvas: Canvas, houses: list[House], trees: np.ndarray) -> None:
    step = np.array(canvas.sun_step)
    for house in houses:
        corners = house_corners(house)
        hull = cv2.convexHull(np.concatenate([corners, corners + step * house.height_m]).astype(np.float32))
        cv2.fillConvexPoly(canvas.shadow, canvas.px(hull.reshape(-1, 2)), 0, cv2.LINE_AA, SHIFT)
    feet, tips = canvas.px(trees[:, :2]), canvas.px(trees[:, :2] + step * trees[:, 3:4] * 0.75)
    width = np.maximum(1, np.round(trees[:, 2] * 1.7 / canvas.gsd_m).astype(int))
    for foot, tip, thickness in zip(feet.tolist(), tips.tolist(), width.tolist(), strict=True):
        cv2.line(canvas.shadow, foot, tip, 0, thickness, cv2.LINE_8, SHIFT)
    cv2.blur(canvas.shadow, (3, 3), canvas.shadow)


def house_corners(house: House) -> np.ndarray:
    """(4, 2) plan metres; the ridge runs along the first edge."""
    c, s = math.cos(house.angle_rad), math.sin(house.angle_rad)
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (house.length_m / 2, house.width_m / 2)
    return half @ np.array([[c, s], [-s, c]]) + house.centre_m
