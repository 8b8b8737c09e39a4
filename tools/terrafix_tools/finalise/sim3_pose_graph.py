"""Fragments into the world: a pose graph of similarities (7 degrees of freedom for each keyframe), robust.

Strasdat, Montiel, Davison: Scale Drift-Aware Large Scale Monocular SLAM (RSS 2010). A keyframe is S_k: its camera in
the world, and how long the unit of its fragment is there. Anchors say the pose and nothing of the unit; the way between
two of them does. Fragments need not overlap: they meet in the world. Every anchor and every relocalisation may be
wrong."""

from collections import Counter
from collections.abc import Iterator

import gtsam
import numpy as np

from terrafix.core.gate import GATE
from terrafix_tools.finalise.gnc import Covariances, OutlierCandidate, marginals, settle, solve, weighted
from terrafix_tools.finalise.sim3_consensus import Similarity, place
from terrafix_tools.finalise.submap_types import (
    AbsoluteConstraint,
    MergedSubmaps,
    RelativeConstraint,
    Submap,
    SubmapPose,
)

# Precisions of a prior on every fragment, so wide that it says nothing and so narrow that the system stays solvable
# when nothing else is believed: sigmas of 10 rad, 1 km, and e^3 of the unit.
LOOSE = np.array([1e-2] * 3 + [1e-6] * 3 + [0.1])
UNIT_SIGMA = 0.3  # share: a fragment whose unit is known less well than that is not placed
READMITTED = 3  # times that anchors may come back which only the drift of the others had excluded


def merge(
    fragments: list[Submap], anchors: list[AbsoluteConstraint], joins: list[RelativeConstraint] | None = None
) -> MergedSubmaps:
    """Places every fragment that its anchors or its relocalisations allow; says why of the others.

    The order of ``anchors`` and ``joins`` does not matter."""
    return Sim3PoseGraph(fragments, anchors, joins or []).merged()


