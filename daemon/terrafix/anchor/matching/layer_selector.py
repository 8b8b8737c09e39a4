"""Which layer of a map the frames are looked at with: learnt in flight, from pairs of looks at the same ground.

Layers are other dates of a place: crops, snow and houses change, and no date says which one looks like today. Two
frames that fit two layers differently well say little about them, for the places differ too; one frame at one place
does. So now and then a second layer is looked at beside the one in use, and what is learnt is the difference."""

import math
from collections.abc import Mapping, Sequence

PAIRS = 3.0  # full looks at a layer beside the best one before it may take its place
LEAD = 0.5  # of the mean difference, standardised correlation: frames at the right place score 3 to 10
SPREAD = 1.0  # of the difference from frame to frame, 1 sigma: 0.6 to 1.0 between three summers of farmland
MEMORY = 10.0  # full looks that a difference remembers: the ground changes along the way
PROBE_EVERY = 8.0  # full looks between two pairs, once every layer was tried
POOR_SCORE = 2.0  # below this the layer in use may be the reason: ask another one each time


class LayerChoice:
    """``tables``: of the layers, the one to begin with first (``LocalMap.layers`` has the newest first).

    Say with what to look: ``wanted``; then what came of it: ``looked``."""

    def __init__(self, tables: Sequence[str]) -> None:
        self.best = tables[0]
        self._others = {table: _Difference() for table in tables[1:]}
        self._since_pair = 0.0
        self._poor = False

    def wanted(self) -> tuple[str, ...]:
        """Layers to look at with the next frame: the best one, and now and then another one beside it."""
        if not self._others:
            return (self.best,)
        table, least = min(self._others.items(), key=lambda item: item[1].looks)  # the first of equals
        due = least.looks < PAIRS or self._poor or self._since_pair >= PROBE_EVERY
        if due and least.looks >= PAIRS:  # all are known: the one that was asked longest ago
            table = max(self._others, key=lambda name: self._others[name].age)
        return (self.best, table) if due else (self.best,)

    def looked(self, scores: Mapping[str, float | None], weight: float) -> str | None:
        """``scores``: standardised correlation at the believed place, in each layer that was looked at; None: it has
        nothing there. ``weight``: 1 for new ground, less for ground that was just seen.

        Returns the layer to use for this frame: ``best`` as it is now, or the other one where that has nothing; None
        when none of them has anything."""
        mine = scores.get(self.best)
        self._poor = mine is None or mine < POOR_SCORE
        pair = False
        for table, difference in self._others.items():
            difference.age += weight
            other = scores.get(table)
            if mine is not None and other is not None:
                difference.add(other - mine, weight)
                pair = True
        self._since_pair = 0.0 if pair else self._since_pair + weight
        leader = max(self._others, key=lambda name: self._others[name].mean, default=None)
        if leader is not None and self._others[leader].is_better():
            self._take(leader)
        there = {table: score for table, score in scores.items() if score is not None}
        return self.best if self.best in there else max(there, key=lambda name: there[name], default=None)

    def _take(self, table: str) -> None:
        """Every difference is against the best layer: all of them move with it."""
        taken = self._others.pop(table)
        for difference in self._others.values():
            difference.mean -= taken.mean
        self._others[self.best] = _Difference(-taken.mean, taken.looks, 0.0)
        self.best = table


class _Difference:
    """Mean of how much better a layer fits than the best one, with a bounded memory."""

    def __init__(self, mean: float = 0.0, looks: float = 0.0, age: float = 0.0) -> None:
        self.mean, self.looks, self.age = mean, looks, age

    def add(self, difference: float, weight: float) -> None:
        self.looks = min(self.looks + weight, MEMORY)
        self.mean += (difference - self.mean) * weight / self.looks
        self.age = 0.0

    def is_better(self) -> bool:
        """By more than chance: a change of layers is also one of their errors of position."""
        return self.looks >= PAIRS and self.mean > LEAD + SPREAD / math.sqrt(self.looks)
