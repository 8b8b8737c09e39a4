"""The loop: draws views, changes their weather, teaches; keeps what it has, so that it can go on where it was stopped.

Views and weather of a step follow from the seed and the step alone: what was stopped and goes on sees what it would
have seen. On a CPU the result is the same bit for bit; a GPU adds gradients in any order."""

import math
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from terrafix_engines.train.errors import TrainingError
from terrafix_engines.train.losses import WEIGHTS, Teacher
from terrafix_engines.train.measure import Measured, measure
from terrafix_engines.train.network import Describing
from terrafix_engines.train.views import Sheet, Views, draw
from terrafix_engines.train.weather import changed

RATE, WARM_UP_SHARE, DECAY, MOST_GRADIENT = 1e-3, 0.05, 1e-2, 1.0
KEPT_EVERY_S, SAID_EVERY_S = 60.0, 10.0
MEASURED_EVERY = 20  # times that something is said
SMOOTH = 0.95  # of the losses that are said


@dataclass(frozen=True)
class Recipe:
    """All that decides what comes out, besides the pictures. ``steps``: after them the learning rate is zero."""

    steps: int
    batch: int
    width: int
    seed: int
    trained_on: tuple[str, ...]
    held_out: tuple[str, ...]


@dataclass(frozen=True)
class Said:
    step: int
    losses: dict[str, float]
    steps_per_s: float
    measured: Measured | None


class Training:
    def __init__(
        self, recipe: Recipe, trained: list[Sheet], held_out: list[Sheet], checkpoint: Path, device: str
    ) -> None:
        """Goes on from ``checkpoint`` where there is one. Raises TrainingError."""
        torch.manual_seed(recipe.seed)
        self.recipe, self.device, self.step = recipe, device, 0
        self._trained, self._held_out, self._checkpoint = trained, held_out, checkpoint
        self.network, self._teacher = Describing(recipe.width).to(device), Teacher().to(device)
        self._all = [*self.network.parameters(), *self._teacher.parameters()]
        self._optimiser = torch.optim.AdamW(self._all, lr=RATE, weight_decay=DECAY)
        if checkpoint.exists():
            self._load()

    def run(self, seconds: float) -> Iterator[Said]:
        """Until ``seconds`` are over, or all steps done. What is yielded is for people."""
        began_s = said_s = kept_s = time.monotonic()
        smooth: dict[str, float] = {}
        said, said_step, begun_step = 0, self.step, self.step
        self.network.train()
        while self.step < self.recipe.steps and time.monotonic() - began_s < seconds:
            for name, value in self._teach().items():
                smooth[name] = SMOOTH * smooth.get(name, value) + (1 - SMOOTH) * value
            now_s = time.monotonic()
            if now_s - said_s >= SAID_EVERY_S or self.step == begun_step + 1:
                pace = (self.step - said_step) / max(now_s - said_s, 1e-6)
                yield Said(self.step, dict(smooth), pace, self.measure() if said % MEASURED_EVERY == 0 else None)
                said, said_step, said_s = said + 1, self.step, time.monotonic()
            if now_s - kept_s >= KEPT_EVERY_S:
                self.keep()
                kept_s = now_s
        self.keep()
        yield Said(self.step, smooth, 0.0, self.measure(batches=8))

    def measure(self, batches: int = 2) -> Measured:
        return measure(self.network, self._held_out, batches, self.recipe.batch)

    def keep(self) -> None:
        """Whole or not at all: a checkpoint that was cut off would be the end of the run."""
        part = self._checkpoint.with_suffix(".part")
        torch.save(
            {
                "recipe": asdict(self.recipe),
                "step": self.step,
                "network": self.network.state_dict(),
                "teacher": self._teacher.state_dict(),
                "optimiser": self._optimiser.state_dict(),
            },
            part,
        )
        part.replace(self._checkpoint)

    def _load(self) -> None:
        kept: dict[str, Any] = torch.load(self._checkpoint, map_location=self.device, weights_only=True)
        if kept.get("recipe") != asdict(self.recipe):
            raise TrainingError(f"{self._checkpoint}: of another recipe; choose another --out, or the options it had")
        self.network.load_state_dict(kept["network"])
        self._teacher.load_state_dict(kept["teacher"])
        self._optimiser.load_state_dict(kept["optimiser"])
        self.step = kept["step"]

    def _teach(self) -> dict[str, float]:
        rng = np.random.default_rng((self.recipe.seed, self.step))
        g = torch.Generator(self.device).manual_seed(self.recipe.seed * 1_000_003 + self.step)
        for group in self._optimiser.param_groups:
            group["lr"] = RATE * rate_at(self.step, self.recipe.steps)
        with torch.no_grad():
            views = in_other_weather(draw(self._trained, self.recipe.batch, rng), g)
        losses = self._teacher.losses(self.network, views, g)
        total = torch.stack([WEIGHTS[name] * loss for name, loss in losses.items()]).sum()
        self._optimiser.zero_grad()
        total.backward()
        torch.nn.utils.clip_grad_norm_(self._all, MOST_GRADIENT)
        self._optimiser.step()
        self.step += 1
        values = torch.stack([loss.detach() for loss in losses.values()]).tolist()
        if not all(math.isfinite(value) for value in values):
            raise TrainingError(f"step {self.step}: a loss is not a number; the last checkpoint is {self._checkpoint}")
        return dict(zip(losses, values, strict=True))


def in_other_weather(views: Views, g: torch.Generator) -> Views:
    """Each view for itself."""
    return replace(views, camera=changed(views.camera, g), ground=changed(views.ground, g))


def rate_at(step: int, steps: int) -> float:
    """Rises over WARM_UP_SHARE of the steps, then falls to zero as a cosine."""
    rise = min((step + 1) / (WARM_UP_SHARE * steps), 1.0)
    return rise * 0.5 * (1.0 + math.cos(math.pi * min(step / steps, 1.0)))
