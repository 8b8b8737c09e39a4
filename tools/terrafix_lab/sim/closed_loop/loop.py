"""Flight in closed loop: the vehicle steers by the autopilot's position, which depends on our GPS_INPUT.

Vehicle, sensors, autopilot, MAVLink bytes, the flight's edge and nodes, and bytes back: one thread, one simulated
clock, as fast as this machine can. Only the renderer, the sensors and the evaluation use the truth.
"""

import csv
import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from terrafix.core.config import Config
from terrafix.core.errors import OutputError
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.geodesy import LocalFrame
from terrafix.core.node import Image, NodeContext
from terrafix.messages import Frame, Message, Origin
from terrafix.recorder.provenance import header, versions
from terrafix_lab.sim.autopilot.lockstep import SimAutopilot
from terrafix_lab.sim.autopilot.report import PeerMonitor, PeerReport
from terrafix_lab.sim.closed_loop.companion import Companion, Delays
from terrafix_lab.sim.closed_loop.loopback import Loopback
from terrafix_lab.sim.interfaces import Navigation, Sensors, State, Vehicle
from terrafix_tools.replay_output import ReplayOutput

STEP_S = 0.02
ZERO_NS = 0  # start of the flight on the companion's clock: t_s in estimates.csv counts from it
FRAMES_KEPT = 32
ROW_FINAL_S = 1.0  # after this time a frame's row changes only by refinement
TRACK_EVERY = 10  # steps between two rows of track.csv
TRUTH_COLUMNS = ("file", "lat_deg", "lon_deg", "agl_m", "yaw_deg")
TRACK_COLUMNS = ("t_s", "east_m", "north_m", "up_m", "agl_m", "believed_east_m", "believed_north_m", "error_m")
Progress = Callable[[float], None]  # seconds of the flight


@dataclass(frozen=True)
class LoopPlan:
    """Everything that a closed-loop flight consists of."""

    name: str
    frame: LocalFrame  # of vehicle, sensors and autopilot
    vehicle: Vehicle
    sensors: Sensors
    autopilot: SimAutopilot
    view: Callable[[State, int], Image | None]  # renders the image of a frame number; None: the camera stalls
    origin: Origin  # camera and start, as given by the pilot
    map_path: Path  # map package
    duration_s: float
    length_m: float = math.inf  # over ground; the flight ends when duration, length or mission is complete
    frame_hz: float = 1.0
    delays: Delays = field(default_factory=Delays)
    config: Config = field(default_factory=Config)
    over: Callable[[], bool] = lambda: False  # True when the mission is complete
    temperature_c: Callable[[float], float] | None = None  # of the companion computer; None: constant and cool


@dataclass(frozen=True)
class Flown:
    """Result of a flight."""

    summary: dict[str, Any]
    peer: PeerReport


def fly(plan: LoopPlan, out: Path, *, progress: Progress = lambda _: None) -> Flown:
    """Writes estimates.csv, flight.mcap, summary.json, truth.csv, track.csv and peer.json into ``out``.

    Raises OutputError, and the nodes' errors for a bad map or model.
    """
    with ReplayOutput(out, header(plan.config, plan.map_path), plan.config.recorder) as output:
        began_s, cpu_s = time.perf_counter(), time.process_time()
        loop = _Loop(plan, out, output)
        while loop.t_s < plan.duration_s and loop.flown_m < plan.length_m and not plan.over():
            loop.step()
            progress(loop.t_s)
        peer = loop.finish()
        summary = {
            "flight": plan.name,
            "map": {"path": str(plan.map_path)},
            "versions": versions(),
            **output.counts(),
            "anchor_skipped": loop.companion.skipped,
            "flown_s": round(loop.t_s, 2),
            "flown_m": round(loop.flown_m, 1),
            "cpu_s": round(time.process_time() - cpu_s, 2),
            "wall_s": round(time.perf_counter() - began_s, 2),
        }
        _write(out / "truth.csv", TRUTH_COLUMNS, loop.truth)
        _write(out / "track.csv", TRACK_COLUMNS, loop.track)
        peer.write(out / "peer.json")
        output.finish(summary)
    return Flown(summary, peer)


