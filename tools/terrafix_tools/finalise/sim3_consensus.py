"""Where a fragment lies by most of its anchors: a first place for the merge, in closed form.

Every anchor proposes where the fragment is, and those that the fragment's own drift allows agree with it. The proposal
on which most agree wins; there is no chance in it, and the order of the anchors plays no part."""

from dataclasses import dataclass

import numpy as np

from terrafix.core.gate import GATE
from terrafix_tools.finalise.submap_types import AbsoluteConstraint, Submap

PROPOSERS, PARTNERS = 16, 8  # anchors that propose, and others against which each proposes a scale: more say the same
SCALE_BASE = 5.0  # two anchors propose a scale when they are so many of their sigmas apart


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
    """The anchors of one fragment as arrays, with the drift that lies between any two of them."""

    def __init__(self, fragment: Submap, anchors: list[AbsoluteConstraint]) -> None:
        index = [a.keyframe for a in anchors]
        self.r_f, self.p_f = fragment.r_f_c[index], fragment.p_c_in_f[index]
        self.r_w = np.array([a.r_w_c for a in anchors])
        self.p_w = np.array([a.p_c_in_w_m for a in anchors])
        covs = np.array([a.cov for a in anchors])
        self.turn_var = np.trace(covs[:, :3, :3], axis1=1, axis2=2) / 3.0
        self.place_var = np.trace(covs[:, 3:, 3:], axis1=1, axis2=2) / 3.0
        steps = np.trace(fragment.step_cov[:, :3, :3], axis1=1, axis2=2) / 3.0
        shifts = np.trace(fragment.step_cov[:, 3:, 3:], axis1=1, axis2=2) / 3.0
        self.turned, self.shifted = (_along(fragment.parent, v)[index] for v in (steps, shifts))
        self.stretched = _along(fragment.parent, np.full(len(fragment), fragment.scale_walk**2))[index]
        self.scale_sigma = fragment.scale_sigma

    def agreeing(self, guess: Similarity, by: int) -> int:
        """How many agree with a place that anchor ``by`` proposed."""
        far_m = guess.scale * np.linalg.norm(self.p_f - self.p_f[by], axis=1)
        turn_var = np.abs(self.turned - self.turned[by]) + self.turn_var[by]
        stretch_var = np.abs(self.stretched - self.stretched[by]) + (self.scale_sigma or 0.0) ** 2
        drift = guess.scale**2 * np.abs(self.shifted - self.shifted[by]) + (turn_var + stretch_var) * far_m**2
        off_m = guess.position(self.p_f) - self.p_w
        near = np.sum(off_m**2, axis=1) <= GATE[3] * (drift + self.place_var + self.place_var[by])
        cos = (np.einsum("nij,nij->n", self.r_w, guess.r @ self.r_f) - 1.0) / 2.0
        aligned = np.arccos(np.clip(cos, -1.0, 1.0)) ** 2 <= GATE[3] * (turn_var + self.turn_var)
        return int(np.sum(near & aligned))

    def proposed(self, by: int, scale: float) -> Similarity:
        r = self.r_w[by] @ self.r_f[by].T
        return Similarity(r, self.p_w[by] - scale * r @ self.p_f[by], scale)

    def scales(self, by: int) -> list[float]:
        """What the way from anchor ``by`` to others says of the unit."""
        if self.scale_sigma is not None:
            return [1.0]
        there = np.linalg.norm(self.p_f - self.p_f[by], axis=1)
        here_m = np.linalg.norm(self.p_w - self.p_w[by], axis=1)
        far = np.flatnonzero((here_m > SCALE_BASE * np.sqrt(self.place_var + self.place_var[by])) & (there > 0.0))
        return [float(here_m[i] / there[i]) for i in _spread(far, PARTNERS)]


def place(fragment: Submap, anchors: list[AbsoluteConstraint]) -> Similarity | None:
    """None when they do not say where it is, or how large."""
    if not anchors:
        return None
    seen = _Anchored(fragment, anchors)
    best: tuple[int, Similarity] | None = None
    for by in _spread(np.arange(len(anchors)), PROPOSERS):
        for scale in seen.scales(by):
            guess = seen.proposed(by, scale)
            support = seen.agreeing(guess, by)
            if best is None or support > best[0]:
                best = support, guess
    return None if best is None else best[1]


def _spread(index: np.ndarray, most: int) -> list[int]:
    """At most so many, evenly over all."""
    chosen = np.linspace(0, len(index) - 1, min(len(index), most)).round().astype(int)
    return [int(i) for i in index[chosen]]


def _along(parent: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(N,) sums of ``values`` from the first keyframe on; parents come before their children."""
    sums = np.zeros(len(values))
    for i in range(1, len(values)):
        sums[i] = sums[parent[i]] + values[i]
    return sums
