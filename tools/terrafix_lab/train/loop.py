"""Training loop: samples views, augments them, takes optimiser steps, saves checkpoints.

The views and augmentations of a step depend on the seed and the step number only, so a resumed run continues with the
same data. On a CPU the result is bit-identical; a GPU sums gradients in varying order."""

import math
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from terrafix_lab.train.errors import TrainingError
from terrafix_lab.train.losses import WEIGHTS, TrainingLoss
from terrafix_lab.train.measure import Evaluation, evaluate
from terrafix_lab.train.network import FeatureNetwork
from terrafix_lab.train.views import ImageStack, Views, sample_views
from terrafix_lab.train.weather import augment

LEARNING_RATE, WARM_UP_SHARE, WEIGHT_DECAY, MAX_GRADIENT_NORM = 1e-3, 0.05, 1e-2, 1.0
CHECKPOINT_EVERY_S, REPORT_EVERY_S = 60.0, 10.0
EVALUATION_EVERY = 20  # progress reports per evaluation
LOSS_SMOOTHING = 0.95  # exponential smoothing of the reported losses


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
    losses: dict[str, float]
    steps_per_s: float
    evaluation: Evaluation | None


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
        if checkpoint.exists():
            self._load()

    def run(self, seconds: float) -> Iterator[Progress]:
        """Trains for ``seconds`` or until all steps are done; yields progress reports."""
        start_s = report_s = checkpoint_s = time.monotonic()
        smoothed: dict[str, float] = {}
        reports, report_step, start_step = 0, self.step, self.step
        self.network.train()
        while self.step < self.recipe.steps and time.monotonic() - start_s < seconds:
            for name, value in self._train_step().items():
                smoothed[name] = LOSS_SMOOTHING * smoothed.get(name, value) + (1 - LOSS_SMOOTHING) * value
            now_s = time.monotonic()
            if now_s - report_s >= REPORT_EVERY_S or self.step == start_step + 1:
                pace = (self.step - report_step) / max(now_s - report_s, 1e-6)
                yield Progress(
                    self.step, dict(smoothed), pace, self.evaluate() if reports % EVALUATION_EVERY == 0 else None
                )
                reports, report_step, report_s = reports + 1, self.step, time.monotonic()
            if now_s - checkpoint_s >= CHECKPOINT_EVERY_S:
                self.save_checkpoint()
                checkpoint_s = now_s
        self.save_checkpoint()
        yield Progress(self.step, smoothed, 0.0, self.evaluate(batches=8))

    def evaluate(self, batches: int = 2) -> Evaluation:
        return evaluate(self.network, self._held_out, batches, self.recipe.batch)

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

    def _train_step(self) -> dict[str, float]:
        rng = np.random.default_rng((self.recipe.seed, self.step))
        g = torch.Generator(self.device).manual_seed(self.recipe.seed * 1_000_003 + self.step)
        for group in self._optimiser.param_groups:
            group["lr"] = LEARNING_RATE * learning_rate_factor(self.step, self.recipe.steps)
        with torch.no_grad():
            views = augment_views(sample_views(self._trained, self.recipe.batch, rng), g)
        losses = self._criterion.losses(self.network, views, g)
        total = torch.stack([WEIGHTS[name] * loss for name, loss in losses.items()]).sum()
        self._optimiser.zero_grad()
        total.backward()
        torch.nn.utils.clip_grad_norm_(self._all, MAX_GRADIENT_NORM)
        self._optimiser.step()
        self.step += 1
        values = torch.stack([loss.detach() for loss in losses.values()]).tolist()
        if not all(math.isfinite(value) for value in values):
            raise TrainingError(f"step {self.step}: a loss is not a number; the last checkpoint is {self._checkpoint}")
        return dict(zip(losses, values, strict=True))


def augment_views(views: Views, g: torch.Generator) -> Views:
    """Augments both views independently."""
    return replace(views, camera=augment(views.camera, g), ground=augment(views.ground, g))


def learning_rate_factor(step: int, steps: int) -> float:
    """Learning rate schedule: linear warm-up over WARM_UP_SHARE of the steps, then a cosine to zero; factor 0 to 1."""
    rise = min((step + 1) / (WARM_UP_SHARE * steps), 1.0)
    return rise * 0.5 * (1.0 + math.cos(math.pi * min(step / steps, 1.0)))
