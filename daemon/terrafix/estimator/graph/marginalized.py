"""What has left the window of the graph, kept for the refinement after landing in as little as that needs.

A factor that leaves becomes linear, around the values that its nodes left with: those at which iSAM2 had it linear, so
that it remembers the answer (linearization_cache.py). Of the nodes only some are kept as unknowns: what lies between
two kept ones is taken out of the linear system, exactly, and follows these from then on (trajectory.py). A keyframe
parts what is before it from what comes after, but for the one factor of three keyframes of which it is the middle one:
where it is kept that is dropped. (To keep the keyframe before it as well was tried: covariances of a chain that hangs
on two nodes, and these on two others, drown in rounding.) When too many are kept, more are taken out. So the cost of a
frame does not grow with the flight, and its memory by some 270 bytes a frame."""

from bisect import bisect_left, bisect_right
from contextlib import suppress
from itertools import pairwise

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C, V

from terrafix.estimator.graph.elimination import (
    GaussianFactor,
    GaussianMarginal,
    IndeterminateError,
    eliminate,
    linear_of,
    nodes_of,
    solve,
)
from terrafix.estimator.graph.trajectory import Trajectory

SPACING = 10  # nodes from one kept node to the next, at least
THREE = 3  # nodes of a factor that says how one way is in units of the other
MOST_KEPT = 128
MOST_OPEN = 60  # nodes among which none can be kept alone: then the newest is, and what reaches beyond it is dropped

State = tuple[gtsam.Pose3, np.ndarray, np.ndarray]  # C, B, V of a node


