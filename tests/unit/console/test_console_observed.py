"""Results and events of the messages of a flight."""

import math

import msgspec
import numpy as np
import pytest

from flight_records import estimate, frame, origin
from map_matches import with_search
from terrafix import messages as m
from terrafix_tools.console.compute.observed import FlightObserver, FrameOutcome, confidence_of, ellipse_of
from terrafix_tools.console.events import (
    ChunkMerged,
    Event,
    FragmentChanged,
    FrameRefined,
    HintAnswered,
    RecoveryStarted,
    RecoverySucceeded,
    SearchExpanded,
    StateChanged,
    UserFixApplied,
    UserInputNeeded,
    VerdictGiven,
    WaypointsUpdated,
    name_of,
)
from terrafix_tools.console.payloads import FlightState, FragmentState


class ObservedFlight:
    """A flight, frame by frame."""

    def __init__(self) -> None:
        self.observer = FlightObserver(lambda frame_id: f"/image/{frame_id}")
        self.observer.take([origin()])
        self.next_id = 0

    def searches(self, tiles: int | None, places: list[tuple[float, float]] | None = None) -> None:
        found = m.SearchPlaces(t_ns=0, frame_id=self.next_id, tiles=tiles, places=places or [], half_size_m=66.66)
        self.observer.take([found])

    def frame(
        self, verdict: m.Verdict, step: m.SearchStep = m.SearchStep.NORMAL, fragment: int = 0, joined: bool = True
    ) -> FrameOutcome:
        i = self.next_id
        self.next_id += 1
        located = msgspec.structs.replace(estimate(i, 10.0 * i, 0.0), fragment_id=fragment, joined=joined)
        located = msgspec.structs.replace(located, cov=(*located.cov[:35], 0.2**2))
        match = m.MapMatch(t_ns=located.t_ns, frame_id=i, verdict=verdict, matcher="gradient", inliers=12)
        self.observer.take([frame(i), located, with_search(match, step=step)])
        return self.observer.frame_done()


def of_kind(outcome: FrameOutcome, *kinds: type[Event]) -> list[Event]:
    return [event for event in outcome.events if isinstance(event, kinds)]


LOST, WIDEN, WHOLE, ASK = m.Verdict.LOST, m.SearchStep.WIDEN, m.SearchStep.WHOLE_MAP, m.SearchStep.ASK


def test_the_result_of_a_frame_is_its_last_estimate_with_the_match() -> None:
    flight = ObservedFlight()
    flight.observer.origin_ns = frame(0).t_ns - 1_500_000_000
    outcome = flight.frame(m.Verdict.ACCEPTED)
    result = outcome.result
    assert result is not None and result.gps is not None and result.ellipse is not None
    assert (result.gps.lat, result.gps.lon, result.altitude, result.heading) == (48.0, 11.0, 600.0, 90.0)
    assert (result.match, result.inliers, result.source) == ("accepted", 12, "satellite_anchored")
    assert result.t_s == 1.5
    assert result.ellipse.semi_major_m == pytest.approx(4.0 * math.sqrt(5.991), abs=0.01)
    assert result.confidence == pytest.approx(1.0 - math.exp(-(20.0**2) / (2 * 4.0**2)), abs=1e-4)
    assert result.heading_sigma == pytest.approx(math.degrees(0.2), abs=1e-3)
    assert [name_of(type(e)) for e in outcome.events] == ["frame_processed", "fragment_changed"]


def test_the_ellipse_points_along_its_longer_axis_and_the_confidence_is_that_of_the_worse_one() -> None:
    east = ellipse_of(np.diag([9.0, 1.0]))
    assert (east.bearing_deg, east.semi_major_m, east.semi_minor_m) == (90.0, 7.34, 2.45)
    turn = np.array([[math.cos(0.5), math.sin(0.5)], [-math.sin(0.5), math.cos(0.5)]])  # 0.5 rad from east to south
    assert ellipse_of(turn @ np.diag([9.0, 1.0]) @ turn.T).bearing_deg == pytest.approx(90 + math.degrees(0.5), abs=0.1)
    assert confidence_of(np.diag([400.0, 1.0])) == pytest.approx(1.0 - math.exp(-0.5), abs=1e-4)


