"""Initial poses for the batch smoother after map matches have reset the graph in flight.

The part of a flight before such a reset may be kilometres off and rotated, too far for a local optimiser. Each segment
keeps its shape and is placed by the map matches of all of them."""

import gtsam
import numpy as np

from terrafix.estimator.filter_state import scale_sigma
from terrafix.estimator.initialization import HEIGHT_BIAS
from terrafix.estimator.state import TRANSLATION, VELOCITY, NodeState
from terrafix.smoother.sim3_pose_graph import merge
from terrafix.smoother.submap_types import AbsoluteConstraint, RelativeConstraint, Submap
from terrafix_tools.finalise.flight_graph import SAME_FRAME_M, FlightGraph, RecordedNode

# Random walk of the scale of a segment from frame to frame, as a share: a known height drifts; an assumed one changes
# with every map match.
KNOWN_HEIGHT_WALK, ASSUMED_HEIGHT_WALK = 0.002, 0.02
SAME_SCALE = 0.01  # 1-sigma of the ratio of scales of successive segments at the frame that both contain


def placed_states(flight: FlightGraph) -> list[NodeState]:
    """State of every node: moved with its segment, or the last estimate in flight."""
    nodes = flight.recorder.nodes
    states = [node.state for node in nodes]
    if not any(node.again for node in nodes):
        return states
    firsts = [i for i, node in enumerate(nodes) if node.parent < 0 or node.again]
    ends = [*firsts[1:], len(nodes)]
    sigma = float(np.hypot(HEIGHT_BIAS, scale_sigma(flight.origin.camera))) if flight.has_height else None
    submaps = [_submap(nodes[a:b], a, sigma) for a, b in zip(firsts, ends, strict=True)]
    segment_of = np.repeat(np.arange(len(firsts)), np.diff([*firsts, len(nodes)]))
    anchors = [
        AbsoluteConstraint(int(segment_of[f.node]), f.node - firsts[segment_of[f.node]], f.pose.rotation().matrix(),
               np.asarray(f.pose.translation()), f.cov)
        for f in flight.fixes
        if f.tried
    ]  # fmt: skip
    joins = [
        RelativeConstraint(
            (k - 1, first - 1 - firsts[k - 1]),
            (k, 0),
            np.eye(3),
            np.zeros(3),
            SAME_FRAME_M**2 * np.eye(6),
            1.0,
            SAME_SCALE,
        )
        for k, first in enumerate(firsts)
        if nodes[first].again
    ]
    for first, placement in zip(firsts, merge(submaps, anchors, joins).placements, strict=True):
        if placement is None:
            continue
        for i, (r, p) in enumerate(zip(placement.r_w_c, placement.p_c_in_w_m, strict=True), start=first):
            states[i] = _moved(states[i], gtsam.Pose3(gtsam.Rot3.ClosestTo(r), p))
    return states


def _submap(nodes: list[RecordedNode], first: int, scale_sigma: float | None) -> Submap:
    """From the relative motions alone, without the effect of map matches on the estimates in flight."""
    n = len(nodes)
    r, p, cov = np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, 6, 6))
    parent = np.full(n, -1)
    r[0], p[0] = nodes[0].state.pose.rotation().matrix(), nodes[0].state.pose.translation()
    for i, node in enumerate(nodes[1:], start=1):
        assert node.motion is not None, "only the first node of a segment has no motion"
        parent[i] = node.parent - first
        r[i] = r[parent[i]] @ node.motion.r
        p[i] = p[parent[i]] + r[parent[i]] @ node.motion.p_m
        cov[i] = node.motion.cov
        if (rays := node.motion.rays) is not None:  # a height error is the scale of the segment, not of the step
            translation = node.motion.r.T @ node.motion.p_m
            cov[i, TRANSLATION, TRANSLATION] -= (
                np.outer(translation, translation) * (rays.ground.height_sigma_m / rays.ground.height_m) ** 2
            )
    walk = ASSUMED_HEIGHT_WALK if scale_sigma is None else KNOWN_HEIGHT_WALK
    return Submap(r, p, parent, cov, scale_sigma, np.full(n, walk))


def _moved(state: NodeState, pose: gtsam.Pose3) -> NodeState:
    turn = pose.rotation().matrix() @ state.pose.rotation().matrix().T
    velocity = state.motion.copy()
    velocity[VELOCITY] = turn @ velocity[VELOCITY]
    return NodeState(pose, state.calibration, velocity)
