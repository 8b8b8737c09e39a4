"""Events of a flight, as they are stored and sent: the data of each is one of these models."""

from typing import Any

from pydantic import BaseModel

from terrafix_tools.console.payloads import (
    CameraPose,
    Ellipse,
    FlightState,
    FragmentState,
    FrameResult,
    Gps,
    WholeVerdict,
)


class Event(BaseModel):
    """Base class; the name of an event is that of its class in lower case with underscores (``name_of``)."""


class OfFrame(Event):
    """An event of one frame. ``file``: name of its image as it was uploaded; "" for that of a live camera."""

    frame_id: int
    file: str = ""


class FrameProcessed(Event, FrameResult):
    """A frame has its immediate result."""


class FrameRefined(OfFrame, CameraPose):
    """Later frames, or the end of the flight, have moved a frame."""

    gps: Gps
    refined: bool = True
    altitude: float | None
    ellipse: Ellipse
    source: str  # "smoother" (during the flight), "flight" (after its end), "finalised" (by all of it, solved anew)
    fragment_id: int


class SearchExpanded(OfFrame):
    """Lost: the search has reached another size. ``grid_size``: tiles, 1 to 25; None: the whole map."""

    grid_size: int | None
    status: str  # "widen", "whole_map", "found"


class CandidateTile(BaseModel):
    """``gps``: its centre, where the camera may be; ``half_size_m``: what the frame shows fits into the square."""

    rank: int
    gps: Gps
    half_size_m: float


class UserInputNeeded(OfFrame):
    """The whole map was searched: a user fix or a coarse hint is asked for. At most five tiles, the best first."""

    request_id: str
    image_url: str
    candidate_tiles: list[CandidateTile]


class ProcessingBlocked(Event):
    reason: str
    frame_id: int | None
    file: str = ""


class ChunkMerged(OfFrame):
    """A fragment is tied to the flight from ``frame_id`` on; one that begins joined, with its first frame."""

    fragment_id: int
    frames: int  # of the fragment until then


class FragmentChanged(OfFrame):
    """A fragment has begun, or its state has changed."""

    fragment_id: int
    state: FragmentState


class RecoveryStarted(OfFrame):
    """The position is lost at this frame: a search begins."""


class RecoverySucceeded(OfFrame):
    """The search has found the position; ``frames``: since it was lost."""

    frames: int


class UserFixApplied(OfFrame):
    """A user fix has passed the gate and is in the graph. A refused one is a ``VerdictGiven`` with the reason."""

    detail: str


class StateChanged(Event):
    state: FlightState
    previous: FlightState


class VerdictGiven(OfFrame):
    """A measurement was rejected, or a map match was accepted."""

    measurement: str
    verdict: str
    detail: str
    test_ratio: float | None


class HintAnswered(Event):
    """What the flight did with a hint or user fix."""

    hint_id: int
    verdict: str
    distance_m: float | None
    text: str


class FinaliseProgress(Event):
    """The completed flight is computed as a whole. ``stage``: "read" (the record), "compare" (solutions, at held-out
    map matches), "smooth"; ``of`` None: not known."""

    stage: str
    done: int
    of: int | None


class FlightCompleted(Event):
    """``statistics``: frames, localised, refined, finalised, fragments, merged, hints; ``median_radius95_m``;
    ``not_finalised``: why, else empty. ``verdict``: on the whole flight; None: no service has seen all of it."""

    statistics: dict[str, Any]
    verdict: WholeVerdict | None = None


class Health(Event):
    """Of a live flight, once a second: the facts of `terrafix status --json`. It has no id and is not stored."""

    facts: dict[str, Any]


EVENTS: tuple[type[Event], ...] = (
    FrameProcessed,
    FrameRefined,
    SearchExpanded,
    UserInputNeeded,
    ProcessingBlocked,
    ChunkMerged,
    FragmentChanged,
    RecoveryStarted,
    RecoverySucceeded,
    UserFixApplied,
    StateChanged,
    VerdictGiven,
    HintAnswered,
    FinaliseProgress,
    FlightCompleted,
    Health,
)


def name_of(kind: type[Event]) -> str:
    """FrameProcessed -> "frame_processed"."""
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in kind.__name__).lstrip("_")
