"""Two views of one piece of ground, a camera's at one date and the map's at another, and what of one is where in which.

The camera is turned, higher or lower, tilted, off centre; what stands on the ground leans; something hides a part. For
a single cell the truth is where the map shows what the cell shows; for a whole view, where the ground is."""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from terrafix_engines.train.ground import Ground

STRIDE = 8
CAMERA_PX, MAP_PX = 256, 448
CELLS = CAMERA_PX // STRIDE
REACH_CELLS = 6  # to every side: places that are told apart when a whole view is looked for
TURN_DEG = 15.0  # heading that the anchor does not search, and some more
SCALE = 0.10
TILT = 0.12  # perspective: of the distance, from the middle to the rim
SHIFT_PX = 24.0
LEAN_PX = 6.0  # roofs against streets
ZOOM = 0.7, 1.4  # pixels of the picture to one of the view; levels are octaves apart
OTHER_DATE = 0.85  # of views of places with several dates
EMPTY = 0.05  # of a view's pixels without imagery, at most
TRIES = 20


@dataclass(frozen=True)
class Ranges:
    """How much of all that is drawn; ``MEASURED`` is what a flight leaves open, without anything made up."""

    turn_deg: float = TURN_DEG
    scale: float = SCALE
    tilt: float = TILT
    lean_px: float = LEAN_PX
    occluders: int = 3


TRAINED, MEASURED = Ranges(), Ranges(turn_deg=4.0, scale=0.05, tilt=0.03, lean_px=0.0, occluders=0)


@dataclass(frozen=True)
class Sheet:
    """A place at one scale, where it is drawn from. ``pictures`` (dates, 3, H, W) uint8 RGB."""

    name: str
    pictures: Tensor


@dataclass(frozen=True)
class Views:
    """``camera`` (B, 3, CAMERA_PX, CAMERA_PX), ``ground`` (B, 3, MAP_PX, MAP_PX), 0 to 1, RGB. ``at_px`` (B, n, n, 2):
    x, y in the ground view of the middle of each cell of the camera's, and of REACH_CELLS more on every side, by the
    ground alone; ``true_px`` (B, CELLS, CELLS, 2) with what leans, ``seen`` (B, CELLS, CELLS) bool: not hidden."""

    camera: Tensor
    ground: Tensor
    at_px: Tensor
    true_px: Tensor
    seen: Tensor


def spread_out(grounds: list[Ground], device: str) -> list[Sheet]:
    return [Sheet(ground.name, torch.from_numpy(ground.pictures).to(device)) for ground in grounds]


def draw(sheets: list[Sheet], count: int, rng: np.random.Generator, ranges: Ranges = TRAINED) -> Views:
    """``count`` pairs of views; each place is as likely as any other, whatever its size."""
    names = sorted({sheet.name for sheet in sheets})
    drawn = []
    for _ in range(count):
        name = names[rng.integers(len(names))]
        levels = [sheet for sheet in sheets if sheet.name == name]
        drawn.append(_pair(levels[rng.integers(len(levels))], rng, ranges))
    return Views(*(torch.stack(parts) for parts in zip(*drawn, strict=True)))


def _pair(sheet: Sheet, rng: np.random.Generator, ranges: Ranges) -> tuple[Tensor, ...]:
    device = sheet.pictures.device
    dates, _, height, width = sheet.pictures.shape
    first, second = int(rng.integers(dates)), int(rng.integers(dates))
    if dates > 1 and rng.random() < OTHER_DATE:
        second = (first + 1 + int(rng.integers(dates - 1))) % dates
    for _ in range(TRIES):
        zoom = float(np.exp(rng.uniform(*np.log(ZOOM))))
        half = MAP_PX / 2 * zoom * np.sqrt(0.5)  # corners may lie outside, where the rim is repeated
        centre = rng.uniform((half, half), (width - half, height - half))
        turn = rng.uniform(-np.pi, np.pi)
        onto = torch.tensor(zoom * _rotation(turn), dtype=torch.float32, device=device)
        base = torch.tensor(centre, dtype=torch.float32, device=device)
        grid = pixels(MAP_PX, device)
        map_view = _sampled(sheet.pictures[second], grid @ onto.T + base)
        if float((map_view.amax(0) == 0).float().mean()) <= EMPTY:
            break
    warp = Warp(rng, ranges)
    inner = pixels(CAMERA_PX, device)
    lean = _lean(rng, ranges, device)
    camera = _sampled(sheet.pictures[first], (warp(inner) + lean) @ onto.T + base)
    camera, hidden = _occluded(camera, rng, ranges)
    middles = F.avg_pool2d(lean.permute(2, 0, 1), STRIDE).permute(1, 2, 0)
    cells = STRIDE * pixels(CELLS + 2 * REACH_CELLS, device)
    at_px = warp(cells) + (MAP_PX - 1) / 2
    own = slice(REACH_CELLS, REACH_CELLS + CELLS)
    true_px = at_px[own, own] + middles
    inside = ((true_px > 0) & (true_px < MAP_PX - 1)).all(-1)
    covered = F.max_pool2d(hidden[None].float(), STRIDE)[0] > 0
    return camera, map_view, at_px, true_px, inside & ~covered


