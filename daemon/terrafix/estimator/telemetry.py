"""What the autopilot said around a frame's time: attitude, height, each with its absence."""

from collections import deque
from dataclasses import dataclass
from typing import Any

from terrafix.messages import VehicleState

KEPT = 400  # states; 8 s at 50 Hz
STANDS_BELOW_M = 10.0  # what a barometer may have drifted before take-off
MAX_GAP_NS = 1_000_000_000  # older than this against the frame says nothing about it


@dataclass(frozen=True)
class Attitude:
    yaw_rad: float | None
    pitch_rad: float | None
    roll_rad: float | None
    agl_m: float | None
    armed: bool | None = None

    @property
    def stands(self) -> bool:
        """On the ground, motors off. An autopilot that reports a height is not believed to be off in the air."""
        return self.armed is False and (self.agl_m is None or self.agl_m < STANDS_BELOW_M)


class Telemetry:
    def __init__(self) -> None:
        self._states: deque[VehicleState] = deque(maxlen=KEPT)

    def add(self, state: VehicleState) -> None:
        self._states.append(state)

    def at(self, t_ns: int) -> Attitude:
        """Field by field the value measured nearest to ``t_ns``; ``None`` where nobody said it within a second."""

        def nearest(name: str) -> Any:
            known = [s for s in self._states if getattr(s, name) is not None and abs(s.t_ns - t_ns) <= MAX_GAP_NS]
            return getattr(min(known, key=lambda s: abs(s.t_ns - t_ns)), name) if known else None

        return Attitude(*(nearest(name) for name in ("yaw_rad", "pitch_rad", "roll_rad", "agl_m", "armed")))
