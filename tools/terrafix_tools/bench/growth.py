"""Cost as the flight grows: the estimator on synthetic messages. python -m terrafix_tools.bench.growth FRAMES OUT.

Frames of a camera would take minutes and cost the same in every frame; what could grow is the estimator. Beside its
own covariance query the same one from scratch, as GTSAM offers it: ``gtsam.Marginals`` over the window, over all.
Times are those of the processor, all threads: other programs do not lengthen them."""

import json
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gtsam

from terrafix.estimator.filter import Estimator
from terrafix.estimator.telemetry import Telemetry
from terrafix_tools.bench.flights import spread
from terrafix_tools.bench.stream import ORIGIN, spoken
from terrafix_tools.replay import peak_memory_mb

RESULT = "growth.json"
LAST = 80  # frames at the end of the flight, over which the time of one is taken
QUERIES = 10  # of a covariance from scratch
ASKED_BEFORE = 10  # nodes before the newest: the middle of the window


def measure(frames: int) -> dict[str, Any]:
    """-> time for each of the last frames, of the refinement after landing, of covariance queries; memory."""
    estimator, telemetry = Estimator(ORIGIN), Telemetry()
    times_ms: list[float] = []
    query_ms: list[float] = []
    for said in spoken(frames):
        telemetry.add(said.state)
        began_s = time.process_time()
        t_ns = said.odometry.t_ns
        estimator.advance(said.odometry.frame_id, t_ns * 1e-9, said.odometry, telemetry.at(t_ns))
        if said.match is not None:
            estimator.fix(said.match)
        times_ms.append((time.process_time() - began_s) * 1e3)
        # Not of the newest: the smoother still has that one from this very frame.
        query_ms.append(_ms(partial(estimator.graph.covariance, max(0, estimator.graph.newest - ASKED_BEFORE))))
    in_flight_mb = peak_memory_mb()
    queries = {"of the smoother": spread(query_ms[-LAST:])} | _from_scratch(estimator)
    began_s = time.process_time()
    estimator.refine()
    return {
        "frames": frames,
        "frame_cpu_ms": spread(times_ms[-LAST:]),
        "refine_cpu_s": round(time.process_time() - began_s, 2),
        "covariance_cpu_ms": queries,
        "memory_in_flight_mb": in_flight_mb,
        "peak_memory_mb": peak_memory_mb(),
    }


def _from_scratch(estimator: Estimator) -> dict[str, dict[str, float]]:
    """The same covariance as GTSAM computes it without a smoother."""
    graph = estimator.graph
    asked = _camera(graph.newest - ASKED_BEFORE)
    graphs = {"window": (_window(estimator), QUERIES), "whole flight": ((graph.all_factors, graph.all_values), 2)}
    return {
        f"gtsam.Marginals, {name}": spread(
            [_ms(lambda: gtsam.Marginals(factors, values).marginalCovariance(asked)) for _ in range(times)]  # noqa: B023
        )
        for name, ((factors, values), times) in graphs.items()
    }


def _window(estimator: Estimator) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The factors among the nodes of the window, with a prior on the oldest in place of what lies before."""
    graph = estimator.graph
    nodes = [n for n in range(graph.newest + 1) if graph.holds(n)]
    keys = {key for n in nodes for key in (_camera(n), _bias(n), _velocity(n))}
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i in range(graph.all_factors.size()):
        factor = graph.all_factors.at(i)
        its_keys = factor.keys()
        if all(key in keys for key in its_keys):
            factors.push_back(factor)
    for n in nodes:
        state = graph.state(n)
        values.insert(_camera(n), state.pose)
        values.insert(_bias(n), state.bias)
        values.insert(_velocity(n), state.velocity)
    oldest = graph.state(nodes[0])
    factors.add(gtsam.PriorFactorPose3(_camera(nodes[0]), oldest.pose, gtsam.noiseModel.Isotropic.Sigma(6, 1.0)))
    factors.add(gtsam.PriorFactorVector(_bias(nodes[0]), oldest.bias, gtsam.noiseModel.Isotropic.Sigma(4, 1.0)))
    factors.add(gtsam.PriorFactorVector(_velocity(nodes[0]), oldest.velocity, gtsam.noiseModel.Isotropic.Sigma(6, 1.0)))
    return factors, values


def _camera(node: int) -> int:
    return int(gtsam.symbol("c", node))


def _bias(node: int) -> int:
    return int(gtsam.symbol("b", node))


def _velocity(node: int) -> int:
    return int(gtsam.symbol("v", node))


def _ms(work: Callable[[], object]) -> float:
    began_s = time.process_time()
    work()
    return (time.process_time() - began_s) * 1e3


if __name__ == "__main__":
    Path(sys.argv[2]).write_text(json.dumps(measure(int(sys.argv[1]))), encoding="utf-8")
