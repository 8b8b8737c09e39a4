"""Heights and headings that cannot be: a sensor made them up. The flight goes on as if nobody had told them."""

from collections.abc import Callable
from math import radians

import msgspec
import numpy as np
import pytest

from simulated_flight import ORIGIN, Flight, Listener, cov_of, error_m
from terrafix.estimator.integrity.innovation_gate import REPEATED, SIGMAS, InnovationGate
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


def flown(wrong: dict[int, Alter], without_fix: bool = False) -> tuple[Flight, Listener]:
    """``wrong``: by frame, what becomes of the words of the autopilot."""
    flight, listener = Flight(FRAMES, seed=5), Listener()
    listener.hear([ORIGIN])
    for i in range(FRAMES):
        alter = wrong.get(i, lambda state: state)
        messages = [m for m in flight.messages(i) if not (without_fix and isinstance(m, MapMatch))]
        listener.hear([alter(m) if isinstance(m, VehicleState) else m for m in messages])
    return flight, listener


def refused(listener: Listener, measurement: str = "height") -> list[int]:
    said = [m for m in listener.said if isinstance(m, MeasurementVerdict) and m.measurement == measurement]
    assert all(m.verdict is Verdict.IMPLAUSIBLE for m in said)
    return [m.frame_id for m in said]


@pytest.mark.parametrize("agl_m", [0.0, -3.0, 300.0, 1000.0, 12000.0])
def test_one_height_that_cannot_be_moves_nothing(agl_m: float) -> None:
    flight, listener = flown({AT: at_height(agl_m)})
    assert refused(listener) == [AT]
    check_all_right(flight, listener)


@pytest.mark.parametrize(("by_deg", "frames"), [(180.0, 1), (120.0, FRAMES - AT), (-90.0, FRAMES - AT)])
def test_a_heading_that_cannot_be_turns_nothing(by_deg: float, frames: int) -> None:
    wrong = range(AT, AT + frames)
    flight, listener = flown(dict.fromkeys(wrong, turned(by_deg)))
    assert refused(listener, "attitude") == list(wrong)
    check_all_right(flight, listener)


def check_all_right(flight: Flight, listener: Listener) -> None:
    for i in range(AT, FRAMES):
        estimate = listener.estimate(i)
        off = error_m(estimate, flight)
        assert np.linalg.norm(off) < 10.0
        assert float(off[:2] @ np.linalg.solve(cov_of(estimate)[:2, :2], off[:2])) < 13.8


def test_what_can_be_is_all_believed() -> None:
    _, listener = flown({})
    assert refused(listener) == refused(listener, "attitude") == []


@pytest.mark.parametrize(("agl_m", "frames", "refused_at"), [(0.0, 1, []), (1000.0, 1, []), (0.0, 6, [6])])
def test_first_heights_that_later_ones_contradict_are_forgotten(
    agl_m: float, frames: int, refused_at: list[int]
) -> None:
    flight, listener = flown(dict.fromkeys(range(frames), at_height(agl_m)), without_fix=True)
    assert refused(listener) == refused_at
    assert abs(listener.estimate(FRAMES - 1).agl_m - float(flight.p_m[FRAMES - 1, 2])) < 15.0


def test_what_is_repeated_without_a_map_fix_is_believed_in_the_end() -> None:
    words = InnovationGate()
    far_m = 1.01 * SIGMAS * 5.0
    assert [words.refuses(far_m, 5.0, 1.0) for _ in range(REPEATED + 1)] == [True] * REPEATED + [False]
    assert not words.refuses(0.99 * SIGMAS * 5.0, 5.0, 1.0)
    assert all(words.refuses(far_m, 5.0, float(i)) for i in range(3 * REPEATED))  # fixes bear the flight out


def test_a_first_heading_that_the_second_one_contradicts_is_forgotten() -> None:
    flight, listener = flown({0: turned(150.0)}, without_fix=True)
    assert refused(listener, "attitude") == []
    assert np.linalg.norm(error_m(listener.estimate(FRAMES - 1), flight)[:2]) < 60.0


@pytest.mark.parametrize("wrong", [(AT, AT + 1), (AT, AT + 1, AT + 2, AT + 3)])
def test_a_flight_without_a_map_goes_on_where_it_was(wrong: tuple[int, ...]) -> None:
    flight, listener = flown(dict.fromkeys(wrong, at_height(300.0)), without_fix=True)
    _, plain = flown({}, without_fix=True)
    assert refused(listener) == list(wrong)
    here, there = listener.estimate(FRAMES - 1), plain.estimate(FRAMES - 1)
    off = error_m(here, flight)[:2]
    assert float(off @ np.linalg.solve(cov_of(here)[:2, :2], off)) < 13.8
    assert here.cov[0] < 1.2 * there.cov[0]
