"""Events of a flight, as they are stored and sent: the data of each is one of these models."""

from typing import Any

from pydantic import BaseModel

from terrafix_tools.console.payloads import Ellipse, FlightState, FrameResult, Gps


class Event(BaseModel):
    """Base class; the name of an event is that of its class in lower case with underscores (``name_of``)."""


class FrameProcessed(Event, FrameResult):
    """A frame has its immediate result."""


class FrameRefined(Event):
    """Later frames, or the end of the flight, have moved the position of a frame."""

    frame_id: int
    gps: Gps
    refined: bool = True
    altitude: float | None
    ellipse: Ellipse
    source: str  # "smoother" (during the flight), "flight" (after its end)
    fragment_id: int


class SearchExpanded(Event):
    """Lost: the search has reached another size. ``grid_size``: tiles, 1 to 25; None: the whole map."""

    frame_id: int
    grid_size: int | None
    status: str  # "widen", "whole_map", "found"


class CandidateTile(BaseModel):
    """``gps``: its centre, where the camera may be; ``half_size_m``: what the frame shows fits into the square."""

    rank: int
    gps: Gps
    half_size_m: float


class UserInputNeeded(Event):
    """The whole map was searched: a user fix or a coarse hint is asked for. At most five tiles, the best first."""

    request_id: str
    frame_id: int
    image_url: str
    candidate_tiles: list[CandidateTile]


class ProcessingBlocked(Event):
    reason: str
    frame_id: int | None


class ChunkMerged(Event):
    """A fragment is tied to the flight from ``frame_id`` on."""

    fragment_id: int
    frame_id: int
    frames: int  # of the fragment until then


class StateChanged(Event):
    state: FlightState
    previous: FlightState


class VerdictGiven(Event):
    """A measurement was rejected, or a map match was accepted."""

    frame_id: int
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


class FlightCompleted(Event):
    """``statistics``: frames, localised, refined, fragments, merged, hints; ``median_radius95_m``."""

    statistics: dict[str, Any]


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
    StateChanged,
    VerdictGiven,
    HintAnswered,
    FlightCompleted,
    Health,
)


def name_of(kind: type[Event]) -> str:
    """FrameProcessed -> "frame_processed"."""
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in kind.__name__).lstrip("_")
