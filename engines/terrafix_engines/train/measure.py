"""How well the network finds places that it was never trained on: the camera at one date, the map at another, and only
what a flight leaves open of heading, height and tilt made up. The yardstick of training; the anchor itself is asked by
`terrafix_tools.bench.two_dates --model`."""

from dataclasses import dataclass

import numpy as np
import torch

from terrafix_engines.train.losses import PLACES, places
from terrafix_engines.train.network import Describing
from terrafix_engines.train.views import MEASURED, REACH_CELLS, Sheet, draw

SEED = 5  # the same views every time


@dataclass(frozen=True)
class Measured:
    """Shares, of ``views``: the best of PLACES^2 places is the right one or beside it; the nearest tile of the batch is
    the right one."""

    views: int
    found: float
    tiles: float

    def __str__(self) -> str:
        return f"held out: {100 * self.found:.0f} % of {self.views} places found, {100 * self.tiles:.0f} % of tiles"


@torch.no_grad()
def measure(network: Describing, held_out: list[Sheet], batches: int, batch: int) -> Measured:
    network.eval()
    rng = np.random.default_rng(SEED)
    found, tiles = 0, 0
    for _ in range(batches):
        views = draw(held_out, batch, rng, MEASURED)
        camera, _, _, camera_tile = network(views.camera)
        ground, _, _, ground_tile = network(views.ground)
        best = places(camera, ground, views).flatten(1).argmax(1)
        row, column = best // PLACES - REACH_CELLS, best % PLACES - REACH_CELLS
        found += int(((row.abs() <= 1) & (column.abs() <= 1)).sum())
        right = torch.arange(batch, device=best.device)
        tiles += int(((camera_tile @ ground_tile.T).argmax(1) == right).sum())
    network.train()
    return Measured(batches * batch, found / (batches * batch), tiles / (batches * batch))
