"""Where the pieces of a flight lie before it is smoothed, when a map match has moved the graph on the way.

What was flown before such a restart may be kilometres off and turned, too far for a smoothing that only goes downhill.
Each piece keeps its shape and is placed by the map matches of all of them."""

import gtsam
import numpy as np

from terrafix.estimator.graph.pose_graph import NodeState
from terrafix.estimator.propagation import HEIGHT_BIAS, scale_sigma
from terrafix_tools.finalise.flight_graph import SAME_M, FlightGraph, RecordedNode
from terrafix_tools.finalise.sim3_pose_graph import merge
from terrafix_tools.finalise.submap_types import AbsoluteConstraint, RelativeConstraint, Submap

# How fast the unit of a piece changes from frame to frame, share: a height that is known drifts; one that is guessed
# moves with every map match.
KNOWN_WALK, OPEN_WALK = 0.002, 0.02
SAME_SHARE = 0.01  # the unit of a piece is that of the next, at the frame that they share


def placed_states(flight: FlightGraph) -> list[NodeState]:
    """Of every node: as its piece was placed, or as it was last known in flight."""
    nodes = flight.graph.nodes
    states = [node.state for node in nodes]
    if not any(node.again for node in nodes):
        return states
    firsts = [i for i, node in enumerate(nodes) if node.parent < 0 or node.again]
    ends = [*firsts[1:], len(nodes)]
    sigma = float(np.hypot(HEIGHT_BIAS, scale_sigma(flight.origin.camera))) if flight.has_height else None
    fragments = [_fragment(nodes[a:b], a, sigma) for a, b in zip(firsts, ends, strict=True)]
    piece_of = np.repeat(np.arange(len(firsts)), np.diff([*firsts, len(nodes)]))
    anchors = [
        AbsoluteConstraint(int(piece_of[f.node]), f.node - firsts[piece_of[f.node]], f.pose.rotation().matrix(),
               np.asarray(f.pose.translation()), f.cov)
        for f in flight.fixes
        if f.tried
    ]  # fmt: skip
    joins = [
        RelativeConstraint(
            (k - 1, first - 1 - firsts[k - 1]), (k, 0), np.eye(3), np.zeros(3), SAME_M**2 * np.eye(6), 1.0, SAME_SHARE
        )
        for k, first in enumerate(firsts)
        if nodes[first].again
    ]
    for first, placement in zip(firsts, merge(fragments, anchors, joins).placements, strict=True):
        if placement is None:
            continue
        for i, (r, p) in enumerate(zip(placement.r_w_c, placement.p_c_in_w_m, strict=True), start=first):
            states[i] = _moved(states[i], gtsam.Pose3(gtsam.Rot3.ClosestTo(r), p))
    return states


def _fragment(nodes: list[RecordedNode], first: int, scale_sigma: float | None) -> Submap:
    """From the motions alone: what the map matches of the flight did to the estimates meanwhile plays no part."""
    n = len(nodes)
    r, p, cov = np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, 6, 6))
    parent = np.full(n, -1)
    r[0], p[0] = nodes[0].state.pose.rotation().matrix(), nodes[0].state.pose.translation()
    for i, node in enumerate(nodes[1:], start=1):
        assert node.motion is not None, "only the first node of a piece has no motion"
        parent[i] = node.parent - first
        r[i] = r[parent[i]] @ node.motion.r
        p[i] = p[parent[i]] + r[parent[i]] @ node.motion.p_m
        cov[i] = node.motion.cov
        if (seen := node.motion.seen) is not None:  # a wrong height is the unit of the piece, not an error of the step
            way = node.motion.r.T @ node.motion.p_m
            cov[i, 3:, 3:] -= np.outer(way, way) * (seen.ground.height_sigma_m / seen.ground.height_m) ** 2
    return Submap(r, p, parent, cov, scale_sigma, OPEN_WALK if scale_sigma is None else KNOWN_WALK)


def _moved(state: NodeState, pose: gtsam.Pose3) -> NodeState:
    turn = pose.rotation().matrix() @ state.pose.rotation().matrix().T
    velocity = state.velocity.copy()
    velocity[:3] = turn @ velocity[:3]
    return NodeState(pose, state.bias, velocity)
