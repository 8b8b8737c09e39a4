"""Camera of every node of a flight: unknowns, and nodes between them that depend on these."""

import gtsam
import numpy as np

from terrafix.core.geodesy import quat_from_rot, rot_from_quat
from terrafix.core.pose import exp_so3
from terrafix.estimator.graph.elimination import NODE_SIZE, Conditional, GaussianMarginal
from terrafix.estimator.state import POSE_SIZE, ROTATION, TRANSLATION, WORLD_POSITION, WORLD_ROTATION

_ROW_BLOCK = 1024  # rows by which the arrays grow [tuned]
_UPPER = np.triu_indices(POSE_SIZE)  # upper triangle of a covariance of a pose [spec: 6 numbers]


class Trajectory:
    """Camera of each node, with the unknowns at the state in which they left the window. For a node that has been
    eliminated: the Jacobian of its pose by the two unknowns around it, and its covariance given these. Changes of a
    pose are those of its position, then its turn about world axes."""

    def __init__(self) -> None:
        self.size = 0
        self._q_w_c = np.zeros((0, 4), np.float32)
        self._moved = np.zeros((0, POSE_SIZE))  # position, and turn since _q_w_c
        # By the unknown before and the one after. float16 is good to a thousandth of their change, in a quarter of the
        # memory.
        self._by_ends = np.zeros((0, POSE_SIZE, 2 * NODE_SIZE), np.float16)
        self._cov = np.zeros((0, len(_UPPER[0])), np.float32)

    def put(self, node: int, pose: gtsam.Pose3) -> None:
        """The next node, or the new pose of an unknown."""
        if node == len(self._moved):
            self._q_w_c, self._moved, self._by_ends, self._cov = (
                np.concatenate([rows, np.zeros((_ROW_BLOCK, *rows.shape[1:]), rows.dtype)])
                for rows in (self._q_w_c, self._moved, self._by_ends, self._cov)
            )
        self.size = max(self.size, node + 1)
        self._q_w_c[node] = quat_from_rot(pose.rotation().matrix())
        self._moved[node] = [*pose.translation(), 0.0, 0.0, 0.0]

    def eliminate(self, conditional: Conditional, poses: list[gtsam.Pose3], ends: tuple[int, int]) -> None:
        """The nodes of ``conditional``, at ``poses``, are no longer unknowns. All nodes between the unknowns ``ends``
        depend on these from now on."""
        inverse = np.linalg.inv(conditional.r)
        change = inverse @ conditional.d
        by_ends = _by_ends(conditional, inverse, ends)
        jacobians = [_pose_jacobian(pose) for pose in poses]
        if len(conditional.nodes) == 1:
            # Nodes that depended on this node depend on the ends through it, and so does the node itself.
            node, cov = conditional.nodes[0], inverse @ inverse.T
            self._by_ends[node] = np.hstack([np.zeros((POSE_SIZE, NODE_SIZE)), jacobians[0]])
            for rows, side in ((slice(ends[0] + 1, node + 1), 1), (slice(node + 1, ends[1]), 0)):
                columns = slice(side * NODE_SIZE, (side + 1) * NODE_SIZE)
                through = self._by_ends[rows, :, columns].astype(float)
                self._moved[rows] += through @ change
                self._cov[rows] += (through @ cov @ through.transpose(0, 2, 1))[:, *_UPPER]
                self._by_ends[rows, :, columns] = 0.0
                self._by_ends[rows] += through @ by_ends
            return
        for i, (node, jacobian) in enumerate(zip(conditional.nodes, jacobians, strict=True)):
            at = slice(NODE_SIZE * i, NODE_SIZE * (i + 1))
            self._moved[node] += jacobian @ change[at]
            root = jacobian @ inverse[at]
            self._cov[node] = (root @ root.T)[_UPPER]
            self._by_ends[node] = jacobian @ by_ends[at]

    def mark_indeterminate(self, ends: tuple[int, int]) -> None:
        """Sets the poses of the nodes between these two to nan, which means indeterminate."""
        self._moved[ends[0] + 1 : ends[1]] = np.nan

    def solved(
        self, marginals: dict[int, GaussianMarginal], poses: dict[int, gtsam.Pose3], intervals: list[tuple[int, int]]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """``marginals`` of the unknowns, linear around ``poses``; ``intervals``: pairs of unknowns that factors tie,
        with the nodes between them. -> positions (N, 3), orientations r_w_c (N, 3, 3), covariances (N, 6, 6) of
        position, then rotation, world axes; nan where indeterminate."""
        p_m, r_w_c, cov = (np.full((self.size, *shape), np.nan) for shape in ((3,), (3, 3), (POSE_SIZE, POSE_SIZE)))
        for node, marginal in marginals.items():
            change, node_cov = marginal.marginal([node])
            jacobian, solved = _pose_jacobian(poses[node]), poses[node].retract(change[:POSE_SIZE])
            p_m[node], r_w_c[node] = solved.translation(), solved.rotation().matrix()
            cov[node] = jacobian @ node_cov @ jacobian.T
        for a, b in intervals:
            if b in marginals and a in marginals[b].nodes:
                change, ends_cov = marginals[b].marginal([a, b])
                by_ends = self._by_ends[a + 1 : b].astype(float)
                # With a rotation, large changes follow an arc: the exponential map, to second order.
                turn = 0.5 * sum(poses[n].rotation().rotate(marginals[n].marginal([n])[0][ROTATION]) for n in (a, b))
                moved = by_ends @ change
                shift_m = moved[:, WORLD_POSITION] + 0.5 * np.cross(turn, moved[:, WORLD_POSITION])
                p_m[a + 1 : b] = self._moved[a + 1 : b, WORLD_POSITION] + shift_m
                turns = self._moved[a + 1 : b, WORLD_ROTATION] + moved[:, WORLD_ROTATION]
                for node, turned in zip(range(a + 1, b), turns, strict=True):
                    w, x, y, z = self._q_w_c[node].tolist()
                    r_w_c[node] = exp_so3(turned) @ rot_from_quat((w, x, y, z))
                own_cov = np.zeros((b - a - 1, POSE_SIZE, POSE_SIZE))
                own_cov[:, *_UPPER] = own_cov[:, *_UPPER[::-1]] = self._cov[a + 1 : b]
                cov[a + 1 : b] = own_cov + by_ends @ ends_cov @ by_ends.transpose(0, 2, 1)
        return p_m, r_w_c, cov


def _by_ends(conditional: Conditional, inverse: np.ndarray, ends: tuple[int, int]) -> np.ndarray:
    """(NODE_SIZE * nodes, 2 * NODE_SIZE) Jacobian by the two ends. An older parent, which many nodes of a stationary
    vehicle share, is taken to change like the end before."""
    by_ends = np.zeros((len(inverse), 2 * NODE_SIZE))
    for i, node in enumerate(conditional.parents):
        first = NODE_SIZE if node == ends[1] else 0
        by_ends[:, first : first + NODE_SIZE] -= inverse @ conditional.s[:, NODE_SIZE * i : NODE_SIZE * (i + 1)]
    return by_ends


def _pose_jacobian(pose: gtsam.Pose3) -> np.ndarray:
    """(6, NODE_SIZE) of a change of the pose by the tangent of a node."""
    jacobian = np.zeros((POSE_SIZE, NODE_SIZE))
    jacobian[WORLD_POSITION, TRANSLATION] = jacobian[WORLD_ROTATION, ROTATION] = pose.rotation().matrix()
    return jacobian
