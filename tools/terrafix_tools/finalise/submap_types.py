"""Pieces of a flight that hang together by what was seen, and what ties them to the world and to each other."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Submap:
    """Keyframes in a frame and a unit of their own.

    ``r_f_c`` (N, 3, 3) and ``p_c_in_f`` (N, 3): the cameras. ``parent`` (N,): the keyframe against which each was
    measured, before it in the order; -1 for the first. ``step_cov`` (N, 6, 6): of each in its parent, tangent order
    (rotation, translation), in the own unit. ``scale_sigma``: the unit is a metre to this share; None: nobody knows
    how long it is. ``scale_walk``: by what share it changes from a keyframe to the next, 1-sigma."""

    r_f_c: np.ndarray
    p_c_in_f: np.ndarray
    parent: np.ndarray
    step_cov: np.ndarray
    scale_sigma: float | None
    scale_walk: float

    def __len__(self) -> int:
        return len(self.parent)

    def steps(self) -> tuple[np.ndarray, np.ndarray]:
        """Each keyframe in its parent: (N, 3, 3) and (N, 3), own unit; those of the first mean nothing."""
        r_parent = self.r_f_c[self.parent]
        r = np.einsum("nji,njk->nik", r_parent, self.r_f_c)
        p = np.einsum("nji,nj->ni", r_parent, self.p_c_in_f - self.p_c_in_f[self.parent])
        return r, p


@dataclass(frozen=True)
class AbsoluteConstraint:
    """A map fix: the camera of a keyframe in the world, with its covariance (6, 6), tangent order, metres."""

    fragment: int
    keyframe: int
    r_w_c: np.ndarray  # (3, 3)
    p_c_in_w_m: np.ndarray  # (3,)
    cov: np.ndarray


@dataclass(frozen=True)
class RelativeConstraint:
    """A relocalisation: keyframe ``second`` of one fragment seen from keyframe ``first`` of another.

    ``first`` and ``second``: (fragment, keyframe). ``p_b_in_a`` (3,) and ``cov`` (6, 6) are in the unit of the first;
    ``ratio``: units of the first in one of the second, known to the share ``ratio_sigma``."""

    first: tuple[int, int]
    second: tuple[int, int]
    r_a_b: np.ndarray
    p_b_in_a: np.ndarray
    cov: np.ndarray
    ratio: float
    ratio_sigma: float


@dataclass(frozen=True)
class SubmapPose:
    """A fragment in the world: ``r_w_c`` (N, 3, 3), ``p_c_in_w_m`` (N, 3), ``cov`` (N, 6, 6) of each keyframe, tangent
    order, metres; ``m_per_unit`` (N,)."""

    r_w_c: np.ndarray
    p_c_in_w_m: np.ndarray
    cov: np.ndarray
    m_per_unit: np.ndarray


@dataclass(frozen=True)
class MergedSubmaps:
    """``placements``: of every fragment, None for one that nothing places. ``why``: for those, one line each.
    ``anchors`` (A,) and ``joins`` (J,), bool: which were believed."""

    placements: list[SubmapPose | None]
    why: list[str]
    anchors: np.ndarray
    joins: np.ndarray
