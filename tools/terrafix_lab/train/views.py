"""Synthetic pairs of views of the same ground, camera and map of different dates, with the true place.

The map view is a window of the map. The camera view is what rectification of a frame on a level plane gives: turned,
scaled and shifted by the errors of the prediction; seen from the side by up to MAX_TILT_DEG, through the pixels of an
oblique image, with ground and roofs displaced by their height; with occluders."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from terrafix_lab.train.ground import TrainingGround

STRIDE = 4  # pixels of a cell
CAMERA_PX, MAP_PX = 192, 320
CELLS, MAP_CELLS = CAMERA_PX // STRIDE, MAP_PX // STRIDE
OFFSETS = MAP_CELLS - CELLS + 1  # places of the camera view in the map view, per axis
AGL_PX = 170.0  # height of the camera above ground in pixels of a view: the matcher's cells are about 1/43 of it
MAX_TURN_DEG = 9.0  # heading error: that which the matcher does not search, plus a margin
SCALE = 0.08
TILT = 0.06  # perspective: relative change of distance from the centre to the edge
SHIFT_PX = 56.0
MAX_TILT_DEG, OBLIQUE_SHARE = 45.0, 0.35  # of the camera from straight down, and the share of such views
OBLIQUE_PX, OBLIQUE_FOCAL_PX = 256, 200.0  # side of the image and its focal length
ROOFS = 0.09  # largest height of blocks above the ground, shares of AGL_PX
ZOOM = 0.7, 1.4  # image pixels per view pixel; scale levels are octaves apart
OTHER_DATE_FRACTION = 0.85  # fraction of views with two different dates, for places with several dates
MAX_EMPTY = 0.05  # maximum fraction of a view's pixels without imagery
MAX_TRIES = 20


@dataclass(frozen=True)
class Ranges:
    """Ranges of the random transformations; ``EVALUATION_RANGES`` contains the errors of a real flight only."""

    turn_deg: float = MAX_TURN_DEG
    scale: float = SCALE
    tilt: float = TILT
    oblique_share: float = OBLIQUE_SHARE
    roofs: float = ROOFS
    occluders: int = 3


TRAINING_RANGES = Ranges()
EVALUATION_RANGES = Ranges(turn_deg=4.0, scale=0.04, tilt=0.03, oblique_share=0.15, roofs=0.05, occluders=1)


@dataclass(frozen=True)
class ImageStack:
    """A place at one scale on the training device: tensors of ``TrainingGround``."""

    name: str
    pictures: Tensor
    heights_px: Tensor | None = None


@dataclass(frozen=True)
class Views:
    """``camera`` (B, 3, CAMERA_PX, CAMERA_PX), ``ground`` (B, 3, MAP_PX, MAP_PX), RGB, 0 to 1; ``mask`` (CELLS, CELLS)
    float: cells that the camera sees, of all views; ``place`` (B, 2): row and column, in cells, of the corner of the
    camera view in the map view."""

    camera: Tensor
    ground: Tensor
    mask: Tensor
    place: Tensor


def to_device(grounds: list[TrainingGround], device: str) -> list[ImageStack]:
    return [
        ImageStack(
            ground.name,
            torch.from_numpy(ground.pictures).to(device),
            None if ground.heights_px is None else torch.from_numpy(ground.heights_px).to(device),
        )
        for ground in grounds
    ]


def sample_views(
    stacks: list[ImageStack], count: int, rng: np.random.Generator, ranges: Ranges = TRAINING_RANGES
) -> Views:
    """``count`` pairs of views; each place has the same probability, independent of its size."""
    names = sorted({stack.name for stack in stacks})
    drawn = []
    for _ in range(count):
        name = names[rng.integers(len(names))]
        levels = [stack for stack in stacks if stack.name == name]
        drawn.append(_sample_pair(levels[rng.integers(len(levels))], rng, ranges))
    camera, ground, place = (torch.stack(parts) for parts in zip(*drawn, strict=True))
    return Views(camera, ground, _footprint(rng, camera.device), place)


def _sample_pair(stack: ImageStack, rng: np.random.Generator, ranges: Ranges) -> tuple[Tensor, Tensor, Tensor]:
    device = stack.pictures.device
    dates, _, height, width = stack.pictures.shape
    first, second = int(rng.integers(dates)), int(rng.integers(dates))
    if dates > 1 and rng.random() < OTHER_DATE_FRACTION:
        second = (first + 1 + int(rng.integers(dates - 1))) % dates
    for _ in range(MAX_TRIES):
        largest = max(min(height, width) / (1.15 * MAP_PX), ZOOM[0])
        zoom = float(np.exp(rng.uniform(np.log(ZOOM[0]), np.log(min(ZOOM[1], largest)))))
        half = min(MAP_PX / 2 * zoom * 1.15, min(height, width) / 2)  # corners may lie outside, the edge is repeated
        centre = rng.uniform((half, half), (width - half + 1e-6, height - half + 1e-6))
        onto = torch.tensor(zoom * _rotation(rng.uniform(-np.pi, np.pi)), dtype=torch.float32, device=device)
        base = torch.tensor(centre, dtype=torch.float32, device=device)
        map_view = _sample(stack.pictures[second], pixels(MAP_PX, device) @ onto.T + base)
        if float((map_view.amax(0) == 0).float().mean()) <= MAX_EMPTY:
            break
    warp = ViewWarp(rng, ranges)
    oblique = ObliqueView(rng, ranges)
    blocks = _blocks(rng, ranges, device)

    def height_px(xy: Tensor) -> Tensor:
        """Height above the plane, in view pixels, at pixels (h, w, 2) of the camera view."""
        roofs = F.grid_sample(blocks, (xy / (CAMERA_PX / 2))[None], align_corners=False)[0, 0]
        if stack.heights_px is None:
            return roofs
        terrain = _sample(stack.heights_px[None], warp(xy) @ onto.T + base)[0] / zoom
        return roofs + terrain - terrain.mean()

    def seen(xy: Tensor) -> Tensor:
        """Content (3, h, w) that rectification on the plane shows at pixels of the camera view."""
        return _sample(stack.pictures[first], warp(oblique.displaced(xy, height_px(xy))) @ onto.T + base)

    camera = _add_occluders(oblique.rectified(seen, device), rng, ranges)
    corner = (MAP_CELLS - CELLS) / 2 + warp.shift_px[::-1] / STRIDE
    return camera, map_view, torch.tensor(corner.copy(), dtype=torch.float32, device=device)


class ViewWarp:
    """Pixels relative to the centre of the camera view -> pixels relative to the centre of the ground view."""

    def __init__(self, rng: np.random.Generator, ranges: Ranges) -> None:
        scale = 1.0 + rng.uniform(-ranges.scale, ranges.scale)
        self._linear = scale * _rotation(np.radians(rng.uniform(-ranges.turn_deg, ranges.turn_deg)))
        self._tilt = rng.uniform(-ranges.tilt, ranges.tilt, 2) / (CAMERA_PX / 2)
        self.shift_px = rng.uniform(-SHIFT_PX, SHIFT_PX, 2)

    def __call__(self, xy: Tensor) -> Tensor:
        linear, tilt, shift = (
            torch.tensor(a, dtype=xy.dtype, device=xy.device) for a in (self._linear, self._tilt, self.shift_px)
        )
        return (xy @ linear.T) / (1.0 + xy @ tilt)[..., None] + shift


class ObliqueView:
    """A camera above the plane that looks at the centre of the view, tilted to a random side."""

    def __init__(self, rng: np.random.Generator, ranges: Ranges) -> None:
        is_oblique = rng.random() < ranges.oblique_share
        self._tilt_rad = np.radians(rng.uniform(10.0, MAX_TILT_DEG) if is_oblique else rng.uniform(0.0, 5.0))
        side_rad = rng.uniform(-np.pi, np.pi)
        self._side = np.array([np.cos(side_rad), np.sin(side_rad)])  # from the nadir point to the centre of the view
        self._is_oblique = is_oblique

    def displaced(self, xy: Tensor, height_px: Tensor) -> Tensor:
        """Where on the ground the content is that the plane shows at ``xy``: nearer to the nadir point by height."""
        nadir = torch.tensor(self._side * AGL_PX * np.tan(self._tilt_rad), dtype=xy.dtype, device=xy.device)
        return xy - (xy + nadir) * (height_px / AGL_PX).clamp(-0.5, 0.5)[..., None]

    def rectified(self, seen: Callable[[Tensor], Tensor], device: torch.device) -> Tensor:
        """The camera view (3, CAMERA_PX, CAMERA_PX) of ``seen``; an oblique one by way of the pixels of its image."""
        grid = pixels(CAMERA_PX, device)
        if not self._is_oblique:
            return seen(grid)
        # Axes along the tilt (a) and across (b); the camera's axis meets the plane in the centre.
        along = torch.tensor(self._side, dtype=torch.float32, device=device)
        across = torch.stack([-along[1], along[0]])
        sin, cos = float(np.sin(self._tilt_rad)), float(np.cos(self._tilt_rad))
        slant = AGL_PX / cos
        uv = pixels(OBLIQUE_PX, device) / OBLIQUE_FOCAL_PX
        # ray = axis + u * up-in-image + v * across; plane at depth AGL_PX
        depth = AGL_PX / (cos - uv[..., 0] * sin).clamp(min=0.2)
        a = depth * (sin + uv[..., 0] * cos) - AGL_PX * float(np.tan(self._tilt_rad))
        b = depth * uv[..., 1]
        image = seen(a[..., None] * along + b[..., None] * across)
        ga, gb = grid @ along, grid @ across
        depth_of = slant + ga * sin
        u, v = OBLIQUE_FOCAL_PX * ga * cos / depth_of, OBLIQUE_FOCAL_PX * gb / depth_of
        where = torch.stack([u, v], dim=-1) / (OBLIQUE_PX / 2)
        return F.grid_sample(image[None], where[None], padding_mode="border", align_corners=False)[0]


def pixels(side: int, device: torch.device) -> Tensor:
    """(side, side, 2): x, y relative to the centre."""
    axis = torch.arange(side, dtype=torch.float32, device=device) - (side - 1) / 2
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    return torch.stack([x, y], dim=-1)


def _footprint(rng: np.random.Generator, device: torch.device) -> Tensor:
    """(CELLS, CELLS) float, 1 where a frame of random heading and aspect lies; not all of it is in the square."""
    turned = pixels(CELLS, device) @ torch.tensor(_rotation(rng.uniform(-np.pi, np.pi)), dtype=torch.float32)
    half = torch.tensor([CELLS * rng.uniform(0.45, 0.65), CELLS * rng.uniform(0.27, 0.45)], dtype=torch.float32)
    return (turned.abs() <= half).all(-1).float().to(device)


def _rotation(angle_rad: float) -> np.ndarray:
    return np.array([[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]])


def _sample(image: Tensor, xy: Tensor) -> Tensor:
    """Bilinear sampling: (C, H, W) at pixels (h, w, 2) -> (C, h, w), uint8 as 0 to 1. Converts the needed part only."""
    height, width = image.shape[1:]
    low = (xy.amin((0, 1)).floor().long() - 1).tolist()
    high = (xy.amax((0, 1)).ceil().long() + 2).tolist()
    x0, y0 = min(max(low[0], 0), width - 2), min(max(low[1], 0), height - 2)
    part = image[:, y0 : max(high[1], y0 + 2), x0 : max(high[0], x0 + 2)].float()
    part = part / 255.0 if image.dtype == torch.uint8 else part
    size = torch.tensor([part.shape[2], part.shape[1]], dtype=torch.float32, device=image.device)
    corner = torch.tensor([x0, y0], dtype=torch.float32, device=image.device)
    where = (2.0 * (xy - corner) + 1.0) / size - 1.0
    return F.grid_sample(part[None], where[None], padding_mode="border", align_corners=False)[0]


def _blocks(rng: np.random.Generator, ranges: Ranges, device: torch.device) -> Tensor:
    """Blocks of random height (1, 1, 192, 192) over the camera view, view pixels."""
    cells = int(rng.integers(6, 20))
    heights = rng.random((cells, cells)) * (rng.random((cells, cells)) < 0.4)
    blocks = torch.tensor(heights, dtype=torch.float32, device=device)[None, None]
    # Steeper than bilinear interpolation, because walls are narrow and roofs are flat.
    blocks = torch.clamp(2.0 * F.interpolate(blocks, size=(CAMERA_PX, CAMERA_PX), mode="bilinear") - 0.25, 0.0, 1.0)
    return blocks * (AGL_PX * rng.uniform(0.0, ranges.roofs))


def _add_occluders(view: Tensor, rng: np.random.Generator, ranges: Ranges) -> Tensor:
    """Adds rotated rectangles of one colour plus noise, such as vehicles, new trees, the vehicle's own landing gear."""
    grid = pixels(view.shape[-1], view.device)
    for _ in range(int(rng.integers(ranges.occluders + 1))):
        turn = torch.tensor(_rotation(rng.uniform(-np.pi, np.pi)), dtype=torch.float32, device=view.device)
        centre = torch.tensor(rng.uniform(-CAMERA_PX / 2, CAMERA_PX / 2, 2), dtype=torch.float32, device=view.device)
        sides = torch.tensor(rng.uniform(4.0, 28.0, 2), dtype=torch.float32, device=view.device)
        here = (((grid - centre) @ turn).abs() < sides).all(-1)
        colour = torch.tensor(rng.random((3, 1, 1)), dtype=torch.float32, device=view.device)
        view = torch.where(here, 0.8 * colour + 0.2 * view.flip(1), view)
    return view
