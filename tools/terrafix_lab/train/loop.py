"""Training loop: samples views, augments them, takes optimiser steps, saves checkpoints, keeps the best weights.

The views and augmentations of a step depend on the seed and the step number only, so a resumed run continues with the
same data. On a CPU the result is bit-identical; a GPU sums gradients in varying order."""

import copy
import math
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from terrafix_lab.train.errors import TrainingError
from terrafix_lab.train.losses import TrainingLoss
from terrafix_lab.train.network import FeatureNetwork
from terrafix_lab.train.views import EVALUATION_RANGES, ImageStack, Views, sample_views
from terrafix_lab.train.weather import augment

LEARNING_RATE, WARM_UP_SHARE, WEIGHT_DECAY, MAX_GRADIENT_NORM = 2e-3, 0.05, 1e-2, 1.0
CHECKPOINT_EVERY_S = 60.0
REPORT_EVERY, EVALUATION_EVERY = 25, 250  # steps
EVALUATION_VIEWS, EVALUATION_SEED = 96, 5  # the same views in every evaluation
PATIENCE = 8  # evaluations without a better one after which the training stops
LOSS_SMOOTHING = 0.98  # exponential smoothing of the reported loss


@dataclass(frozen=True)
class Recipe:
    """Everything except the images that determines the result. ``steps``: the learning rate is zero after these."""

    steps: int
    batch: int
    width: int
    seed: int
    trained_on: tuple[str, ...]
    held_out: tuple[str, ...]


@dataclass(frozen=True)
class Progress:
    step: int
    nats: float
    steps_per_s: float
    held_out_nats: float | None  # loss on the held-out places


class Training:
    def __init__(
        self, recipe: Recipe, trained: list[ImageStack], held_out: list[ImageStack], checkpoint: Path, device: str
    ) -> None:
        """Resumes from ``checkpoint`` if it exists. Raises TrainingError."""
        torch.manual_seed(recipe.seed)
        self.recipe, self.device, self.step = recipe, device, 0
        self._trained, self._held_out, self._checkpoint = trained, held_out, checkpoint
        self.network, self._criterion = FeatureNetwork(recipe.width).to(device), TrainingLoss().to(device)
        self._all = [*self.network.parameters(), *self._criterion.parameters()]
        self._optimiser = torch.optim.AdamW(self._all, lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)
        self._best_nats, self._best_step = math.inf, 0
        self._best = copy.deepcopy(self.network.state_dict())
        if checkpoint.exists():
            self._load()

    @property
    def is_over(self) -> bool:
        """Whether all steps are done, or PATIENCE evaluations brought nothing better."""
        return self.step >= self.recipe.steps or self.step - self._best_step >= PATIENCE * EVALUATION_EVERY

    def best_network(self) -> FeatureNetwork:
        """The weights that were best on the held-out places."""
        network = FeatureNetwork(self.recipe.width)
        network.load_state_dict(self._best)
        return network

    def run(self, seconds: float) -> Iterator[Progress]:
        """Trains for ``seconds`` or until it is over; yields progress reports."""
        start_s = report_s = checkpoint_s = time.monotonic()
        smoothed: float | None = None
        self.network.train()
        while not self.is_over and time.monotonic() - start_s < seconds:
            nats = self._train_step()
            smoothed = nats if smoothed is None else LOSS_SMOOTHING * smoothed + (1 - LOSS_SMOOTHING) * nats
            if self.step % REPORT_EVERY == 0:
                pace = REPORT_EVERY / max(time.monotonic() - report_s, 1e-6)
                yield Progress(self.step, smoothed, pace, self._judge() if self.step % EVALUATION_EVERY == 0 else None)
                report_s = time.monotonic()
            if time.monotonic() - checkpoint_s >= CHECKPOINT_EVERY_S:
                self.save_checkpoint()
                checkpoint_s = time.monotonic()
        nats = self._judge()
        self.save_checkpoint()
        yield Progress(self.step, smoothed or 0.0, 0.0, nats)

    def _judge(self) -> float:
        """-> the loss on the held-out places; keeps the weights if it is the least."""
        nats = self._held_out_nats()
        if nats < self._best_nats:
            self._best_nats, self._best_step = nats, self.step
            self._best = copy.deepcopy(self.network.state_dict())
        return nats

    @torch.no_grad()
    def _held_out_nats(self) -> float:
        self.network.eval()
        rng, batch = np.random.default_rng(EVALUATION_SEED), self.recipe.batch
        g = torch.Generator(self.device).manual_seed(EVALUATION_SEED)
        # With other weather, as in training: without it the loss is near zero before the weights are good, and the best
        # of them is one of chance. [measured: docs/decisions/074-weights-that-ship.md]
        batches = [
            self._criterion(
                self.network, augment_views(sample_views(self._held_out, batch, rng, EVALUATION_RANGES), g)
            )[0]
            for _ in range(max(EVALUATION_VIEWS // batch, 1))
        ]
        self.network.train()
        return float(torch.stack(batches).mean())

    def save_checkpoint(self) -> None:
        """Writes the checkpoint atomically, because a truncated one could not be resumed."""
        part = self._checkpoint.with_suffix(".part")
        torch.save(
            {
                "recipe": asdict(self.recipe),
                "step": self.step,
                "network": self.network.state_dict(),
                "teacher": self._criterion.state_dict(),
                "optimiser": self._optimiser.state_dict(),
                "best": (self._best_nats, self._best_step, self._best),
            },
            part,
        )
        part.replace(self._checkpoint)

    def _load(self) -> None:
        saved: dict[str, Any] = torch.load(self._checkpoint, map_location=self.device, weights_only=True)
        if saved.get("recipe") != asdict(self.recipe):
            raise TrainingError(
                f"{self._checkpoint}: was made with other options; choose another --out, or use the same options"
            )
        self.network.load_state_dict(saved["network"])
        self._criterion.load_state_dict(saved["teacher"])
        self._optimiser.load_state_dict(saved["optimiser"])
        self.step = saved["step"]
        self._best_nats, self._best_step, self._best = saved["best"]

    def _train_step(self) -> float:
        rng = np.random.default_rng((self.recipe.seed, self.step))
        g = torch.Generator(self.device).manual_seed(self.recipe.seed * 1_000_003 + self.step)
        for group in self._optimiser.param_groups:
            group["lr"] = LEARNING_RATE * learning_rate_factor(self.step, self.recipe.steps)
        with torch.no_grad():
            views = augment_views(sample_views(self._trained, self.recipe.batch, rng), g)
        loss, _ = self._criterion(self.network, views)
        self._optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self._all, MAX_GRADIENT_NORM)
        self._optimiser.step()
        self.step += 1
        nats = float(loss.detach())
        if not math.isfinite(nats):
            raise TrainingError(
                f"step {self.step}: the loss is not a number; the last checkpoint is {self._checkpoint}"
            )
        return nats


def augment_views(views: Views, g: torch.Generator) -> Views:
    """Augments both views independently."""
    return replace(views, camera=augment(views.camera, g), ground=augment(views.ground, g))


def learning_rate_factor(step: int, steps: int) -> float:
    """Learning rate schedule: linear warm-up over WARM_UP_SHARE of the steps, then a cosine to zero; factor 0 to 1."""
    rise = min((step + 1) / (WARM_UP_SHARE * steps), 1.0)
    return rise * 0.5 * (1.0 + math.cos(math.pi * min(step / steps, 1.0)))