class _Loop:
    def __init__(self, plan: LoopPlan, out: Path, output: ReplayOutput) -> None:
        self._plan, self._output = plan, output
        frames = MemoryFrameStore(FRAMES_KEPT)
        ctx = NodeContext(config=plan.config, frames=frames, map_path=plan.map_path.resolve(), out_dir=out.resolve())
        self._wire = Loopback()
        self.companion = Companion(ctx, frames, self._wire, plan.delays, self._record_messages)
        if plan.temperature_c is not None:
            self.companion.temperature_c = plan.temperature_c
        self._monitor = PeerMonitor(plan.autopilot, plan.frame)
        self._pending_frames: deque[tuple[Frame, Image | None]] = deque()  # frames whose row may still change
        self._steps = self._frames = 0
        self._state: State | None = None
        self.t_s = self.flown_m = 0.0
        self.truth: list[list[str]] = []
        self.track: list[list[str]] = []
        self.companion.start(msgspec.structs.replace(plan.origin, t_ns=ZERO_NS))

    def step(self) -> None:
        plan, autopilot = self._plan, self._plan.autopilot
        before, state = self._state, plan.vehicle.step(STEP_S, autopilot.navigation())
        self._steps, self._state, self.t_s = self._steps + 1, state, state.t_s
        autopilot.step(self.t_s, plan.sensors.read(state))
        self._wire.to_companion(autopilot.transmit())
        self.companion.step(_ns(self.t_s))
        autopilot.receive(self._wire.take(), self.t_s)
        self._monitor.observe(self.t_s, state)
        if self.t_s * plan.frame_hz >= self._frames:
            self._expose(state)
        self._close_frames(_ns(self.t_s - ROW_FINAL_S))
        if before is not None:
            self.flown_m += math.dist(before.p_b_in_w_m[:2], state.p_b_in_w_m[:2])
        if self._steps % TRACK_EVERY == 0:
            self._append_track(state, autopilot.navigation())

    def finish(self) -> PeerReport:
        self.companion.end()
        self._close_frames(_ns(self.t_s + ROW_FINAL_S))
        return self._monitor.report()

    def _record_messages(self, messages: list[Message]) -> None:
        self._output.take(messages)

    def _expose(self, state: State) -> None:
        self._frames += 1
        image = self._plan.view(state, self._frames)
        camera = self._plan.origin.camera
        frame = Frame(
            t_ns=_ns(state.t_s),
            frame_id=self._frames,
            file=f"{self._frames:05d}",
            width=camera.width,
            height=camera.height,
            error="" if image is not None else "no image from the camera",
        )
        self._pending_frames.append((frame, image))
        self.companion.expose(frame, image)
        lat_deg, lon_deg = self._plan.frame.to_wgs84(float(state.p_b_in_w_m[0]), float(state.p_b_in_w_m[1]))
        yaw_deg = math.degrees(state.yaw_rad) % 360.0
        self.truth.append([frame.file, f"{lat_deg:.7f}", f"{lon_deg:.7f}", f"{state.agl_m:.2f}", f"{yaw_deg:.2f}"])

    def _close_frames(self, until_ns: int) -> None:
        """Writes the rows of frames from before ``until_ns`` to disk; their processing time is the modelled one."""
        while self._pending_frames and self._pending_frames[0][0].t_ns <= until_ns:
            frame, image = self._pending_frames.popleft()
            delay_ns = self.companion.estimated_ns.get(frame.frame_id, frame.t_ns) - frame.t_ns
            self._output.frame_done(frame, image, delay_ns / 1e6)

    def _append_track(self, state: State, navigation: Navigation | None) -> None:
        place = [*map(float, state.p_b_in_w_m), state.agl_m]
        cells = [f"{state.t_s:.2f}", *(f"{v:.2f}" for v in place)]
        if navigation is None:
            cells += ["", "", ""]
        else:
            e_m, n_m = (float(v) for v in navigation.p_b_in_w_m[:2])
            cells += [f"{e_m:.2f}", f"{n_m:.2f}", f"{math.hypot(e_m - place[0], n_m - place[1]):.2f}"]
        self.track.append(cells)


def _ns(t_s: float) -> int:
    return ZERO_NS + round(t_s * 1e9)


def _write(path: Path, columns: tuple[str, ...], rows: list[list[str]]) -> None:
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(columns)
            writer.writerows(rows)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another --out") from None