class MarginalizedHistory:
    def __init__(self) -> None:
        self._window: list[tuple[gtsam.NonlinearFactor, tuple[int, ...]]] = []  # with nodes that have not left yet
        self._linear: list[GaussianFactor] = []
        self._left: dict[int, State] = {}  # of kept nodes and newer ones: where the linear factors are linear
        self._held: set[int] = set()  # of these: still in the window, while newer ones have left
        self._kept: list[int] = []
        self._between: list[int] = []  # nodes between the two newest kept ones: linear, and not taken out yet
        self._begins = {0}  # nodes that nothing ties to the one before
        self._track = Trajectory()

    def add(self, factors: gtsam.NonlinearFactorGraph) -> None:
        self._window += [(f, nodes_of(f)) for f in map(factors.at, range(factors.size()))]

    def leave(self, nodes: list[int], around: gtsam.Values) -> None:
        """These nodes leave the window; their factors are, or will be, linear ``around`` these values."""
        if not nodes:
            return
        passed = set(range(self._track.size, max(nodes)))
        self._held = (self._held | passed) - set(nodes)
        for node in sorted(passed | set(nodes)):
            self._freeze(node, around)

    def tidy(self) -> bool:
        """A small part of what is left to do with nodes that have left; called often, so that no frame takes long.
        -> whether there was something."""
        if self._between:
            self._take_out(self._between)
            self._between = []
            return True
        if self._kept and (node := self._next_kept()) is not None:
            self._keep(node)
            return True
        if len(self._kept) > MOST_KEPT and (node := self._least_kept()) is not None:
            # One that was held was kept beside its neighbour, and their factors may not be linear yet.
            self._linearise({node}, self._kept[bisect_right(self._kept, node)])
            self._take_out([node])
            self._kept.remove(node)
            return True
        return False

    def begin(self, node: int) -> None:
        """The graph begins anew with this node; all before it have left. Nothing ties it to them."""
        self._close()
        self._window.clear()
        self._held.clear()
        self._begins.add(node)

    def refine(self) -> tuple[np.ndarray, np.ndarray]:
        """After landing, when all nodes have left: position (N, 3) of each node by all that was measured, and its
        covariance (N, 3, 3), world axes. nan: indeterminate, what was said in flight stands."""
        self._close()
        tied = [(a, b) for a, b in pairwise(self._kept) if b not in self._begins]
        return self._track.solved(self._solved(), {node: self._left[node][0] for node in self._kept}, tied)

    def _close(self) -> None:
        """Nothing is left to do, and the newest node is kept."""
        while self.tidy():
            pass
        if self._track.size and self._track.size - 1 > self._kept[-1]:
            self._keep(self._track.size - 1)
            self.tidy()
        self._linearise(set(), self._track.size)

    def _solved(self) -> dict[int, GaussianMarginal]:
        """Of the kept nodes; without the parts of the flight that are indeterminate."""
        solved: dict[int, GaussianMarginal] = {}
        begins = sorted(self._begins & set(self._kept))
        for first, end in pairwise([*begins, self._track.size]):
            with suppress(IndeterminateError):
                solved |= solve([f for f in self._linear if first <= f.nodes[0] < end])
        return solved

    def _freeze(self, node: int, around: gtsam.Values) -> None:
        state = (around.atPose3(C(node)), around.atVector(B(node)), around.atVector(V(node)))
        before = self._left.get(node)
        self._left[node] = state
        if before is not None:  # it was held
            change = np.concatenate([before[0].logmap(state[0]), state[1] - before[1], state[2] - before[2]])
            self._linear = [f.moved(node, change) for f in self._linear]
        elif node in self._begins:
            self._kept.append(node)
        self._track.put(node, np.asarray(state[0].translation()))

    def _next_kept(self) -> int | None:
        """The next node that parts what is before it from what comes after: no factor reaches across, but for one of
        three keyframes, which is dropped then."""
        last = self._kept[-1]
        open_nodes = [n for n in self._left if n > last]
        if not open_nodes or (open_nodes[-1] - last < SPACING and self._held.isdisjoint(open_nodes)):
            return None  # which saves a look at every factor in most frames
        reach = dict.fromkeys(open_nodes, 0)
        pairs = (nodes for _, nodes in self._window if len(nodes) < THREE)
        for nodes in (*(f.nodes for f in self._linear), *pairs):
            for node in nodes:
                if node in reach:
                    reach[node] = max(reach[node], nodes[-1])
        furthest = 0
        for node in open_nodes:
            if node in self._held or (node - last >= SPACING and furthest <= node):
                return node
            furthest = max(furthest, reach[node])
        return open_nodes[-1] if len(open_nodes) >= MOST_OPEN else None

    def _keep(self, node: int) -> None:
        """Of the nodes since the last kept one only this remains."""
        self._between = [n for n in self._left if self._kept[-1] < n < node]
        self._kept.append(node)
        if self._between:
            self._linearise(set(self._between), node)

    def _linearise(self, gone: set[int], last: int) -> None:
        """The factors of nodes that will be taken out, as one, and those among nodes before ``last``. What reaches from
        the former beyond ``last`` is dropped: less is known then, never more than is true."""
        graph, nodes, others = gtsam.NonlinearFactorGraph(), set[int](), []
        for factor, its_nodes in self._window:
            touches = not gone.isdisjoint(its_nodes)
            if its_nodes[-1] < last or (touches and its_nodes[-1] == last):
                graph.push_back(factor)
                nodes.update(its_nodes)
            elif not touches:
                others.append((factor, its_nodes))
        self._window = others
        self._linear = [f for f in self._linear if gone.isdisjoint(f.nodes) or f.nodes[-1] <= last]
        if not nodes:
            return
        around = gtsam.Values()
        for node in nodes:
            pose, bias, velocity = self._left[node]
            around.insert(C(node), pose)
            around.insert(B(node), bias)
            around.insert(V(node), velocity)
        self._linear.append(linear_of(graph, sorted(nodes), around))

    def _least_kept(self) -> int | None:
        """The node whose neighbours are nearest to each other, in nodes; the oldest of several."""
        spans = [
            (after - before, node)
            for before, node, after in zip(self._kept, self._kept[1:], self._kept[2:], strict=False)
            if not self._begins & {node, after} and node not in self._held
        ]
        return min(spans)[1] if spans else None

    def _take_out(self, nodes: list[int]) -> None:
        """Neighbours in time, from between two kept ones."""
        ends = (self._kept[bisect_left(self._kept, nodes[0]) - 1], self._kept[bisect_right(self._kept, nodes[-1])])
        gone = set(nodes)
        touching, others = list[GaussianFactor](), list[GaussianFactor]()
        for factor in self._linear:  # what is known of the kept one alone goes into the same factor
            taken = factor.nodes == ends[:1] or not gone.isdisjoint(factor.nodes)
            (touching if taken else others).append(factor)
        self._linear = others
        try:
            known, left = eliminate(touching, nodes)
        except IndeterminateError:
            self._begins.add(ends[1])
            self._track.lose(ends)
        else:
            self._linear.append(left)
            self._track.follow(known, [self._left[node][0] for node in nodes], ends)
        for node in nodes:
            del self._left[node]
