"""Innovation gate of reported heights and headings: implausible readings are treated as missing."""

from collections.abc import Callable
from math import radians

import msgspec
import numpy as np
import pytest

from simulated_flight import ORIGIN, EstimatorRun, Flight, cov_of, error_m
from terrafix.estimator.initialization import ResetReason
from terrafix.estimator.integrity.innovation import Innovation
from terrafix.estimator.integrity.innovation_gate import FUSION_TIMEOUT_SAMPLES, InnovationGate
from terrafix.estimator.measurements.heading import HEADING_GATE_SIGMAS
from terrafix.estimator.measurements.height import HEIGHT_GATE_SIGMAS
from terrafix.messages import MapMatch, MeasurementVerdict, VehicleState, Verdict

Alter = Callable[[VehicleState], VehicleState]

FRAMES, AT = 40, 20


def at_height(agl_m: float) -> Alter:
    return lambda state: msgspec.structs.replace(state, agl_m=agl_m)


def turned(by_deg: float) -> Alter:
    def alter(state: VehicleState) -> VehicleState:
        return (
            state if state.yaw_rad is None else msgspec.structs.replace(state, yaw_rad=state.yaw_rad + radians(by_deg))
        )

    return alter


def flown(wrong: dict[int, Alter], without_fix: bool = False) -> tuple[Flight, EstimatorRun]:
    """``wrong``: frame -> edit of the telemetry of that frame."""
    flight, listener = Flight(FRAMES, seed=5), EstimatorRun()
    listener.feed([ORIGIN])
    for i in range(FRAMES):
        alter = wrong.get(i, lambda state: state)
        messages = [m for m in flight.messages(i) if not (without_fix and isinstance(m, MapMatch))]
        listener.feed([alter(m) if isinstance(m, VehicleState) else m for m in messages])
    return flight, listener


def rejected_frames(listener: EstimatorRun, measurement: str = "height") -> list[int]:
    verdicts = [m for m in listener.published if isinstance(m, MeasurementVerdict) and m.measurement == measurement]
    assert all(m.verdict is Verdict.IMPLAUSIBLE for m in verdicts)
    for verdict in verdicts:
        (residual,), (variance,) = verdict.innovation, verdict.innovation_variance
        limit = HEIGHT_GATE_SIGMAS if measurement == "height" else HEADING_GATE_SIGMAS
        assert verdict.test_ratio == pytest.approx(residual**2 / variance / limit**2) and verdict.test_ratio > 1.0
    return [m.frame_id for m in verdicts]


@pytest.mark.parametrize("agl_m", [0.0, -3.0, 300.0, 1000.0, 12000.0])
def test_a_single_implausible_height_is_rejected_and_does_not_move_the_estimate(agl_m: float) -> None:
    flight, listener = flown({AT: at_height(agl_m)})
    assert rejected_frames(listener) == [AT]
    check_all_right(flight, listener)


@pytest.mark.parametrize(("by_deg", "frames"), [(180.0, 1), (120.0, FRAMES - AT), (-90.0, FRAMES - AT)])
def test_implausible_headings_are_rejected_and_do_not_turn_the_estimate(by_deg: float, frames: int) -> None:
    wrong = range(AT, AT + frames)
    flight, listener = flown(dict.fromkeys(wrong, turned(by_deg)))
    assert rejected_frames(listener, "attitude") == list(wrong)
    check_all_right(flight, listener)


def check_all_right(flight: Flight, listener: EstimatorRun) -> None:
    for i in range(AT, FRAMES):
        estimate = listener.estimate(i)
        off = error_m(estimate, flight)
        assert np.linalg.norm(off) < 10.0
        assert float(off[:2] @ np.linalg.solve(cov_of(estimate)[:2, :2], off[:2])) < 13.8


def test_plausible_heights_and_headings_are_all_accepted() -> None:
    _, listener = flown({})
    assert rejected_frames(listener) == rejected_frames(listener, "attitude") == []


@pytest.mark.parametrize(("agl_m", "frames", "rejected_at"), [(0.0, 1, [1]), (1000.0, 1, [1]), (0.0, 6, [6, 7])])
def test_wrong_initial_heights_are_replaced_by_later_consistent_ones(
    agl_m: float, frames: int, rejected_at: list[int]
) -> None:
    flight, listener = flown(dict.fromkeys(range(frames), at_height(agl_m)), without_fix=True)
    assert rejected_frames(listener) == rejected_at
    assert abs(listener.estimate(FRAMES - 1).agl_m - float(flight.p_m[FRAMES - 1, 2])) < 15.0


def test_after_the_time_out_without_a_map_fix_a_rejected_reading_is_accepted() -> None:
    gate, samples = InnovationGate("height"), FUSION_TIMEOUT_SAMPLES
    far, near = (Innovation.scalar(off * HEIGHT_GATE_SIGMAS * 5.0, 5.0, HEIGHT_GATE_SIGMAS) for off in (1.01, 0.99))
    assert [gate.rejection(far, 1.0) is not None for _ in range(samples + 1)] == [True] * samples + [False]
    assert gate.rejection(near, 1.0) is None
    assert all(gate.rejection(far, float(i)) for i in range(3 * samples))  # map fixes confirm the estimate


def test_a_wrong_initial_heading_is_replaced_by_the_second_one() -> None:
    flight, listener = flown({0: turned(150.0)}, without_fix=True)
    assert rejected_frames(listener, "attitude") == [1]  # at which the graph begins anew
    assert listener.verdicts("reset")[1].detail == ResetReason.HEADING_GATE
    assert np.linalg.norm(error_m(listener.estimate(FRAMES - 1), flight)[:2]) < 60.0


@pytest.mark.parametrize("wrong", [(AT, AT + 1), (AT, AT + 1, AT + 2, AT + 3)])
def test_without_a_map_rejected_heights_do_not_change_position_or_covariance(wrong: tuple[int, ...]) -> None:
    flight, listener = flown(dict.fromkeys(wrong, at_height(300.0)), without_fix=True)
    _, plain = flown({}, without_fix=True)
    assert rejected_frames(listener) == list(wrong)
    here, there = listener.estimate(FRAMES - 1), plain.estimate(FRAMES - 1)
    off = error_m(here, flight)[:2]
    assert float(off @ np.linalg.solve(cov_of(here)[:2, :2], off)) < 13.8
    assert here.cov[0] < 1.2 * there.cov[0]
