"""Definition of a scenario: name, requirement, rows, and the edits that turn a flight into it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from terrafix.messages import Origin
from terrafix_lab.accept.faults import flight_edits
from terrafix_lab.accept.flight import Flight
from terrafix_lab.accept.measuring.results import Marks
from terrafix_tools.replay import MakeNodes, make_nodes

CLOSED_LOOP = (
    "closed loop"  # ground of a scenario in which the autopilot navigates by the estimate; over the base ground
)


@dataclass(frozen=True)
class Plan:
    """Edits that turn one flight into the scenario."""

    edit: flight_edits.Edit = flight_edits.unchanged
    origin: Callable[[Origin], Origin] = flight_edits.unchanged_origin
    nodes: MakeNodes = make_nodes
    other_map: Callable[[Path, Path], str] | None = (
        None  # (map of the flight, map to write) -> reason for failure, or ""
    )
    long_route: bool = False
    marks: Marks = field(default_factory=Marks)


def always(
    edit: flight_edits.Edit = flight_edits.unchanged, origin: Callable[[Origin], Origin] = flight_edits.unchanged_origin
) -> Callable[[Flight], Plan]:
    """The same plan for every flight."""
    return lambda _: Plan(edit, origin)


@dataclass(frozen=True)
class Scenario:
    name: str
    promise: str
    criteria: tuple[str, ...]
    plan: Callable[[Flight], Plan | str]  # a text: the reason why this flight cannot be used
    ground: str = "base"  # of the generated world; a given flight has only "base"
    frames: int = 160  # of a generated flight
