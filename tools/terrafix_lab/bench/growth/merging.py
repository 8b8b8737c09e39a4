"""Merge of the submaps of a flight by the Sim(3) pose graph.

python -m terrafix_lab.bench.growth.merging KEYFRAMES OUT

A synthetic flight in submaps, each with its own frame and unit of length, with absolute constraints of which some are
outliers. Times are processor times."""

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from terrafix.core.camera import Mount
from terrafix.core.geodesy import rot_w_b
from terrafix.core.pose import exp_so3, log_so3
from terrafix.smoother.sim3_pose_graph import merge
from terrafix.smoother.submap_types import AbsoluteConstraint, MergedSubmaps, Submap
from terrafix_lab.sim.vehicle.level import level_path

SUBMAPS, ANCHOR_EVERY, WRONG_SHARE, WRONG_M = 10, 10, 0.05, 350.0
STEP_M, AGL_M = 12.0, 120.0
# 1-sigma of the relative pose of two consecutive keyframes: rotation about the camera's axes [rad], translation [m].
STEP_SIGMAS = np.array([0.002, 0.002, 0.002, 0.15, 0.15, 0.15])
ANCHOR_SIGMAS = np.array([0.015, 0.015, 0.015, 2.0, 2.0, 3.0])
SCALE_WALK = 0.002  # 1-sigma of the random walk of the log scale, per keyframe


@dataclass(frozen=True)
class SubmapFlight:
    """A flight in submaps (``submaps``) with absolute constraints (``anchors``). Truth: ``r_w_c`` and ``p_w_m`` of
    the keyframes of every submap; ``wrong`` (A,): outliers among the constraints."""

    submaps: list[Submap]
    anchors: list[AbsoluteConstraint]
    wrong: np.ndarray
    r_w_c: list[np.ndarray]
    p_w_m: list[np.ndarray]


def make_submap_flight(
    seed: int,
    *,
    submaps: int = SUBMAPS,
    keyframes: int = 300,
    anchor_every: int = ANCHOR_EVERY,
    wrong_share: float = WRONG_SHARE,
    scale_known: bool = False,
) -> SubmapFlight:
    """Draws every error from its covariance. An outlier is WRONG_M off, with the same covariance as the others."""
    rng = np.random.default_rng([seed, 91])
    r_w, p_w = _course(rng, submaps * keyframes)
    submap_list, anchors, truth_r, truth_p = [], [], [], []
    for f in range(submaps):
        at = slice(f * keyframes, (f + 1) * keyframes)
        truth_r.append(r_w[at])
        truth_p.append(p_w[at])
        submap_list.append(_submap(rng, r_w[at], p_w[at], scale_known))
        for k in range(f % anchor_every, keyframes, anchor_every):
            error = ANCHOR_SIGMAS * rng.normal(size=6)
            r, p = r_w[at][k], p_w[at][k]
            anchors.append(
                AbsoluteConstraint(f, k, r @ exp_so3(error[:3]), p + r @ error[3:], np.diag(ANCHOR_SIGMAS**2))
            )
    wrong = np.zeros(len(anchors), bool)
    wrong[rng.permutation(len(anchors))[: round(wrong_share * len(anchors))]] = True
    for i in np.flatnonzero(wrong):
        a, direction_rad = anchors[i], float(rng.uniform(0.0, 2.0 * np.pi))
        shift_m = WRONG_M * np.array([np.cos(direction_rad), np.sin(direction_rad), 0.0])
        anchors[i] = AbsoluteConstraint(a.submap, a.keyframe, a.r_w_c, a.p_c_in_w_m + shift_m, a.cov)
    return SubmapFlight(submap_list, anchors, wrong, truth_r, truth_p)


