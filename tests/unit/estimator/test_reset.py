"""A graph that begins anew in flight: vision's keyframe is not in it, and the anchor need not look before telemetry."""

import msgspec
import numpy as np
import pytest

from map_matches import with_search
from simulated_flight import (
    FRAME_S,
    ORIGIN,
    SPEED_MPS,
    EstimatorRun,
    Flight,
    blind,
    error_m,
    same_features,
    some_features,
)
from terrafix.estimator.initialization import ResetReason
from terrafix.messages import Message, Odometry, Prediction, VehicleState, Verdict

FRAMES = 8
FIRST_TELEMETRY = 1  # frame
FOUND = 4


@pytest.fixture(scope="module")
def flight() -> Flight:
    return Flight(FRAMES, seed=6, dem=True)


def of_one_keyframe(flight: Flight, i: int) -> list[Message]:
    """What is published of frame i, all features of which are of frame 0; without a map match."""
    features = some_features()[2 * i :]  # some are lost on the way
    messages = flight.messages(i)
    odometry = next(m for m in messages if isinstance(m, Odometry)) if i == 0 else same_features(flight, 0, i, features)
    return [m for m in messages if isinstance(m, VehicleState)] + [odometry]


def without_telemetry(messages: list[Message]) -> list[Message]:
    return [m for m in messages if not isinstance(m, VehicleState)]


def steps_off_m(run: EstimatorRun, flight: Flight, first: int) -> list[float]:
    """Of each Prediction after frame ``first``: its step less the true one."""
    steps = {m.frame_id: np.array(m.step_m) for m in run.published if isinstance(m, Prediction) and m.frame_id > first}
    return [float(np.linalg.norm(s - (flight.p_m[i] - flight.p_m[i - 1])[:2])) for i, s in steps.items()]


def test_odometry_of_the_keyframe_before_a_late_heading_is_fused(flight: Flight) -> None:
    run = EstimatorRun()
    run.feed([ORIGIN])
    for i in range(FRAMES):
        messages = of_one_keyframe(flight, i)
        run.feed(messages if i >= FIRST_TELEMETRY else without_telemetry(messages))
    assert {i: v.verdict for i, v in run.verdicts("odometry").items()} == dict.fromkeys(range(FRAMES), Verdict.ACCEPTED)
    reasons = {frame: verdict.detail for frame, verdict in run.verdicts("reset").items()}
    assert reasons == {0: ResetReason.FIRST_FRAME, FIRST_TELEMETRY: ResetReason.FIRST_TELEMETRY}
    assert max(steps_off_m(run, flight, FIRST_TELEMETRY)) < 2.5 < 0.5 * SPEED_MPS * FRAME_S


def test_odometry_of_the_keyframe_before_a_find_is_fused(flight: Flight) -> None:
    run = EstimatorRun()
    run.feed([ORIGIN])
    for i in range(FRAMES):
        run.feed(of_one_keyframe(flight, i))
        if i == FOUND:
            run.feed([with_search(flight.fix(i, offset_m=(300.0, 0.0)), relocalized=True)])
    assert "found" in run.verdicts("map")[FOUND].detail
    assert {i: v.verdict for i, v in run.verdicts("odometry").items()} == dict.fromkeys(range(FRAMES), Verdict.ACCEPTED)
    assert max(steps_off_m(run, flight, FOUND)) < 1.5
    assert np.linalg.norm(error_m(run.estimate(FRAMES - 1), flight, offset_m=(300.0, 0.0))[:2]) < 15.0


def test_where_the_first_frame_tracks_nothing_its_keyframe_stays_lost(flight: Flight) -> None:
    run = EstimatorRun()
    run.feed([ORIGIN])
    for i in range(FRAMES):
        messages = of_one_keyframe(flight, i)
        if i == FIRST_TELEMETRY:
            messages = [blind(m) if isinstance(m, Odometry) else m for m in messages]
        run.feed(messages if i >= FIRST_TELEMETRY else without_telemetry(messages))
    assert run.verdicts("odometry")[FIRST_TELEMETRY + 1].verdict is Verdict.STALE


@pytest.mark.parametrize("telemetry_from_s", [0.5, 1.5, None])
def test_no_frame_of_the_first_second_is_looked_at_without_telemetry(
    telemetry_from_s: float | None, flight: Flight
) -> None:
    run = EstimatorRun()
    run.feed([ORIGIN])
    for i in range(FRAMES):
        has_telemetry = telemetry_from_s is not None and i * FRAME_S >= telemetry_from_s
        run.feed(of_one_keyframe(flight, i) if has_telemetry else without_telemetry(of_one_keyframe(flight, i)))
    first_s = 1.0 if telemetry_from_s is None else min(telemetry_from_s, 1.0)
    looked_at = [m.frame_id for m in run.published if isinstance(m, Prediction)]
    assert looked_at == list(range(round(first_s / FRAME_S), FRAMES))
    assert run.estimate(0).frame_id == 0  # there is an estimate from the first frame on


def test_telemetry_that_lasts_for_a_second_is_all_there_will_be(flight: Flight) -> None:
    """An autopilot that reports no height, and that is received before the camera is."""
    run = EstimatorRun()
    run.feed([ORIGIN])
    for i in range(4):
        messages = [
            msgspec.structs.replace(m, agl_m=None) if isinstance(m, VehicleState) else m
            for m in of_one_keyframe(flight, i)
        ]
        run.feed(messages if i >= 2 else [m for m in messages if isinstance(m, VehicleState)])
    assert [m.frame_id for m in run.published if isinstance(m, Prediction)] == [2, 3]
