"""Initial similarity of a submap by consensus of its absolute constraints ("anchors"), in closed form.

Every anchor proposes a similarity. Anchors that are consistent with it, given the drift of the submap, support it. The
proposal with most support is returned. The method is deterministic and does not depend on the order of the anchors."""

from dataclasses import dataclass

import numpy as np

from terrafix.core.gate import GATE
from terrafix.core.pose import ROTATION, TRANSLATION
from terrafix.smoother.submap_types import AbsoluteConstraint, Submap

PROPOSERS, PARTNERS = 16, 8  # most anchors that propose, and most partners of each for a scale: more are redundant
MIN_BASELINE_SIGMAS = 5.0  # distance of two anchors that propose a scale


@dataclass(frozen=True)
class Similarity:
    """x_w = scale * r @ x_f + shift_m."""

    r: np.ndarray  # (3, 3)
    shift_m: np.ndarray  # (3,)
    scale: float  # metres for a unit

    def position(self, p_f: np.ndarray) -> np.ndarray:
        """(..., 3) -> (..., 3)"""
        return self.scale * p_f @ self.r.T + self.shift_m


class _Anchored:
    """Anchors of one submap as arrays, with the variance of drift up to each."""

    def __init__(self, submap: Submap, anchors: list[AbsoluteConstraint]) -> None:
        index = [a.keyframe for a in anchors]
        self.r_f, self.p_f = submap.r_f_c[index], submap.p_c_in_f[index]
        self.r_w = np.array([a.r_w_c for a in anchors])
        self.p_w = np.array([a.p_c_in_w_m for a in anchors])
        covs = np.array([a.cov for a in anchors])
        self.rotation_var = np.trace(covs[:, ROTATION, ROTATION], axis1=1, axis2=2) / 3.0
        self.position_var = np.trace(covs[:, TRANSLATION, TRANSLATION], axis1=1, axis2=2) / 3.0
        steps = np.trace(submap.step_cov[:, ROTATION, ROTATION], axis1=1, axis2=2) / 3.0
        shifts = np.trace(submap.step_cov[:, TRANSLATION, TRANSLATION], axis1=1, axis2=2) / 3.0
        self.rotation_drift, self.position_drift = (_accumulated(submap.parent, v)[index] for v in (steps, shifts))
        self.scale_drift = _accumulated(submap.parent, submap.scale_walk**2)[index]
        self.scale_sigma = submap.scale_sigma

    def support(self, guess: Similarity, by: int) -> int:
        """Number of anchors that are consistent with a proposal of anchor ``by``."""
        far_m = guess.scale * np.linalg.norm(self.p_f - self.p_f[by], axis=1)
        rotation_var = np.abs(self.rotation_drift - self.rotation_drift[by]) + self.rotation_var[by]
        scale_var = np.abs(self.scale_drift - self.scale_drift[by]) + (self.scale_sigma or 0.0) ** 2
        drift = (
            guess.scale**2 * np.abs(self.position_drift - self.position_drift[by])
            + (rotation_var + scale_var) * far_m**2
        )
        off_m = guess.position(self.p_f) - self.p_w
        near = np.sum(off_m**2, axis=1) <= GATE[3] * (drift + self.position_var + self.position_var[by])
        cos = (np.einsum("nij,nij->n", self.r_w, guess.r @ self.r_f) - 1.0) / 2.0
        aligned = np.arccos(np.clip(cos, -1.0, 1.0)) ** 2 <= GATE[3] * (rotation_var + self.rotation_var)
        return int(np.sum(near & aligned))

    def proposed(self, by: int, scale: float) -> Similarity:
        """The similarity that anchor ``by`` gives with this scale."""
        r = self.r_w[by] @ self.r_f[by].T
        return Similarity(r, self.p_w[by] - scale * r @ self.p_f[by], scale)

    def scales(self, by: int) -> list[float]:
        """Scales from the distances between anchor ``by`` and others."""
        if self.scale_sigma is not None:
            return [1.0]
        there = np.linalg.norm(self.p_f - self.p_f[by], axis=1)
        here_m = np.linalg.norm(self.p_w - self.p_w[by], axis=1)
        far = np.flatnonzero(
            (here_m > MIN_BASELINE_SIGMAS * np.sqrt(self.position_var + self.position_var[by])) & (there > 0.0)
        )
        return [float(here_m[i] / there[i]) for i in _spread(far, PARTNERS)]


def place(submap: Submap, anchors: list[AbsoluteConstraint]) -> Similarity | None:
    """None where the anchors determine no place or no scale."""
    if not anchors:
        return None
    anchored = _Anchored(submap, anchors)
    best: tuple[int, Similarity] | None = None
    for by in _spread(np.arange(len(anchors)), PROPOSERS):
        for scale in anchored.scales(by):
            guess = anchored.proposed(by, scale)
            support = anchored.support(guess, by)
            if best is None or support > best[0]:
                best = support, guess
    return None if best is None else best[1]


def _spread(index: np.ndarray, most: int) -> list[int]:
    """At most ``most``, evenly spaced."""
    chosen = np.linspace(0, len(index) - 1, min(len(index), most)).round().astype(int)
    return [int(i) for i in index[chosen]]


def _accumulated(parent: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(N,) sums of ``values`` from the first keyframe on; parents come before their children."""
    sums = np.zeros(len(values))
    for i in range(1, len(values)):
        sums[i] = sums[parent[i]] + values[i]
    return sums
