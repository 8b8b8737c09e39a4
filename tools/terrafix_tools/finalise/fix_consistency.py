"""What the map matches of a whole flight say of each other: which share their ground, which stand against the rest."""

from collections.abc import Iterator

import gtsam
import numpy as np

from terrafix.estimator.integrity.correlated_fixes import CorrelatedFixes
from terrafix.estimator.integrity.innovation_run import AGREE_M
from terrafix.estimator.integrity.other_place import OtherPlace
from terrafix_tools.finalise.flight_graph import Fix, FlightGraph


def new_ground(flight: FlightGraph) -> list[float]:
    """By what share each fix counts: over ground that the one before it had seen, it shares that one's errors."""
    shares = [1.0] * len(flight.fixes)
    seen, ground_m = CorrelatedFixes(), flight.origin.ground_amsl_m or 0.0
    for i in sorted(range(len(shares)), key=lambda i: flight.fixes[i].node):
        fix = flight.fixes[i]
        here, t_s = np.asarray(fix.pose.translation()), flight.graph.nodes[fix.node].t_s
        shares[i] = seen.share(t_s, here[:2], max(float(here[2]) - ground_m, 1.0))
        seen.add(t_s, here[:2])
    return shares


def doubted(flight: FlightGraph, believed: np.ndarray, begins: np.ndarray) -> np.ndarray:
    """(N,) 1-sigma, m, for each axis: that a node is not where it is placed, because the map was heard to say so.

    A map match that is believed, and came when there was no doubt, speaks for all that was flown before it."""
    doubt_m = np.zeros(len(begins))
    for begin in np.unique(begins):
        said = {node: m for node, m in flight.doubt_m.items() if begins[node] == begin}
        clear = [f.node for f, b in zip(flight.fixes, believed, strict=True) if b and said.get(f.node) == 0.0]
        after = (begins == begin) & (np.arange(len(begins)) > max(clear, default=-1))
        doubt_m[after] = max((m for node, m in said.items() if after[node]), default=0.0)
    return doubt_m


def torn(
    fixes: list[Fix], believed: np.ndarray, begins: np.ndarray, poses: list[gtsam.Pose3]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """-> nodes, and the spread (2, 2) of the two places between which they are.

    Map matches that agree with each other and not with the rest, with the rest on one side of them only, may be right:
    one mistake of odometry would do. With the rest on both sides it would take two."""
    for begin in np.unique(begins):
        own = [i for i, f in enumerate(fixes) if begins[f.node] == begin and not f.coarse]
        own.sort(key=lambda i: fixes[i].node)
        right = [k for k, i in enumerate(own) if believed[i]]
        nodes = np.flatnonzero(begins == begin)
        sides = [(own, nodes)]
        if right:
            first, last = fixes[own[right[0]]].node, fixes[own[right[-1]]].node
            sides = [(own[: right[0]], nodes[nodes < first]), (own[right[-1] + 1 :], nodes[nodes > last])]
        for outside, at in sides:
            offsets = [(fixes[i].pose.translation() - poses[fixes[i].node].translation())[:2] for i in outside]
            middle = np.median(offsets, axis=0) if offsets else np.zeros(2)
            other = OtherPlace()
            # What all of them together say of the offset is far less off than they are apart.
            other.disagreed([o for o in offsets if np.hypot(*(o - middle)) <= AGREE_M], np.zeros((2, 2)), fixed=True)
            if other.probability > 0.0:
                yield at, other.spread_m2()
