"""Batch smoother after landing: all measurements of a flight in one graph, solved to convergence.

Beside the variables of the flight's own graph (terrafix.estimator.state) there is one per map, M_j: the offset of all
map matches whose map states the same error; and one for the flight, F_0: the logarithm of the true focal length over
the described one. So heights are true ones here, and the height scale of B is that of the barometer alone; in flight
heights are as seen through the described lens, and the scale is that of both. Decisions of the flight are made again
with all data: which map matches are inliers, and which of their points (gnc.py), where the segments between resets lie
(sim3_pose_graph.py), and at which poses and through which lens odometry saw the ground."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C, F, M, V

from terrafix.core.gate import GATE
from terrafix.core.initial_position import SEARCH_START_SIGMA_M
from terrafix.core.map_error import shared_variance_m2
from terrafix.estimator.factors.focal import FocalKey
from terrafix.estimator.factors.plane_two_view import LensNoise, k1_model_sigma, plane_two_view_factor
from terrafix.estimator.factors.three_view import (
    ThreeViewPose,
    three_view_constraint_of_focal,
    three_view_factor,
)
from terrafix.estimator.filter_state import scale_sigma
from terrafix.estimator.models.bias_walk import BAROMETER_SCALE_SIGMA
from terrafix.estimator.models.lens_prior import radial_k1_sigma
from terrafix.estimator.models.plane_motion import MatchedRays, RelativePose
from terrafix.estimator.models.terrain import LEVEL_M
from terrafix.estimator.state import (
    CALIBRATION_SIZE,
    EAST,
    HEIGHT,
    HORIZONTAL,
    LOG_HEIGHT_SCALE,
    NORTH,
    POSE_SIZE,
    RADIAL_K1,
    ROTATION,
    TRANSLATION,
    UP,
)
from terrafix.smoother.gnc import Covariances, OutlierCandidate, marginals, settle, solve, step_of, weighted
from terrafix_tools.finalise.fix_consistency import ambiguous_segments, information_shares, lost_sigma
from terrafix_tools.finalise.flight_graph import Fix, FlightGraph, RecordedNode
from terrafix_tools.finalise.lens import Lens, as_described
from terrafix_tools.finalise.map_points import CONSTANT, FOCAL, K1, POSE, PoseRows, rows_of_pose
from terrafix_tools.finalise.submaps import placed_states

ROUNDS = 4  # relinearizations of custom factors; the last one moves a flight by millimetres
# 1-sigma of a map offset, beside what the map states sideways and the local error of elevation models in height: maps
# are shifted, not rotated.
MAP_TURN_RAD, EXACT_M = 1e-6, 0.01
# Precisions of a weak prior on the first pose of a segment, which keeps the system solvable: 10 rad, 1 km.
LOOSE = np.array([1e-2] * 3 + [1e-6] * 3)
NOTHING_LEARNT = 0.99  # share of the variance of a prior, above which nothing was measured [spec: rounding]
MIN_FOCAL_SIGMA = 1e-5  # of the prior of the focal length, relative: an exactly known one is a variable, too
# 1-sigma of an estimated focal length, relative, by errors that all images have in common (model of the lens, principal
# point, relief), beyond what the residuals say.
FOCAL_MODEL_SIGMA = 0.008  # [measured: docs/finalise.md]
POSE_SYMBOLS = gtsam.symbolChr(C(0)), gtsam.symbolChr(M(0))  # of variables that are poses
READMISSIONS = 3  # passes in which outliers that the drift of the others had excluded may become inliers

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Smoothed:
    """Every node of a flight: ``poses`` of the camera, ``covs`` (N, 6, 6) in tangent order, ``bias`` (N, 6).

    ``placed`` (N,) bool: the position on earth is determined. ``inliers`` (F,) bool, of the flight's map matches.
    ``map_offset_m``: offset of each map, by the error that it states: east, north, up, and 1-sigma of each. ``begins``
    (N,): first node of the segment of each node. ``start_inliers``: by that node, for start coordinates. ``lens``:
    with the 1-sigma of both of its numbers, ``lens_sigma``; ``sees_lens`` False: its focal length is as described.
    ``map_residual``: mean distance of the matched points of all inliers from their projection by the pose of the camera
    (not by the match's own one), normalised: by the last estimates in flight, and by the solution. ``moved_m`` (N,):
    horizontal distance from those estimates, in which both have the same principal point. ``camera`` (N): poses before
    the principal point is taken into account, as map matches see them."""

    poses: list[gtsam.Pose3]
    covs: np.ndarray
    bias: np.ndarray
    placed: np.ndarray
    inliers: np.ndarray
    map_offset_m: dict[float, tuple[np.ndarray, np.ndarray]]
    begins: np.ndarray
    start_inliers: dict[int, bool]
    lens: Lens
    lens_sigma: Lens
    sees_lens: bool
    map_residual: tuple[float | None, float | None]
    moved_m: np.ndarray
    camera: list[gtsam.Pose3]

    def on_map(self, fix: Fix) -> gtsam.Pose3:
        """The camera of a map match in the axes of its map, which is off; a map that no other match knows is not."""
        at = self.camera[fix.node]
        offset_m = self.map_offset_m[fix.map_sigma_m][0] if fix.map_sigma_m in self.map_offset_m else np.zeros(3)
        return gtsam.Pose3(at.rotation(), at.translation() - offset_m)

    def lens_at(self, node: int) -> Lens:
        return Lens(float(self.bias[node][RADIAL_K1]), self.lens.log_focal)


def smooth(
    flight: FlightGraph, progress: Progress = lambda _done, _of: None, *, estimates_lens: bool = True
) -> Smoothed:
    """``estimates_lens`` False: the focal length stays as described. Raises RuntimeError (GTSAM's) when the
    measurements leave the system indeterminate."""
    return _Smoothing(flight, progress, estimates_lens).smoothed()


class _Smoothing:
    def __init__(self, flight: FlightGraph, progress: Progress, estimates_lens: bool = True) -> None:
        self._flight, self._progress = flight, progress
        self._nodes = flight.recorder.nodes
        self._begins = _begins(self._nodes)
        self._maps = sorted({f.map_sigma_m for f in flight.fixes})
        self._shares = information_shares(flight)
        self._values = self._initial()
        # A start position that was found by searching is not a measurement.
        known = flight.origin.start_sigma_m <= SEARCH_START_SIGMA_M
        self._starts = [i for i, node in enumerate(self._nodes) if node.prior is not None and known]
        # Only points that three keyframes see separate the lens from relief. Without them it stays as described, and
        # heights are as seen through it.
        camera = flight.origin.camera
        seen = any(node.triples is not None and len(node.triples.xy) for node in self._nodes)
        self._sees_lens = estimates_lens and seen
        self._focal_sigma = max(camera.focal_sigma if self._sees_lens else 0.0, MIN_FOCAL_SIGMA)
        self._rows: list[PoseRows] = []
        self._candidates: list[OutlierCandidate] = []

    def smoothed(self) -> Smoothed:
        fixes = self._flight.fixes
        tried = np.array([f.tried for f in fixes] + [True] * len(self._starts), bool)
        inliers = tried.copy()
        certain = self._certain(0)
        self._see_map()
        self._values, found = solve(
            certain, [d for d, t in zip(self._candidates, tried, strict=True) if t], self._values
        )
        inliers[tried] = found
        for step in range(1, ROUNDS):
            certain = self._certain(step)
            self._see_map()
            self._values = settle(certain, self._candidates, inliers, self._values)
            inliers = self._readmitted(certain, inliers)
        self._progress(ROUNDS, ROUNDS)
        return self._result(certain, inliers)

    def _initial(self) -> gtsam.Values:
        values = gtsam.Values()
        for i, state in enumerate(placed_states(self._flight)):
            values.insert(C(i), state.pose)
            values.insert(B(i), state.calibration)
            values.insert(V(i), state.motion)
        for j in range(len(self._maps)):
            values.insert(M(j), gtsam.Pose3())
        values.insert(F(0), np.zeros(1))
        return values

    def _lens(self, node: int) -> Lens:
        """At the newest estimate."""
        k1 = self._values.atVector(B(node))[RADIAL_K1]
        return Lens(float(k1), float(self._values.atVector(F(0))[0]))

    # --- factors --------------------------------------------------------------------------------------------

    def _certain(self, step: int) -> gtsam.NonlinearFactorGraph:
        """All factors but map matches and starts. Custom factors are linearised at the newest estimate with their own
        values only, because GTSAM copies all values that it is given at each call."""
        graph = gtsam.NonlinearFactorGraph()
        loose = gtsam.noiseModel.Diagonal.Precisions(LOOSE)
        for i, node in enumerate(self._nodes):
            if i % 50 == 0:
                self._progress(step * len(self._nodes) + i, ROUNDS * len(self._nodes))
            if node.prior is not None:
                graph.push_back(gtsam.PriorFactorPose3(C(i), node.prior[0], loose))
            for factor in (*node.factors, *self._calibration_factors(i, node), *self._odometry_factors(i, node)):
                graph.push_back(self._linear(factor) if isinstance(factor, gtsam.CustomFactor) else factor)
        for loop in self._flight.loops:
            graph.push_back(self._linear(self._plane_factor(loop.parent, loop.node, loop.motion, loop.keyframe_m)))
        for j, sigma_m in enumerate(self._maps):
            sigmas = np.array(
                [MAP_TURN_RAD] * 3 + [max(math.sqrt(shared_variance_m2(sigma_m)), EXACT_M)] * 2 + [LEVEL_M]
            )
            noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
            graph.push_back(gtsam.PriorFactorPose3(M(j), gtsam.Pose3(), noise))
        graph.push_back(self._focal_prior(0.0, self._focal_sigma))
        return graph

    def _focal_prior(self, value: float, sigma: float) -> gtsam.NonlinearFactor:
        return gtsam.PriorFactorVector(F(0), np.array([value]), gtsam.noiseModel.Isotropic.Sigma(1, sigma))

    def _calibration_factors(self, i: int, node: RecordedNode) -> Iterator[gtsam.NonlinearFactor]:
        """Prior of B of the first node of a graph. In flight the height scale was that of barometer and focal length
        together. A prior from before anything was measured is taken apart; later ones, also of an estimator that was
        started again in flight, say what was learnt of the sum."""
        if node.calibration is None:
            return
        mean, cov = node.calibration
        air = np.zeros((1, CALIBRATION_SIZE))
        air[0, LOG_HEIGHT_SCALE] = 1.0 / BAROMETER_SCALE_SIGMA
        if not self._sees_lens:
            yield gtsam.PriorFactorVector(B(i), mean, gtsam.noiseModel.Gaussian.Covariance(cov, False))
            return
        unmeasured = scale_sigma(self._flight.origin.camera) ** 2
        if cov[LOG_HEIGHT_SCALE, LOG_HEIGHT_SCALE] > NOTHING_LEARNT * unmeasured:
            cov = cov.copy()
            cov[LOG_HEIGHT_SCALE, :] = cov[:, LOG_HEIGHT_SCALE] = 0.0
            cov[LOG_HEIGHT_SCALE, LOG_HEIGHT_SCALE] = BAROMETER_SCALE_SIGMA**2
            yield gtsam.PriorFactorVector(B(i), mean, gtsam.noiseModel.Gaussian.Covariance(cov, False))
            return
        root = np.linalg.inv(np.linalg.cholesky(cov))
        around = gtsam.Values()
        around.insert(B(i), mean)
        around.insert(F(0), np.zeros(1))
        unit = gtsam.noiseModel.Unit.Create
        both = gtsam.JacobianFactor(
            B(i), root, F(0), root[:, [LOG_HEIGHT_SCALE]], np.zeros(CALIBRATION_SIZE), unit(CALIBRATION_SIZE)
        )
        yield gtsam.LinearContainerFactor(both, around)
        alone = gtsam.Values()
        alone.insert(B(i), np.zeros(CALIBRATION_SIZE))
        yield gtsam.LinearContainerFactor(gtsam.JacobianFactor(B(i), air, np.zeros(1), unit(1)), alone)

    def _odometry_factors(self, i: int, node: RecordedNode) -> Iterator[gtsam.NonlinearFactor]:
        """Factors of the pairs and of the triples, reduced at the newest estimates of cameras and lens."""
        yield from self._three_view_factor(node, i, FocalKey(F(0), self._lens(i).log_focal))
        if node.motion is not None and node.motion.rays is not None and node.keyframe_m is not None:
            yield self._plane_factor(node.parent, i, node.motion, node.keyframe_m)

    def _plane_factor(self, parent: int, i: int, motion: RelativePose, then: np.ndarray) -> gtsam.CustomFactor:
        """Of the pairs that two nodes see; the ground plane is that of the flight, in which ``parent`` was at ``then``
        (3,)."""
        rays, lens, camera = motion.rays, self._lens(i), self._flight.origin.camera
        assert rays is not None
        keyframe, pose = self._values.atPose3(C(parent)), self._values.atPose3(C(i))
        now = keyframe.translation()
        fall_m = rays.ground.slope_e * (now[EAST] - then[EAST]) + rays.ground.slope_n * (now[NORTH] - then[NORTH])
        height_m = rays.ground.height_m + float(now[UP] - then[UP]) - float(fall_m)
        ground = replace(rays.ground, height_m=max(height_m, 1.0))
        pairs = np.hstack([lens.rays(as_described(rays.pairs[:, xy], rays.k1)) for xy in (slice(0, 2), slice(2, 4))])
        sigma = float(lens.normalised(np.array(rays.sigma)))
        repeats = float(np.sqrt(len(self._nodes)))  # relief is no new one in each pair: as a whole they give the prior
        noise = LensNoise(repeats * radial_k1_sigma(camera), repeats * camera.focal_sigma)
        of_plane = noise if self._sees_lens else None
        seen = MatchedRays(pairs, sigma, ground, lens.k1)
        return plane_two_view_factor(C(parent), C(i), B(i), keyframe, pose, seen, B(parent), of_plane)

    def _three_view_factor(self, node: RecordedNode, i: int, focal: FocalKey) -> Iterator[gtsam.NonlinearFactor]:
        seen = node.triples
        if seen is None or not len(seen.xy):
            return
        lens, nodes = self._lens(i), (seen.first, node.parent, i)
        cameras = [self._values.atPose3(C(n)) for n in nodes]
        if seen.rises:
            rises_m = [float(self._values.atVector(B(n))[HEIGHT]) for n in nodes]
            cameras = [
                gtsam.Pose3(pose.rotation(), pose.translation() + np.array([0.0, 0.0, m - rises_m[1]]))
                for pose, m in zip(cameras, rises_m, strict=True)
            ]
        first, middle, last = cameras
        height_m = max(float(middle.translation()[UP]) - seen.ground_m, 1.0)
        guess = ThreeViewPose(middle.between(first), middle.between(last), height_m, seen.ground_m, lens.k1)
        triples, sigma = lens.normalised(seen.xy), float(lens.normalised(np.array(seen.sigma)))
        constraint = three_view_constraint_of_focal(triples, sigma, guess, self._flight.origin.camera.focal_sigma)
        if constraint is not None:
            first_key, middle_key, last_key = ((C(n), B(n)) for n in nodes)
            keys = first_key, middle_key, last_key
            yield three_view_factor(keys, constraint, rises=seen.rises, focal=focal)

    def _linear(self, factor: gtsam.CustomFactor) -> gtsam.NonlinearFactor:
        around = gtsam.Values()
        for key in factor.keys():  # noqa: SIM118 (a factor is no dict)
            is_pose = gtsam.symbolChr(key) in POSE_SYMBOLS
            around.insert(key, self._values.atPose3(key) if is_pose else self._values.atVector(key))
        return gtsam.LinearContainerFactor(factor.linearize(around), around)

    def _see_map(self) -> None:
        """Map matches and starts, through the lens of the newest estimate."""
        fixes = self._flight.fixes
        self._rows = [self._fix_rows(fix) for fix in fixes]
        seen = zip(fixes, self._rows, self._shares, strict=True)
        self._candidates = [self._fix_factor(fix, rows, share) for fix, rows, share in seen]
        self._candidates += [self._start_factor(i) for i in self._starts]

    def _fix_rows(self, fix: Fix) -> PoseRows:
        lens = self._lens(fix.node)
        fit = None if fix.points is None else fix.points.fit(lens)
        if fix.points is not None and fit is not None:
            return fix.points.rows(fit)
        return rows_of_pose(fix.pose, fix.cov, fix.by_lens, Lens(fix.k1))

    def _fix_factor(self, fix: Fix, seen: PoseRows, share: float) -> OutlierCandidate:
        keys = [M(self._maps.index(fix.map_sigma_m)), C(fix.node), B(fix.node), F(0)]

        def factor(weight: float) -> gtsam.NonlinearFactor:
            return self._linear(map_match_factor(keys, seen, share * weight))

        return OutlierCandidate(factor(1.0), factor, GATE[6] * share)

    def _start_factor(self, i: int) -> OutlierCandidate:
        """A start coordinate may have been read from the map, so it is relative to the map's offset."""
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

    def _readmitted(self, certain: gtsam.NonlinearFactorGraph, inliers: np.ndarray) -> np.ndarray:
        """Adds outliers that are consistent with the solution, given its covariance there."""
        for _ in range(READMISSIONS):
            found = self._marginals(certain, inliers)
            fixes = range(len(self._flight.fixes))
            again = [i for i in fixes if not inliers[i] and self._consistent(i, found)]
            if not again:
                break
            inliers = inliers.copy()
            inliers[again] = True
            self._values = settle(certain, self._candidates, inliers, self._values)
        return inliers

    def _marginals(self, certain: gtsam.NonlinearFactorGraph, inliers: np.ndarray) -> Covariances:
        """With segments without a position on earth fixed where they are: their covariance is not used, and the system
        stays well conditioned."""
        return marginals(self._firm_graph(certain, inliers), self._values)

    def _firm_graph(self, certain: gtsam.NonlinearFactorGraph, inliers: np.ndarray) -> gtsam.NonlinearFactorGraph:
        graph = weighted(certain, self._candidates, inliers.astype(float))
        firm = gtsam.noiseModel.Unit.Create(6)
        for begin in sorted(set(self._begins.tolist()) - self._tied(inliers)):
            graph.push_back(gtsam.PriorFactorPose3(C(begin), self._values.atPose3(C(begin)), firm))
        return graph

    def _tied(self, inliers: np.ndarray) -> set[int]:
        """First nodes of the segments with a position on earth: by a map match, or by a start coordinate."""
        nodes = [*(f.node for f in self._flight.fixes), *self._starts]
        return {int(self._begins[node]) for node, b in zip(nodes, inliers.tolist(), strict=True) if b}

    def _consistent(self, i: int, found: Covariances) -> bool:
        """Whether map match ``i`` agrees with the solution, given its covariance there."""
        fix = self._flight.fixes[i]
        shifted, camera = M(self._maps.index(fix.map_sigma_m)), C(fix.node)
        offset, pose = self._values.atPose3(shifted), self._values.atPose3(camera)
        measured, cov_m = self._measured(i, found)
        joint = found.jointMarginalCovariance([shifted, camera])
        seen = offset.between(pose)
        by_offset = -seen.inverse().AdjointMap()
        cov = by_offset @ joint.at(shifted, shifted) @ by_offset.T + joint.at(camera, camera) + cov_m
        across = by_offset @ joint.at(shifted, camera)
        residual = measured.localCoordinates(seen)
        return float(residual @ np.linalg.solve(cov + across + across.T, residual)) <= GATE[6]

    def _measured(self, i: int, found: Covariances) -> tuple[gtsam.Pose3, np.ndarray]:
        """Pose of map match ``i`` through the lens of the newest estimate, with the covariance of both."""
        seen, node = self._rows[i], self._flight.fixes[i].node
        lens = self._lens(node)
        rows = seen.rows[:, POSE]
        cov = np.linalg.inv(rows.T @ rows)
        by_lens = -cov @ rows.T @ seen.rows[:, [K1, FOCAL]]
        change = np.array([lens.k1 - seen.lens.k1, lens.log_focal - seen.lens.log_focal])
        sigmas = self._lens_sigma(node, found)
        of_lens = np.diag([sigmas.k1, sigmas.log_focal]) ** 2
        return seen.pose.retract(by_lens @ change), cov + by_lens @ of_lens @ by_lens.T

    def _lens_sigma(self, node: int, found: Covariances) -> Lens:
        """1-sigma of the lens, also by what the model of it leaves out."""
        k1 = np.hypot(
            np.sqrt(found.marginalCovariance(B(node))[RADIAL_K1, RADIAL_K1]), k1_model_sigma(self._lens(node).k1)
        )
        focal = np.hypot(np.sqrt(found.marginalCovariance(F(0))[0, 0]), self._focal_model_sigma(found))
        return Lens(float(k1), float(focal))

    def _focal_model_sigma(self, found: Covariances) -> float:
        """FOCAL_MODEL_SIGMA, or what the description leaves for it."""
        left = self._focal_sigma**2 - float(found.marginalCovariance(F(0))[0, 0])
        return min(FOCAL_MODEL_SIGMA, float(np.sqrt(max(left, 0.0))))

    def _moved_by_focal(self, graph: gtsam.NonlinearFactorGraph) -> np.ndarray:
        """(N, 6) change of every pose, tangent order, with the focal length, per unit of its logarithm."""
        now = float(self._values.atVector(F(0))[0])
        steps = []
        for value in (now, now + FOCAL_MODEL_SIGMA):
            firm = gtsam.NonlinearFactorGraph(graph)
            firm.push_back(self._focal_prior(value, MIN_FOCAL_SIGMA))
            steps.append(step_of(firm, self._values))
        moved = [steps[1].at(C(i)) - steps[0].at(C(i)) for i in range(len(self._nodes))]
        return np.array(moved).reshape(-1, 6) / FOCAL_MODEL_SIGMA

    # --- result -----------------------------------------------------------------------------------------

    def _result(self, certain: gtsam.NonlinearFactorGraph, inliers: np.ndarray) -> Smoothed:
        graph = self._firm_graph(certain, inliers)
        found = marginals(graph, self._values)
        fixes, n = self._flight.fixes, len(self._nodes)
        poses = [self._values.atPose3(C(i)) for i in range(n)]
        covs = np.array([found.marginalCovariance(C(i)) for i in range(n)]).reshape(n, 6, 6)
        moved_m = np.array(
            [
                np.linalg.norm((pose.translation() - node.state.pose.translation())[HORIZONTAL])
                for pose, node in zip(poses, self._nodes, strict=True)
            ]
        )
        placed = np.isin(self._begins, list(self._tied(inliers)))
        starts = dict(zip(self._starts, inliers[len(fixes) :].tolist(), strict=True))
        for at, spread in ambiguous_segments(fixes, inliers[: len(fixes)], self._begins, poses):
            r = np.array([poses[i].rotation().matrix()[HORIZONTAL] for i in at])
            covs[at, TRANSLATION, TRANSLATION] += np.einsum("nai,ab,nbj->nij", r, spread, r)
        lens, sigma = self._lens(n - 1), self._focal_model_sigma(found)
        if sigma > 0.0:
            by_focal = sigma * self._moved_by_focal(graph)
            covs += by_focal[:, :, None] * by_focal[:, None, :]
        lost_m = lost_sigma(self._flight, inliers[: len(fixes)], self._begins)
        covs[:, TRANSLATION, TRANSLATION] += lost_m[:, None, None] ** 2 * np.eye(3)
        camera = list(poses)
        if (principal_point := self._flight.principal_point) is not None:
            for i, pose in enumerate(poses):
                level, p_m = pose.rotation().matrix()[HORIZONTAL], pose.translation()
                seen_m = np.exp(-lens.log_focal) * (p_m[UP] - (self._flight.origin.ground_amsl_m or 0.0))
                aside_m, aside_cov = principal_point.shift(seen_m * level[:, :2])
                poses[i] = gtsam.Pose3(pose.rotation(), p_m + np.append(aside_m, 0.0))
                covs[i, TRANSLATION, TRANSLATION] += level.T @ aside_cov @ level
        offsets = {}
        for j, sigma_m in enumerate(self._maps):
            sigmas = np.sqrt(np.diag(found.marginalCovariance(M(j)))[TRANSLATION])
            offsets[sigma_m] = np.asarray(self._values.atPose3(M(j)).translation()), sigmas
        return Smoothed(
            poses,
            covs,
            np.array([self._values.atVector(B(i)) for i in range(n)]).reshape(n, CALIBRATION_SIZE),
            placed,
            inliers[: len(fixes)],
            offsets,
            self._begins,
            starts,
            lens,
            self._lens_sigma(n - 1, found),
            self._sees_lens,
            self._map_residual(inliers),
            moved_m,
            camera,
        )

    def _map_residual(self, inliers: np.ndarray) -> tuple[float | None, float | None]:
        in_flight, lengths = Lens(self._flight.radial_k1[0]), list[tuple[float, float]]()
        for fix, is_inlier in zip(self._flight.fixes, inliers.tolist(), strict=False):
            fit = fix.points.fit(self._lens(fix.node)) if is_inlier and fix.points is not None else None
            if fix.points is None or fit is None:
                continue
            offset = self._values.atPose3(M(self._maps.index(fix.map_sigma_m)))
            after = offset.between(self._values.atPose3(C(fix.node)))
            before = self._nodes[fix.node].state.pose
            ways = ((before, in_flight), (after, fit.lens))
            of_match = [fix.points.off(pose, lens)[fit.inliers] for pose, lens in ways]
            lengths += list(zip(*(one.tolist() for one in of_match), strict=True))
        if not lengths:
            return None, None
        before_after = np.mean(lengths, axis=0)
        return float(before_after[0]), float(before_after[1])


def _begins(nodes: list[RecordedNode]) -> np.ndarray:
    """(N,) first node of the segment of each node."""
    begins = np.zeros(len(nodes), int)
    for i, node in enumerate(nodes):
        begins[i] = i if node.parent < 0 else begins[node.parent]
    return begins


def map_match_factor(keys: list[int], seen: PoseRows, information: float) -> gtsam.CustomFactor:
    """Residual of a map match, its ``information`` times: on the offset of its map, the pose of the camera, its
    calibration, and the focal length (``keys``).

    Rotation and translation of the camera are compared one by one, so that moving map and camera alike changes nothing.
    With the logarithm of both together, the rotation in the residual made the offset of the map observable."""
    rows = math.sqrt(information) * seen.rows
    r_seen, p_seen = seen.pose.rotation(), seen.pose.translation()
    by_k1 = np.zeros((len(rows), CALIBRATION_SIZE), order="F")
    by_k1[:, RADIAL_K1] = rows[:, K1]

    def error(_this: object, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        offset, pose = values.atPose3(keys[0]), values.atPose3(keys[1])
        turn = gtsam.Rot3.Logmap(r_seen.between(pose.rotation()))
        change = np.append(turn, r_seen.unrotate(pose.translation() - offset.translation() - p_seen))
        lens = values.atVector(keys[2])[RADIAL_K1] - seen.lens.k1, values.atVector(keys[3])[0] - seen.lens.log_focal
        if jacobians is not None:
            by_pose, by_offset = np.zeros((POSE_SIZE, POSE_SIZE)), np.zeros((POSE_SIZE, POSE_SIZE))
            by_pose[ROTATION, ROTATION] = gtsam.Rot3.LogmapDerivative(turn)
            by_pose[TRANSLATION, TRANSLATION] = r_seen.between(pose.rotation()).matrix()
            by_offset[TRANSLATION, TRANSLATION] = -r_seen.between(offset.rotation()).matrix()
            jacobians[0] = np.asfortranarray(rows[:, POSE] @ by_offset)
            jacobians[1] = np.asfortranarray(rows[:, POSE] @ by_pose)
            jacobians[2], jacobians[3] = by_k1, np.asfortranarray(rows[:, [FOCAL]])
        return np.asarray(rows[:, POSE] @ change + rows[:, [K1, FOCAL]] @ lens + rows[:, CONSTANT])

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(rows)), keys, error)
