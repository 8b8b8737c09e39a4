"""Synthetic pairs of views of the same ground, camera and map of different dates, with the true correspondences.

The camera view is rotated, scaled, tilted and shifted; objects are displaced by relief; occluders hide a part. The
truth of a cell is where the map shows the content of the cell; the truth of a whole view is where the ground is."""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from terrafix_lab.train.ground import TrainingGround

STRIDE = 8
CAMERA_PX, MAP_PX = 256, 448
CELLS = CAMERA_PX // STRIDE
REACH_CELLS = 6  # in all directions: offsets that the place loss distinguishes
MAX_TURN_DEG = 15.0  # heading error: that which the matcher does not search, plus a margin
SCALE = 0.10
TILT = 0.12  # perspective: relative change of distance from the centre to the edge
SHIFT_PX = 24.0
RELIEF_PX = 6.0  # relief displacement of roofs relative to streets
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
    relief_px: float = RELIEF_PX
    occluders: int = 3


TRAINING_RANGES, EVALUATION_RANGES = Ranges(), Ranges(turn_deg=4.0, scale=0.05, tilt=0.03, relief_px=0.0, occluders=0)


@dataclass(frozen=True)
class ImageStack:
    """A place at one scale as a tensor on the training device. ``pictures`` (dates, 3, H, W) uint8 RGB."""

    name: str
    pictures: Tensor


@dataclass(frozen=True)
class Views:
    """``camera`` (B, 3, CAMERA_PX, CAMERA_PX), ``ground`` (B, 3, MAP_PX, MAP_PX), RGB, 0 to 1.

    ``at_px`` (B, n, n, 2): x, y in the ground view of the centre of each camera cell and of REACH_CELLS more in every
    direction, for flat ground; ``true_px`` (B, CELLS, CELLS, 2): the same with relief displacement; ``seen`` (B, CELLS,
    CELLS) bool: not occluded."""

    camera: Tensor
    ground: Tensor
    at_px: Tensor
    true_px: Tensor
    seen: Tensor


def to_device(grounds: list[TrainingGround], device: str) -> list[ImageStack]:
    return [ImageStack(ground.name, torch.from_numpy(ground.pictures).to(device)) for ground in grounds]


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
    return Views(*(torch.stack(parts) for parts in zip(*drawn, strict=True)))


def _sample_pair(stack: ImageStack, rng: np.random.Generator, ranges: Ranges) -> tuple[Tensor, ...]:
    device = stack.pictures.device
    dates, _, height, width = stack.pictures.shape
    first, second = int(rng.integers(dates)), int(rng.integers(dates))
    if dates > 1 and rng.random() < OTHER_DATE_FRACTION:
        second = (first + 1 + int(rng.integers(dates - 1))) % dates
    for _ in range(MAX_TRIES):
        zoom = float(np.exp(rng.uniform(*np.log(ZOOM))))
        half = MAP_PX / 2 * zoom * np.sqrt(0.5)  # corners may lie outside, where the edge is repeated
        centre = rng.uniform((half, half), (width - half, height - half))
        turn = rng.uniform(-np.pi, np.pi)
        onto = torch.tensor(zoom * _rotation(turn), dtype=torch.float32, device=device)
        base = torch.tensor(centre, dtype=torch.float32, device=device)
        grid = pixels(MAP_PX, device)
        map_view = _sample(stack.pictures[second], grid @ onto.T + base)
        if float((map_view.amax(0) == 0).float().mean()) <= MAX_EMPTY:
            break
    warp = ViewWarp(rng, ranges)
    inner = pixels(CAMERA_PX, device)
    relief = _relief_displacement(rng, ranges, device)
    camera = _sample(stack.pictures[first], (warp(inner) + relief) @ onto.T + base)
    camera, hidden = _add_occluders(camera, rng, ranges)
    cell_relief = F.avg_pool2d(relief.permute(2, 0, 1), STRIDE).permute(1, 2, 0)
    cells = STRIDE * pixels(CELLS + 2 * REACH_CELLS, device)
    at_px = warp(cells) + (MAP_PX - 1) / 2
    own = slice(REACH_CELLS, REACH_CELLS + CELLS)
    true_px = at_px[own, own] + cell_relief
    inside = ((true_px > 0) & (true_px < MAP_PX - 1)).all(-1)
    covered = F.max_pool2d(hidden[None].float(), STRIDE)[0] > 0
    return camera, map_view, at_px, true_px, inside & ~covered


