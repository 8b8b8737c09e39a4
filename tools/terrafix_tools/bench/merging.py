"""Merge of the fragments of a flight: python -m terrafix_tools.bench.merging KEYFRAMES OUT.

A synthetic flight that was torn into pieces, each in a frame and a unit of its own, with map fixes of which some are
wrong. Beside it, on the same graph from the same beginning, least squares without any robustness
(``gtsam.LevenbergMarquardtOptimizer``). Times are those of the processor."""

import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from terrafix.core.camera import Mount
from terrafix.core.geodesy import rot_w_b
from terrafix.core.pose import exp_so3, log_so3
from terrafix_tools.bench import merging_baseline
from terrafix_tools.finalise.sim3_pose_graph import merge
from terrafix_tools.finalise.submap_types import AbsoluteConstraint, MergedSubmaps, Submap

RESULT = "merging.json"
FRAGMENTS, ANCHOR_EVERY, WRONG_SHARE, WRONG_M = 10, 10, 0.05, 350.0
STEP_M, AGL_M = 12.0, 120.0
# Of a keyframe in the one before: rotation about the camera's axes [rad], way [m].
STEP_SIGMAS = np.array([0.002, 0.002, 0.002, 0.15, 0.15, 0.15])
ANCHOR_SIGMAS = np.array([0.015, 0.015, 0.015, 2.0, 2.0, 3.0])
SCALE_WALK = 0.002


@dataclass(frozen=True)
class Torn:
    """A flight in pieces; truth is ``r_w_c`` and ``p_w_m`` of every fragment, ``wrong`` (A,) says of every anchor."""

    fragments: list[Submap]
    anchors: list[AbsoluteConstraint]
    wrong: np.ndarray
    r_w_c: list[np.ndarray]
    p_w_m: list[np.ndarray]

    def right_anchors(self) -> list[AbsoluteConstraint]:
        return [a for a, wrong in zip(self.anchors, self.wrong, strict=True) if not wrong]


def torn_flight(
    seed: int,
    *,
    fragments: int = FRAGMENTS,
    keyframes: int = 300,
    anchor_every: int = ANCHOR_EVERY,
    wrong_share: float = WRONG_SHARE,
    scale_known: bool = False,
) -> Torn:
    """Every error is drawn from what its covariance says; a wrong anchor is WRONG_M off, and as sure as the others."""
    rng = np.random.default_rng([seed, 91])
    r_w, p_w = _course(rng, fragments * keyframes)
    pieces, anchors, truth_r, truth_p = [], [], [], []
    for f in range(fragments):
        at = slice(f * keyframes, (f + 1) * keyframes)
        truth_r.append(r_w[at])
        truth_p.append(p_w[at])
        pieces.append(_fragment(rng, r_w[at], p_w[at], scale_known))
        for k in range(f % anchor_every, keyframes, anchor_every):
            error = ANCHOR_SIGMAS * rng.normal(size=6)
            r, p = r_w[at][k], p_w[at][k]
            anchors.append(
                AbsoluteConstraint(f, k, r @ exp_so3(error[:3]), p + r @ error[3:], np.diag(ANCHOR_SIGMAS**2))
            )
    wrong = np.zeros(len(anchors), bool)
    wrong[rng.permutation(len(anchors))[: round(wrong_share * len(anchors))]] = True
    for i in np.flatnonzero(wrong):
        a, towards = anchors[i], float(rng.uniform(0.0, 2.0 * np.pi))
        away_m = WRONG_M * np.array([np.cos(towards), np.sin(towards), 0.0])
        anchors[i] = AbsoluteConstraint(a.fragment, a.keyframe, a.r_w_c, a.p_c_in_w_m + away_m, a.cov)
    return Torn(pieces, anchors, wrong, truth_r, truth_p)


