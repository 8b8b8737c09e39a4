"""What the autopilot said around a frame's time: attitude, height, each with its absence."""

from collections import deque
from dataclasses import dataclass

from terrafix.messages import VehicleState

KEPT = 400  # states; 8 s at 50 Hz
MAX_GAP_NS = 1_000_000_000  # older than this against the frame says nothing about it


@dataclass(frozen=True)
class Attitude:
    yaw_rad: float | None
    pitch_rad: float | None
    roll_rad: float | None
    agl_m: float | None


class Telemetry:
    def __init__(self) -> None:
        self._states: deque[VehicleState] = deque(maxlen=KEPT)

    def add(self, state: VehicleState) -> None:
        self._states.append(state)

    def at(self, t_ns: int) -> Attitude:
        """Field by field the value measured nearest to ``t_ns``; ``None`` where nobody said it within a second."""

        def nearest(name: str) -> float | None:
            known = [s for s in self._states if getattr(s, name) is not None and abs(s.t_ns - t_ns) <= MAX_GAP_NS]
            return float(getattr(min(known, key=lambda s: abs(s.t_ns - t_ns)), name)) if known else None

        return Attitude(nearest("yaw_rad"), nearest("pitch_rad"), nearest("roll_rad"), nearest("agl_m"))
