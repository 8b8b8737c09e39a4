"""Definition of a scenario: name, requirement, rows, and the edits that turn a flight into it."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from terrafix.core.node import Node, NodeContext
from terrafix_lab.accept.flight import AcceptFlight
from terrafix_lab.accept.measuring.criteria import PERMANENT, SCARCE, TEMPORARY, WITH_SPAN
from terrafix_lab.accept.measuring.results import Marks
from terrafix_lab.faults.edits import Edit, OriginEdit, unchanged, unchanged_origin
from terrafix_lab.faults.fault import START, Fault, Need
from terrafix_lab.faults.messages import AlteredAnchor
from terrafix_lab.sim.flights.folder import FRAME_HZ
from terrafix_tools.replay import MakeNodes, make_nodes

FRAMES = 160  # of a generated flight
FAULT_FRAMES = 90  # ... of one with a false or scarce input, at least: 45 s
CLOSED_LOOP = (
    "closed loop"  # ground of a scenario in which the autopilot navigates by the estimate; over the base ground
)


@dataclass(frozen=True)
class Plan:
    """Edits that turn one flight into the scenario."""

    edit: Edit = unchanged
    origin: OriginEdit = unchanged_origin
    nodes: MakeNodes = make_nodes
    other_map: Callable[[Path, Path], str] | None = (
        None  # (map of the flight, map to write) -> reason for failure, or ""
    )
    long_route: bool = False
    marks: Marks = field(default_factory=Marks)


def without_fault(_: AcceptFlight) -> Plan:
    return Plan()


def plan_of(fault: Fault, flight: AcceptFlight) -> Plan | str:
    """With the fault of the table from its usual time on."""
    if flight.duration_s < fault.flight_s:
        return f"the flight lasts only {flight.duration_s:.0f} s"
    refs = flight.frame_refs
    span = fault.span(refs[0].t_s, refs[-1].t_s, refs[flight.at(START)].t_s)
    is_marked = fault.lasts_s is not None or not fault.is_true
    marks = Marks(spans=(span,) if is_marked else (), lie=None if fault.is_true else span)
    return Plan(fault.edit(span), fault.origin or unchanged_origin, _nodes_of(fault), marks=marks)


def _nodes_of(fault: Fault) -> MakeNodes:
    if fault.matches is None:
        return make_nodes
    edit = fault.matches()

    def nodes(ctx: NodeContext) -> Mapping[str, Node]:
        made = make_nodes(ctx)
        return {**made, "anchor": AlteredAnchor(made["anchor"], edit)}

    return nodes


@dataclass(frozen=True)
class Scenario:
    name: str
    promise: str
    criteria: tuple[str, ...]
    plan: Callable[[AcceptFlight], Plan | str]  # a text: the reason why this flight cannot be used
    ground: str = "base"  # of the generated world; a given flight has only "base"
    frames: int = FRAMES  # of a generated flight


def scenario_of(fault: Fault, criteria: tuple[str, ...] | None = None, frames: int = FAULT_FRAMES) -> Scenario:
    """The scenario of a row of the table of faults. ``criteria`` None: by whether inputs are false, and how long."""
    if criteria is None:
        ends = fault.lasts_s is not None
        criteria = (WITH_SPAN if ends else SCARCE) if fault.is_true else (TEMPORARY if ends else PERMANENT)
    frames = max(frames, math.ceil(fault.flight_s * FRAME_HZ) + 2)
    ground = "gimbal" if Need.GIMBAL in fault.needs else "base"
    return Scenario(fault.name, fault.words, criteria, partial(plan_of, fault), ground, frames)
