"""Propagated covariances of a tree of nodes, against the marginals of GTSAM in a graph of the same factors."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, C, V

from terrafix.core.pose import exp_so3
from terrafix.estimator.graph.elimination import NODE_SIZE, values_of
from terrafix.estimator.graph.propagated_covariance import (
    CALIBRATION_BLOCK,
    MOTION_BLOCK,
    POSE_BLOCK,
    PropagatedCovariance,
)
from terrafix.estimator.state import CALIBRATION_SIZE, MOTION_SIZE, POSE_SIZE, NodeState

PARENT_OF = {1: 0, 2: 0, 3: 2, 4: 2, 5: 4, 6: 4}


class Tree:
    """Nodes with random poses, each tied to its parent, and every factor also in ``graph``."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.graph = gtsam.NonlinearFactorGraph()
        self.propagated = PropagatedCovariance()
        self.states = {
            n: NodeState(
                gtsam.Pose3(gtsam.Rot3(exp_so3(self.rng.normal(0.0, 0.5, 3))), self.rng.normal(0.0, 20.0, 3)),
                np.zeros(CALIBRATION_SIZE),
                np.zeros(MOTION_SIZE),
            )
            for n in (0, *PARENT_OF)
        }
        cov = self.cov(NODE_SIZE)
        for key, at, part in (
            (C, POSE_BLOCK, POSE_SIZE),
            (B, CALIBRATION_BLOCK, CALIBRATION_SIZE),
            (V, MOTION_BLOCK, MOTION_SIZE),
        ):
            assert at.stop - at.start == part
            cov[at, : at.start] = cov[at, at.stop :] = 0.0  # the priors of a graph are of one variable each
            self.graph.add(self.prior(key, 0, cov[at, at]))
        self.propagated.begin(0, cov)
        for node, parent in PARENT_OF.items():
            self.extend(node, parent)

    def cov(self, size: int) -> np.ndarray:
        root = self.rng.normal(size=(size, size))
        return np.asarray(root @ root.T + 0.1 * np.eye(size))

    def prior(self, key: type[C], node: int, cov: np.ndarray) -> gtsam.NonlinearFactor:
        state, noise = self.states[node], gtsam.noiseModel.Gaussian.Covariance(cov)
        if key is C:
            return gtsam.PriorFactorPose3(C(node), state.pose, noise)
        return gtsam.PriorFactorVector(key(node), state.calibration if key is B else state.motion, noise)

    def extend(self, node: int, parent: int) -> None:
        """Not a measurement of ``parent``: pose and calibration by their change, V alone."""
        between = self.states[parent].pose.between(self.states[node].pose)
        noise = gtsam.noiseModel.Gaussian.Covariance
        factors = [
            gtsam.BetweenFactorPose3(C(parent), C(node), between, noise(self.cov(POSE_SIZE))),
            gtsam.BetweenFactorVector(
                B(parent), B(node), np.zeros(CALIBRATION_SIZE), noise(self.cov(CALIBRATION_SIZE))
            ),
            self.prior(V, node, self.cov(MOTION_SIZE)),
        ]
        self.propagated.extend(node, parent, factors, self.states)
        self.add(factors)

    def attitude(self, node: int) -> gtsam.NonlinearFactor:
        """A measurement of pose and calibration together, as that of attitude and height is."""
        a, b = self.rng.normal(size=(2, 4, POSE_SIZE))
        noise = gtsam.noiseModel.Unit.Create(4)
        linear = gtsam.JacobianFactor(C(node), a, B(node), b, np.zeros(4), noise)
        return gtsam.LinearContainerFactor(linear, values_of({node: self.states[node]}))

    def fuse(self, node: int, factor: gtsam.NonlinearFactor) -> None:
        self.propagated.fuse(node, [factor], self.states[node])
        self.add([factor])

    def add(self, factors: list[gtsam.NonlinearFactor]) -> None:
        for factor in factors:
            self.graph.add(factor)

    def marginal(self, node: int) -> np.ndarray:
        """(NODE_SIZE, NODE_SIZE) of the graph."""
        values = values_of({n: self.states[n] for n in self.states})
        keys = gtsam.KeyVector([C(node), B(node), V(node)])
        return np.asarray(gtsam.Marginals(self.graph, values).jointMarginalCovariance(keys).fullMatrix())

    def rounding(self) -> float:
        """What rounding may do to a covariance, as a share of the two sigmas of its row and column: the condition of
        the information matrix, whose inverse the marginals are, with a diagonal of ones."""
        information = self.graph.linearize(values_of({n: self.states[n] for n in self.states})).hessian()[0]
        root = np.sqrt(np.diag(information))
        return float(np.finfo(float).eps * np.linalg.cond(information / np.outer(root, root)))

    def assert_propagated_as_in_the_graph(self) -> None:
        rounding = self.rounding()
        assert rounding < 1e-8  # otherwise the comparison shows nothing
        for node in self.states:
            marginal = self.marginal(node)
            sigmas = np.sqrt(np.diag(marginal))
            off = np.abs(self.propagated[node] - marginal) / np.outer(sigmas, sigmas)
            assert off.max() < rounding, f"node {node}"


