"""Closed-loop scenarios: the autopilot of a simulated aircraft navigates by GPS_INPUT."""

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from terrafix.core.config import Config, LinkSection
from terrafix.core.geodesy import LocalFrame
from terrafix.core.node import Image
from terrafix.messages import FIX_3D, Frame, GpsInput
from terrafix.recorder.reader import read_flight
from terrafix.vision.sources import Shot
from terrafix_lab.accept.false_inputs.scenarios import LIES_IN_THE_LOOP
from terrafix_lab.accept.generated import KINDS
from terrafix_lab.accept.measuring.evidence import Evidence, SentFix, gather
from terrafix_lab.accept.measuring.results import Marks
from terrafix_lab.faults.edits import Edit, Span
from terrafix_lab.faults.source import Stepwise
from terrafix_lab.sim.closed_loop.flight import FRAME_HZ as LOOP_HZ
from terrafix_lab.sim.closed_loop.flight import Conditions, plan_over
from terrafix_lab.sim.closed_loop.loop import LoopPlan, fly
from terrafix_lab.sim.flights.folder import FRAME_HZ
from terrafix_lab.sim.flights.scene import Scene, scene_of_world
from terrafix_lab.sim.interfaces import State
from terrafix_lab.sim.sensors.gnss_events import AnyEvent, Drag, Jam
from terrafix_lab.sim.world import place as world
from terrafix_tools.estimates import ESTIMATES, read_rows
from terrafix_tools.evaluate import read_truth

AFTER_S = 40.0  # of flight with undisturbed GNSS
DRAG_MPS = 2.0
EVENTS: dict[str, tuple[AnyEvent, str]] = {
    "GNSS jam": (Jam(start_s=AFTER_S), "GNSS jammed"),
    "slow spoof": (Drag(start_s=AFTER_S, east_mps=DRAG_MPS), f"GNSS walks off at {DRAG_MPS:g} m/s"),
}
LIE = Span(60.0, 75.0, "the camera lies")  # the autopilot switches away from GNSS some 10 s after the jamming begins
SPEED_MPS = 26.0  # over ground, more than in any leg: the course must be longer than the flight
WITHOUT_LIE = "without-lie"  # folder of the reference flight
MAX_LAG_S = 10.0  # in both directions: time difference of the two flights at the same place
FINE_S = 0.02  # spacing of the points of the reference trajectory for distances


def fly_closed(
    scenario: str, package: Path, out: Path, *, seed: int, frames: int, truth_offset_m: tuple[float, float]
) -> Evidence:
    """A plane over the base ground, with a real receiver as first GPS and Terrafix as second, which may switch over.

    Raises OutputError."""
    if scenario in LIES_IN_THE_LOOP:
        return _fly_with_lie(scenario, package, out, seed=seed, frames=frames, truth_offset_m=truth_offset_m)
    event, text = EVENTS[scenario]
    plan = _plan(_scene(seed), package, (event,), LOOP_HZ, seed=seed, frames=frames)
    fly(plan, out)
    zero_s = read_rows(out / ESTIMATES)[0].t_s  # the first frame is taken at the start
    marks = Marks(spans=(Span(zero_s + AFTER_S, zero_s + plan.duration_s, text),))
    return _gathered(out, marks, truth_offset_m)


def _fly_with_lie(
    scenario: str, package: Path, out: Path, *, seed: int, frames: int, truth_offset_m: tuple[float, float]
) -> Evidence:
    """With a reference flight first: on GNSS only, without a camera and without the false input."""
    scene = _scene(seed)
    fly(
        replace(_plan(scene, package, (), FRAME_HZ, seed=seed, frames=frames), view=lambda _state, _index: None),
        out / WITHOUT_LIE,
    )
    plan = _plan(scene, package, (Jam(start_s=AFTER_S),), FRAME_HZ, seed=seed, frames=frames)
    fly(replace(plan, view=EditedCamera(plan.view, LIES_IN_THE_LOOP[scenario](LIE))), out)
    evidence = _gathered(out, Marks(spans=(LIE,), lie=LIE), truth_offset_m)
    evidence.sent = sent_fixes(out, out / WITHOUT_LIE, plan.frame)
    return evidence


