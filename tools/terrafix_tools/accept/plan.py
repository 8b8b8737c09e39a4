"""What a scenario is: a name, what it promises, the rows that judge it, and how a flight becomes it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from terrafix.messages import Origin
from terrafix_tools.accept import faults
from terrafix_tools.accept.flight import Flight
from terrafix_tools.accept.judged import Marks
from terrafix_tools.replay import MakeNodes, make_nodes

CLOSED_LOOP = "closed loop"  # ground of a scenario in which an aircraft steers by the estimate; over the base ground


@dataclass(frozen=True)
class Plan:
    """How one flight becomes the scenario."""

    edit: faults.Edit = faults.same
    origin: Callable[[Origin], Origin] = faults.same_origin
    nodes: MakeNodes = make_nodes
    other_map: Callable[[Path, Path], str] | None = None  # (map of the flight, map to write) -> why not, or ""
    long_route: bool = False
    marks: Marks = field(default_factory=Marks)


@dataclass(frozen=True)
class Scenario:
    name: str
    promise: str
    criteria: tuple[str, ...]
    plan: Callable[[Flight], Plan | str]  # a text: why it cannot be flown with this flight
    ground: str = "base"  # of the generated world; a flight that is given has only "base"
    frames: int = 160  # of a generated flight