class Sim3PoseGraph:
    def __init__(
        self, fragments: list[Submap], anchors: list[AbsoluteConstraint], joins: list[RelativeConstraint]
    ) -> None:
        self._fragments = fragments
        self._anchors = sorted(range(len(anchors)), key=lambda i: _order_of_anchor(anchors[i]))
        self._joins = sorted(range(len(joins)), key=lambda i: (*joins[i].first, *joins[i].second, *joins[i].p_b_in_a))
        self._said_anchors, self._said_joins = anchors, joins
        ends = np.cumsum([0, *(len(f) for f in fragments)])
        self._first_key = [int(k) for k in ends]
        self._starts = self._placed_first()

    def merged(self) -> MergedSubmaps:
        n_anchors, n_joins = len(self._said_anchors), len(self._said_joins)
        anchors, joins = np.zeros(n_anchors, bool), np.zeros(n_joins, bool)
        if not any(self._starts):
            return MergedSubmaps(
                [None] * len(self._fragments), [self._why_not(f) for f in self._numbers()], anchors, joins
            )
        used = [i for i in self._anchors if self._starts[self._said_anchors[i].fragment] is not None]
        tied = [i for i in self._joins if self._starts[self._said_joins[i].first[0]] is not None]
        doubtful = [self._anchor_factor(self._said_anchors[i]) for i in used]
        doubtful += [self._join_factor(self._said_joins[i]) for i in tied]
        certain, values = self._chains()
        values, believed = solve(certain, doubtful, values)
        for _ in range(READMITTED + 1):
            anchors[used], joins[tied] = believed[: len(used)], believed[len(used) :]
            reasons = self._reasons(anchors, joins)
            held = self._held(certain, values, reasons)
            found = marginals(weighted(held, doubtful, believed.astype(float)), values)
            # Of relocalisations no such question is asked: it would need the covariance of two keyframes together.
            refused = [k for k in range(len(used)) if not believed[k]]
            again = [k for k in refused if self._allowed(self._said_anchors[used[k]], values, found)]
            if not again:
                break
            believed[again] = True
            values = settle(held, doubtful, believed, values)
        placements, why = [], []
        for number, reason in zip(self._numbers(), reasons, strict=True):
            placed = None if reason else self._placement(number, values, found)
            if placed is None and not reason:
                reason = "the anchors leave its size open"
            placements.append(placed)
            why.append(reason)
        return MergedSubmaps(placements, why, anchors, joins)

    # --- where to begin -------------------------------------------------------------------------------------

    def _placed_first(self) -> list[Similarity | None]:
        """By the anchors of each, and where there are none along the relocalisations."""
        own: list[list[AbsoluteConstraint]] = [[] for _ in self._fragments]
        for i in self._anchors:
            own[self._said_anchors[i].fragment].append(self._said_anchors[i])
        starts = [place(fragment, its) for fragment, its in zip(self._fragments, own, strict=True)]
        for _ in self._fragments:
            for i in self._joins:
                self._carry_over(self._said_joins[i], starts)
        return starts

    def _carry_over(self, join: RelativeConstraint, starts: list[Similarity | None]) -> None:
        (a, i), (b, j) = join.first, join.second
        at_a = self._fragments[a].r_f_c[i], self._fragments[a].p_c_in_f[i]
        at_b = self._fragments[b].r_f_c[j], self._fragments[b].p_c_in_f[j]
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

    # --- the graph ------------------------------------------------------------------------------------------

    def _chains(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Of every fragment that has a place to begin; in metres, as its beginning has them."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        loose = gtsam.noiseModel.Diagonal.Precisions(LOOSE)
        for number, key, start in self._begun():
            fragment = self._fragments[number]
            r_w, p_w = start.r @ fragment.r_f_c, start.position(fragment.p_c_in_f)
            r_step, p_step = fragment.steps()
            covs = np.zeros((len(fragment), 7, 7))
            to_m = np.array([1.0, 1.0, 1.0, *([start.scale] * 3)])
            covs[:, :6, :6] = fragment.step_cov * np.outer(to_m, to_m)
            covs[:, 6, 6] = fragment.scale_walk**2
            for i in range(len(fragment)):
                values.insert(key + i, gtsam.Similarity3(r_w[i], p_w[i], 1.0))
                if i == 0:
                    continue
                step = gtsam.Similarity3(r_step[i], start.scale * p_step[i], 1.0)
                noise = gtsam.noiseModel.Gaussian.Covariance(covs[i], False)
                parent = key + int(fragment.parent[i])
                graph.push_back(gtsam.BetweenFactorSimilarity3(parent, key + i, step, noise))
            first = values.atSimilarity3(key)
            graph.push_back(gtsam.PriorFactorSimilarity3(key, first, loose))
            if fragment.scale_sigma is not None:
                known = np.array([0.0] * 6 + [fragment.scale_sigma**-2])
                metre = gtsam.Similarity3(first.rotation().matrix(), first.translation() * start.scale, 1 / start.scale)
                noise = gtsam.noiseModel.Diagonal.Precisions(known)
                graph.push_back(gtsam.PriorFactorSimilarity3(key, metre, noise))
        return graph, values

    def _held(
        self, certain: gtsam.NonlinearFactorGraph, values: gtsam.Values, reasons: list[str]
    ) -> gtsam.NonlinearFactorGraph:
        """With what is not placed tied to where it is: nobody asks how well that is known, and the system is sound."""
        held = gtsam.NonlinearFactorGraph(certain)
        firm = gtsam.noiseModel.Unit.Create(7)
        for number, key, _ in self._begun():
            if reasons[number]:
                held.push_back(gtsam.PriorFactorSimilarity3(key, values.atSimilarity3(key), firm))
        return held

    def _anchor_factor(self, anchor: AbsoluteConstraint) -> OutlierCandidate:
        key = self._first_key[anchor.fragment] + anchor.keyframe
        pose = gtsam.Similarity3(anchor.r_w_c, anchor.p_c_in_w_m, 1.0)
        information = np.zeros((7, 7))
        information[:6, :6] = np.linalg.inv(anchor.cov)
        square_root = np.zeros((7, 7))
        square_root[:6, :6] = np.linalg.cholesky(information[:6, :6]).T

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
        cov[:6, :6] = join.cov * np.outer(to_m, to_m)
        cov[6, 6] = join.ratio_sigma**2
        keys = self._first_key[a] + i, self._first_key[b] + j

        def factor(weight: float) -> gtsam.NonlinearFactor:
            return gtsam.BetweenFactorSimilarity3(
                *keys, step, gtsam.noiseModel.Gaussian.Covariance(cov / weight, False)
            )

        return OutlierCandidate(factor(1.0), factor, GATE[7])

    def _allowed(self, anchor: AbsoluteConstraint, values: gtsam.Values, found: Covariances) -> bool:
        """Whether an anchor agrees with the rest, given how uncertain the rest is there."""
        key = self._first_key[anchor.fragment] + anchor.keyframe
        pose = gtsam.Similarity3(anchor.r_w_c, anchor.p_c_in_w_m, 1.0)
        residual = pose.localCoordinates(values.atSimilarity3(key))[:6]
        cov = found.marginalCovariance(key)[:6, :6] + anchor.cov
        return float(residual @ np.linalg.solve(cov, residual)) <= GATE[6]

    # --- the answer -----------------------------------------------------------------------------------------

    def _placement(self, number: int, values: gtsam.Values, found: Covariances) -> SubmapPose | None:
        start = self._starts[number]
        assert start is not None
        keys = [self._first_key[number] + i for i in range(len(self._fragments[number]))]
        states = [values.atSimilarity3(k) for k in keys]
        covs = np.array([found.marginalCovariance(k) for k in keys])
        if float(np.sqrt(np.median(covs[:, 6, 6]))) > UNIT_SIGMA:
            return None
        scales = np.array([s.scale() for s in states])
        covs[:, 3:6, :] *= scales[:, None, None]
        covs[:, :, 3:6] *= scales[:, None, None]
        return SubmapPose(
            r_w_c=np.array([s.rotation().matrix() for s in states]),
            p_c_in_w_m=np.array([s.translation() for s in states]) * scales[:, None],
            cov=covs[:, :6, :6],
            m_per_unit=scales * start.scale,
        )

    def _reasons(self, anchors: np.ndarray, joins: np.ndarray) -> list[str]:
        """Why a fragment is not placed; empty for one that is. Those that are tied together share anchors."""
        group = list(self._numbers())
        for join in (self._said_joins[i] for i in np.flatnonzero(joins)):
            old, new = sorted((group[join.first[0]], group[join.second[0]]), reverse=True)
            group = [new if g == old else g for g in group]
        votes = [Counter[int](), Counter[int]()]
        for anchor, believed in zip(self._said_anchors, anchors, strict=True):
            votes[int(believed)][group[anchor.fragment]] += 1
        reasons = []
        for number in self._numbers():
            against, for_it = (v[group[number]] for v in votes)
            if self._starts[number] is None or for_it == 0:
                reasons.append(self._why_not(number))
            else:
                reasons.append("" if for_it > against else f"{for_it} of {for_it + against} anchors agree: too few")
        return reasons

    def _why_not(self, number: int) -> str:
        own = sum(a.fragment == number for a in self._said_anchors)
        if own == 0:
            return "no anchor, and no relocalisation to a fragment that has one"
        if self._starts[number] is None:
            return f"{own} anchor{'s' if own > 1 else ''} and no height: its size is not known"
        return f"none of {own} anchor{'s' if own > 1 else ''} is believed"

    def _numbers(self) -> range:
        return range(len(self._fragments))

    def _begun(self) -> Iterator[tuple[int, int, Similarity]]:
        for number, start in enumerate(self._starts):
            if start is not None:
                yield number, self._first_key[number], start


def _order_of_anchor(anchor: AbsoluteConstraint) -> tuple[float, ...]:
    return (anchor.fragment, anchor.keyframe, *anchor.p_c_in_w_m.tolist(), *anchor.r_w_c.ravel().tolist())
