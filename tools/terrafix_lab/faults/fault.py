"""What a fault is: its name, what it does to the source or to the processes of a flight, and words for reports."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from terrafix.core.errors import UsageError
from terrafix_lab.faults.edits import EVER, Edit, OriginEdit, Span, unchanged
from terrafix_lab.faults.messages import MatchEdit

if TYPE_CHECKING:
    from terrafix_lab.chaos.rig import Rig

START = 0.4  # share of the flight before a fault that ends before the flight


class Phase(StrEnum):
    """When a fault begins in the fault matrix."""

    START = "before the first fix"  # of the processes, in cruise
    CRUISE = "cruise"
    TURN = "turn"
    DARK = "dark"  # in cruise; the images are black from 4 s before the fault to its end
    LANDING = "landing"  # as the descent begins


class Need(StrEnum):
    """What a fault needs beside frames, telemetry and a map. ROOT: only root can mount it."""

    PROCESSES = "the real processes"
    MATCHES = "map matches as messages between nodes in one process"
    LIVE = "a live camera"
    PIXELS = "images"
    SEARCH = "a search over the map"
    UNKNOWN = "a source that reports not everything"
    DISK = "a disk of its own for the record"
    SHARED_MEMORY = "shared memory of its own"
    SERIAL = "a serial line to the autopilot"
    SWITCHES = "the switches of switches.py"
    MODEL = "the weights of XFeat"
    CONSOLE = "a console that shows the flight"
    DECK = "a start on a deck that moves"
    ELSEWHERE = "pictures of another place"
    MEMORY_GROUP = "a control group of memory"
    GIMBAL = "a camera on a gimbal that reports its attitude"


ROOT = frozenset({Need.DISK, Need.SHARED_MEMORY, Need.MEMORY_GROUP})
Action = Callable[["Rig"], None]


def nothing(_rig: "Rig") -> None:
    pass


@dataclass(frozen=True)
class Process:
    """What is done to the processes, by the rig of the fault matrix. ``during`` is called often with the seconds since
    the beginning."""

    begin: Action = nothing
    end: Action = nothing
    during: Callable[["Rig", float], None] = lambda _rig, _s: None


@dataclass(frozen=True)
class Fault:
    """One row of the table. ``lasts_s`` None: from the first frame to the last. ``source``: the edit of frames in a
    span; ``telemetry``: of what the autopilot reports, one shot for each. ``origin``: an edit of start and camera, for
    the whole flight. ``matches``: makes an edit of the map matches. ``is_true``: no input is false, some are missing.
    ``past_s``: of pictures before it, which its ``source`` shows.
    ``cause``: regular expression for what texts to the pilot and the verdict of the report call it. ``no_fix_in``:
    phases of the fault matrix in which no fix is expected after it."""

    name: str
    words: str = ""
    lasts_s: float | None = None
    source: Callable[[Span], Edit] | None = None
    telemetry: Callable[[Span], Edit] | None = None
    origin: OriginEdit | None = None
    matches: Callable[[], MatchEdit] | None = None
    process: Process | None = None
    needs: frozenset[Need] = frozenset()
    is_true: bool = False
    cause: str = ""
    past_s: float = 0.0
    no_fix_in: frozenset[Phase] = frozenset({Phase.LANDING})  # it ends below the least height for matching

    def of_camera(self, span: Span) -> Edit:
        return self._edit(self.source, span)

    def of_telemetry(self, span: Span) -> Edit:
        return self._edit(self.telemetry, span)

    def edit(self, span: Span) -> Edit:
        """Of camera and telemetry."""
        return lambda shots: self.of_telemetry(span)(self.of_camera(span)(shots))

    def _edit(self, part: Callable[[Span], Edit] | None, span: Span) -> Edit:
        """The fault of a whole flight hits also what comes before the first frame."""
        return unchanged if part is None else part(EVER if self.lasts_s is None else span)

    @property
    def flight_s(self) -> float:
        """Shortest flight in which it is flown: with time before and after it."""
        return 0.0 if self.lasts_s is None else self.lasts_s / START

    def span(self, first_s: float, last_s: float, from_s: float | None = None) -> Span:
        """Of a flight from ``first_s`` to ``last_s``. ``from_s``: beginning of a fault that ends before the flight;
        None: after the share START."""
        if self.lasts_s is None:
            return Span(first_s, last_s, self.name)
        begin_s = first_s + START * (last_s - first_s) if from_s is None else from_s
        return Span(begin_s, begin_s + self.lasts_s, self.name)


CAMPAIGNS = {  # command -> what its driver has
    "terrafix accept --scenario": frozenset({Need.GIMBAL, Need.MATCHES, Need.PIXELS, Need.SEARCH, Need.UNKNOWN}),
    "terrafix montecarlo --fault": frozenset({Need.GIMBAL, Need.MATCHES, Need.UNKNOWN}),
    "terrafix chaos --fault": frozenset(Need) - {Need.MATCHES, Need.UNKNOWN},
}


def lacking(command: str, fault: Fault) -> list[Need]:
    """What a fault needs that ``command``, a key of CAMPAIGNS, has not."""
    of_parts = {Need.PROCESSES: fault.process, Need.MATCHES: fault.matches}
    needed = fault.needs | {need for need, part in of_parts.items() if part is not None}
    return sorted(needed - CAMPAIGNS[command])


def check_flown_by(command: str, fault: Fault) -> None:
    """Raises UsageError: ``command`` lacks something that the fault needs."""
    if missing := lacking(command, fault):
        able = [other for other in CAMPAIGNS if not lacking(other, fault)]
        raise UsageError(
            f"{command} '{fault.name}': the fault needs {' and '.join(missing)}, which is not there; "
            f"fly it by {' or '.join(able)}"
        )
