"""Scenarios that need an aircraft: the closed loop, in which the autopilot steers by what it is told."""

import json
from pathlib import Path

from terrafix.core.config import Config, LinkSection
from terrafix_tools.accept.evidence import Evidence, gather
from terrafix_tools.accept.generated import KINDS
from terrafix_tools.accept.judged import Marks, Span
from terrafix_tools.estimates import ESTIMATES, read_rows
from terrafix_tools.evaluate import read_truth
from terrafix_tools.sim.closed_loop.flight import Conditions, plan_over
from terrafix_tools.sim.closed_loop.loop import fly
from terrafix_tools.sim.flights.folder import FRAME_HZ
from terrafix_tools.sim.flights.scene import scene_of_world
from terrafix_tools.sim.sensors.gnss_events import AnyEvent, Drag, Jam
from terrafix_tools.sim.world import place as world

AFTER_S = 40.0  # of flight with GNSS as it should be
DRAG_MPS = 2.0
EVENTS: dict[str, tuple[AnyEvent, str]] = {
    "GNSS jam": (Jam(start_s=AFTER_S), "GNSS jammed"),
    "slow spoof": (Drag(start_s=AFTER_S, east_mps=DRAG_MPS), f"GNSS walks off at {DRAG_MPS:g} m/s"),
}
SPEED_MPS = 26.0  # over ground, more than any leg: the course is longer than the flight


def fly_closed(
    scenario: str, package: Path, out: Path, *, seed: int, frames: int, truth_offset_m: tuple[float, float]
) -> Evidence:
    """A plane over the base ground, with a real receiver as first GPS and Terrafix as second, which may switch over.

    Raises OutputError."""
    event, text = EVENTS[scenario]
    place = world.generate(seed)
    scene = scene_of_world(place, place.look(KINDS["base"].looks[1]))
    duration_s = frames / FRAME_HZ
    plan = plan_over(
        scene,
        package,
        seed=seed,
        length_m=SPEED_MPS * duration_s,
        duration_s=duration_s,
        conditions=Conditions(events=(event,)),
        config=Config(link=LinkSection(gnss="act")),
    )
    fly(plan, out)
    zero_s = read_rows(out / ESTIMATES)[0].t_s  # the first picture is taken at the start
    marks = Marks(spans=(Span(zero_s + AFTER_S, zero_s + duration_s, text),))
    peer = json.loads((out / "peer.json").read_text(encoding="utf-8"))
    return gather(out, read_truth(out / "truth.csv"), marks, peer=peer, truth_offset_m=truth_offset_m)
