"""Nodes that have left the window of the graph: a small linear system for the refinement after landing.

A factor that leaves is linearised at the values with which its nodes left. These are iSAM2's own linearization point,
so that the cached Jacobian is used (linearization_cache.py). Only some nodes are retained as unknowns. The nodes
between two retained ones are eliminated exactly, and their positions depend on these from then on (trajectory.py).

A node is retained where it separates the graph: a keyframe does, but for the three-view factor of which it is the
middle one, which is dropped. (Retaining the keyframe before it as well was tried: the covariances of a chain in which
each pair of nodes depends on another pair are lost in rounding.) When too many nodes are retained, some of them are
eliminated. So the time per frame is constant, and the memory grows by some 630 bytes a frame."""

from bisect import bisect_left, bisect_right
from contextlib import suppress
from itertools import pairwise

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C, V

from terrafix.estimator.graph.elimination import (
    Conditional,
    GaussianFactor,
    GaussianMarginal,
    IndeterminateError,
    eliminate,
    linearize,
    nodes_of,
    solve,
)
from terrafix.estimator.graph.trajectory import Trajectory

MIN_SPACING = 10  # nodes from one retained node to the next, at least [tuned]
THREE_VIEW_NODES = 3  # nodes of a three-view factor [spec: three_view_factor]
MAX_RETAINED = 128  # retained nodes [tuned]
# Nodes without a separating one among them: then the newest is retained, and factors that reach beyond it are dropped.
MAX_UNSEPARATED = 60  # [tuned]

NodeValues = tuple[gtsam.Pose3, np.ndarray, np.ndarray]  # C, B, V of a node
_Eliminated = tuple[Conditional, list[gtsam.Pose3], tuple[int, int]]  # nodes given their ends, poses, ends


