"""Evaluation on held-out places: camera image and map of different dates, with the pose errors of a flight (heading,
height, tilt) only. It tracks the training; `terrafix models bench` and flights evaluate the weights."""

from dataclasses import dataclass

import numpy as np
import torch

from terrafix_lab.train.losses import PLACES, places
from terrafix_lab.train.network import FeatureNetwork
from terrafix_lab.train.views import EVALUATION_RANGES, REACH_CELLS, ImageStack, sample_views

SEED = 5  # the same views in every evaluation


@dataclass(frozen=True)
class Evaluation:
    """Fractions of ``views``. ``found``: the best of PLACES^2 offsets is the true one or adjacent to it; ``tiles``: the
    nearest tile descriptor of the batch is the true one."""

    views: int
    found: float
    tiles: float

    def __str__(self) -> str:
        return f"held out: {100 * self.found:.0f} % of {self.views} places found, {100 * self.tiles:.0f} % of tiles"


@torch.no_grad()
def evaluate(network: FeatureNetwork, held_out: list[ImageStack], batches: int, batch: int) -> Evaluation:
    network.eval()
    rng = np.random.default_rng(SEED)
    found, tiles = 0, 0
    for _ in range(batches):
        views = sample_views(held_out, batch, rng, EVALUATION_RANGES)
        camera, _, _, camera_tile = network(views.camera)
        ground, _, _, ground_tile = network(views.ground)
        best = places(camera, ground, views).flatten(1).argmax(1)
        row, column = best // PLACES - REACH_CELLS, best % PLACES - REACH_CELLS
        found += int(((row.abs() <= 1) & (column.abs() <= 1)).sum())
        right = torch.arange(batch, device=best.device)
        tiles += int(((camera_tile @ ground_tile.T).argmax(1) == right).sum())
    network.train()
    return Evaluation(batches * batch, found / (batches * batch), tiles / (batches * batch))