def test_a_loss_widens_asks_once_and_ends_with_the_place() -> None:
    flight = ObservedFlight()
    flight.frame(m.Verdict.ACCEPTED)
    flight.searches(1)
    lost = flight.frame(LOST, WIDEN)
    assert of_kind(lost, SearchExpanded, RecoveryStarted, StateChanged) == [
        SearchExpanded(frame_id=1, file="0001.jpg", grid_size=1, status="widen"),
        RecoveryStarted(frame_id=1, file="0001.jpg"),
        StateChanged(state=FlightState.RECOVERING, previous=FlightState.PROCESSING),
    ]
    assert of_kind(flight.frame(LOST, WIDEN), SearchExpanded, StateChanged) == []
    flight.searches(4)
    assert of_kind(flight.frame(LOST, WIDEN), SearchExpanded) == [
        SearchExpanded(frame_id=3, file="0003.jpg", grid_size=4, status="widen")
    ]
    flight.searches(None, [(48.0 + 0.001 * k, 11.0) for k in range(5)])
    assert of_kind(flight.frame(LOST, WHOLE), SearchExpanded) == [
        SearchExpanded(frame_id=4, file="0004.jpg", grid_size=None, status="whole_map")
    ]
    asked = flight.frame(LOST, ASK)
    (needed,) = of_kind(asked, UserInputNeeded)
    assert isinstance(needed, UserInputNeeded)
    assert (needed.request_id, needed.frame_id, needed.image_url) == ("r1", 5, "/image/5")
    assert [tile.rank for tile in needed.candidate_tiles] == [1, 2, 3, 4, 5]
    third = needed.candidate_tiles[2]
    assert (third.gps.lat, third.gps.lon, third.half_size_m) == (48.002, 11.0, 66.7)
    assert asked.state is FlightState.BLOCKED and asked.request is not None and asked.request.frame_id == 5
    again = flight.frame(LOST, m.SearchStep.NEW_FRAGMENT)
    assert of_kind(again, UserInputNeeded, RecoveryStarted, StateChanged) == [] and again.state is FlightState.BLOCKED
    found = flight.frame(m.Verdict.ACCEPTED, m.SearchStep.MERGE)
    assert of_kind(found, SearchExpanded, RecoverySucceeded, StateChanged) == [
        SearchExpanded(frame_id=7, file="0007.jpg", grid_size=None, status="found"),
        RecoverySucceeded(frame_id=7, file="0007.jpg", frames=6),
        StateChanged(state=FlightState.PROCESSING, previous=FlightState.BLOCKED),
    ]
    assert found.request is None
    assert of_kind(flight.frame(LOST, WIDEN), SearchExpanded) == [
        SearchExpanded(frame_id=8, file="0008.jpg", grid_size=None, status="widen")  # nothing of the search before
    ]


def test_a_flight_that_is_lost_when_its_images_are_through_asks_once() -> None:
    flight = ObservedFlight()
    for step in (WIDEN, WHOLE):
        flight.frame(LOST, step)
        assert flight.observer.images_through() is None  # two frames are no lost flight
    flight.frame(LOST, WHOLE)
    asked = flight.observer.images_through()
    assert asked is not None and asked.state is FlightState.BLOCKED and asked.request is not None
    kinds = [type(event).__name__ for event in asked.events]
    assert kinds == ["UserInputNeeded", "ProcessingBlocked", "StateChanged"]
    assert "all images are computed" in str(asked.events[1])
    assert flight.observer.images_through() is None
    found = flight.frame(m.Verdict.ACCEPTED, m.SearchStep.MERGE)
    assert found.state is FlightState.PROCESSING and found.request is None
    assert flight.observer.images_through() is None


def test_a_fragment_is_unanchored_then_matching_then_anchored_or_merged() -> None:
    flight, states = ObservedFlight(), []
    apart, skipped = (m.Verdict.UNCONFIRMED, m.SearchStep.NORMAL), (m.Verdict.BAD_IMAGE, m.SearchStep.SKIP)
    steps = [apart, (LOST, WIDEN), apart, apart, apart, skipped, (m.Verdict.ACCEPTED, m.SearchStep.NORMAL)]
    for verdict, step in (*steps, (LOST, WHOLE)):
        outcome = flight.frame(verdict, step, joined=False)
        assert outcome.fragment is not None
        states.append(outcome.fragment.state)
    assert "".join(state[0] for state in states) == "umuumuaa"


@pytest.mark.parametrize(("verdict", "kind"), [("accepted", UserFixApplied), ("innovation", VerdictGiven)])
def test_a_user_fix_is_applied_or_refused_with_the_reason(verdict: str, kind: type[Event]) -> None:
    flight = ObservedFlight()
    flight.observer.take(
        [m.MeasurementVerdict(t_ns=0, frame_id=0, measurement="user_fix", verdict=m.Verdict(verdict), detail="why")]
    )
    (event,) = of_kind(flight.frame(m.Verdict.UNCONFIRMED), UserFixApplied, VerdictGiven)[-1:]
    assert isinstance(event, kind) and event.model_dump()["detail"] == "why"


