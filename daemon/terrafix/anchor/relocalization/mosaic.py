"""Mosaic of the last frames as one template. It is larger than a frame, so fewer places of the map resemble it.

Frames are joined as descriptors: in a joined image the exposure seams would appear as edges. For each yaw and scale of
the search the whole mosaic is rotated and scaled, so that only the right one agrees with the map in every frame.
"""

from collections.abc import Sequence

import numpy as np

from terrafix.anchor.matching.frame_matcher import Hypothesis
from terrafix.anchor.relocalization.block_search import Template

MAX_MOSAIC_FRAMES = 8  # frames in a mosaic [tuned]
MIN_WEIGHT = 0.5  # smallest weight of a cell at the border that belongs to some frame [tuned]


class Mosaic:
    """``hypotheses``: yaws and scales, the same for every frame; ``cell_m``: cell size of all templates."""

    def __init__(self, hypotheses: Sequence[Hypothesis], cell_m: float) -> None:
        self._hypotheses = hypotheses
        self._cell_m = cell_m
        self._frames: list[tuple[np.ndarray, float, Sequence[Template]]] = []

    def add(
        self, p_m: np.ndarray, var_m2: float, templates: Sequence[Template], max_sigma_m: float, max_distance_m: float
    ) -> None:
        """Adds a frame, one template per hypothesis, and drops old ones.

        ``p_m`` (2,): camera position by odometry, east and north from any origin; ``var_m2``: accumulated variance of
        odometry. Frames with a relative 1-sigma above ``max_sigma_m`` or a distance above ``max_distance_m`` are
        dropped.
        """
        self._frames = [
            frame
            for frame in self._frames
            if var_m2 - frame[1] <= max_sigma_m**2 and np.hypot(*(p_m - frame[0])) <= max_distance_m
        ][1 - MAX_MOSAIC_FRAMES :]
        self._frames.append((p_m.copy(), var_m2, templates))

    @property
    def length_m(self) -> float:
        """Distance from the newest frame to the farthest one of the mosaic."""
        return max((float(np.hypot(*(self._frames[-1][0] - p_m))) for p_m, _, _ in self._frames), default=0.0)

    def templates(self) -> list[Template]:
        """All frames relative to the newest one, one template per hypothesis, on the cells of the map."""
        return [self._joined(k, h) for k, h in enumerate(self._hypotheses)]

    def _joined(self, k: int, hypothesis: Hypothesis) -> Template:
        last_m = self._frames[-1][0]
        c, s = float(np.cos(hypothesis.yaw_rad)), float(np.sin(hypothesis.yaw_rad))
        turn = hypothesis.scale * np.array([[c, -s], [s, c]])
        parts: list[tuple[int, int, np.ndarray, np.ndarray]] = []
        for p_m, _, templates in self._frames:
            part = templates[k]
            e_m, n_m = turn @ (p_m - last_m)
            row, column = -(part.n_max_m + n_m) / self._cell_m, (part.e_min_m + e_m) / self._cell_m
            r, q = int(np.floor(row)), int(np.floor(column))
            descriptors, weight = (
                _shifted(x, row - r, column - q) for x in (part.descriptors * part.mask, part.mask.astype(np.float32))
            )
            parts.append((r, q, descriptors, weight))
        top, left = min(p[0] for p in parts), min(p[1] for p in parts)
        height = max(r + weight.shape[0] for r, _, _, weight in parts) - top
        width = max(c + weight.shape[1] for _, c, _, weight in parts) - left
        total = np.zeros((len(parts[0][2]), height, width), np.float32)
        count = np.zeros((height, width), np.float32)
        for r, c, descriptors, weight in parts:
            at = (slice(r - top, r - top + weight.shape[0]), slice(c - left, c - left + weight.shape[1]))
            total[(slice(None), *at)] += descriptors
            count[at] += weight
        return Template(total / np.maximum(count, 1e-6), count > MIN_WEIGHT, left * self._cell_m, -top * self._cell_m)


def _shifted(x: np.ndarray, down: float, right: float) -> np.ndarray:
    """(..., h, w) -> (..., h + 1, w + 1), shifted by fractions of a cell with bilinear weights."""
    h, w = x.shape[-2:]
    out = np.zeros((*x.shape[:-2], h + 1, w + 1), np.float32)
    for r, share_r in ((0, 1.0 - down), (1, down)):
        for c, share_c in ((0, 1.0 - right), (1, right)):
            out[..., r : r + h, c : c + w] += share_r * share_c * x
    return out
