"""Residuals of map matches as displacements on the ground, and a local model of the map's distortion from them.

A map that is stretched, or ground that differs from it, displaces the matches of all frames there alike. The model at a
point is the weighted mean of the displacements that the matches of *other* frames have around it, so that what it
leaves is an error of the match itself and not a fit to it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from terrafix.core.geodesy import rot_from_quat
from terrafix.messages import MapMatch

# 1-sigma of the weight's distance, share of the height: patches a tenth of the height apart share a third of the error.
REACH = 0.04  # [measured: docs/monte-carlo.md, patches]
PRIOR_WEIGHT = 0.25  # of no displacement: a neighbour right there has 1 [spec: ridge of the weighted mean]
# Least median weight of the other frames' matches around a point for the model to be used: that of four matches right
# there, whose mean has a fourth of the variance of one [spec: variance of a mean]
LEAST_WEIGHT = 4.0
FAR_SIGMAS = 3.0  # beyond which a neighbour does not count [spec: Gaussian weight below 1 %]


@dataclass(frozen=True)
class Residuals:
    """Matched points of one frame with the pose of the match: ``map_m`` (N, 2) on the map, east and north; ``off_m``
    (N, 2): map point less the ground that the pose sees there; ``px`` (N,): the same as a length in the frame;
    ``height_m``: of the camera above the points."""

    map_m: np.ndarray
    off_m: np.ndarray
    px: np.ndarray
    height_m: float


def residuals(match: MapMatch, focal_px: float) -> Residuals:
    """``match``: with a pose and its 2D-3D matches (core.pnp.solved)."""
    assert match.pose is not None
    points, p_m = np.array(match.matches), np.array(match.pose.p_c_in_w_m)
    r_w_c = rot_from_quat(match.pose.q_w_c)
    in_c = (points[:, 2:5] - p_m) @ r_w_c
    px = np.linalg.norm(in_c[:, :2] / in_c[:, 2:] - points[:, :2], axis=1) * focal_px
    rays = np.column_stack([points[:, :2], np.ones(len(points))]) @ r_w_c.T
    seen_m = p_m[:2] + rays[:, :2] * ((points[:, 4] - p_m[2]) / rays[:, 2])[:, None]
    return Residuals(points[:, 2:4], points[:, 2:4] - seen_m, px, float(p_m[2] - np.median(points[:, 4])))


def left_by_local_model(frames: Sequence[Residuals]) -> list[np.ndarray]:
    """What the local model leaves of ``off_m`` of every frame, (N, 2) each."""
    off_m = np.concatenate([f.off_m for f in frames])
    return [
        frame.off_m - weight @ off_m[others] / (weight.sum(axis=1, keepdims=True) + PRIOR_WEIGHT)
        for frame, (weight, others) in zip(frames, _neighbours(frames), strict=True)
    ]


def shows_distortion(frames: Sequence[Residuals]) -> bool:
    """Whether the flight has matched its ground often enough for the local model, whatever that leaves: the median
    weight of the neighbours of a point is ``LEAST_WEIGHT`` or more. It does not depend on the displacements."""
    weights = np.concatenate([weight.sum(axis=1) for weight, _ in _neighbours(frames)])
    return bool(np.median(weights) >= LEAST_WEIGHT)


def _neighbours(frames: Sequence[Residuals]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """For every frame: weight (N, M) that the M points of the other frames have for its N, and (points,) bool, which
    of all points these are."""
    map_m = np.concatenate([f.map_m for f in frames])
    of_frame = np.repeat(np.arange(len(frames)), [len(f.map_m) for f in frames])
    for i, frame in enumerate(frames):
        others = of_frame != i
        squares = np.sum((frame.map_m[:, None] - map_m[None, others]) ** 2, axis=2) / (REACH * frame.height_m) ** 2
        yield np.where(squares < FAR_SIGMAS**2, np.exp(-0.5 * squares), 0.0), others


def mean_px(frames: Sequence[Residuals], off_m: Sequence[np.ndarray]) -> float:
    """Mean over the frames of the mean length of ``off_m``, in pixels by the scale of each frame's own residuals."""
    scales = [float(f.px.mean()) / max(float(np.linalg.norm(f.off_m, axis=1).mean()), 1e-9) for f in frames]
    lengths = [float(np.linalg.norm(one, axis=1).mean()) for one in off_m]
    return float(np.mean(np.multiply(scales, lengths)))
