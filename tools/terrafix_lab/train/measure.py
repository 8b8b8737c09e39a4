"""Evaluation on held-out places during the training, by the same loss; it stops the training early. Weights are judged
by `terrafix models matching` (docs/training.md)."""

from dataclasses import dataclass

import numpy as np
import torch

from terrafix_lab.train.losses import TrainingLoss
from terrafix_lab.train.network import FeatureNetwork
from terrafix_lab.train.views import EVALUATION_RANGES, ImageStack, sample_views

SEED = 5  # the same views in every evaluation


@dataclass(frozen=True)
class Evaluation:
    """``nats``: loss; ``leads``: share of views whose right place leads all wrong ones; ``margin``: mean lead, standard
    deviations."""

    nats: float
    leads: float
    margin: float

    def __str__(self) -> str:
        return f"held out: {self.nats:.3f} nats, {100 * self.leads:.0f} % lead, by {self.margin:.2f} sd"


@torch.no_grad()
def evaluate(
    network: FeatureNetwork, criterion: TrainingLoss, held_out: list[ImageStack], batches: int, batch: int
) -> Evaluation:
    network.eval()
    rng = np.random.default_rng(SEED)
    nats, margins = [], []
    for _ in range(batches):
        loss, scores = criterion(network, sample_views(held_out, batch, rng, EVALUATION_RANGES))
        nats.append(float(loss))
        margins.append(scores.margins())
    network.train()
    margin = torch.cat(margins)
    return Evaluation(float(np.mean(nats)), float((margin > 0).float().mean()), float(margin.mean()))