def _course(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """-> attitudes R_w_c (n, 3, 3) and positions (n, 3) of a flight with turns and climbs."""
    phase = rng.uniform(0.0, 2.0 * np.pi, 3)
    t = np.arange(n)
    yaw = np.cumsum(0.03 * np.sin(t / 23.0 + phase[0]) + 0.02 * np.sin(t / 61.0 + phase[1]))
    p = np.column_stack([level_path(yaw, STEP_M, (0.0, 0.0)), AGL_M + 10.0 * np.sin(t / 40.0 + phase[2])])
    mount = Mount().r_b_c()
    r = np.array([rot_w_b(float(y), 0.04 * np.sin(i / 3.0), 0.05 * np.sin(i / 5.0)) @ mount for i, y in enumerate(yaw)])
    return r, p


def _submap(rng: np.random.Generator, r_w: np.ndarray, p_w: np.ndarray, scale_known: bool) -> Submap:
    n = len(r_w)
    scale = np.exp(np.cumsum(SCALE_WALK * rng.normal(size=n)))
    scale *= 1.0 if scale_known else float(np.exp(rng.normal(0.0, 0.5)))
    to_units = np.array([1.0, 1.0, 1.0, *([1.0 / scale[0]] * 3)])
    cov = np.diag((STEP_SIGMAS * to_units) ** 2)
    r_f, p_f = np.zeros((n, 3, 3)), np.zeros((n, 3))
    r_f[0] = exp_so3(rng.normal(size=3))
    for i in range(1, n):
        error = STEP_SIGMAS * to_units * rng.normal(size=6)
        r_step = r_w[i - 1].T @ r_w[i]
        p_step = r_w[i - 1].T @ (p_w[i] - p_w[i - 1]) / scale[i - 1] + r_step @ error[3:]
        r_f[i] = r_f[i - 1] @ r_step @ exp_so3(error[:3])
        p_f[i] = p_f[i - 1] + r_f[i - 1] @ p_step
    parent = np.arange(-1, n - 1)
    steps_cov, walk = np.broadcast_to(cov, (n, 6, 6)), np.full(n, SCALE_WALK)
    return Submap(r_f, p_f, parent, steps_cov, 0.01 if scale_known else None, walk)


def pose_errors(flight: SubmapFlight, merged: MergedSubmaps) -> tuple[np.ndarray, np.ndarray]:
    """-> of all placed keyframes the errors (M, 6; rotation, translation in the camera frame), and their covariances
    (M, 6, 6)."""
    errors, covs = [], []
    for placed, r_true, p_true in zip(merged.placements, flight.r_w_c, flight.p_w_m, strict=True):
        if placed is None:
            continue
        for r, p, cov, rt, pt in zip(placed.r_w_c, placed.p_c_in_w_m, placed.cov, r_true, p_true, strict=True):
            errors.append(np.concatenate([log_so3(r.T @ rt), r.T @ (pt - p)]))
            covs.append(cov)
    return np.array(errors), np.array(covs)


def measure(keyframes: int) -> dict[str, Any]:
    """-> time and accuracy. ``keyframes``: of the whole flight, in SUBMAPS submaps."""
    flight = make_submap_flight(1, keyframes=keyframes // SUBMAPS)
    began_s = time.process_time()
    merged = merge(flight.submaps, flight.anchors)
    cpu_s = time.process_time() - began_s
    off_m = np.linalg.norm(pose_errors(flight, merged)[0][:, 3:], axis=1)
    return {
        "keyframes": keyframes,
        "fragments": SUBMAPS,
        "anchors": len(flight.anchors),
        "wrong_anchors": int(flight.wrong.sum()),
        "cpu_s": round(cpu_s, 3),
        "placed": len(off_m) / keyframes,
        "median_m": round(float(np.median(off_m)), 3),
        "max_m": round(float(np.max(off_m)), 3),
    }


def show(found: dict[str, Any], console: Console) -> None:
    console.print(
        f"merge of {found['fragments']} submaps of unknown scale, {found['keyframes']} keyframes, "
        f"{found['wrong_anchors']} of {found['anchors']} anchors wrong: {found['cpu_s']:.2f} s of the processor, "
        f"{100 * found['placed']:.0f} % placed, {found['median_m']:.2f} m off, {found['max_m']:.0f} m at most",
        highlight=False,
    )


if __name__ == "__main__":
    Path(sys.argv[2]).write_text(json.dumps(measure(int(sys.argv[1]))), encoding="utf-8")
