"""Selection of the map layer with which the frames are correlated, learned in flight from paired scores at the same
ground.

Layers are images of one place from other dates. Crops, snow and houses change, and the date does not tell which layer
resembles today's ground. Scores of two different frames are not comparable, because their places differ; two layers
scored with one frame at one place are. Therefore a second layer is correlated from time to time beside the one in use,
and the mean difference of the scores is estimated.
"""

import math
from collections.abc import Mapping, Sequence

MIN_LAYER_PAIRS = 3.0  # paired observations (full new ground) of a layer before it may replace the one in use [tuned]
# mean difference of the standardised correlation that a replacement needs; frames at the right place score 3 to 10
# [tuned]
MIN_SCORE_LEAD = 0.5
# 1-sigma of the difference between frames: 0.6 to 1.0 over three summers of farmland [measured: this comment]
DIFFERENCE_SIGMA = 1.0
MAX_WEIGHT_SUM = 10.0  # effective number of observations in the mean; the ground changes along the flight [tuned]
PROBE_INTERVAL = 8.0  # observations between two pairs once every layer has been tried [tuned]
# Standardised correlation at the mode below which the layer in use may be the cause, so that another one is tried with
# every frame; a frame at the right place has 3 to 10. [tuned]
POOR_SCORE = 2.0


class LayerSelector:
    """``tables``: names of the layers, the initial one first (``LocalMap.layers`` has the newest first).

    Call ``layers_to_correlate`` before a frame and ``update`` with the scores after it.
    """

    def __init__(self, tables: Sequence[str]) -> None:
        self.best = tables[0]
        self._others = {table: _Difference() for table in tables[1:]}
        self._since_pair = 0.0
        self._poor = False

    def layers_to_correlate(self) -> tuple[str, ...]:
        """Layers to correlate with the next frame: the best one, from time to time a second one."""
        if not self._others:
            return (self.best,)
        table, least = min(self._others.items(), key=lambda item: item[1].weight_sum)  # ties: the first one
        due = least.weight_sum < MIN_LAYER_PAIRS or self._poor or self._since_pair >= PROBE_INTERVAL
        if due and least.weight_sum >= MIN_LAYER_PAIRS:  # all have enough pairs: the one that was tried longest ago
            table = max(self._others, key=lambda name: self._others[name].age)
        return (self.best, table) if due else (self.best,)

    def update(self, scores: Mapping[str, float | None], weight: float) -> str | None:
        """``scores``: standardised correlation at the believed position in each layer that was correlated; None: that
        layer has no data there. ``weight``: share of new ground, 0 to 1.

        Returns the layer to use for this frame: ``best`` after the update, another one if ``best`` has no data there,
        None if no layer has.
        """
        best_score = scores.get(self.best)
        self._poor = best_score is None or best_score < POOR_SCORE
        pair = False
        for table, difference in self._others.items():
            difference.age += weight
            other = scores.get(table)
            if best_score is not None and other is not None:
                difference.add(other - best_score, weight)
                pair = True
        self._since_pair = 0.0 if pair else self._since_pair + weight
        leader = max(self._others, key=lambda name: self._others[name].mean, default=None)
        if leader is not None and self._others[leader].is_better():
            self._switch_to(leader)
        available = {table: score for table, score in scores.items() if score is not None}
        return self.best if self.best in available else max(available, key=lambda name: available[name], default=None)

    def _switch_to(self, table: str) -> None:
        """Makes ``table`` the best layer. All differences are relative to the best layer, so they shift with it."""
        new_best = self._others.pop(table)
        for difference in self._others.values():
            difference.mean -= new_best.mean
        self._others[self.best] = _Difference(-new_best.mean, new_best.weight_sum, 0.0)
        self.best = table


class _Difference:
    """Mean score of a layer relative to the best one, with bounded memory."""

    def __init__(self, mean: float = 0.0, weight_sum: float = 0.0, age: float = 0.0) -> None:
        self.mean, self.weight_sum, self.age = mean, weight_sum, age

    def add(self, difference: float, weight: float) -> None:
        self.weight_sum = min(self.weight_sum + weight, MAX_WEIGHT_SUM)
        self.mean += (difference - self.mean) * weight / self.weight_sum
        self.age = 0.0

    def is_better(self) -> bool:
        """Whether the mean exceeds ``MIN_SCORE_LEAD`` by one standard error. A change of layers also changes the
        position error of the map."""
        return self.weight_sum >= MIN_LAYER_PAIRS and self.mean > MIN_SCORE_LEAD + DIFFERENCE_SIGMA / math.sqrt(
            self.weight_sum
        )