def test_a_hint_that_is_accepted_ends_the_request_and_the_search_goes_on() -> None:
    flight = ObservedFlight()
    flight.frame(LOST, ASK)
    rejected = m.HintVerdict(
        t_ns=0, hint_t_ns=1, verdict=m.Verdict.OUTSIDE_MAP, distance_m=None, sigma_m=None, text="outside"
    )
    flight.observer.take([rejected])
    assert flight.frame(LOST, WHOLE).state is FlightState.BLOCKED
    flight.observer.take([msgspec.structs.replace(rejected, verdict=m.Verdict.ACCEPTED)])
    outcome = flight.frame(LOST, WHOLE)
    assert outcome.state is FlightState.RECOVERING and outcome.request is None


@pytest.mark.parametrize("frames", [1, 2])
def test_a_fragment_is_merged_once_when_it_is_joined_or_begins_joined(frames: int) -> None:
    flight = ObservedFlight()
    assert of_kind(flight.frame(m.Verdict.ACCEPTED), ChunkMerged) == []
    for i in range(1, frames + 1):
        outcome = flight.frame(m.Verdict.UNCONFIRMED, m.SearchStep.NEW_FRAGMENT, fragment=1, joined=i == frames)
    at = {"fragment_id": 1, "frame_id": frames, "file": f"000{frames}.jpg"}
    assert of_kind(outcome, ChunkMerged, FragmentChanged) == [
        ChunkMerged(**at, frames=frames),
        FragmentChanged(**at, state=FragmentState.MERGED),
    ]
    assert outcome.fragment is not None and outcome.fragment.merged_at_frame == frames
    assert of_kind(flight.frame(m.Verdict.ACCEPTED, fragment=1), ChunkMerged, FragmentChanged) == []
    counted = [flight.observer.completed().statistics[name] for name in ("frames", "localised", "fragments", "merged")]
    assert counted == [frames + 2, frames + 2, 2, 1]


def test_rejections_answers_and_refined_positions_are_events_of_their_step() -> None:
    flight = ObservedFlight()
    flight.observer.hints[77], flight.observer.flight_id = 3, "f7"
    pose = m.RefinedPose(frame_id=0, lat_deg=48.5, lon_deg=11.5, alt_amsl_m=600.0, sigma_e_m=2.0, sigma_n_m=1.0)
    more = {"fragment_id": 3, "q_w_c": (1.0, 0.0, 0.0, 0.0), "cov": tuple(range(36)), "m_per_unit": 1.25}
    whole = msgspec.structs.replace(pose, **more)
    flight.observer.take(
        [
            m.MeasurementVerdict(t_ns=0, frame_id=0, measurement="height", verdict=m.Verdict.IMPLAUSIBLE, detail="x"),
            m.MeasurementVerdict(t_ns=0, frame_id=0, measurement="odometry", verdict=m.Verdict.ACCEPTED),
            m.MeasurementVerdict(t_ns=0, frame_id=0, measurement="map", verdict=m.Verdict.ACCEPTED, test_ratio=0.25),
            m.HintVerdict(
                t_ns=0, hint_t_ns=77, verdict=m.Verdict.ACCEPTED, distance_m=3.21, sigma_m=1.0, text="agrees"
            ),
            m.Refinement(t_ns=0, source=m.RefinementSource.SMOOTHER, poses=[whole]),
        ]
    )
    outcome = flight.frame(m.Verdict.ACCEPTED)
    given = [event for event in outcome.events if isinstance(event, VerdictGiven)]
    assert [(v.measurement, v.verdict, v.test_ratio) for v in given] == [
        ("height", "implausible", None),
        ("map", "accepted", 0.25),
    ]
    assert of_kind(outcome, HintAnswered) == [
        HintAnswered(hint_id=3, verdict="accepted", distance_m=3.2, text="agrees")
    ]
    (refined,) = outcome.refined
    assert of_kind(outcome, FrameRefined) == [refined]
    assert (refined.gps.lat, refined.source, refined.ellipse.bearing_deg) == (48.5, "smoother", 90.0)
    assert (refined.fragment_id, refined.m_per_unit, refined.orientation) == (3, 1.25, [1.0, 0.0, 0.0, 0.0])
    assert refined.covariance == [float(i) for i in range(36)]
    assert of_kind(outcome, WaypointsUpdated) == [
        WaypointsUpdated(frames=1, first_frame=0, last_frame=0, url="/flights/f7/waypoints")
    ]
    assert flight.observer.rest().events == []
    flight.observer.take([m.Refinement(t_ns=1, poses=[pose])])
    (after_the_end,) = flight.observer.rest().refined
    assert after_the_end.m_per_unit == 1.25, "a refinement without a scale keeps the last one"


def test_an_image_without_position_has_a_result_with_its_error() -> None:
    flight = ObservedFlight()
    flight.observer.take([msgspec.structs.replace(frame(0), error="file is empty")])
    outcome = flight.observer.frame_done()
    assert outcome.result is not None
    assert (outcome.result.error, outcome.result.gps, outcome.fragment) == ("file is empty", None, None)