class Warp:
    """Pixels from the middle of the camera's view -> pixels from the middle of the ground view."""

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
    """(side, side, 2) x, y from the middle."""
    axis = torch.arange(side, dtype=torch.float32, device=device) - (side - 1) / 2
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    return torch.stack([x, y], dim=-1)


def _rotation(angle_rad: float) -> np.ndarray:
    return np.array([[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]])


def _sampled(picture: Tensor, xy: Tensor) -> Tensor:
    """(3, H, W) uint8 at pixels (h, w, 2) -> (3, h, w), 0 to 1, bilinear; only the part that is needed is converted."""
    height, width = picture.shape[1:]
    low = (xy.amin((0, 1)).floor().long() - 1).tolist()
    high = (xy.amax((0, 1)).ceil().long() + 2).tolist()
    x0, y0 = min(max(low[0], 0), width - 2), min(max(low[1], 0), height - 2)
    part = picture[:, y0 : max(high[1], y0 + 2), x0 : max(high[0], x0 + 2)].float() / 255.0
    size = torch.tensor([part.shape[2], part.shape[1]], dtype=torch.float32, device=picture.device)
    corner = torch.tensor([x0, y0], dtype=torch.float32, device=picture.device)
    where = (2.0 * (xy - corner) + 1.0) / size - 1.0
    return F.grid_sample(part[None], where[None], padding_mode="border", align_corners=False)[0]


def _lean(rng: np.random.Generator, ranges: Ranges, device: torch.device) -> Tensor:
    """(CAMERA_PX, CAMERA_PX, 2): blocks of different height, all leaning one way."""
    cells = int(rng.integers(6, 20))
    heights = rng.random((cells, cells)) * (rng.random((cells, cells)) < 0.4)
    blocks = torch.tensor(heights, dtype=torch.float32, device=device)[None, None]
    # Steeper than bilinear: walls are narrow, and roofs level.
    blocks = torch.clamp(2.0 * F.interpolate(blocks, size=(CAMERA_PX, CAMERA_PX), mode="bilinear") - 0.25, 0.0, 1.0)
    angle, most = rng.uniform(-np.pi, np.pi), rng.uniform(0.0, ranges.lean_px)
    way = torch.tensor([most * np.cos(angle), most * np.sin(angle)], dtype=torch.float32, device=device)
    return blocks[0, 0][..., None] * way


def _occluded(view: Tensor, rng: np.random.Generator, ranges: Ranges) -> tuple[Tensor, Tensor]:
    """Turned rectangles of one colour and some noise: vehicles, trees that grew, a leg of the vehicle itself."""
    grid = pixels(view.shape[-1], view.device)
    hidden = torch.zeros(view.shape[1:], dtype=torch.bool, device=view.device)
    for _ in range(int(rng.integers(ranges.occluders + 1))):
        turn = torch.tensor(_rotation(rng.uniform(-np.pi, np.pi)), dtype=torch.float32, device=view.device)
        middle = torch.tensor(rng.uniform(-CAMERA_PX / 2, CAMERA_PX / 2, 2), dtype=torch.float32, device=view.device)
        sides = torch.tensor(rng.uniform(6.0, 40.0, 2), dtype=torch.float32, device=view.device)
        here = (((grid - middle) @ turn).abs() < sides).all(-1)
        colour = torch.tensor(rng.random((3, 1, 1)), dtype=torch.float32, device=view.device)
        view = torch.where(here, 0.8 * colour + 0.2 * view.flip(1), view)
        hidden = hidden | here
    return view, hidden
