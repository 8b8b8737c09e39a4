"""A Start while the vehicle stands: the estimator begins there, and remembers it."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from map_matches import plane
from simulated_flight import FRAME_S, ORIGIN, PLACE, EstimatorRun, Flight, error_m, sigma_m
from terrafix.core.codec import decode, encode
from terrafix.estimator.node import EstimatorNode
from terrafix.estimator.prior import CheckpointWriter, load_checkpoint
from terrafix.messages import (
    InitialPosition,
    MapMatch,
    MeasurementVerdict,
    Message,
    NavEstimate,
    Odometry,
    Prediction,
    SearchResult,
    VehicleState,
    Verdict,
)
from terrafix_tools.finalise.flight_graph import FlightReplayer

NOBODY_SAID_M = 4000.0
UNKNOWN = msgspec.structs.replace(ORIGIN, start_sigma_m=NOBODY_SAID_M)
SIGMA_M, AT_M, GROUND_M = 3.0, (900.0, -400.0), 80.0
START_AT = 4  # frames


def start_at(i: int, e_m: float = AT_M[0], n_m: float = AT_M[1], ground_m: float | None = GROUND_M) -> InitialPosition:
    lat_deg, lon_deg = PLACE.to_wgs84(e_m, n_m)
    fields = {"lat_deg": lat_deg, "lon_deg": lon_deg, "sigma_m": SIGMA_M, "ground_amsl_m": ground_m}
    return InitialPosition(t_ns=round(i * FRAME_S * 1e9), verdict=Verdict.ACCEPTED, **fields)


def withdrawn(i: int) -> InitialPosition:
    fields = {"lat_deg": None, "lon_deg": None, "sigma_m": None, "ground_amsl_m": None}
    return InitialPosition(t_ns=round(i * FRAME_S * 1e9), verdict=Verdict.ACCEPTED, **fields)


def standing(i: int, armed: bool = False) -> list[Message]:
    t_ns = round(i * FRAME_S * 1e9)
    state = VehicleState(t_ns=t_ns, source="mavlink", yaw_rad=0.3, pitch_rad=0.0, roll_rad=0.0, agl_m=0.4, armed=armed)
    return [state, Odometry(t_ns=t_ns, frame_id=i, keyframe_id=i, verdict=Verdict.NO_FEATURES)]


def stood(
    frames: int = 10, start: InitialPosition | None = None, told_at: int = START_AT, node: EstimatorNode | None = None
) -> EstimatorRun:
    run = EstimatorRun()
    run.node = node or run.node
    run.feed([UNKNOWN])
    for i in range(frames):
        run.feed([start] if start is not None and i == told_at else [])
        run.feed(standing(i))
    return run


def at_m(estimate: NavEstimate) -> np.ndarray:
    return np.array(PLACE.to_local(estimate.lat_deg, estimate.lon_deg))


def test_it_begins_there_with_the_next_frame_as_sure_as_that_is() -> None:
    run = stood(start=start_at(START_AT))
    assert sigma_m(run.estimate(START_AT - 1)) > NOBODY_SAID_M
    for i in (START_AT, 9):
        estimate = run.estimate(i)
        assert at_m(estimate) == pytest.approx(AT_M, abs=0.1)
        assert SIGMA_M <= sigma_m(estimate) < 1.2 * SIGMA_M
        assert estimate.alt_amsl_m == pytest.approx(GROUND_M + 0.4, abs=1.0)  # the ground there, not in the middle


def test_a_prediction_names_the_start_it_is_based_on() -> None:
    run = stood(start=start_at(START_AT))
    predictions = {m.frame_id: m for m in run.published if isinstance(m, Prediction)}
    assert [predictions[i].prior_t_ns for i in (START_AT - 1, START_AT, 9)] == [0, *[start_at(START_AT).t_ns] * 2]
    assert predictions[START_AT].step_m == (0.0, 0.0)


def test_without_a_ground_height_from_the_map_the_former_one_stays() -> None:
    run = EstimatorRun()
    run.feed([msgspec.structs.replace(UNKNOWN, ground_amsl_m=25.0), start_at(0, ground_m=None), *standing(0)])
    assert run.estimate(0).alt_amsl_m == pytest.approx(25.4, abs=1.0)


def test_a_repeated_start_changes_nothing_and_another_one_resets() -> None:
    run = stood(start=start_at(START_AT))
    estimator = run.node.estimator
    run.feed([start_at(START_AT), *standing(10)])
    assert run.node.estimator is estimator
    run.feed([start_at(11, 0.0, 0.0), *standing(11)])
    assert at_m(run.estimate(11)) == pytest.approx([0.0, 0.0], abs=0.1)


def test_what_is_withdrawn_is_not_known() -> None:
    run = stood(start=start_at(START_AT))
    run.feed([withdrawn(10), *standing(10)])
    assert sigma_m(run.estimate(10)) > NOBODY_SAID_M
    assert run.node.origin == UNKNOWN


def test_a_start_before_the_first_picture_holds_while_the_vehicle_stands() -> None:
    """However long: the camera may be late."""
    run = EstimatorRun()
    run.feed([UNKNOWN, start_at(0), *standing(240)])
    assert sigma_m(run.estimate(240)) < 1.2 * SIGMA_M
    flown = EstimatorRun()
    flown.feed([UNKNOWN, start_at(0), *standing(20, armed=True)])
    assert sigma_m(flown.estimate(20)) > 50.0  # it has flown for ten seconds, nobody knows where


def test_a_match_of_a_frame_before_the_start_is_stale() -> None:
    """Not where the ground lies, and not that the place is doubted."""
    run = stood(start=start_at(START_AT))
    before = run.estimate(9)
    match = MapMatch(
        t_ns=0,
        frame_id=START_AT - 1,
        verdict=Verdict.LOST,
        matcher="gradient",
        ground=plane(300.0),
        search=SearchResult(sigma_m=1000.0),
    )
    (verdict,) = run.feed([match])
    assert isinstance(verdict, MeasurementVerdict) and verdict.verdict is Verdict.STALE
    run.feed(standing(10))
    after = run.estimate(10)
    assert after.alt_amsl_m == pytest.approx(before.alt_amsl_m, abs=0.5) and sigma_m(after) < 1.2 * SIGMA_M


def test_a_position_by_a_map_match_is_not_replaced_by_a_start() -> None:
    flight = Flight(20, seed=2)
    run = EstimatorRun().fly(flight, 0, 20)
    run.feed([start_at(20)])
    assert run.node.estimator is not None and run.node.estimator.last_fix_s is not None
    run.feed([blind_frame(20)])
    assert np.linalg.norm(at_m(run.estimate(20)) - flight.p_m[19, :2]) < 30.0


def blind_frame(i: int) -> Odometry:
    return Odometry(t_ns=round(i * FRAME_S * 1e9), frame_id=i, keyframe_id=i, verdict=Verdict.FEW_INLIERS)


def test_a_flight_from_there_is_a_flight() -> None:
    """With matches that are gated: at the place in the middle of the map, where nobody was, all would be refused."""
    flight = Flight(30, seed=5)
    run = EstimatorRun()
    run.feed([UNKNOWN, start_at(0, *flight.p_m[0, :2], ground_m=0.0)])
    for i in range(30):
        run.feed(flight.messages(i))
    assert {v.verdict for v in run.verdicts("map").values()} == {Verdict.ACCEPTED}
    assert np.linalg.norm(error_m(run.estimate(29), flight)[:2]) < 10.0


def killed(folder: Path) -> Path:
    file = folder / "estimator.checkpoint"
    keeper = CheckpointWriter(file)
    for message in (start_at(START_AT), *stood(start=start_at(START_AT)).published):
        keeper.on_message(message)
    return file


def test_an_estimator_that_is_started_in_its_place_knows_it(tmp_path: Path) -> None:
    """Where it was and how high the ground is there; also after a second time, though the Start is published once."""
    file = killed(tmp_path)
    for _ in range(2):
        last = load_checkpoint(file)
        assert last is not None
        run = EstimatorRun()
        run.node = EstimatorNode(0, last)
        run.feed([UNKNOWN])
        run.feed(standing(11))
        estimate = run.estimate(11)
        assert at_m(estimate) == pytest.approx(AT_M, abs=1.0) and sigma_m(estimate) < 60.0
        assert estimate.alt_amsl_m == pytest.approx(GROUND_M + 0.4, abs=1.0)
        keeper = CheckpointWriter(file)
        for message in run.published:
            keeper.on_message(message)
    run.feed([start_at(12, 0.0, 0.0), *standing(12)])
    assert at_m(run.estimate(12)) == pytest.approx(
        [0.0, 0.0], abs=0.1
    )  # nobody was on the map: the newest start counts


def test_one_that_was_on_the_map_goes_on_from_there(tmp_path: Path) -> None:
    flight, file = Flight(20, seed=2), tmp_path / "estimator.checkpoint"
    keeper = CheckpointWriter(file)
    for message in EstimatorRun().fly(flight, 0, 20).published:
        keeper.on_message(message)
    run = EstimatorRun()
    run.node = EstimatorNode(0, load_checkpoint(file))
    run.feed([UNKNOWN, start_at(20), *standing(20)])
    assert np.linalg.norm(at_m(run.estimate(20)) - flight.p_m[19, :2]) < 30.0


def test_after_landing_the_flight_begins_there_too() -> None:
    storyteller = FlightReplayer()
    for message in (UNKNOWN, *standing(0), *standing(1), start_at(2), *standing(2), *standing(3)):
        storyteller.on(message)
    before, after = storyteller.flights
    assert (before.origin.start_sigma_m, after.origin.start_sigma_m) == (NOBODY_SAID_M, SIGMA_M)
    assert sorted(before.node_of) == [0, 1] and sorted(after.node_of) == [2, 3]
    assert after.recorder.graph is storyteller.estimator.graph  # type: ignore[union-attr]


@pytest.mark.parametrize("start", [start_at(3), withdrawn(3)])
def test_it_survives_bus_and_record(start: InitialPosition) -> None:
    assert decode(encode(start)) == start
