"""Where every node of a flight was: nodes that are unknowns, and between them positions that follow these."""

import gtsam
import numpy as np

from terrafix.estimator.graph.elimination import NODE, Conditional, GaussianMarginal

_GROWS_BY = 1024  # rows
_UPPER = np.triu_indices(3)


class Trajectory:
    """For each node its position where the unknowns are as they left the window; how it follows the two unknowns around
    it, and its covariance when these are known. World axes. Of an unknown only the position counts."""

    def __init__(self) -> None:
        self.size = 0
        self._p_m = np.zeros((0, 3))
        # By the unknown before and the one after; good to a thousandth of what these move, in a quarter of the memory.
        self._by = np.zeros((0, 3, 2 * NODE), np.float16)
        self._cov = np.zeros((0, 6), np.float32)

    def put(self, node: int, p_m: np.ndarray) -> None:
        """The next node, or an unknown that has moved."""
        if node == len(self._p_m):
            self._p_m, self._by, self._cov = (
                np.concatenate([rows, np.zeros((_GROWS_BY, *rows.shape[1:]), rows.dtype)])
                for rows in (self._p_m, self._by, self._cov)
            )
        self.size = max(self.size, node + 1)
        self._p_m[node] = p_m

    def follow(self, known: Conditional, poses: list[gtsam.Pose3], ends: tuple[int, int]) -> None:
        """The nodes of ``known``, at ``poses``, are unknowns no more, and all that lies between the unknowns ``ends``
        follows these."""
        inverse = np.linalg.inv(known.root)
        change, cov, by = inverse @ known.rhs, inverse @ inverse.T, self._by_ends(known, inverse, ends)
        moves = [_moves(pose) for pose in poses]
        if len(known.nodes) == 1:
            # What followed this node follows the ends through it, and so does the node itself.
            node = known.nodes[0]
            self._by[node] = np.hstack([np.zeros((3, NODE)), moves[0]])
            for rows, its in ((slice(ends[0] + 1, node + 1), 1), (slice(node + 1, ends[1]), 0)):
                through = self._by[rows, :, its * NODE : (its + 1) * NODE].astype(float)
                self._p_m[rows] += through @ change
                self._cov[rows] += (through @ cov @ through.transpose(0, 2, 1))[:, *_UPPER]
                self._by[rows, :, its * NODE : (its + 1) * NODE] = 0.0
                self._by[rows] += through @ by
            return
        for i, (node, move) in enumerate(zip(known.nodes, moves, strict=True)):
            at = slice(NODE * i, NODE * (i + 1))
            self._p_m[node] += move @ change[at]
            self._cov[node] = (move @ cov[at, at] @ move.T)[_UPPER]
            self._by[node] = move @ by[at]

    def lose(self, ends: tuple[int, int]) -> None:
        """Nothing is known between these two."""
        self._p_m[ends[0] + 1 : ends[1]] = np.nan

    def solved(
        self, known: dict[int, GaussianMarginal], poses: dict[int, gtsam.Pose3], tied: list[tuple[int, int]]
    ) -> tuple[np.ndarray, np.ndarray]:
        """``known`` of the unknowns, which were at ``poses``, and what follows them between those that are ``tied``.
        -> positions (N, 3), covariances (N, 3, 3); nan where nothing is known."""
        p_m, cov = np.full((self.size, 3), np.nan), np.full((self.size, 3, 3), np.nan)
        for node, its in known.items():
            change, its_cov = its.of([node])
            move = _moves(poses[node])
            p_m[node] = poses[node].retract(change[:6]).translation()
            cov[node] = move @ its_cov @ move.T
        for a, b in tied:
            if b in known and a in known[b].nodes:
                change, its_cov = known[b].of([a, b])
                by = self._by[a + 1 : b].astype(float)
                # Where the way turns, what moves far moves on an arc: the exponential map, to second order.
                turn = 0.5 * sum(poses[n].rotation().rotate(known[n].of([n])[0][:3]) for n in (a, b))
                moved = by @ change
                p_m[a + 1 : b] = self._p_m[a + 1 : b] + moved + 0.5 * np.cross(turn, moved)
                full = np.zeros((b - a - 1, 3, 3))
                full[:, *_UPPER] = full[:, *_UPPER[::-1]] = self._cov[a + 1 : b]
                cov[a + 1 : b] = full + by @ its_cov @ by.transpose(0, 2, 1)
        return p_m, cov

    @staticmethod
    def _by_ends(known: Conditional, inverse: np.ndarray, ends: tuple[int, int]) -> np.ndarray:
        """(NODE * nodes, 2 * NODE). A node far back, on which many hang that stand there, moves like the end before."""
        by = np.zeros((len(inverse), 2 * NODE))
        for i, node in enumerate(known.given):
            first = NODE if node == ends[1] else 0
            by[:, first : first + NODE] -= inverse @ known.by_given[:, NODE * i : NODE * (i + 1)]
        return by


def _moves(pose: gtsam.Pose3) -> np.ndarray:
    """(3, NODE): how the position changes with the changes of a node."""
    by = np.zeros((3, NODE))
    by[:, 3:6] = pose.rotation().matrix()
    return by
