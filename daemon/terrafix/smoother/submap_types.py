"""Submaps of a flight, and the constraints that tie them to the world and to each other."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Submap:
    """Keyframes connected by odometry, in a frame f and a unit of length of their own.

    ``r_f_c`` (N, 3, 3) and ``p_c_in_f`` (N, 3): the cameras. ``parent`` (N,): index of the keyframe that each was
    measured against, which comes before it; -1 for the first. ``step_cov`` (N, 6, 6): covariance of each in its parent,
    tangent order (rotation, translation), in the own unit. ``scale_sigma``: 1-sigma of the unit in metres, as a share;
    None: the scale is unknown. ``scale_walk`` (N,): 1-sigma of its change from the parent to each, as a share."""

    r_f_c: np.ndarray
    p_c_in_f: np.ndarray
    parent: np.ndarray
    step_cov: np.ndarray
    scale_sigma: float | None
    scale_walk: np.ndarray

    def __len__(self) -> int:
        return len(self.parent)

    def steps(self) -> tuple[np.ndarray, np.ndarray]:
        """Each keyframe in its parent: (N, 3, 3) and (N, 3), own unit; the first entry is undefined."""
        r_parent = self.r_f_c[self.parent]
        r = np.einsum("nji,njk->nik", r_parent, self.r_f_c)
        p = np.einsum("nji,nj->ni", r_parent, self.p_c_in_f - self.p_c_in_f[self.parent])
        return r, p


@dataclass(frozen=True)
class AbsoluteConstraint:
    """A map match: camera pose of a keyframe in the world, with covariance (6, 6), tangent order, metres. ``submap``:
    its index."""

    submap: int
    keyframe: int
    r_w_c: np.ndarray  # (3, 3)
    p_c_in_w_m: np.ndarray  # (3,)
    cov: np.ndarray


@dataclass(frozen=True)
class RelativeConstraint:
    """A relocalisation: keyframe ``second`` of one submap seen from keyframe ``first`` of another.

    ``first`` and ``second``: (submap, keyframe). ``p_b_in_a`` (3,) and ``cov`` (6, 6) are in the unit of the first;
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
    """A submap in the world: ``r_w_c`` (N, 3, 3), ``p_c_in_w_m`` (N, 3), ``cov`` (N, 6, 6) of each keyframe, tangent
    order, metres; ``m_per_unit`` (N,)."""

    r_w_c: np.ndarray
    p_c_in_w_m: np.ndarray
    cov: np.ndarray
    m_per_unit: np.ndarray


@dataclass(frozen=True)
class MergedSubmaps:
    """``placements``: pose of every submap, None where it is undetermined; ``why``: the reason, one line each.
    ``anchors`` (A,) and ``joins`` (J,), bool: which absolute and relative constraints are inliers."""

    placements: list[SubmapPose | None]
    why: list[str]
    anchors: np.ndarray
    joins: np.ndarray
