"""Scenarios with a false input ("lie"): the position must be correct or withdrawn. Described in docs/acceptance.md.

The last group has true inputs with gaps: the position must stay correct."""

from collections.abc import Callable
from functools import partial

from terrafix_lab.accept.false_inputs import plans
from terrafix_lab.accept.false_inputs.plans import START_SIGMA_M
from terrafix_lab.accept.measuring.criteria import LYING_IN_THE_LOOP, PERMANENT, SCARCE, TEMPORARY
from terrafix_lab.accept.plan import CLOSED_LOOP, FAULT_FRAMES, Scenario, scenario_of, without_fault
from terrafix_lab.faults.edits import Edit, Span, during, start_sigma, start_unknown
from terrafix_lab.faults.pictures import mirrored_before
from terrafix_lab.faults.table import FALSE_INPUTS, FAULTS, SCARCE_INPUTS

LOOP_FRAMES = 200  # 100 s: 40 s with GNSS, 20 s jammed, 15 s with the lie, and 25 s to recover
MAP_SHIFT_M, SMALL_SHIFT_M = (212.0, -212.0), (100.0, 80.0)  # east, north: 300 m; 128 m, as between two datums
_scenario = partial(Scenario, frames=FAULT_FRAMES)
# Rows of scenarios of the table of faults beside those that every false or scarce input has.
ROWS = {
    "telemetry 2 s late": (*PERMANENT, "late sure over 20 m"),
    "pictures 1 s late": (*PERMANENT, "late sure over 20 m"),
    "start unknown": (*SCARCE, "first position"),
}


def _source(name: str) -> Callable[[Span], Edit]:
    source = FAULTS[name].source
    assert source is not None
    return source


# Pictures in the closed loop, while GNSS is jammed and the autopilot navigates by Terrafix: what they show, rows, edit
IN_THE_LOOP: tuple[tuple[str, str, tuple[str, ...], Callable[[Span], Edit]], ...] = (
    (
        "GNSS jam, frozen picture", "one picture again and again, with new noise", (),
        _source("frozen picture with noise")),
    ("GNSS jam, four stale buffers", "four pictures in turn", (), _source("four stale buffers")),
    ("GNSS jam, foreign frames", "pictures of another place that agree with each other", (), mirrored_before),
    (
        "GNSS jam, late pictures", "pictures that are a second old", ("late sure over 20 m",),
        lambda span: during(span, _source("pictures 1 s late")(span))),
)  # fmt: skip
LIES_IN_THE_LOOP = {name: edit for name, _, _, edit in IN_THE_LOOP}
LIES: tuple[Scenario, ...] = (
    _scenario("ten foreign frames", "Ten frames in a row show another place.", TEMPORARY, plans.foreign_row()),
    _scenario(
        "fast foreign frames", "Ten frames in a row show another place, at three times the speed.", TEMPORARY,
        plans.foreign_row(pace=plans.FAST)),
    _scenario(
        "foreign frames at the start", "The first ten frames show another place.", TEMPORARY,
        plans.foreign_row(at=0.0)),
    _scenario(
        "15 % foreign frames", "At random, 15 % of the frames are of another vehicle's camera.", TEMPORARY,
        plans.foreign_at_random),
    _scenario(
        "every second frame foreign", "Two cameras by turns, one of them at another place, for 30 frames.", TEMPORARY,
        plans.interleaved),
    _scenario(
        "elsewhere in reverse", "Ten frames of another part of the map, in reverse order.", TEMPORARY,
        plans.elsewhere_reversed),
    _scenario(
        "another town's map", "The map is of another town; the start claims 50 m.", PERMANENT,
        plans.with_map("the map is of another town", plans.other_town, start_sigma(START_SIGMA_M))),
    _scenario(
        "another town's map, no start", "The map is of another town, and no start is known.", PERMANENT,
        plans.with_map("the map is of another town", plans.other_town, start_unknown)),
    _scenario(
        "map shifted by 300 m", "The coordinates of the map are off by 300 m.", PERMANENT,
        plans.with_map("the map is shifted", partial(plans.shifted_map, MAP_SHIFT_M))),
    _scenario(
        "map in another datum", "The coordinates of the map are off by 128 m.", PERMANENT,
        plans.with_map("the map is shifted", partial(plans.shifted_map, SMALL_SHIFT_M))),
    _scenario(
        "map 10 % too large", "The scale of the map is wrong.", PERMANENT,
        plans.with_map("too large", plans.grown_map)),
    _scenario("start 300 m off", "The start is 300 m off and claims 50 m.", TEMPORARY, plans.start_off),
    *(scenario_of(fault, ROWS.get(fault.name)) for fault in (*FALSE_INPUTS, *SCARCE_INPUTS)),
    _scenario(
        "photos every 155 m", "Photos that share little ground, and nothing between them.", SCARCE,
        plans.sparse_photos, frames=400),
    _scenario(
        "gap of minutes", "No frame and no telemetry for three minutes.", (*SCARCE, "recovery"), plans.gap_of_minutes),
    *(
        Scenario(
            name,
            f"In flight, with nothing but Terrafix, for 15 s: {text}. Closed loop.",
            (*LYING_IN_THE_LOOP, *more),
            without_fault,
            ground=CLOSED_LOOP,
            frames=LOOP_FRAMES,
        )
        for name, text, more, _ in IN_THE_LOOP
    ),
)  # fmt: skip