class ViewWarp:
    """Pixels relative to the centre of the camera view -> pixels relative to the centre of the ground view."""

    def __init__(self, rng: np.random.Generator, ranges: Ranges) -> None:
        scale = 1.0 + rng.uniform(-ranges.scale, ranges.scale)
        self._linear = scale * _rotation(np.radians(rng.uniform(-ranges.turn_deg, ranges.turn_deg)))
        self._tilt = rng.uniform(-ranges.tilt, ranges.tilt, 2) / (CAMERA_PX / 2)
        self._shift = rng.uniform(-SHIFT_PX, SHIFT_PX, 2)

    def __call__(self, xy: Tensor) -> Tensor:
        linear, tilt, shift = (
            torch.tensor(a, dtype=xy.dtype, device=xy.device) for a in (self._linear, self._tilt, self._shift)
        )
        return (xy @ linear.T) / (1.0 + xy @ tilt)[..., None] + shift


def pixels(side: int, device: torch.device) -> Tensor:
    """(side, side, 2): x, y relative to the centre."""
    axis = torch.arange(side, dtype=torch.float32, device=device) - (side - 1) / 2
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    return torch.stack([x, y], dim=-1)


def _rotation(angle_rad: float) -> np.ndarray:
    return np.array([[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]])


def _sample(image: Tensor, xy: Tensor) -> Tensor:
    """Bilinear sampling: (3, H, W) uint8 at pixels (h, w, 2) -> (3, h, w), 0 to 1. Converts the needed part only."""
    height, width = image.shape[1:]
    low = (xy.amin((0, 1)).floor().long() - 1).tolist()
    high = (xy.amax((0, 1)).ceil().long() + 2).tolist()
    x0, y0 = min(max(low[0], 0), width - 2), min(max(low[1], 0), height - 2)
    part = image[:, y0 : max(high[1], y0 + 2), x0 : max(high[0], x0 + 2)].float() / 255.0
    size = torch.tensor([part.shape[2], part.shape[1]], dtype=torch.float32, device=image.device)
    corner = torch.tensor([x0, y0], dtype=torch.float32, device=image.device)
    where = (2.0 * (xy - corner) + 1.0) / size - 1.0
    return F.grid_sample(part[None], where[None], padding_mode="border", align_corners=False)[0]


def _relief_displacement(rng: np.random.Generator, ranges: Ranges, device: torch.device) -> Tensor:
    """Relief displacement (CAMERA_PX, CAMERA_PX, 2) px: blocks of random height, displaced in one direction."""
    cells = int(rng.integers(6, 20))
    heights = rng.random((cells, cells)) * (rng.random((cells, cells)) < 0.4)
    blocks = torch.tensor(heights, dtype=torch.float32, device=device)[None, None]
    # Steeper than bilinear interpolation, because walls are narrow and roofs are flat.
    blocks = torch.clamp(2.0 * F.interpolate(blocks, size=(CAMERA_PX, CAMERA_PX), mode="bilinear") - 0.25, 0.0, 1.0)
    angle, relief_max_px = rng.uniform(-np.pi, np.pi), rng.uniform(0.0, ranges.relief_px)
    displacement = torch.tensor(
        [relief_max_px * np.cos(angle), relief_max_px * np.sin(angle)], dtype=torch.float32, device=device
    )
    return blocks[0, 0][..., None] * displacement


def _add_occluders(view: Tensor, rng: np.random.Generator, ranges: Ranges) -> tuple[Tensor, Tensor]:
    """Adds rotated rectangles of one colour plus noise, such as vehicles, new trees, the vehicle's own landing gear.

    -> the view and (H, W) bool: occluded."""
    grid = pixels(view.shape[-1], view.device)
    hidden = torch.zeros(view.shape[1:], dtype=torch.bool, device=view.device)
    for _ in range(int(rng.integers(ranges.occluders + 1))):
        turn = torch.tensor(_rotation(rng.uniform(-np.pi, np.pi)), dtype=torch.float32, device=view.device)
        centre = torch.tensor(rng.uniform(-CAMERA_PX / 2, CAMERA_PX / 2, 2), dtype=torch.float32, device=view.device)
        sides = torch.tensor(rng.uniform(6.0, 40.0, 2), dtype=torch.float32, device=view.device)
        here = (((grid - centre) @ turn).abs() < sides).all(-1)
        colour = torch.tensor(rng.random((3, 1, 1)), dtype=torch.float32, device=view.device)
        view = torch.where(here, 0.8 * colour + 0.2 * view.flip(1), view)
        hidden = hidden | here
    return view, hidden
