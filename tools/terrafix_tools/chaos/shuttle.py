"""The two legs of the fault matrix forth and back without end, for flights that last."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from terrafix.core.errors import OutputError
from terrafix_tools.chaos.scene import Phase, Scene, scene_in
from terrafix_tools.sim.autopilot.course import PeerState

TURN_S = 4.0  # in which the time of the flight turns round; whole periods of the camera
RUN = "run"  # folder of the run, beside that of the generated flight


def shuttle_in(out: Path, seed: int) -> Scene:
    """The endless scene of the flight in ``out``, which is generated if it is not there. Raises OutputError (``out``
    has a run already), SourceError."""
    if (out / RUN).exists():
        raise OutputError(f"{out / RUN}: exists; give a new folder")
    out.mkdir(parents=True, exist_ok=True)
    return ShuttleScene(scene_in(out / f"flight-{seed}", seed)).unfolded()


class ShuttleScene:
    """The legs of a scene forth and back. At both ends the time of the flight slows down, stops and runs backwards:
    attitude and specific force stay nearly true, velocities have its rate as a factor."""

    def __init__(self, scene: Scene) -> None:
        speeds = [(t_s, _speed(scene.course(t_s))) for t_s in np.arange(0.0, scene.at_s[Phase.LANDING], 0.5).tolist()]
        self._from_s = next(t_s for t_s, mps in speeds if mps > 1.0)
        self._to_s = next(t_s for t_s, mps in reversed(speeds) if mps > 1.0)
        self._scene = scene

    def unfolded(self) -> Scene:
        """A scene whose seconds run without end."""
        return _Shuttle(
            map_path=self._scene.map_path,
            jpegs=self._scene.jpegs,
            course=self.state,
            at_s=self._scene.at_s,
            duration_s=math.inf,
            fold=lambda t_s: self.folded(t_s)[0],
        )

    def folded(self, t_s: float) -> tuple[float, float]:
        """-> second of the flight, and its rate, -1 to 1. A leg begins and ends at a time of an image, so that the
        vehicle is where the images show it."""
        leg_s = self._to_s - self._from_s
        into_s = t_s % (2.0 * (leg_s + TURN_S))
        backwards = into_s >= leg_s + TURN_S
        into_s -= (leg_s + TURN_S) * backwards
        begin_s, sign = (self._to_s, -1.0) if backwards else (self._from_s, 1.0)
        if into_s < leg_s:
            return begin_s + sign * into_s, sign
        phase = math.pi * (into_s - leg_s) / TURN_S
        end_s = begin_s + sign * leg_s
        return end_s + sign * TURN_S / math.pi * math.sin(phase), sign * math.cos(phase)

    def state(self, t_s: float) -> PeerState:
        at_s, rate = self.folded(t_s)
        state = self._scene.course(at_s)
        return replace(state, vn_mps=rate * state.vn_mps, ve_mps=rate * state.ve_mps, vd_mps=rate * state.vd_mps)


@dataclass(frozen=True)
class _Shuttle(Scene):
    fold: Any = None

    def jpeg(self, t_s: float) -> bytes:
        return super().jpeg(self.fold(t_s))


def _speed(state: PeerState) -> float:
    return math.hypot(state.vn_mps, state.ve_mps)
