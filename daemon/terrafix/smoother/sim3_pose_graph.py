"""Pose graph of submaps in Sim(3), with robust absolute and relative constraints.

Strasdat, Montiel, Davison: Scale Drift-Aware Large Scale Monocular SLAM (RSS 2010). A keyframe is a similarity S_k: its
camera in the world, and the scale of its submap there. Absolute constraints ("anchors") give the pose and not the
scale; the distance of two of them gives the scale. Submaps need not overlap, because they share the world frame. Every
anchor and every relocalisation ("join") may be an outlier."""

from collections import Counter
from collections.abc import Iterator

import gtsam
import numpy as np

from terrafix.core.gate import GATE
from terrafix.core.pose import TRANSLATION
from terrafix.smoother.gnc import Covariances, OutlierCandidate, marginals, settle, solve, weighted
from terrafix.smoother.sim3_consensus import Similarity, place
from terrafix.smoother.submap_types import AbsoluteConstraint, MergedSubmaps, RelativeConstraint, Submap, SubmapPose

# Precisions of a weak prior on every submap, which keeps the system solvable without inliers: sigmas of 10 rad, 1 km,
# and e^3 of the scale.
LOOSE = np.array([1e-2] * 3 + [1e-6] * 3 + [0.1])
# Tangent of a similarity in GTSAM: that of the pose, then the logarithm of the scale.
POSE_OF_SIM3, LOG_SCALE = slice(0, 6), 6
MAX_SCALE_SIGMA = 0.3  # share: a submap with a less certain scale is not placed
READMISSIONS = 3  # passes in which outliers that the drift of the others had excluded may become inliers


def merge(
    submaps: list[Submap], anchors: list[AbsoluteConstraint], joins: list[RelativeConstraint] | None = None
) -> MergedSubmaps:
    """Places every submap that its anchors or its relocalisations determine; gives a reason for the others.

    The result does not depend on the order of ``anchors`` and ``joins``."""
    return Sim3PoseGraph(submaps, anchors, joins or []).merged()


