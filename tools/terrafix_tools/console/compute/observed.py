"""What the messages of a flight mean to its operator: results, fragments and events, frame by frame."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from terrafix.core.flight_id import frame_uid
from terrafix.core.gate import CHI2_95
from terrafix.core.log_lines import SEARCHING_STEPS
from terrafix.link.ground_station.prior_request import MIN_FRAMES
from terrafix.messages import (
    Frame,
    HintVerdict,
    MapMatch,
    MeasurementVerdict,
    Message,
    NavEstimate,
    Origin,
    RefinedPose,
    Refinement,
    SearchPlaces,
    SearchStep,
    Verdict,
)
from terrafix_tools.before_after import FINALISED
from terrafix_tools.console.events import (
    CandidateTile,
    ChunkMerged,
    Event,
    FlightCompleted,
    FragmentChanged,
    FrameProcessed,
    FrameRefined,
    HintAnswered,
    OfFrame,
    ProcessingBlocked,
    RecoveryStarted,
    RecoverySucceeded,
    SearchExpanded,
    StateChanged,
    UserFixApplied,
    UserInputNeeded,
    VerdictGiven,
    WaypointsUpdated,
)
from terrafix_tools.console.payloads import (
    Ellipse,
    FlightState,
    Fragment,
    FragmentState,
    FrameResult,
    Gps,
    InputRequest,
    WholeVerdict,
)
from terrafix_tools.estimates import yaw_deg_of
from terrafix_tools.finalised import FinalRow

# Frames of a fragment from which on it is matched as a whole: the joint correlation has several looks [spec: SV-4]
READY_FRAMES = 5
NEAR_M = 20.0  # of the position, within which `confidence` is the probability [spec: AC-1 of the requirements]
LOST_REASON = "the position is lost and the whole map was searched; a user fix or a hint would help"
THROUGH_REASON = "all images are computed and the position is not found; a user fix or a hint would help"


@dataclass
class FrameOutcome:
    """What one step of a flight adds. ``result``: None at the origin and at the end."""

    result: FrameResult | None = None
    fragment: Fragment | None = None
    refined: list[FrameRefined] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    state: FlightState = FlightState.PROCESSING
    request: InputRequest | None = None


@dataclass
class _Totals:
    frames: int = 0
    localised: int = 0
    merged: int = 0
    hints: int = 0
    radii_m: list[float] = field(default_factory=list)
    refined: set[int] = field(default_factory=set)


class FlightObserver:
    """``take`` all messages in their order, then ``frame_done`` or ``rest`` for what they add. ``image_url``: of a
    frame."""

    def __init__(self, image_url: Callable[[int], str]) -> None:
        self._image_url = image_url
        self.estimates: dict[int, NavEstimate] = {}  # the last one of each frame
        self.hints: dict[int, int] = {}  # id of each hint that was given, by its t_ns
        self.origin_ns, self.flight_id = 0, ""
        self._fragments: dict[int, Fragment] = {}
        self._state = FlightState.PROCESSING
        self._asked = False
        self._lost_frames = 0  # in a row
        self._lost_at = 0  # frame at which the last search began
        self._requests = 0
        self._request: InputRequest | None = None
        self._reached: tuple[str, int | None] | None = None  # of the search
        self._totals = _Totals()
        self._shown: Frame | None = None
        self._match: MapMatch | None = None
        self._places: SearchPlaces | None = None  # of the running search
        self._others: list[Event] = []
        self._refined: list[FrameRefined] = []
        self._scales: dict[int, float] = {}  # by frame: metres per unit, of the newest refinement that states them
        self._frame_of: dict[str, int] = {}  # by file
        self._file_of: dict[int, str] = {}  # by frame
        self._finalised = 0

    def resume(self, state: FlightState) -> None:
        """Continues a live flight of which an earlier service has stored this state."""
        self._state = state
        self._reached = None if state is FlightState.PROCESSING else ("whole_map", None)
        self._asked = state is FlightState.BLOCKED

    def take(self, messages: Iterable[Message]) -> None:
        for message in messages:
            match message:
                case Origin():
                    self.origin_ns, self.flight_id = message.t_ns, message.flight_id
                case Frame():
                    self._shown, self._match = message, None
                    self._frame_of[message.file], self._file_of[message.frame_id] = message.frame_id, message.file
                case NavEstimate():
                    self.estimates[message.frame_id] = message
                case MapMatch():
                    self._match = message
                case SearchPlaces():
                    self._places = message
                case Refinement():
                    self._refined += [self._refined_frame(pose, str(message.source)) for pose in message.poses]
                case MeasurementVerdict(measurement="user_fix", verdict=Verdict.ACCEPTED):
                    self._others.append(UserFixApplied(frame_id=message.frame_id, detail=message.detail))
                case MeasurementVerdict() if message.verdict is not Verdict.ACCEPTED or message.measurement == "map":
                    self._others.append(_verdict(message))
                case HintVerdict():
                    self._others.append(self._answer(message))
                case _:
                    pass

    def frame_done(self) -> FrameOutcome:
        """What the newest frame adds."""
        shown = self._shown
        assert shown is not None
        estimate, found = self.estimates.get(shown.frame_id), self._match
        result = _result(shown, estimate, found, self.origin_ns)
        result.frame_uid = frame_uid(self.flight_id, shown.frame_id)
        events: list[Event] = [FrameProcessed(**result.model_dump())]
        fragment = None
        if estimate is not None and estimate.fragment_id >= 0:
            fragment, changes = self._fragment_of(estimate, found)
            events += changes
        events += self._search_events(found, shown.frame_id) if found is not None else []
        self._totals.frames += 1
        if result.ellipse is not None:
            self._totals.localised += 1
            self._totals.radii_m.append(result.ellipse.semi_major_m)
        outcome = self._outcome(events)
        outcome.result, outcome.fragment = result, fragment
        return outcome

    @property
    def asks(self) -> bool:
        """A position was asked for, and none has helped yet."""
        return self._asked

    def rest(self) -> FrameOutcome:
        """What messages without a frame add: those after the source has ended."""
        return self._outcome([])

    def finalised(self, rows: list[FinalRow]) -> FrameOutcome:
        """What the solution of the whole flight adds; ``rows``: those with a pose."""
        poses = [row.pose(self._frame_of[row.file]) for row in rows if row.file in self._frame_of]
        self._refined += [self._refined_frame(pose, FINALISED) for pose in poses]
        self._finalised = len(poses)
        return self._outcome([])

    def _refined_frame(self, pose: RefinedPose, source: str) -> FrameRefined:
        if pose.m_per_unit is not None:
            self._scales[pose.frame_id] = pose.m_per_unit
        refined = _refined(pose, source, self._scales.get(pose.frame_id))
        refined.frame_uid = frame_uid(self.flight_id, pose.frame_id)
        return refined

    def completed(self, verdict: WholeVerdict | None = None, not_finalised: str = "") -> FlightCompleted:
        """``verdict``: on the flight, None: it has no record; ``not_finalised``: why it has no solution as a whole."""
        totals = self._totals
        median = float(np.median(totals.radii_m)) if totals.radii_m else None
        return FlightCompleted(
            statistics={
                "frames": totals.frames,
                "localised": totals.localised,
                "refined": len(totals.refined),
                "finalised": self._finalised,
                "fragments": len(self._fragments),
                "merged": totals.merged,
                "hints": totals.hints,
                "median_radius95_m": None if median is None else round(median, 2),
                "not_finalised": not_finalised,
            },
            verdict=verdict,
        )

    def _outcome(self, events: list[Event]) -> FrameOutcome:
        events = [*events, *self._others, *self._refined]
        if self._refined:
            changed = [refined.frame_id for refined in self._refined]
            span = {"first_frame": min(changed), "last_frame": max(changed)}
            url = f"/flights/{self.flight_id}/waypoints"
            events.append(WaypointsUpdated(frames=len({*changed}), url=url, **span))
        for event in events:
            if isinstance(event, (OfFrame, ProcessingBlocked)) and event.frame_id is not None:
                event.file = self._file_of.get(event.frame_id, "")
        self._totals.refined |= {refined.frame_id for refined in self._refined}
        outcome = FrameOutcome(refined=self._refined, events=events, state=self._state, request=self._request)
        self._others, self._refined = [], []
        return outcome

    def _fragment_of(self, estimate: NavEstimate, found: MapMatch | None) -> tuple[Fragment, list[Event]]:
        """The fragment of the newest frame, with its merge, if it is tied to the flight just now, and its new state."""
        frame_id, known = estimate.frame_id, self._fragments.get(estimate.fragment_id)
        joined = estimate.joined or (found is not None and found.search.step is SearchStep.MERGE)
        if known is None:
            fragment = Fragment(
                fragment_id=estimate.fragment_id, first_frame=frame_id, last_frame=frame_id, frames=1, joined=joined
            )
            merges = joined and bool(self._fragments)  # the first one of a flight is tied to nothing
        else:
            fragment = known.model_copy(
                update={
                    "last_frame": max(known.last_frame, frame_id),
                    "frames": known.frames + 1,
                    "joined": known.joined or joined,
                }
            )
            merges = joined and not known.joined
        events: list[Event] = []
        if merges:
            fragment.merged_at_frame = frame_id
            events.append(ChunkMerged(fragment_id=fragment.fragment_id, frame_id=frame_id, frames=fragment.frames))
            self._totals.merged += 1
        fragment.state = _state_of(fragment, found)
        if known is None or fragment.state is not known.state:
            events.append(FragmentChanged(fragment_id=fragment.fragment_id, frame_id=frame_id, state=fragment.state))
        self._fragments[fragment.fragment_id] = fragment
        return fragment, events

    def _search_events(self, found: MapMatch, frame_id: int) -> list[Event]:
        """Changes of the search and of the state of the flight with the match of the newest frame."""
        events: list[Event] = []
        self._lost_frames = self._lost_frames + 1 if found.verdict is Verdict.LOST else 0
        if found.verdict is Verdict.LOST:
            self._asked |= found.search.step is SearchStep.ASK
            reached: tuple[str, int | None] = "whole_map", None
            if found.search.step is SearchStep.WIDEN:
                reached = "widen", None if self._places is None else self._places.tiles
            if reached != self._reached:
                events.append(SearchExpanded(frame_id=frame_id, grid_size=reached[1], status=reached[0]))
                self._reached = reached
            if self._asked and self._request is None:
                events += self._ask(frame_id, LOST_REASON)
        elif self._reached is not None:
            events.append(SearchExpanded(frame_id=frame_id, grid_size=self._reached[1], status="found"))
            self._reached, self._asked, self._request, self._places = None, False, None, None
        lost = FlightState.BLOCKED if self._asked else FlightState.RECOVERING
        state = lost if self._reached is not None else FlightState.PROCESSING
        if state is not self._state:
            if self._state is FlightState.PROCESSING:
                self._lost_at = frame_id
                events.append(RecoveryStarted(frame_id=frame_id))
            elif state is FlightState.PROCESSING:
                events.append(RecoverySucceeded(frame_id=frame_id, frames=frame_id - self._lost_at))
            events.append(StateChanged(state=state, previous=self._state))
            self._state = state
        return events

    def images_through(self) -> FrameOutcome | None:
        """All images so far are computed. -> a request for a position, if it is lost and none was asked for; else
        None."""
        if self._lost_frames < MIN_FRAMES or self._asked or self._shown is None:
            return None
        self._asked = True
        events = self._ask(self._shown.frame_id, THROUGH_REASON)
        events.append(StateChanged(state=FlightState.BLOCKED, previous=self._state))
        self._state = FlightState.BLOCKED
        return self._outcome(events)

    def _ask(self, frame_id: int, reason: str) -> list[Event]:
        self._requests += 1
        self._request = InputRequest(request_id=f"r{self._requests}", frame_id=frame_id)
        return [
            UserInputNeeded(
                request_id=self._request.request_id,
                frame_id=frame_id,
                image_url=self._image_url(frame_id),
                candidate_tiles=[] if self._places is None else _tiles(self._places),
            ),
            ProcessingBlocked(reason=reason, frame_id=frame_id),
        ]

    def _answer(self, message: HintVerdict) -> HintAnswered:
        self._totals.hints += 1
        if message.verdict is Verdict.ACCEPTED:
            self._asked, self._request = False, None  # the search goes on with it
        return HintAnswered(
            hint_id=self.hints.get(message.hint_t_ns, 0),
            verdict=str(message.verdict),
            distance_m=None if message.distance_m is None else round(message.distance_m, 1),
            text=message.text,
        )


def _state_of(fragment: Fragment, found: MapMatch | None) -> FragmentState:
    """With the map match of its newest frame; a fragment that is merged or anchored stays so."""
    if fragment.state is FragmentState.MERGED or fragment.merged_at_frame is not None:
        return FragmentState.MERGED
    if fragment.state is FragmentState.ANCHORED or (found is not None and found.verdict is Verdict.ACCEPTED):
        return FragmentState.ANCHORED
    if found is None or found.search.step is SearchStep.SKIP:
        return FragmentState.UNANCHORED
    matched = found.search.step in SEARCHING_STEPS or fragment.frames >= READY_FRAMES
    return FragmentState.MATCHING if matched else FragmentState.UNANCHORED


def ellipse_of(cov_m2: np.ndarray) -> Ellipse:
    """The 95 % ellipse of a covariance (2, 2) of east and north."""
    variances, axes = np.linalg.eigh(cov_m2)
    semi = np.sqrt(CHI2_95 * np.maximum(variances, 0.0))
    bearing_deg = math.degrees(math.atan2(float(axes[0, 1]), float(axes[1, 1]))) % 180.0
    return Ellipse(
        semi_major_m=round(float(semi[1]), 2), semi_minor_m=round(float(semi[0]), 2), bearing_deg=round(bearing_deg, 1)
    )


def confidence_of(cov_m2: np.ndarray) -> float:
    """Probability that the position is within NEAR_M, from below: as if both axes had the larger variance."""
    worst_m2 = max(float(np.linalg.eigvalsh(cov_m2)[-1]), 1e-12)
    return round(-math.expm1(-(NEAR_M**2) / (2.0 * worst_m2)), 4)


def _gps(lat_deg: float, lon_deg: float) -> Gps:
    return Gps(lat=round(lat_deg, 8), lon=round(lon_deg, 8))


def _result(shown: Frame, estimate: NavEstimate | None, found: MapMatch | None, origin_ns: int) -> FrameResult:
    result = FrameResult(
        frame_id=shown.frame_id, file=shown.file, t_s=round((shown.t_ns - origin_ns) * 1e-9, 3), error=shown.error
    )
    if found is not None:
        result.match, result.inliers, result.search = str(found.verdict), found.inliers, str(found.search.step)
    if estimate is not None:
        cov_m2 = np.reshape(estimate.cov, (6, 6))[:2, :2]
        if estimate.is_placed:
            result.gps = _gps(estimate.lat_deg, estimate.lon_deg)
            result.confidence, result.ellipse = confidence_of(cov_m2), ellipse_of(cov_m2)
        result.altitude = None if estimate.amsl_m is None else round(estimate.amsl_m, 3)
        result.agl_m = round(estimate.agl_m, 3)
        result.heading = round(yaw_deg_of(estimate), 3)
        result.heading_sigma = round(math.degrees(math.sqrt(max(estimate.cov[35], 0.0))), 3)
        result.source = str(estimate.source_label)
        result.fragment_id, result.joined = estimate.fragment_id, estimate.joined
    return result


def _refined(pose: RefinedPose, source: str, m_per_unit: float | None) -> FrameRefined:
    cov_m2 = np.array([[pose.sigma_e_m**2, pose.cov_en_m2], [pose.cov_en_m2, pose.sigma_n_m**2]])
    return FrameRefined(
        frame_id=pose.frame_id,
        gps=_gps(pose.lat_deg, pose.lon_deg),
        altitude=None if pose.alt_amsl_m is None else round(pose.alt_amsl_m, 3),
        ellipse=ellipse_of(cov_m2),
        source=source,
        fragment_id=pose.fragment_id,
        orientation=_rounded(pose.q_w_c),
        covariance=_rounded(pose.cov),
        m_per_unit=None if m_per_unit is None else round(m_per_unit, 4),
    )


def _rounded(values: tuple[float, ...] | None) -> list[float] | None:
    """To six significant digits."""
    return None if values is None else [float(f"{value:.6g}") for value in values]


def _tiles(found: SearchPlaces) -> list[CandidateTile]:
    return [
        CandidateTile(rank=rank, gps=_gps(*place), half_size_m=round(found.half_size_m, 1))
        for rank, place in enumerate(found.places, start=1)
    ]


def _verdict(message: MeasurementVerdict) -> VerdictGiven:
    return VerdictGiven(
        frame_id=message.frame_id,
        measurement=message.measurement,
        verdict=str(message.verdict),
        detail=message.detail,
        test_ratio=None if message.test_ratio is None else round(message.test_ratio, 3),
    )