@pytest.mark.parametrize("seed", range(3))
def test_propagation_gives_the_marginal_of_every_node(seed: int) -> None:
    tree = Tree(seed)
    tree.assert_propagated_as_in_the_graph()


@pytest.mark.parametrize("measured", [0, 2, 3, 6])
def test_measurements_change_the_covariance_of_all_joined_nodes_as_in_the_graph(measured: int) -> None:
    """At the root, in the middle, and at a leaf; several in a row."""
    tree = Tree(4)
    tree.fuse(measured, tree.prior(C, measured, tree.cov(POSE_SIZE)))
    tree.fuse(5, tree.attitude(5))
    tree.fuse(measured, tree.attitude(measured))
    tree.assert_propagated_as_in_the_graph()
    for node in tree.states:
        assert np.array_equal(tree.propagated[node], tree.propagated[node].T)


def test_what_a_new_node_tells_of_its_parent_improves_all_joined_nodes() -> None:
    tree = Tree(5)
    before = {node: tree.propagated[node] for node in tree.states}
    tree.fuse(2, tree.attitude(2))
    tree.states[7] = tree.states[6]
    noise = gtsam.noiseModel.Gaussian.Covariance
    factors = [
        gtsam.BetweenFactorPose3(C(6), C(7), gtsam.Pose3(), noise(tree.cov(POSE_SIZE))),
        gtsam.BetweenFactorVector(B(6), B(7), np.zeros(CALIBRATION_SIZE), noise(tree.cov(CALIBRATION_SIZE))),
        tree.prior(V, 7, tree.cov(MOTION_SIZE)),
        tree.prior(C, 7, 0.01 * tree.cov(POSE_SIZE)),
        tree.attitude(7),
    ]
    tree.propagated.extend(7, 6, factors, tree.states)
    tree.add(factors)
    tree.fuse(3, tree.attitude(3))
    tree.assert_propagated_as_in_the_graph()
    for node, cov in before.items():
        assert np.linalg.slogdet(tree.propagated[node])[1] < np.linalg.slogdet(cov)[1]


def test_nodes_that_are_not_retained_join_their_children_no_longer() -> None:
    """What is left is the covariance of each part for itself."""
    tree = Tree(6)
    tree.propagated.retain((2, 3, 5, 6))
    before = {node: tree.propagated[node].copy() for node in (5, 6)}
    child = tree.propagated[3].copy()
    tree.propagated.fuse(2, [tree.prior(C, 2, tree.cov(POSE_SIZE))], tree.states[2])
    assert not np.allclose(tree.propagated[3], child)
    for node, cov in before.items():
        assert np.array_equal(tree.propagated[node], cov)
    with pytest.raises(KeyError):
        tree.propagated[4]