def _course(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Cameras (n, 3, 3), (n, 3) of a flight with turns and climbs."""
    phase = rng.uniform(0.0, 2.0 * np.pi, 3)
    t = np.arange(n)
    yaw = np.cumsum(0.03 * np.sin(t / 23.0 + phase[0]) + 0.02 * np.sin(t / 61.0 + phase[1]))
    steps = STEP_M * np.column_stack([np.sin(yaw), np.cos(yaw), np.zeros(n)])
    p = np.cumsum(steps, axis=0)
    p[:, 2] = AGL_M + 10.0 * np.sin(t / 40.0 + phase[2])
    mount = Mount().r_b_c()
    r = np.array([rot_w_b(float(y), 0.04 * np.sin(i / 3.0), 0.05 * np.sin(i / 5.0)) @ mount for i, y in enumerate(yaw)])
    return r, p


def _fragment(rng: np.random.Generator, r_w: np.ndarray, p_w: np.ndarray, scale_known: bool) -> Submap:
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
    return Submap(r_f, p_f, parent, np.broadcast_to(cov, (n, 6, 6)), 0.01 if scale_known else None, SCALE_WALK)


def positions(fragments: list[Submap], anchors: list[AbsoluteConstraint]) -> list[np.ndarray]:
    """(N, 3) of the keyframes of every fragment, as merged; not a number where it was not placed."""
    placed = merge(fragments, anchors).placements
    return [np.full((len(f), 3), np.nan) if p is None else p.p_c_in_w_m for f, p in zip(fragments, placed, strict=True)]


def pose_errors(torn: Torn, merged: MergedSubmaps) -> tuple[np.ndarray, np.ndarray]:
    """(M, 6) tangent of the error, of placed keyframes, and the covariances (M, 6, 6) that were claimed."""
    errors, covs = [], []
    for placed, r_true, p_true in zip(merged.placements, torn.r_w_c, torn.p_w_m, strict=True):
        if placed is None:
            continue
        for r, p, cov, rt, pt in zip(placed.r_w_c, placed.p_c_in_w_m, placed.cov, r_true, p_true, strict=True):
            errors.append(np.concatenate([log_so3(r.T @ rt), r.T @ (pt - p)]))
            covs.append(cov)
    return np.array(errors), np.array(covs)


def measure(keyframes: int) -> dict[str, Any]:
    """``keyframes`` of the whole flight, in FRAGMENTS pieces."""
    torn = torn_flight(1, keyframes=keyframes // FRAGMENTS)
    right = torn.right_anchors()
    ways: list[
        tuple[str, Callable[[list[Submap], list[AbsoluteConstraint]], list[np.ndarray]], list[AbsoluteConstraint]]
    ] = [
        ("merge", positions, torn.anchors),
        ("merge, no wrong anchors", positions, right),
        (merging_baseline.METHOD, merging_baseline.positions, torn.anchors),
    ]
    found: dict[str, Any] = {"keyframes": keyframes, "fragments": FRAGMENTS, "ways": {}}
    found |= {"anchors": len(torn.anchors), "wrong_anchors": int(torn.wrong.sum())}
    for name, work, anchors in ways:
        began_s = time.process_time()
        placed = work(torn.fragments, anchors)
        cpu_s = time.process_time() - began_s
        off_m = np.linalg.norm(np.concatenate(placed) - np.concatenate(torn.p_w_m), axis=1)
        found["ways"][name] = {
            "cpu_s": round(cpu_s, 3),
            "placed": float(np.mean(np.isfinite(off_m))),
            "median_m": round(float(np.nanmedian(off_m)), 3),
            "max_m": round(float(np.nanmax(off_m)), 3),
        }
    return found


def show(found: dict[str, Any], console: Console) -> None:
    pieces = f"{found['fragments']} fragments of unknown size, {found['keyframes']} keyframes"
    table = Table(
        title=f"merge of {pieces}, {found['wrong_anchors']} of {found['anchors']} anchors wrong", title_justify="left"
    )
    for column in ("", "processor time", "placed", "median error", "largest"):
        table.add_column(column, justify="right" if column else "left")
    for name, one in found["ways"].items():
        table.add_row(
            name, f"{one['cpu_s']:.2f} s", f"{100 * one['placed']:.0f} %", f"{one['median_m']:.2f} m",
            f"{one['max_m']:.0f} m")  # fmt: skip
    console.print(table)


if __name__ == "__main__":
    Path(sys.argv[2]).write_text(json.dumps(measure(int(sys.argv[1]))), encoding="utf-8")