def _scene(seed: int) -> Scene:
    place = world.generate(seed)
    return scene_of_world(place, place.render(KINDS["base"].looks[1]))


def _plan(
    scene: Scene, package: Path, events: tuple[AnyEvent, ...], frame_hz: float, *, seed: int, frames: int
) -> LoopPlan:
    """``frames``: gives the duration, as of a recorded flight."""
    duration_s = frames / FRAME_HZ
    return plan_over(
        scene,
        package,
        seed=seed,
        length_m=SPEED_MPS * duration_s,
        duration_s=duration_s,
        frame_hz=frame_hz,
        conditions=Conditions(events=events),
        config=Config(link=LinkSection(gnss="act")),
    )


def _gathered(out: Path, marks: Marks, truth_offset_m: tuple[float, float]) -> Evidence:
    peer = json.loads((out / "peer.json").read_text(encoding="utf-8"))
    return gather(out, read_truth(out / "truth.csv"), marks, peer=peer, truth_offset_m=truth_offset_m)


class EditedCamera:
    """A view that applies ``edit``, which must give one shot for each shot, to the pictures of another view."""

    def __init__(self, view: Callable[[State, int], Image | None], edit: Edit) -> None:
        self._view, self._edited = view, Stepwise(edit)

    def __call__(self, state: State, index: int) -> Image | None:
        image = self._view(state, index)
        height, width = (0, 0) if image is None else image.shape[:2]
        t_ns = round(state.t_s * 1e9)
        frame = Frame(t_ns=t_ns, frame_id=index, file=f"{index:05d}", width=width, height=height)
        return self._edited(Shot(frame, (), image)).image


def sent_fixes(out: Path, without_lie: Path, frame: LocalFrame) -> list[SentFix]:
    """All GPS_INPUT messages of the closed loop in ``out``, compared with the reference flight in ``without_lie``.

    ``frame``: the local frame of both."""
    t_s, true_m = _track(out)
    reference_s, reference_m = _track(without_lie)
    fine_s = np.arange(reference_s[0], reference_s[-1], FINE_S)
    fine_m = _at(fine_s, reference_s, reference_m)
    sent = []
    for _, _, message in read_flight(out):
        if not isinstance(message, GpsInput):
            continue
        now_s = message.t_ns / 1e9
        here_m = _at(np.array([now_s]), t_s, true_m)[0]
        near_m = fine_m[np.searchsorted(fine_s, now_s - MAX_LAG_S) : np.searchsorted(fine_s, now_s + MAX_LAG_S)]
        error_m = None
        if message.fix_type >= FIX_3D:
            reported_m = np.array(frame.to_local(message.lat_deg, message.lon_deg))
            error_m = float(np.hypot(*(reported_m - here_m)))
        deviation_m = float(np.hypot(*(near_m - here_m).T).min())
        sent.append(SentFix(now_s, error_m, message.horiz_accuracy_m, deviation_m, message.no_fix_reason))
    return sent


def _track(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """(N,) seconds and (N, 2) true east, north of track.csv."""
    with (folder / "track.csv").open(encoding="utf-8", newline="") as file:
        rows = [(float(r["t_s"]), float(r["east_m"]), float(r["north_m"])) for r in csv.DictReader(file)]
    table = np.array(rows)
    return table[:, 0], table[:, 1:]


def _at(query_s: np.ndarray, t_s: np.ndarray, p_m: np.ndarray) -> np.ndarray:
    """(M, 2) at ``query_s`` (M,), linearly interpolated."""
    return np.column_stack([np.interp(query_s, t_s, p_m[:, axis]) for axis in (0, 1)])
