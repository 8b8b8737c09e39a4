"""Baseline of the merge without a robust loss: GTSAM's Levenberg-Marquardt over all submaps and constraints."""

import gtsam
import numpy as np

from terrafix.smoother.sim3_consensus import place
from terrafix.smoother.submap_types import AbsoluteConstraint, Submap

METHOD = "gtsam.LevenbergMarquardtOptimizer, no robust loss"
LOOSE = np.array([1e-2, 1e-2, 1e-2, 1e-6, 1e-6, 1e-6, 0.1])  # precisions of an uninformative prior


def positions(submaps: list[Submap], anchors: list[AbsoluteConstraint]) -> list[np.ndarray]:
    """-> for every submap the positions of its keyframes (N, 3) [m]. The initial values are those of the robust
    merge."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    first_key = np.cumsum([0, *(len(f) for f in submaps)]).tolist()
    for number, submap in enumerate(submaps):
        start = place(submap, [a for a in anchors if a.submap == number])
        assert start is not None, "every fragment of the benchmark has anchors"
        r_step, p_step = submap.steps()
        p_w = start.position(submap.p_c_in_f)
        for i in range(len(submap)):
            key = first_key[number] + i
            values.insert(key, gtsam.Similarity3(start.r @ submap.r_f_c[i], p_w[i], 1.0))
            if i == 0:
                loose = gtsam.noiseModel.Diagonal.Precisions(LOOSE)
                graph.add(gtsam.PriorFactorSimilarity3(key, values.atSimilarity3(key), loose))
                continue
            cov = np.zeros((7, 7))
            cov[:6, :6] = submap.step_cov[i]
            cov[3:6, 3:6] *= start.scale**2
            cov[6, 6] = submap.scale_walk[i] ** 2
            step = gtsam.Similarity3(r_step[i], start.scale * p_step[i], 1.0)
            noise = gtsam.noiseModel.Gaussian.Covariance(cov)
            parent = first_key[number] + int(submap.parent[i])
            graph.add(gtsam.BetweenFactorSimilarity3(parent, key, step, noise))
    for anchor in anchors:
        key = first_key[anchor.submap] + anchor.keyframe
        pose = gtsam.Similarity3(anchor.r_w_c, anchor.p_c_in_w_m, 1.0)
        noise = gtsam.noiseModel.Diagonal.Precisions(np.append(1.0 / np.diag(anchor.cov), 0.0))
        graph.add(gtsam.PriorFactorSimilarity3(key, pose, noise))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams()).optimize()
    result = []
    for number, submap in enumerate(submaps):
        states = [found.atSimilarity3(first_key[number] + i) for i in range(len(submap))]
        result.append(np.array([s.scale() * s.translation() for s in states]))
    return result
