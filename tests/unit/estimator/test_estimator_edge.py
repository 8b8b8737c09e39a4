"""Log lines of the pose estimation, by level (RS-1, ON-8), and the checkpoint beside them."""

import io
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from simulated_flight import ORIGIN, EstimatorRun, Flight
from terrafix.core import logs
from terrafix.core.config import Config
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.node import NodeContext
from terrafix.estimator.node import make_edge
from terrafix.estimator.prior import load_checkpoint
from terrafix.messages import (
    Health,
    MapMatch,
    Message,
    Odometry,
    PoseMethod,
    PoseSolution,
    ThermalBand,
    Verdict,
)

FRAMES = 10


def context(folder: Path, checkpoint: Path | None = None) -> NodeContext:
    return NodeContext(Config(), MemoryFrameStore(1), None, folder, checkpoint=checkpoint)


def logged(messages: Iterable[Message], folder: Path, level: str = "DEBUG") -> list[dict[str, Any]]:
    """The lines that the edge of the estimator logs of messages, as the shell hands them to it."""
    stream = io.StringIO()
    writer = logs.configure(level, "estimator", stream)
    edge = make_edge(context(folder))
    for message in messages:
        edge.on_message(message)
    edge.close()
    writer.close()
    return [json.loads(line) for line in stream.getvalue().splitlines()]


def received_and_published(messages: Iterable[Message]) -> list[Message]:
    run = EstimatorRun()
    return [one for message in messages for one in (message, *run.feed([message]))]


def health(band: ThermalBand, temperature_c: float, cause: str = "") -> Health:
    known: dict[str, Any] = {"temperature_c": temperature_c, "cause": cause, "clock_mhz": 612.0}
    return Health(t_ns=0, band=band, throttled=False, disk_free_mb=None, **known)


def flight_messages(flight: Flight, end: int = FRAMES) -> list[Message]:
    return [ORIGIN, *(message for i in range(end) for message in flight.messages(i))]


def test_the_start_of_a_flight_is_logged_with_estimator_and_default_mode(tmp_path: Path) -> None:
    (line,) = logged(received_and_published([ORIGIN]), tmp_path, "INFO")
    assert (line["level"], line["event"]) == ("info", "pose estimator ready")
    assert (line["estimator"], line["covariance_mode"]) == ("OpenCVGtsamPoseEstimator", "marginals")


def test_beginning_and_end_of_thermal_throttle_are_warnings_with_temperature_and_cause(tmp_path: Path) -> None:
    messages = [
        health(ThermalBand.NORMAL, 60.0),
        health(ThermalBand.HOT, 81.0, "gpu 81 C"),
        health(ThermalBand.CRITICAL, 96.0),  # the mode is the same
        health(ThermalBand.NORMAL, 70.0, "all below 75 C"),
    ]
    lines = logged(messages, tmp_path, "WARN")
    fields = "level", "event", "temperature_c", "cause", "covariance_mode", "clock_mhz"
    assert [tuple(line[field] for field in fields) for line in lines] == [
        ("warning", "thermal throttle entered", 81.0, "gpu 81 C", "jacobian", 612.0),
        ("warning", "thermal throttle left", 70.0, "all below 75 C", "marginals", 612.0),
    ]


def test_the_pose_of_each_match_is_logged_for_developers(tmp_path: Path) -> None:
    messages = received_and_published(flight_messages(Flight(FRAMES, seed=2)))
    lines = [line for line in logged(messages, tmp_path) if line["event"] == "pose"]
    solutions = [message for message in messages if isinstance(message, PoseSolution)]
    assert [line["level"] for line in lines] == ["debug"] * 2
    for line, solution in zip(lines, solutions, strict=True):
        assert (line["frame_id"], line["inliers"]) == (solution.frame_id, solution.inliers)
        assert (line["method"], line["residual_px"]) == (PoseMethod.MATCHER, solution.residual_px)
        assert line["covariance_mode"] == "marginals"
    assert [line for line in logged(messages, tmp_path, "INFO") if line["event"] == "pose"] == []


@pytest.mark.parametrize(("odometry", "fallback"), [(True, "visual_propagated"), (False, "dead_reckoned")])
def test_an_accepted_match_without_a_pose_is_an_error_with_frame_mode_and_fallback(
    odometry: bool, fallback: str, tmp_path: Path
) -> None:
    flight = Flight(FRAMES, seed=2, fix_every=1000)
    messages = flight_messages(flight)
    if not odometry:
        messages = [
            msgspec.structs.replace(m, verdict=Verdict.NO_FEATURES, two_view=[])
            if isinstance(m, Odometry) and m.frame_id == FRAMES - 1
            else m
            for m in messages
        ]
    match = msgspec.structs.replace(flight.fix(FRAMES - 1), pose=None)
    lines = logged(received_and_published([*messages, match]), tmp_path, "ERROR")
    assert [(line["level"], line["event"], line["frame_id"]) for line in lines] == [
        ("error", "PnP failure", FRAMES - 1)
    ]
    assert (lines[0]["verdict"], lines[0]["covariance_mode"]) == ("degenerate", "marginals")
    assert lines[0]["fallback"] == fallback


@pytest.mark.parametrize("verdict", [Verdict.AMBIGUOUS, Verdict.FEW_INLIERS, Verdict.THROTTLED])
def test_a_match_that_the_anchor_did_not_accept_is_no_error(verdict: Verdict, tmp_path: Path) -> None:
    flight = Flight(FRAMES, seed=2, fix_every=1000)
    match = MapMatch(t_ns=flight.fix(FRAMES - 1).t_ns, frame_id=FRAMES - 1, verdict=verdict, matcher="gradient")
    messages = received_and_published([*flight_messages(flight), match])
    assert isinstance(messages[-1], PoseSolution)
    assert logged(messages, tmp_path, "ERROR") == []


def test_a_pose_that_the_gate_rejects_is_no_error(tmp_path: Path) -> None:
    flight = Flight(FRAMES, seed=2, fix_every=1000)
    messages = received_and_published([*flight_messages(flight), flight.fix(FRAMES - 1, (354.0, 0.0))])
    assert logged(messages, tmp_path, "ERROR") == []


def test_the_checkpoint_is_written_where_the_process_has_one(tmp_path: Path) -> None:
    messages = received_and_published(flight_messages(Flight(FRAMES, seed=2)))
    edge = make_edge(context(tmp_path, tmp_path / "checkpoint"))
    for message in messages:
        edge.on_message(message)
    saved = load_checkpoint(tmp_path / "checkpoint")
    assert saved is not None and saved.estimate in messages
    assert list(edge.poll(0)) == []
