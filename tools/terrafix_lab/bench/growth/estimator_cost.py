"""Cost of the estimator as the flight grows, on synthetic messages.

python -m terrafix_lab.bench.growth.estimator_cost FRAMES OUT

The cost of image processing does not depend on the length of the flight and is left out. The estimator's covariance
query is compared with the same query from scratch: ``gtsam.Marginals`` over the window, and over the whole flight.
Times are processor times of all threads, which other programs do not lengthen."""

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C, V

from terrafix.estimator.estimator import Estimator
from terrafix.estimator.filter_state import FrameInput
from terrafix.estimator.graph.marginalized import MarginalizedHistory
from terrafix.estimator.graph.pose_graph import PoseGraph
from terrafix.estimator.map_update import MapResult
from terrafix.estimator.measurements.telemetry_buffer import Telemetry
from terrafix.estimator.propagation import PropagationResult
from terrafix.messages import Imu, VehicleState
from terrafix_lab.bench.growth.stream import FrameMessages, frame_messages, origin
from terrafix_tools.replay import peak_memory_mb
from terrafix_tools.timing import spread

LAST = 80  # last frames of the flight, for the statistics of the time per frame
LATER = 500  # last frames for the statistics of the graph alone: more, for the 99th percentile
QUERIES = 10  # covariance queries from scratch
QUERIED_BEFORE = 10  # number of nodes from the queried one to the newest: the middle of the window


Flown = tuple[FrameMessages, PropagationResult, MapResult | None, float]


class _TimedGraph(PoseGraph):
    """``spent_ms``: processor time since it was set to zero: new nodes and map fixes, iSAM2 updates, covariance
    queries."""

    def __init__(self) -> None:
        super().__init__()
        self.spent_ms = 0.0

    def extend(self, *node: Any, **more: Any) -> int:
        with self._stopwatch():
            return super().extend(*node, **more)

    def add(self, *new: Any) -> None:
        with self._stopwatch():
            super().add(*new)

    def _marginal(self, key: int) -> np.ndarray:
        with self._stopwatch():
            return super()._marginal(key)

    @contextmanager
    def _stopwatch(self) -> Iterator[None]:
        began_s = time.process_time()
        yield
        self.spent_ms += (time.process_time() - began_s) * 1e3


class _WholeFlight(MarginalizedHistory):
    """Also stores every factor of the flight and the last values, for the queries from scratch."""

    def __init__(self) -> None:
        super().__init__()
        self.factors = gtsam.NonlinearFactorGraph()
        self.values = gtsam.Values()

    def add(self, factors: gtsam.NonlinearFactorGraph) -> None:
        super().add(factors)
        self.factors.push_back(factors)

    def marginalize(self, nodes: list[int], estimate: gtsam.Values) -> None:
        super().marginalize(nodes, estimate)
        for node in nodes:
            self.values.insert(C(node), estimate.atPose3(C(node)))
            self.values.insert(B(node), estimate.atVector(B(node)))
            self.values.insert(V(node), estimate.atVector(V(node)))

    def linear(self) -> gtsam.NonlinearFactorGraph:
        """-> all factors, linearized. Factors in Python are slow in a large graph, because GTSAM copies all values for
        each call."""
        graph = gtsam.NonlinearFactorGraph()
        for i in range(self.factors.size()):
            factor = self.factors.at(i)
            point = gtsam.Values()
            for key in factor.keys():  # noqa: SIM118 (a factor is not a dict)
                is_pose = key == C(gtsam.symbolIndex(key))
                point.insert(key, self.values.atPose3(key) if is_pose else self.values.atVector(key))
            graph.push_back(gtsam.LinearContainerFactor(factor.linearize(point), point))
        return graph


