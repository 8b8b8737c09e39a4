"""Correlation and consistency of the map matches of a whole flight."""

from collections.abc import Iterator

import gtsam
import numpy as np

from terrafix.estimator.integrity.alternative_position import AlternativePosition
from terrafix.estimator.integrity.correlated_fixes import CorrelatedFixes
from terrafix.estimator.integrity.innovation_run import CONSISTENT_M
from terrafix.estimator.state import HORIZONTAL, UP
from terrafix_tools.finalise.flight_graph import Fix, FlightGraph


def information_shares(flight: FlightGraph) -> list[float]:
    """Share of its information with which each map match counts: over ground that the one before has seen, their errors
    are correlated."""
    shares = [1.0] * len(flight.fixes)
    seen, ground_m = CorrelatedFixes(), flight.origin.ground_amsl_m or 0.0
    for i in sorted(range(len(shares)), key=lambda i: flight.fixes[i].node):
        fix = flight.fixes[i]
        here, t_s = np.asarray(fix.pose.translation()), flight.recorder.nodes[fix.node].t_s
        shares[i] = seen.information_share(t_s, here[HORIZONTAL], max(float(here[UP]) - ground_m, 1.0))
        seen.add(t_s, here[HORIZONTAL])
    return shares


def lost_sigma(flight: FlightGraph, inliers: np.ndarray, begins: np.ndarray) -> np.ndarray:
    """(N,) 1-sigma of the position of each node, m per axis, due to map matches that contradicted it in flight.

    An inlier map match at a time without such a contradiction confirms all nodes before it."""
    sigma_m = np.zeros(len(begins))
    for begin in np.unique(begins):
        in_flight = {node: m for node, m in flight.lost_sigma_m.items() if begins[node] == begin}
        clear = [f.node for f, b in zip(flight.fixes, inliers, strict=True) if b and in_flight.get(f.node) == 0.0]
        after = (begins == begin) & (np.arange(len(begins)) > max(clear, default=-1))
        sigma_m[after] = max((m for node, m in in_flight.items() if after[node]), default=0.0)
    return sigma_m


def ambiguous_segments(
    fixes: list[Fix], inliers: np.ndarray, begins: np.ndarray, poses: list[gtsam.Pose3]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Segments with two possible positions. -> nodes, and the covariance (2, 2) of the mixture of both.

    Outlier map matches at the beginning or end of a segment that agree with each other may be right: one odometry error
    would explain them. Between inliers it would take two errors."""
    for begin in np.unique(begins):
        own = [i for i, f in enumerate(fixes) if begins[f.node] == begin and not f.position_only]
        own.sort(key=lambda i: fixes[i].node)
        right = [k for k, i in enumerate(own) if inliers[i]]
        nodes = np.flatnonzero(begins == begin)
        sides = [(own, nodes)]
        if right:
            first, last = fixes[own[right[0]]].node, fixes[own[right[-1]]].node
            sides = [(own[: right[0]], nodes[nodes < first]), (own[right[-1] + 1 :], nodes[nodes > last])]
        for outside, at in sides:
            offsets = [(fixes[i].pose.translation() - poses[fixes[i].node].translation())[HORIZONTAL] for i in outside]
            middle = np.median(offsets, axis=0) if offsets else np.zeros(2)
            other = AlternativePosition()
            # The error of their common offset is far less than the distance between them.
            other.spawn([o for o in offsets if np.hypot(*(o - middle)) <= CONSISTENT_M], np.zeros((2, 2)))
            if other.weight > 0.0:
                yield at, other.moments_m2()
