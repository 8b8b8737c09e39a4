"""Objects on the ground of a generated place, drawn on top of it: tree crowns, roofs, cars."""

import math

import cv2
import numpy as np

from terrafix_lab.sim.world.season import Bgr, Season
from terrafix_lab.sim.world.shapes import House, Line

ROOFS: tuple[Bgr, ...] = (
    (72, 86, 168),  # new tiles
    (66, 78, 138),
    (58, 66, 104),  # old tiles
    (92, 84, 84),  # slate
    (64, 68, 82),
    (148, 150, 152),  # sheet metal
    (122, 128, 136),  # fibre cement
    (96, 108, 150),
)
CARS: tuple[Bgr, ...] = ((235, 235, 235), (40, 40, 44), (60, 60, 190), (170, 120, 60), (150, 150, 150))
VARIANTS = 4  # number of different crowns per size and colour
SIZES_M = np.arange(0.75, 5.25, 0.5)  # crown radii
ROOF_COLOUR_CHANGES = 0.08  # share of the houses whose roof differs between two dates

Sprite = tuple[np.ndarray, np.ndarray]  # colours (n, n, 3) uint8, mask (n, n) bool
Sprites = list[list[list[Sprite]]]  # by kind of tree and size, the variants


def crown_sprites(
    rng: np.random.Generator, palette: tuple[tuple[Bgr, ...], ...], sun_azimuth_deg: float, gsd_m: float
) -> Sprites:
    """Crowns for every kind of tree: lit from the sun's side, with an irregular edge."""
    azimuth = math.radians(sun_azimuth_deg)
    sun = (math.sin(azimuth), -math.cos(azimuth))
    return [
        [[_crown(rng, c, sun, r / gsd_m) for c in colours for _ in range(VARIANTS)] for r in SIZES_M]
        for colours in palette
    ]


def _crown(rng: np.random.Generator, colour: Bgr, sun: tuple[float, float], radius_px: float) -> Sprite:
    reach = math.ceil(radius_px * 1.2)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1] / radius_px
    angle = np.arctan2(y, x)
    edge = 1.0 + sum(0.09 * np.sin(k * angle + rng.uniform(0, 6.3)) for k in (3, 5, 8))
    radius = np.hypot(x, y) / edge
    dome = np.sqrt(np.clip(1.0 - radius**2, 0.0, 1.0))
    light = 0.62 + 0.30 * dome + 0.38 * (x * sun[0] + y * sun[1])
    light = light * (1.0 + 0.14 * rng.normal(size=x.shape)) * rng.normal(1.0, 0.08)
    pixels = np.clip(light[..., None] * np.array(colour) * 1.1, 0, 255).astype(np.uint8)
    return pixels, radius < 1.0


def stamp_trees(image: np.ndarray, trees: np.ndarray, sprites: Sprites, gsd_m: float) -> None:
    """Draws a crown at every tree (N, 6), low ones first."""
    height, width = image.shape[:2]
    order = trees[np.argsort(trees[:, 3], kind="stable")]
    size = np.clip(np.searchsorted(SIZES_M, order[:, 2] - 0.25), 0, len(SIZES_M) - 1)
    columns, rows = (np.round(order[:, i] / gsd_m - 0.5).astype(int).tolist() for i in (0, 1))
    for x, y, kind, step, chance in zip(
        columns, rows, order[:, 4].astype(int).tolist(), size.tolist(), order[:, 5].tolist(), strict=True
    ):
        variants = sprites[kind][step]
        pixels, mask = variants[int(chance * len(variants))]
        reach = mask.shape[0] // 2
        if reach <= x < width - reach and reach <= y < height - reach:
            np.copyto(image[y - reach : y + reach + 1, x - reach : x + reach + 1], pixels, where=mask[..., None])


def stamp_houses(image: np.ndarray, houses: list[House], season: Season, gsd_m: float) -> None:
    """Draws gable roofs; the side that faces the sun is brighter."""
    azimuth = math.radians(season.sun_azimuth_deg)
    sun = np.array([math.sin(azimuth), -math.cos(azimuth)])
    for house in houses:
        chance = np.random.default_rng([house.key, season.key]).random()
        index = (house.roof + 3 if chance < ROOF_COLOUR_CHANGES else house.roof) % len(ROOFS)
        along = np.array([math.cos(house.angle_rad), math.sin(house.angle_rad)])
        across = np.array([-along[1], along[0]])
        half_length, half_width = along * house.length_m / 2, across * house.width_m / 2
        for side in (-1.0, 1.0):
            brightness = 0.92 + 0.32 * side * float(across @ sun)
            colour = [min(255, round(v * brightness)) for v in ROOFS[index]]
            edge = side * half_width
            corners = house.centre_m + np.array([-half_length, half_length, half_length + edge, -half_length + edge])
            cv2.fillConvexPoly(image, _px(corners, gsd_m), colour, cv2.LINE_AA, 4)
        chimney = house.centre_m + half_length * 0.4 + half_width * 0.3
        cv2.circle(image, _px(chimney[None], gsd_m)[0].tolist(), 12, (60, 60, 70), -1, cv2.LINE_AA, 4)


def stamp_cars(image: np.ndarray, season: Season, lines: list[Line], gsd_m: float) -> None:
    """Draws traffic, different in every season."""
    for line in lines:
        rng = np.random.default_rng([line.key, season.key])
        for start, end in zip(line.points_m[:-1], line.points_m[1:], strict=True):
            if rng.random() > 0.16:
                continue
            along = (end - start) / max(float(np.hypot(*(end - start))), 1e-6)
            across = np.array([-along[1], along[0]])
            centre = start + (end - start) * rng.random() + across * line.width_m / 4 * rng.choice([-1, 1])
            corners = centre + np.array(
                [along * 2.2 * a + across * 0.95 * b for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            )
            cv2.fillConvexPoly(image, _px(corners, gsd_m), CARS[int(rng.integers(len(CARS)))], cv2.LINE_AA, 4)


def _px(points_m: np.ndarray, gsd_m: float) -> np.ndarray:
    """Plan metres (N, 2) -> pixels with 4 sub-pixel bits (N, 2) int32."""
    return np.round((points_m / gsd_m - 0.5) * 16).astype(np.int32)