class Sim3PoseGraph:
    """See ``merge``. Constraints are used in an order of their own, so that the result does not depend on theirs."""

    def __init__(
        self, submaps: list[Submap], anchors: list[AbsoluteConstraint], joins: list[RelativeConstraint]
    ) -> None:
        self._submaps = submaps
        self._anchors = sorted(range(len(anchors)), key=lambda i: _order_of_anchor(anchors[i]))
        self._joins = sorted(range(len(joins)), key=lambda i: (*joins[i].first, *joins[i].second, *joins[i].p_b_in_a))
        self._given_anchors, self._given_joins = anchors, joins
        ends = np.cumsum([0, *(len(s) for s in submaps)])
        self._first_key = [int(k) for k in ends]
        self._starts = self._initial_similarities()

    def merged(self) -> MergedSubmaps:
        n_anchors, n_joins = len(self._given_anchors), len(self._given_joins)
        anchors, joins = np.zeros(n_anchors, bool), np.zeros(n_joins, bool)
        if not any(self._starts):
            return MergedSubmaps(
                [None] * len(self._submaps), [self._why_not(f) for f in self._numbers()], anchors, joins
            )
        used = [i for i in self._anchors if self._starts[self._given_anchors[i].submap] is not None]
        tied = [i for i in self._joins if self._starts[self._given_joins[i].first[0]] is not None]
        candidates = [self._anchor_factor(self._given_anchors[i]) for i in used]
        candidates += [self._join_factor(self._given_joins[i]) for i in tied]
        certain, values = self._chains()
        values, inliers = solve(certain, candidates, values)
        for _ in range(READMISSIONS + 1):
            anchors[used], joins[tied] = inliers[: len(used)], inliers[len(used) :]
            reasons = self._reasons(anchors, joins)
            held = self._with_fixed_submaps(certain, values, reasons)
            found = marginals(weighted(held, candidates, inliers.astype(float)), values)
            # Relocalisations are not readmitted: that would need the joint covariance of two keyframes.
            outliers = [k for k in range(len(used)) if not inliers[k]]
            again = [k for k in outliers if self._consistent(self._given_anchors[used[k]], values, found)]
            if not again:
                break
            inliers[again] = True
            values = settle(held, candidates, inliers, values)
        placements, why = [], []
        for number, reason in zip(self._numbers(), reasons, strict=True):
            placed = None if reason else self._placement(number, values, found)
            if placed is None and not reason:
                reason = "the anchors do not determine its scale"
            placements.append(placed)
            why.append(reason)
        return MergedSubmaps(placements, why, anchors, joins)

    # --- initial values -------------------------------------------------------------------------------------

    def _initial_similarities(self) -> list[Similarity | None]:
        """From the anchors of each submap, and without these from a relocalisation to a submap that has some."""
        own: list[list[AbsoluteConstraint]] = [[] for _ in self._submaps]
        for i in self._anchors:
            own[self._given_anchors[i].submap].append(self._given_anchors[i])
        starts = [place(submap, its) for submap, its in zip(self._submaps, own, strict=True)]
        for _ in self._submaps:
            for i in self._joins:
                self._carry_over(self._given_joins[i], starts)
        return starts

    def _carry_over(self, join: RelativeConstraint, starts: list[Similarity | None]) -> None:
        (a, i), (b, j) = join.first, join.second
        at_a = self._submaps[a].r_f_c[i], self._submaps[a].p_c_in_f[i]
        at_b = self._submaps[b].r_f_c[j], self._submaps[b].p_c_in_f[j]
        if (here := starts[a]) is not None and starts[b] is None:
            r = here.r @ at_a[0] @ join.r_a_b @ at_b[0].T
            seen = here.position(at_a[1] + at_a[0] @ join.p_b_in_a)
            scale = here.scale * join.ratio
            starts[b] = Similarity(r, seen - scale * r @ at_b[1], scale)
        elif (there := starts[b]) is not None and starts[a] is None:
            r = there.r @ at_b[0] @ join.r_a_b.T @ at_a[0].T
            scale = there.scale / join.ratio
            seen = there.position(at_b[1]) - scale * r @ at_a[0] @ join.p_b_in_a
            starts[a] = Similarity(r, seen - scale * r @ at_a[1], scale)

    # --- factors ------------------------------------------------------------------------------------------

    def _chains(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Relative motions of every submap that has initial values, in metres by its initial scale."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        loose = gtsam.noiseModel.Diagonal.Precisions(LOOSE)
        for number, key, start in self._initialised():
            submap = self._submaps[number]
            r_w, p_w = start.r @ submap.r_f_c, start.position(submap.p_c_in_f)
            r_step, p_step = submap.steps()
            covs = np.zeros((len(submap), 7, 7))
            to_m = np.array([1.0, 1.0, 1.0, *([start.scale] * 3)])
            covs[:, POSE_OF_SIM3, POSE_OF_SIM3] = submap.step_cov * np.outer(to_m, to_m)
            covs[:, LOG_SCALE, LOG_SCALE] = submap.scale_walk**2
            for i in range(len(submap)):
                values.insert(key + i, gtsam.Similarity3(r_w[i], p_w[i], 1.0))
                if i == 0:
                    continue
                step = gtsam.Similarity3(r_step[i], start.scale * p_step[i], 1.0)
                noise = gtsam.noiseModel.Gaussian.Covariance(covs[i], False)
                parent = key + int(submap.parent[i])
                graph.push_back(gtsam.BetweenFactorSimilarity3(parent, key + i, step, noise))
            first = values.atSimilarity3(key)
            graph.push_back(gtsam.PriorFactorSimilarity3(key, first, loose))
            if submap.scale_sigma is not None:
                known = np.array([0.0] * 6 + [submap.scale_sigma**-2])
                metre = gtsam.Similarity3(first.rotation().matrix(), first.translation() * start.scale, 1 / start.scale)
                noise = gtsam.noiseModel.Diagonal.Precisions(known)
                graph.push_back(gtsam.PriorFactorSimilarity3(key, metre, noise))
        return graph, values

    def _with_fixed_submaps(
        self, certain: gtsam.NonlinearFactorGraph, values: gtsam.Values, reasons: list[str]
    ) -> gtsam.NonlinearFactorGraph:
        """With submaps that are not placed fixed where they are: their covariance is not used, and the system stays
        well conditioned."""
        held = gtsam.NonlinearFactorGraph(certain)
        firm = gtsam.noiseModel.Unit.Create(7)
        for number, key, _ in self._initialised():
            if reasons[number]:
                held.push_back(gtsam.PriorFactorSimilarity3(key, values.atSimilarity3(key), firm))
        return held

    def _anchor_factor(self, anchor: AbsoluteConstraint) -> OutlierCandidate:
        key = self._first_key[anchor.submap] + anchor.keyframe
        pose = gtsam.Similarity3(anchor.r_w_c, anchor.p_c_in_w_m, 1.0)
        information = np.zeros((7, 7))
        information[POSE_OF_SIM3, POSE_OF_SIM3] = np.linalg.inv(anchor.cov)
        square_root = np.zeros((7, 7))
        square_root[POSE_OF_SIM3, POSE_OF_SIM3] = np.linalg.cholesky(information[POSE_OF_SIM3, POSE_OF_SIM3]).T

        def factor(weight: float) -> gtsam.NonlinearFactor:
            noise = gtsam.noiseModel.Gaussian.SqrtInformation(np.sqrt(weight) * square_root, False)
            return gtsam.PriorFactorSimilarity3(key, pose, noise)

        return OutlierCandidate(factor(1.0), factor, GATE[6])

    def _join_factor(self, join: RelativeConstraint) -> OutlierCandidate:
        (a, i), (b, j) = join.first, join.second
        start_a, start_b = self._starts[a], self._starts[b]
        assert start_a is not None and start_b is not None
        ratio = join.ratio * start_a.scale / start_b.scale
        step = gtsam.Similarity3(join.r_a_b, start_a.scale * join.p_b_in_a / ratio, ratio)
        to_m = np.array([1.0, 1.0, 1.0, *([start_a.scale] * 3)])
        cov = np.zeros((7, 7))
        cov[POSE_OF_SIM3, POSE_OF_SIM3] = join.cov * np.outer(to_m, to_m)
        cov[LOG_SCALE, LOG_SCALE] = join.ratio_sigma**2
        keys = self._first_key[a] + i, self._first_key[b] + j

        def factor(weight: float) -> gtsam.NonlinearFactor:
            return gtsam.BetweenFactorSimilarity3(
                *keys, step, gtsam.noiseModel.Gaussian.Covariance(cov / weight, False)
            )

        return OutlierCandidate(factor(1.0), factor, GATE[7])

    def _consistent(self, anchor: AbsoluteConstraint, values: gtsam.Values, found: Covariances) -> bool:
        """Whether an anchor is consistent with the solution, given its covariance there."""
        key = self._first_key[anchor.submap] + anchor.keyframe
        pose = gtsam.Similarity3(anchor.r_w_c, anchor.p_c_in_w_m, 1.0)
        residual = pose.localCoordinates(values.atSimilarity3(key))[POSE_OF_SIM3]
        cov = found.marginalCovariance(key)[POSE_OF_SIM3, POSE_OF_SIM3] + anchor.cov
        return float(residual @ np.linalg.solve(cov, residual)) <= GATE[6]

    # --- result -----------------------------------------------------------------------------------------

    def _placement(self, number: int, values: gtsam.Values, found: Covariances) -> SubmapPose | None:
        start = self._starts[number]
        assert start is not None
        keys = [self._first_key[number] + i for i in range(len(self._submaps[number]))]
        states = [values.atSimilarity3(k) for k in keys]
        covs = np.array([found.marginalCovariance(k) for k in keys])
        if float(np.sqrt(np.median(covs[:, LOG_SCALE, LOG_SCALE]))) > MAX_SCALE_SIGMA:
            return None
        scales = np.array([s.scale() for s in states])
        covs[:, TRANSLATION, :] *= scales[:, None, None]
        covs[:, :, TRANSLATION] *= scales[:, None, None]
        return SubmapPose(
            r_w_c=np.array([s.rotation().matrix() for s in states]),
            p_c_in_w_m=np.array([s.translation() for s in states]) * scales[:, None],
            cov=covs[:, POSE_OF_SIM3, POSE_OF_SIM3],
            m_per_unit=scales * start.scale,
        )

    def _reasons(self, anchors: np.ndarray, joins: np.ndarray) -> list[str]:
        """Why a submap is not placed; empty for one that is. Submaps that joins connect share their anchors."""
        group = list(self._numbers())
        for join in (self._given_joins[i] for i in np.flatnonzero(joins)):
            old, new = sorted((group[join.first[0]], group[join.second[0]]), reverse=True)
            group = [new if g == old else g for g in group]
        votes = [Counter[int](), Counter[int]()]
        for anchor, inlier in zip(self._given_anchors, anchors, strict=True):
            votes[int(inlier)][group[anchor.submap]] += 1
        reasons = []
        for number in self._numbers():
            against, for_it = (v[group[number]] for v in votes)
            if self._starts[number] is None or for_it == 0:
                reasons.append(self._why_not(number))
            else:
                reasons.append("" if for_it > against else f"{for_it} of {for_it + against} anchors agree: too few")
        return reasons

    def _why_not(self, number: int) -> str:
        own = sum(a.submap == number for a in self._given_anchors)
        if own == 0:
            return "no anchor, and no relocalisation to a submap that has one"
        if self._starts[number] is None:
            return f"{own} anchor{'s' if own > 1 else ''} and no height: its size is not known"
        return f"none of {own} anchor{'s' if own > 1 else ''} is an inlier"

    def _numbers(self) -> range:
        return range(len(self._submaps))

    def _initialised(self) -> Iterator[tuple[int, int, Similarity]]:
        """Number, key of the first keyframe and initial similarity of the submaps that have one."""
        for number, start in enumerate(self._starts):
            if start is not None:
                yield number, self._first_key[number], start


def _order_of_anchor(anchor: AbsoluteConstraint) -> tuple[float, ...]:
    return (anchor.submap, anchor.keyframe, *anchor.p_c_in_w_m.tolist(), *anchor.r_w_c.ravel().tolist())
