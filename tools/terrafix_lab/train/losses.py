"""Training losses: cell descriptors, places, tile descriptors, keypoints, reliability.

Cells: dual softmax over all cells of all pairs (LoFTR, Sun et al., CVPR 2021; XFeat, Potje et al., CVPR 2024); cells
adjacent to the true one are excluded. Places: likelihood of the true offset among all offsets around it, with the same
correlation as in the matcher (Barsan et al., Learning to localize using a LiDAR intensity map, CoRL 2018; OrienterNet,
Sarlin et al., CVPR 2023); the hard negatives are the offsets where false peaks occur in flight. Tiles: InfoNCE (van den
Oord et al., 2018)."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from terrafix_lab.train.network import STRIDE, FeatureNetwork
from terrafix_lab.train.views import CELLS, MAP_PX, REACH_CELLS, Views
from terrafix_lab.train.weather import brightness

CELLS_PER_PAIR = 96  # random cells per pair; memory grows with the square
NEIGHBOUR_CELLS = 1.5  # cells: nearer ones are neither positive nor negative
MIN_CORNER = 0.01  # minimum corner strength of a cell with a keypoint
WEIGHTS = {"cells": 1.0, "places": 1.0, "tiles": 0.3, "trust": 0.1, "keypoints": 0.1}
PLACES = 2 * REACH_CELLS + 1


class TrainingLoss(nn.Module):
    """All losses, with three learnt temperatures."""

    def __init__(self) -> None:
        super().__init__()
        self.log_scales = nn.Parameter(torch.log(torch.tensor([20.0, 20.0, 10.0])))

    def losses(self, network: FeatureNetwork, views: Views, g: torch.Generator) -> dict[str, Tensor]:
        """Loss values with the keys of ``WEIGHTS``."""
        scales = self.log_scales.clamp(max=4.6).exp()  # at most 100
        on_gpu = views.camera.device.type == "cuda"
        with torch.autocast(views.camera.device.type, torch.bfloat16, enabled=on_gpu):
            outputs = *network(views.camera), *network(views.ground)
        camera, logits, trust, camera_tile, ground, _, _, ground_tile = (output.float() for output in outputs)
        chosen = _choose_cells(views.seen, g)
        one = camera.flatten(2).transpose(1, 2)[chosen]
        other = sample_cells(ground, views.true_px).flatten(2).transpose(1, 2)[chosen]
        table = scales[0] * one @ other.T
        pair = torch.nonzero(chosen)[:, 0]
        at = views.true_px.flatten(1, 2)[chosen] / STRIDE
        neighbour = (pair[:, None] == pair[None, :]) & (torch.cdist(at, at) < NEIGHBOUR_CELLS)
        neighbour.fill_diagonal_(False)
        table = table.masked_fill(neighbour, -1e4)
        rows, columns = table.log_softmax(1).diagonal(), table.log_softmax(0).diagonal()
        matched = (rows + columns).detach().exp()
        tiles = scales[2] * camera_tile @ ground_tile.T
        every = torch.arange(len(tiles), device=tiles.device)
        return {
            "cells": -(rows + columns).mean() / 2,
            "places": F.cross_entropy(
                scales[1] * places(camera, ground, views).flatten(1),
                torch.full((len(camera),), PLACES**2 // 2, device=camera.device),
            ),
            "tiles": (F.cross_entropy(tiles, every) + F.cross_entropy(tiles.T, every)) / 2,
            "trust": F.binary_cross_entropy(trust.flatten(1)[chosen].clamp(1e-4, 1 - 1e-4), matched),
            "keypoints": F.cross_entropy(logits, corners(views.camera)),
        }


def places(camera: Tensor, ground: Tensor, views: Views) -> Tensor:
    """Correlation (B, PLACES, PLACES) of the camera view with the map, per cell; the true offset is in the centre."""
    around = sample_cells(ground, views.at_px)
    weight = views.seen[:, None].float()
    count = weight.sum((2, 3), keepdim=True).clamp(min=1.0)
    centred = (camera - (camera * weight).sum((2, 3), keepdim=True) / count) * weight / count
    b, c = centred.shape[:2]
    found = F.conv2d(around.reshape(1, b * c, *around.shape[2:]), centred, groups=b)
    return found[0]


def sample_cells(cells: Tensor, at_px: Tensor) -> Tensor:
    """Samples (B, C, h, w) of the ground view at its pixels (B, n, n, 2) -> (B, C, n, n); zero outside of it."""
    return F.grid_sample(cells, (2.0 * at_px + 1.0) / MAP_PX - 1.0, align_corners=False)


def corners(view: Tensor) -> Tensor:
    """(B, CELLS, CELLS) long: index of a cell's strongest corner (Shi and Tomasi, 1994) in its 64 pixels; 64: none."""
    luma = F.pad(brightness(view), (1, 1, 1, 1), mode="reflect")
    dx = (luma[:, :, 1:-1, 2:] - luma[:, :, 1:-1, :-2]) / 2
    dy = (luma[:, :, 2:, 1:-1] - luma[:, :, :-2, 1:-1]) / 2
    xx, yy, xy = (F.avg_pool2d(one, 5, 1, 2) for one in (dx * dx, dy * dy, dx * dy))
    smaller = (xx + yy) / 2 - torch.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    best, which = F.pixel_unshuffle(smaller, STRIDE).max(dim=1)
    return torch.where(best > MIN_CORNER**2, which, torch.full_like(which, STRIDE**2))


def _choose_cells(seen: Tensor, g: torch.Generator) -> Tensor:
    """(B, CELLS * CELLS) bool: CELLS_PER_PAIR random visible cells of each pair."""
    random_key = torch.rand(len(seen), CELLS**2, generator=g, device=seen.device) * seen.flatten(1)
    threshold = random_key.topk(CELLS_PER_PAIR, dim=1).values[:, -1:]
    return (random_key >= threshold) & (random_key > 0)
