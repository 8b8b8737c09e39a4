"""Position of every node of a flight: unknowns, and nodes between them that depend on these."""

import gtsam
import numpy as np

from terrafix.estimator.graph.elimination import NODE_SIZE, Conditional, GaussianMarginal
from terrafix.estimator.state import POSE_SIZE, ROTATION, TRANSLATION

_ROW_BLOCK = 1024  # rows by which the arrays grow [tuned]
_UPPER = np.triu_indices(3)  # upper triangle of a position covariance [spec: 3 axes]


class Trajectory:
    """Position of each node in world axes, with the unknowns at the state in which they left the window. For a node
    that has been eliminated: the Jacobian of its position by the two unknowns around it, and its covariance given
    these."""

    def __init__(self) -> None:
        self.size = 0
        self._p_m = np.zeros((0, 3))
        # By the unknown before and the one after. float16 is good to a thousandth of their change, in a quarter of the
        # memory.
        self._by_ends = np.zeros((0, 3, 2 * NODE_SIZE), np.float16)
        self._cov = np.zeros((0, 6), np.float32)

    def put(self, node: int, p_m: np.ndarray) -> None:
        """Position of the next node, or the new position of an unknown."""
        if node == len(self._p_m):
            self._p_m, self._by_ends, self._cov = (
                np.concatenate([rows, np.zeros((_ROW_BLOCK, *rows.shape[1:]), rows.dtype)])
                for rows in (self._p_m, self._by_ends, self._cov)
            )
        self.size = max(self.size, node + 1)
        self._p_m[node] = p_m

    def eliminate(self, conditional: Conditional, poses: list[gtsam.Pose3], ends: tuple[int, int]) -> None:
        """The nodes of ``conditional``, at ``poses``, are no longer unknowns. All nodes between the unknowns ``ends``
        depend on these from now on."""
        inverse = np.linalg.inv(conditional.r)
        change = inverse @ conditional.d
        by_ends = _by_ends(conditional, inverse, ends)
        jacobians = [_position_jacobian(pose) for pose in poses]
        if len(conditional.nodes) == 1:
            # Nodes that depended on this node depend on the ends through it, and so does the node itself.
            node, cov = conditional.nodes[0], inverse @ inverse.T
            self._by_ends[node] = np.hstack([np.zeros((3, NODE_SIZE)), jacobians[0]])
            for rows, side in ((slice(ends[0] + 1, node + 1), 1), (slice(node + 1, ends[1]), 0)):
                columns = slice(side * NODE_SIZE, (side + 1) * NODE_SIZE)
                through = self._by_ends[rows, :, columns].astype(float)
                self._p_m[rows] += through @ change
                self._cov[rows] += (through @ cov @ through.transpose(0, 2, 1))[:, *_UPPER]
                self._by_ends[rows, :, columns] = 0.0
                self._by_ends[rows] += through @ by_ends
            return
        for i, (node, jacobian) in enumerate(zip(conditional.nodes, jacobians, strict=True)):
            at = slice(NODE_SIZE * i, NODE_SIZE * (i + 1))
            self._p_m[node] += jacobian @ change[at]
            root = jacobian @ inverse[at]
            self._cov[node] = (root @ root.T)[_UPPER]
            self._by_ends[node] = jacobian @ by_ends[at]

    def mark_indeterminate(self, ends: tuple[int, int]) -> None:
        """Sets the positions of the nodes between these two to nan, which means indeterminate."""
        self._p_m[ends[0] + 1 : ends[1]] = np.nan

    def solved(
        self, marginals: dict[int, GaussianMarginal], poses: dict[int, gtsam.Pose3], intervals: list[tuple[int, int]]
    ) -> tuple[np.ndarray, np.ndarray]:
        """``marginals`` of the unknowns, linear around ``poses``; ``intervals``: pairs of unknowns that factors tie,
        with the nodes between them. -> positions (N, 3), covariances (N, 3, 3); nan where indeterminate."""
        p_m, cov = np.full((self.size, 3), np.nan), np.full((self.size, 3, 3), np.nan)
        for node, marginal in marginals.items():
            change, node_cov = marginal.marginal([node])
            jacobian = _position_jacobian(poses[node])
            p_m[node] = poses[node].retract(change[:POSE_SIZE]).translation()
            cov[node] = jacobian @ node_cov @ jacobian.T
        for a, b in intervals:
            if b in marginals and a in marginals[b].nodes:
                change, ends_cov = marginals[b].marginal([a, b])
                by_ends = self._by_ends[a + 1 : b].astype(float)
                # With a rotation, large changes follow an arc: the exponential map, to second order.
                turn = 0.5 * sum(poses[n].rotation().rotate(marginals[n].marginal([n])[0][ROTATION]) for n in (a, b))
                moved = by_ends @ change
                p_m[a + 1 : b] = self._p_m[a + 1 : b] + moved + 0.5 * np.cross(turn, moved)
                own_cov = np.zeros((b - a - 1, 3, 3))
                own_cov[:, *_UPPER] = own_cov[:, *_UPPER[::-1]] = self._cov[a + 1 : b]
                cov[a + 1 : b] = own_cov + by_ends @ ends_cov @ by_ends.transpose(0, 2, 1)
        return p_m, cov


def _by_ends(conditional: Conditional, inverse: np.ndarray, ends: tuple[int, int]) -> np.ndarray:
    """(NODE_SIZE * nodes, 2 * NODE_SIZE) Jacobian by the two ends. An older parent, which many nodes of a stationary
    vehicle share, is taken to change like the end before."""
    by_ends = np.zeros((len(inverse), 2 * NODE_SIZE))
    for i, node in enumerate(conditional.parents):
        first = NODE_SIZE if node == ends[1] else 0
        by_ends[:, first : first + NODE_SIZE] -= inverse @ conditional.s[:, NODE_SIZE * i : NODE_SIZE * (i + 1)]
    return by_ends


def _position_jacobian(pose: gtsam.Pose3) -> np.ndarray:
    """(3, NODE_SIZE) of the position by the tangent of a node."""
    jacobian = np.zeros((3, NODE_SIZE))
    jacobian[:, TRANSLATION] = pose.rotation().matrix()
    return jacobian