class MarginalizedHistory:
    """Factors are added as in the graph; nodes leave by ``marginalize``; ``refine`` solves for all."""

    def __init__(self) -> None:
        self._window: list[tuple[gtsam.NonlinearFactor, tuple[int, ...]]] = []  # factors with nodes in the window
        self._linear: list[GaussianFactor] = []
        self._values: dict[int, NodeValues] = {}  # linearization point of retained nodes and of newer ones
        self._held: set[int] = set()  # of these: still in the window, while newer nodes have left
        self._retained: list[int] = []
        self._pending: list[int] = []  # nodes between the two newest retained ones, linear, not eliminated yet
        self._conditional: _Eliminated | None = None  # of the last elimination, not in the trajectory yet
        self._segment_starts = {0}  # nodes without a factor to the node before
        self._trajectory = Trajectory()

    def add(self, factors: gtsam.NonlinearFactorGraph) -> None:
        """Factors that the graph was given."""
        self._window += [(f, nodes_of(f)) for f in map(factors.at, range(factors.size()))]

    def marginalize(self, nodes: list[int], around: gtsam.Values) -> None:
        """``nodes`` leave the window; their factors are linearised, now or later, ``around`` these values."""
        if not nodes:
            return
        passed = set(range(self._trajectory.size, max(nodes)))
        self._held = (self._held | passed) - set(nodes)
        for node in sorted(passed | set(nodes)):
            self._freeze(node, around)

    def reduce_step(self) -> bool:
        """One small part of the outstanding elimination. It is called often, so that no frame takes long. -> whether
        there was any."""
        if self._conditional is not None:
            self._trajectory.eliminate(*self._conditional)
            self._conditional = None
            return True
        if self._pending:
            self._eliminate(self._pending)
            self._pending = []
            return True
        if self._retained and (node := self._next_retained()) is not None:
            self._retain(node)
            return True
        if len(self._retained) > MAX_RETAINED and (node := self._closest_retained()) is not None:
            # A held node was retained beside its neighbour, and their factors may not be linear yet.
            self._linearize({node}, self._retained[bisect_right(self._retained, node)])
            self._eliminate([node])
            self._retained.remove(node)
            return True
        return False

    def begin_segment(self, node: int) -> None:
        """The graph is reset with this node, without a factor to earlier ones; all earlier nodes have left."""
        self._close()
        self._window.clear()
        self._held.clear()
        self._segment_starts.add(node)

    def refine(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """After landing, when all nodes have left: position (N, 3) and orientation r_w_c (N, 3, 3) of each node given
        all measurements, and their covariance (N, 6, 6), position, then rotation, world axes; nan where indeterminate:
        the caller keeps the estimate made in flight."""
        self._close()
        intervals = [(a, b) for a, b in pairwise(self._retained) if b not in self._segment_starts]
        poses = {node: self._values[node][0] for node in self._retained}
        return self._trajectory.solved(self._solved(), poses, intervals)

    def _close(self) -> None:
        """Completes the elimination, and retains the newest node."""
        while self.reduce_step():
            pass
        if self._trajectory.size and self._trajectory.size - 1 > self._retained[-1]:
            self._retain(self._trajectory.size - 1)
            for _ in range(2):  # the elimination, and its part of the trajectory
                self.reduce_step()
        self._linearize(set(), self._trajectory.size)

    def _solved(self) -> dict[int, GaussianMarginal]:
        """Marginals of the retained nodes, without segments that are indeterminate."""
        solved: dict[int, GaussianMarginal] = {}
        starts = sorted(self._segment_starts & set(self._retained))
        for first, end in pairwise([*starts, self._trajectory.size]):
            with suppress(IndeterminateError):
                solved |= solve([f for f in self._linear if first <= f.nodes[0] < end])
        return solved

    def _freeze(self, node: int, around: gtsam.Values) -> None:
        """Sets the linearization point of a node."""
        values = (around.atPose3(C(node)), around.atVector(B(node)), around.atVector(V(node)))
        before = self._values.get(node)
        self._values[node] = values
        if before is not None:  # it was held
            change = np.concatenate([before[0].logmap(values[0]), values[1] - before[1], values[2] - before[2]])
            self._linear = [f.relinearized(node, change) for f in self._linear]
        elif node in self._segment_starts:
            self._retained.append(node)
        self._trajectory.put(node, values[0])

    def _next_retained(self) -> int | None:
        """The next node that separates older from newer nodes: no factor reaches across, but for a three-view factor,
        which is dropped."""
        last = self._retained[-1]
        candidates = [n for n in self._values if n > last]
        if not candidates or (candidates[-1] - last < MIN_SPACING and self._held.isdisjoint(candidates)):
            return None  # avoids a pass over all factors in most frames
        reach = dict.fromkeys(candidates, 0)
        pairs = (nodes for _, nodes in self._window if len(nodes) < THREE_VIEW_NODES)
        for nodes in (*(f.nodes for f in self._linear), *pairs):
            for node in nodes:
                if node in reach:
                    reach[node] = max(reach[node], nodes[-1])
        furthest = 0
        for node in candidates:
            if node in self._held or (node - last >= MIN_SPACING and furthest <= node):
                return node
            furthest = max(furthest, reach[node])
        return candidates[-1] if len(candidates) >= MAX_UNSEPARATED else None

    def _retain(self, node: int) -> None:
        """Retains one node, and schedules those since the last retained one for elimination."""
        self._pending = [n for n in self._values if self._retained[-1] < n < node]
        self._retained.append(node)
        if self._pending:
            self._linearize(set(self._pending), node)

    def _linearize(self, frontals: set[int], last: int) -> None:
        """Linearises, as one, the factors of ``frontals``, which are to be eliminated, and those among nodes before
        ``last``. Factors from ``frontals`` beyond ``last`` are dropped: that loses information and never adds any."""
        graph, nodes, others = gtsam.NonlinearFactorGraph(), set[int](), []
        for factor, its_nodes in self._window:
            involved = not frontals.isdisjoint(its_nodes)
            if its_nodes[-1] < last or (involved and its_nodes[-1] == last):
                graph.push_back(factor)
                nodes.update(its_nodes)
            elif not involved:
                others.append((factor, its_nodes))
        self._window = others
        self._linear = [f for f in self._linear if frontals.isdisjoint(f.nodes) or f.nodes[-1] <= last]
        if not nodes:
            return
        around = gtsam.Values()
        for node in nodes:
            pose, calibration, motion = self._values[node]
            around.insert(C(node), pose)
            around.insert(B(node), calibration)
            around.insert(V(node), motion)
        self._linear.append(linearize(graph, sorted(nodes), around))

    def _closest_retained(self) -> int | None:
        """The node whose neighbours are closest to each other, in nodes; the oldest of several."""
        spans = [
            (after - before, node)
            for before, node, after in zip(self._retained, self._retained[1:], self._retained[2:], strict=False)
            if not self._segment_starts & {node, after} and node not in self._held
        ]
        return min(spans)[1] if spans else None

    def _eliminate(self, nodes: list[int]) -> None:
        """Eliminates successive nodes between two retained ones."""
        ends = (
            self._retained[bisect_left(self._retained, nodes[0]) - 1],
            self._retained[bisect_right(self._retained, nodes[-1])],
        )
        frontals = set(nodes)
        involved, others = list[GaussianFactor](), list[GaussianFactor]()
        for factor in self._linear:  # factors of the older end alone go into the same factor
            taken = factor.nodes == ends[:1] or not frontals.isdisjoint(factor.nodes)
            (involved if taken else others).append(factor)
        self._linear = others
        try:
            conditional, remaining = eliminate(involved, nodes)
        except IndeterminateError:
            self._segment_starts.add(ends[1])
            self._trajectory.mark_indeterminate(ends)
        else:
            self._linear.append(remaining)
            self._conditional = conditional, [self._values[node][0] for node in nodes], ends
        for node in nodes:
            del self._values[node]
