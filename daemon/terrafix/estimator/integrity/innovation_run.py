"""Fixes that are not believed one by one, as offsets from the estimate: what they say when they agree."""

from dataclasses import dataclass, field

import numpy as np

AGREE_M = 15.0  # from their mean


@dataclass
class InnovationRun:
    """Of fixes in a row, each ``offset`` (east, north) from the estimate of its frame."""

    offsets_m: list[np.ndarray] = field(default_factory=list)
    poses: int = 0  # of them; the others are coarse
    _began_at_m: np.ndarray = field(default_factory=lambda: np.zeros(2))
    _reached_m: float = 0.0

    def add(self, offset_m: np.ndarray, here_m: np.ndarray, *, coarse: bool) -> bool:
        """One more, with the estimate at ``here_m``. -> whether it agrees with the row; else it begins a new one."""
        if self.offsets_m and float(np.hypot(*(offset_m - np.mean(self.offsets_m, axis=0)))) > AGREE_M:
            self.clear()
        agrees = bool(self.offsets_m)
        if not agrees:
            self._began_at_m = here_m
        self.offsets_m.append(offset_m)
        self.poses += not coarse
        self._reached_m = float(np.hypot(*(here_m - self._began_at_m)))
        return agrees

    def holds(self, count: int, over_m: float, *, poses: bool = False) -> bool:
        """So many agree (so many ``poses``), over so much way that they are not one mistake seen again and again."""
        return (self.poses if poses else len(self.offsets_m)) >= count and self._reached_m > over_m

    def clear(self) -> None:
        self.offsets_m, self.poses, self._reached_m = [], 0, 0.0
