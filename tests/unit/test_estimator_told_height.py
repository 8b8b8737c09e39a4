"""Heights that cannot be: a sensor made them up. The flight goes on as if nobody had told them."""

from collections.abc import Iterable

import msgspec
import numpy as np
import pytest
from simulated_flight import ORIGIN, Flight, Listener, cov_of, error_m

from terrafix.estimator.told_height import REPEATED, SIGMAS, ToldHeights
from terrafix.messages import MapMatch, MeasurementVerdict, Message, VehicleState, Verdict

FRAMES, AT = 40, 20


def told_otherwise(messages: Iterable[Message], agl_m: float) -> list[Message]:
    return [msgspec.structs.replace(m, agl_m=agl_m) if isinstance(m, VehicleState) else m for m in messages]


def flown(wrong: dict[int, float], without_fix: bool = False) -> tuple[Flight, Listener]:
    """``wrong``: by frame, the height that is told."""
    flight, listener = Flight(FRAMES, seed=5), Listener()
    listener.hear([ORIGIN])
    for i in range(FRAMES):
        messages = [m for m in flight.messages(i) if not (without_fix and isinstance(m, MapMatch))]
        listener.hear(told_otherwise(messages, wrong[i]) if i in wrong else messages)
    return flight, listener


def refused(listener: Listener) -> list[int]:
    said = [m for m in listener.said if isinstance(m, MeasurementVerdict) and m.measurement == "height"]
    assert all(m.verdict is Verdict.IMPLAUSIBLE for m in said)
    return [m.frame_id for m in said]


@pytest.mark.parametrize("agl_m", [0.0, -3.0, 300.0, 1000.0, 12000.0])
def test_one_height_that_cannot_be_moves_nothing(agl_m: float) -> None:
    flight, listener = flown({AT: agl_m})
    assert refused(listener) == [AT]
    for i in range(AT, FRAMES):
        estimate = listener.estimate(i)
        off = error_m(estimate, flight)
        assert np.linalg.norm(off) < 10.0
        assert float(off[:2] @ np.linalg.solve(cov_of(estimate)[:2, :2], off[:2])) < 13.8


def test_heights_that_can_be_are_all_believed() -> None:
    _, listener = flown({})
    assert refused(listener) == []


@pytest.mark.parametrize(("agl_m", "frames", "refused_at"), [(0.0, 1, []), (1000.0, 1, []), (0.0, 6, [6])])
def test_first_heights_that_later_ones_contradict_are_forgotten(
    agl_m: float, frames: int, refused_at: list[int]
) -> None:
    flight, listener = flown(dict.fromkeys(range(frames), agl_m), without_fix=True)
    assert refused(listener) == refused_at
    assert abs(listener.estimate(FRAMES - 1).agl_m - float(flight.p_m[FRAMES - 1, 2])) < 15.0


def test_what_is_repeated_without_a_map_fix_is_believed_in_the_end() -> None:
    heights = ToldHeights()
    far_m = 1.01 * SIGMAS * 5.0
    assert [heights.refuses(far_m, 5.0, 1.0) for _ in range(REPEATED + 1)] == [True] * REPEATED + [False]
    assert not heights.refuses(0.99 * SIGMAS * 5.0, 5.0, 1.0)
    assert all(heights.refuses(far_m, 5.0, float(i)) for i in range(3 * REPEATED))  # fixes bear the flight out
