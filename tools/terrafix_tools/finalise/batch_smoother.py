"""After landing: all that was measured in a flight, in one graph, solved to the end.

Beside the variables of the flight's own graph (custom_factors.py) there is one for the map, M_j: how far a map that
states a certain error is off, everywhere alike. What the flight decided is decided again by all that is known now:
which map matches are right (gnc.py), where the pieces between its restarts lie (sim3_pose_graph.py), and where the
cameras stood over the ground that odometry saw."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C, M, V

from terrafix.core.gate import GATE
from terrafix.core.initial_position import SEARCHED_START_M
from terrafix.estimator.factors.custom_factors import BIAS_SIZE, plane_two_view_factor
from terrafix.estimator.measurements.map_pose import straightened_pose
from terrafix_tools.finalise.fix_consistency import doubted, new_ground, torn
from terrafix_tools.finalise.flight_graph import Fix, FlightGraph, RecordedNode
from terrafix_tools.finalise.gnc import Covariances, OutlierCandidate, marginals, settle, solve, weighted
from terrafix_tools.finalise.submaps import placed_states

ROUNDS = 4  # times that what bends is made linear anew; the last one moves a flight by millimetres
# 1-sigma: a map is shifted, not turned, and its heights are in the covariance of each fix.
MAP_TURN_RAD, EXACT_M = 1e-6, 0.01
# Precisions of a prior on where a piece begins that keeps the system solvable, and says nothing: 10 rad, 1 km.
LOOSE = np.array([1e-2] * 3 + [1e-6] * 3)
READMITTED = 3  # times that map matches may come back which only the drift of the others had excluded

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Smoothed:
    """Every node of a flight: ``poses`` of the camera, ``covs`` (N, 6, 6) in tangent order, ``bias`` (N, 4).

    ``placed`` (N,) bool: a place on earth is known. ``believed`` (F,) bool, of the flight's fixes. ``map_offset_m``:
    how far each map is off, by the error that it states: east, north, up, and 1-sigma of each. ``begins`` (N,): first
    node of the piece to which each belongs. ``start_believed``: by that node, where the start was known."""

    poses: list[gtsam.Pose3]
    covs: np.ndarray
    bias: np.ndarray
    placed: np.ndarray
    believed: np.ndarray
    map_offset_m: dict[float, tuple[np.ndarray, np.ndarray]]
    begins: np.ndarray
    start_believed: dict[int, bool]


def smooth(flight: FlightGraph, progress: Progress = lambda _done, _of: None) -> Smoothed:
    """Raises RuntimeError (GTSAM's) when the measurements leave the system indeterminate."""
    return _Smoothing(flight, progress).smoothed()


class _Smoothing:
    def __init__(self, flight: FlightGraph, progress: Progress) -> None:
        bend, sigma = flight.lens
        fixes = []
        for fix in flight.fixes:  # through the lens as it is known now
            pose, cov = straightened_pose(fix.pose, fix.cov, fix.by_lens, bend - fix.lens, sigma)
            fixes.append(replace(fix, pose=pose, cov=cov))
        self._flight, self._progress = replace(flight, fixes=fixes), progress
        self._nodes = flight.graph.nodes
        self._begins = _begins(self._nodes)
        self._maps = sorted({f.map_sigma_m for f in flight.fixes})
        self._new = new_ground(flight)
        self._doubtful = [self._fix_factor(f, new) for f, new in zip(fixes, self._new, strict=True)]
        # A start that was searched is no measurement.
        known = flight.origin.start_sigma_m <= SEARCHED_START_M
        self._starts = [i for i, node in enumerate(self._nodes) if node.prior is not None and known]
        self._doubtful += [self._start_factor(i) for i in self._starts]
        self._values = self._initial()

    def smoothed(self) -> Smoothed:
        fixes = self._flight.fixes
        tried = np.array([f.tried for f in fixes] + [True] * len(self._starts), bool)
        believed = tried.copy()
        certain = self._certain(0)
        self._values, found = solve(certain, [d for d, t in zip(self._doubtful, tried, strict=True) if t], self._values)
        believed[tried] = found
        for step in range(1, ROUNDS):
            certain = self._certain(step)
            self._values = settle(certain, self._doubtful, believed, self._values)
            believed = self._reconsidered(certain, believed)
        self._progress(ROUNDS, ROUNDS)
        return self._answer(believed, self._marginals(certain, believed))

    def _initial(self) -> gtsam.Values:
        values = gtsam.Values()
        for i, state in enumerate(placed_states(self._flight)):
            values.insert(C(i), state.pose)
            values.insert(B(i), state.bias)
            values.insert(V(i), state.velocity)
        for j in range(len(self._maps)):
            values.insert(M(j), gtsam.Pose3())
        return values

    # --- factors --------------------------------------------------------------------------------------------

    def _certain(self, step: int) -> gtsam.NonlinearFactorGraph:
        """All but map matches and starts. Factors in Python are linear around the newest estimate: GTSAM hands each
        call of one a copy of all values that it is given, so they are given no more than their own."""
        graph = gtsam.NonlinearFactorGraph()
        loose = gtsam.noiseModel.Diagonal.Precisions(LOOSE)
        for i, node in enumerate(self._nodes):
            if i % 50 == 0:
                self._progress(step * len(self._nodes) + i, ROUNDS * len(self._nodes))
            if node.prior is not None:
                graph.push_back(gtsam.PriorFactorPose3(C(i), node.prior[0], loose))
            for factor in (*node.factors, *self._seen(i, node)):
                graph.push_back(self._linear(factor) if isinstance(factor, gtsam.CustomFactor) else factor)
        for j, sigma_m in enumerate(self._maps):
            sigmas = np.array([MAP_TURN_RAD] * 3 + [max(sigma_m, EXACT_M)] * 2 + [EXACT_M])
            noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
            graph.push_back(gtsam.PriorFactorPose3(M(j), gtsam.Pose3(), noise))
        return graph

    def _seen(self, i: int, node: RecordedNode) -> Iterator[gtsam.NonlinearFactor]:
        """Odometry, reduced anew around where the two cameras are now; the ground is where it was in flight."""
        if node.motion is None or node.motion.seen is None or node.keyframe_m is None:
            return
        seen, then = node.motion.seen, node.keyframe_m
        keyframe, pose = self._values.atPose3(C(node.parent)), self._values.atPose3(C(i))
        now = keyframe.translation()
        fallen = seen.ground.slope_e * (now[0] - then[0]) + seen.ground.slope_n * (now[1] - then[1])
        height_m = seen.ground.height_m + float(now[2] - then[2]) - float(fallen)
        ground = replace(seen.ground, height_m=max(height_m, 1.0))
        keys = C(node.parent), C(i), B(i)
        yield plane_two_view_factor(*keys, keyframe, pose, seen.pairs, seen.sigma, ground, B(node.parent), seen.lens)

    def _linear(self, factor: gtsam.CustomFactor) -> gtsam.NonlinearFactor:
        around = gtsam.Values()
        for key in factor.keys():  # noqa: SIM118 (a factor is no dict)
            is_pose = gtsam.symbolChr(key) == gtsam.symbolChr(C(0))
            around.insert(key, self._values.atPose3(key) if is_pose else self._values.atVector(key))
        return gtsam.LinearContainerFactor(factor.linearize(around), around)

    def _fix_factor(self, fix: Fix, new: float) -> OutlierCandidate:
        keys = M(self._maps.index(fix.map_sigma_m)), C(fix.node)

        def factor(weight: float) -> gtsam.NonlinearFactor:
            noise = gtsam.noiseModel.Gaussian.Covariance(fix.cov / (new * weight), False)
            return gtsam.BetweenFactorPose3(*keys, fix.pose, noise)

        return OutlierCandidate(factor(1.0), factor, GATE[6] * new)

    def _start_factor(self, i: int) -> OutlierCandidate:
        """A start coordinate is no witness against the map: it may have been read from that very map."""
        prior = self._nodes[i].prior
        assert prior is not None
        stated = [f.map_sigma_m for f in self._flight.fixes]
        usual = [M(self._maps.index(max(self._maps, key=stated.count)))] if stated else []

        def factor(weight: float) -> gtsam.NonlinearFactor:
            noise = gtsam.noiseModel.Gaussian.Covariance(prior[1] / weight, False)
            if usual:
                return gtsam.BetweenFactorPose3(usual[0], C(i), prior[0], noise)
            return gtsam.PriorFactorPose3(C(i), prior[0], noise)

        return OutlierCandidate(factor(1.0), factor, GATE[6])

    # --- decisions ------------------------------------------------------------------------------------------

    def _reconsidered(self, certain: gtsam.NonlinearFactorGraph, believed: np.ndarray) -> np.ndarray:
        """Fixes that are not believed, and agree with the rest after all, given how uncertain the rest is there."""
        for _ in range(READMITTED):
            found = self._marginals(certain, believed)
            fixes = self._flight.fixes
            again = [i for i in range(len(fixes)) if not believed[i] and self._allowed(fixes[i], found)]
            if not again:
                break
            believed = believed.copy()
            believed[again] = True
            self._values = settle(certain, self._doubtful, believed, self._values)
        return believed

    def _marginals(self, certain: gtsam.NonlinearFactorGraph, believed: np.ndarray) -> Covariances:
        """With what is not placed tied to where it is: nobody asks how well that is known, and the system is sound."""
        graph = weighted(certain, self._doubtful, believed.astype(float))
        firm = gtsam.noiseModel.Unit.Create(6)
        for begin in sorted(set(self._begins.tolist()) - self._tied(believed)):
            graph.push_back(gtsam.PriorFactorPose3(C(begin), self._values.atPose3(C(begin)), firm))
        return marginals(graph, self._values)

    def _tied(self, believed: np.ndarray) -> set[int]:
        """First nodes of the pieces that have a place on earth: by a map match, or by a start coordinate."""
        nodes = [*(f.node for f in self._flight.fixes), *self._starts]
        return {int(self._begins[node]) for node, b in zip(nodes, believed.tolist(), strict=True) if b}

    def _allowed(self, fix: Fix, found: Covariances) -> bool:
        shifted, camera = M(self._maps.index(fix.map_sigma_m)), C(fix.node)
        offset, pose = self._values.atPose3(shifted), self._values.atPose3(camera)
        joint = found.jointMarginalCovariance([shifted, camera])
        seen = offset.between(pose)
        by_offset = -seen.inverse().AdjointMap()
        cov = by_offset @ joint.at(shifted, shifted) @ by_offset.T + joint.at(camera, camera) + fix.cov
        across = by_offset @ joint.at(shifted, camera)
        residual = fix.pose.localCoordinates(seen)
        return float(residual @ np.linalg.solve(cov + across + across.T, residual)) <= GATE[6]

    # --- the answer -----------------------------------------------------------------------------------------

    def _answer(self, believed: np.ndarray, found: Covariances) -> Smoothed:
        fixes, n = self._flight.fixes, len(self._nodes)
        poses = [self._values.atPose3(C(i)) for i in range(n)]
        covs = np.array([found.marginalCovariance(C(i)) for i in range(n)]).reshape(n, 6, 6)
        placed = np.isin(self._begins, list(self._tied(believed)))
        starts = dict(zip(self._starts, believed[len(fixes) :].tolist(), strict=True))
        for at, spread in torn(fixes, believed[: len(fixes)], self._begins, poses):
            r = np.array([poses[i].rotation().matrix()[:2] for i in at])
            covs[at, 3:, 3:] += np.einsum("nai,ab,nbj->nij", r, spread, r)
        covs[:, 3:, 3:] += doubted(self._flight, believed[: len(fixes)], self._begins)[:, None, None] ** 2 * np.eye(3)
        if (middle := self._flight.middle) is not None:
            for i, pose in enumerate(poses):
                level, p_m = pose.rotation().matrix()[:2], pose.translation()
                height_m = p_m[2] - (self._flight.origin.ground_amsl_m or 0.0)
                aside_m, aside_cov = middle.aside(height_m * level[:, :2])
                poses[i] = gtsam.Pose3(pose.rotation(), p_m + np.append(aside_m, 0.0))
                covs[i, 3:, 3:] += level.T @ aside_cov @ level
        offsets = {}
        for j, sigma_m in enumerate(self._maps):
            sigmas = np.sqrt(np.diag(found.marginalCovariance(M(j)))[3:])
            offsets[sigma_m] = np.asarray(self._values.atPose3(M(j)).translation()), sigmas
        return Smoothed(
            poses,
            covs,
            np.array([self._values.atVector(B(i)) for i in range(n)]).reshape(n, BIAS_SIZE),
            placed,
            believed[: len(fixes)],
            offsets,
            self._begins,
            starts,
        )


def _begins(nodes: list[RecordedNode]) -> np.ndarray:
    """(N,) the first node of the piece to which each belongs."""
    begins = np.zeros(len(nodes), int)
    for i, node in enumerate(nodes):
        begins[i] = i if node.parent < 0 else begins[node.parent]
    return begins