def measure(frames: int) -> dict[str, Any]:
    """-> times per frame (of the last ones), of the refinement after landing and of covariance queries; memory."""
    graph = _TimedGraph()
    estimator = Estimator(origin(), graph=graph)
    times_ms: list[float] = []
    update_ms: list[float] = []
    query_ms: list[float] = []
    for *_, frame_ms in flown(estimator, frames):
        times_ms.append(frame_ms)
        update_ms.append(graph.spent_ms)
        # Not the newest node: the smoother has computed its covariance in this frame.
        query_ms.append(_ms(partial(estimator.graph.covariance, _queried(estimator.graph))))
        graph.spent_ms = 0.0
    in_flight_mb = peak_memory_mb()
    began_s = time.process_time()
    estimator.refine()
    return {
        "frames": frames,
        "frame_cpu_ms": spread(times_ms[-LAST:]),
        "update_cpu_ms": {
            name: round(float(np.percentile(update_ms[-LATER:], share)), 2)
            for name, share in (("median", 50), ("p99", 99))
        },
        "refine_cpu_s": round(time.process_time() - began_s, 2),
        "memory_in_flight_mb": in_flight_mb,
        "peak_memory_mb": peak_memory_mb(),
        "covariance_cpu_ms": {"of the smoother": spread(query_ms[-LAST:])} | _from_scratch(frames),
    }


def flown(estimator: Estimator, frames: int) -> Iterator[Flown]:
    """-> each frame, what the estimator made of it, and its processor time [ms] with all messages since the last."""
    telemetry = Telemetry()
    for frame in frame_messages(frames):
        began_s = time.process_time()
        for message in frame.telemetry:
            if isinstance(message, Imu):
                telemetry.add_imu(message)
            elif isinstance(message, VehicleState):
                telemetry.add(message)
        t_ns = frame.odometry.t_ns
        attitude = telemetry.at(t_ns)
        imu = telemetry.world_acceleration
        new = FrameInput(frame.odometry.frame_id, t_ns * 1e-9, frame.odometry, attitude, imu)
        propagated = estimator.feed_frame(new)
        matched = None if frame.match is None else estimator.feed_map_match(frame.match)
        yield frame, propagated, matched, (time.process_time() - began_s) * 1e3


def _queried(graph: PoseGraph) -> int:
    """-> QUERIED_BEFORE nodes before the newest, or the oldest node of a graph that has begun anew since."""
    return graph.window[-1 - QUERIED_BEFORE :][0]


def _from_scratch(frames: int) -> dict[str, dict[str, float]]:
    """-> times of the same covariance query with ``gtsam.Marginals``, after the same flight."""
    flight = _WholeFlight()
    estimator = Estimator(origin(), graph=PoseGraph(flight))
    for _ in flown(estimator, frames):
        pass
    in_window, queried = set(estimator.graph.window), C(_queried(estimator.graph))
    estimator.graph.refine()
    factors = flight.linear()
    graphs = {
        "window": (_window(factors, flight.values, in_window), QUERIES),
        "whole flight": ((factors, flight.values), 2),
    }
    return {
        f"gtsam.Marginals, {name}": spread(
            [_ms(lambda: gtsam.Marginals(*graph).marginalCovariance(queried)) for _ in range(count)]  # noqa: B023
        )
        for name, (graph, count) in graphs.items()
    }


def _window(
    whole: gtsam.NonlinearFactorGraph, all_values: gtsam.Values, nodes: set[int]
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """-> factors and values of ``nodes``, with a prior on the oldest one instead of the earlier nodes."""
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i in range(whole.size()):
        factor = whole.at(i)
        if all(gtsam.symbolIndex(key) in nodes for key in factor.keys()):  # noqa: SIM118
            factors.push_back(factor)
    for n in nodes:
        values.insert(C(n), all_values.atPose3(C(n)))
        values.insert(B(n), all_values.atVector(B(n)))
        values.insert(V(n), all_values.atVector(V(n)))
    first, unit = min(nodes), gtsam.noiseModel.Isotropic.Sigma
    factors.add(gtsam.PriorFactorPose3(C(first), values.atPose3(C(first)), unit(6, 1.0)))
    for key in (B(first), V(first)):
        factors.add(gtsam.PriorFactorVector(key, values.atVector(key), unit(len(values.atVector(key)), 1.0)))
    return factors, values


def _ms(work: Callable[[], object]) -> float:
    began_s = time.process_time()
    work()
    return (time.process_time() - began_s) * 1e3


if __name__ == "__main__":
    Path(sys.argv[2]).write_text(json.dumps(measure(int(sys.argv[1]))), encoding="utf-8")
