"""The last frames as one template: what odometry joins is larger than a frame, and repeated less often on the map.

Frames are joined as descriptors, not as pictures: seams between exposures would look like edges. For each heading and
scale of the search the whole mosaic turns and stretches, so that only one that fits every frame agrees with the map."""

from collections.abc import Sequence

import numpy as np

from terrafix.anchor.matching.frame_matcher import Hypothesis
from terrafix.anchor.relocalization.block_search import Template

MOST_FRAMES = 8
MIN_WEIGHT = 0.5  # of a cell at the rim that belongs to some frame


class Mosaic:
    """``hypotheses``: headings and scales, the same for every frame; ``cell_m``: of all templates."""

    def __init__(self, hypotheses: Sequence[Hypothesis], cell_m: float) -> None:
        self._hypotheses = hypotheses
        self._cell_m = cell_m
        self._kept: list[tuple[np.ndarray, float, Sequence[Template]]] = []

    def add(
        self, p_m: np.ndarray, var_m2: float, templates: Sequence[Template], most_sigma_m: float, most_away_m: float
    ) -> None:
        """``p_m`` (2,): where odometry has the camera (east, north), from anywhere, and ``var_m2`` what its error has
        grown to since; one template per hypothesis. Frames that lie off by more than ``most_sigma_m``, or farther away
        than ``most_away_m``, are left out."""
        self._kept = [
            kept
            for kept in self._kept
            if var_m2 - kept[1] <= most_sigma_m**2 and np.hypot(*(p_m - kept[0])) <= most_away_m
        ][1 - MOST_FRAMES :]
        self._kept.append((p_m.copy(), var_m2, templates))

    @property
    def length_m(self) -> float:
        """From the newest frame to the farthest one that is joined to it."""
        return max((float(np.hypot(*(self._kept[-1][0] - p_m))) for p_m, _, _ in self._kept), default=0.0)

    def templates(self) -> list[Template]:
        """All frames as seen from the last one, one template per hypothesis, on the cells of the map."""
        return [self._joined(k, h) for k, h in enumerate(self._hypotheses)]

    def _joined(self, k: int, hypothesis: Hypothesis) -> Template:
        last_m = self._kept[-1][0]
        c, s = float(np.cos(hypothesis.yaw_rad)), float(np.sin(hypothesis.yaw_rad))
        turn = hypothesis.scale * np.array([[c, -s], [s, c]])
        parts: list[tuple[int, int, np.ndarray, np.ndarray]] = []
        for p_m, _, templates in self._kept:
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
    """(..., h, w) -> (..., h + 1, w + 1), moved by fractions of a cell."""
    h, w = x.shape[-2:]
    out = np.zeros((*x.shape[:-2], h + 1, w + 1), np.float32)
    for r, share_r in ((0, 1.0 - down), (1, down)):
        for c, share_c in ((0, 1.0 - right), (1, right)):
            out[..., r : r + h, c : c + w] += share_r * share_c * x
    return out
