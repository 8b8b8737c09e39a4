"""Model of a GNSS receiver: fixes with noise and delay, and the effects of outage, jamming and spoofing."""

import math
import random
from collections import deque
from collections.abc import Sequence

from terrafix.core.geodesy import LocalFrame
from terrafix_lab.sim.interfaces import GnssFix, State
from terrafix_lab.sim.sensors.gnss_events import AnyEvent, Drag, Jam, Jump, Outage

RATE_HZ = 5.0
DELAY_S = 0.12  # from measurement to the last byte on the wire (u-blox M8 at 5 Hz; ArduPilot assumes 0.1 to 0.22)
WANDER_M = (1.2, 1.2, 2.2)  # east, north, up: slow error, 1-sigma (u-blox M8: 2.5 m CEP at 24 h is the upper end)
WANDER_TIME_S = 120.0
NOISE_M = (0.12, 0.12, 0.25)
NOISE_MPS = (0.06, 0.06, 0.1)  # u-blox M8: 0.05 m/s, 50 %, at 30 m/s
REPORTED_M = (1.3, 2.0)  # horizontal, vertical accuracy that the receiver reports in the open
REPORTED_MPS = 0.25
SATELLITES, MIN_SATELLITES = 14, 5
HDOP = 0.8
MAX_ACCURACY_FACTOR = 25.0  # reported accuracies grow to this multiple of the best before the fix is lost
NO_FIX = GnssFix(1, 0.0, 0.0, 0.0, (0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0, 99.99)


class Gnss:
    """Call ``read`` once for every state, in order of time."""

    def __init__(self, frame: LocalFrame, *, seed: int = 0, events: Sequence[AnyEvent] = ()) -> None:
        self._frame, self._events = frame, tuple(events)
        self._gauss = random.Random(f"{seed} gnss").gauss
        self._wander_m = [sigma * self._gauss(0.0, 1.0) for sigma in WANDER_M]
        self._next_s = 0.0
        self._pending: deque[tuple[float, GnssFix]] = deque()

    def read(self, state: State) -> GnssFix | None:
        """Returns the fix that the receiver outputs now, measured DELAY_S before; None: no new fix."""
        if state.t_s >= self._next_s - 1e-6:
            self._next_s += 1.0 / RATE_HZ
            self._pending.append((state.t_s + DELAY_S, self._measure(state)))
        if self._pending and state.t_s >= self._pending[0][0] - 1e-6:
            return self._pending.popleft()[1]
        return None

    def _measure(self, state: State) -> GnssFix:
        share = self._signal(state.t_s)
        satellites = round(SATELLITES * share)
        decay = math.exp(-1.0 / (RATE_HZ * WANDER_TIME_S))
        driving_sigma = math.sqrt(1.0 - decay * decay)
        draws = [self._gauss(0.0, 1.0) for _ in range(9)]
        for i in range(3):
            self._wander_m[i] = decay * self._wander_m[i] + driving_sigma * WANDER_M[i] * draws[i]
        if satellites < MIN_SATELLITES:
            return NO_FIX
        accuracy_factor = min(MAX_ACCURACY_FACTOR, 1.0 / share**3)  # code tracking noise at decreasing signal strength
        spoof_offset = self._spoofed(state.t_s)
        p = [
            float(state.p_b_in_w_m[i])
            + spoof_offset[i]
            + self._wander_m[i] * math.sqrt(accuracy_factor)
            + NOISE_M[i] * accuracy_factor * draws[3 + i]
            for i in range(3)
        ]
        v = [
            float(state.velocity_enu_mps[i]) + spoof_offset[3 + i] + NOISE_MPS[i] * accuracy_factor * draws[6 + i]
            for i in range(3)
        ]
        lat_deg, lon_deg = self._frame.to_wgs84(p[0], p[1])
        return GnssFix(
            fix_type=3,
            lat_deg=lat_deg,
            lon_deg=lon_deg,
            alt_amsl_m=p[2],
            velocity_ned_mps=(v[1], v[0], -v[2]),
            horizontal_m=REPORTED_M[0] * accuracy_factor,
            vertical_m=REPORTED_M[1] * accuracy_factor,
            speed_mps=REPORTED_MPS * accuracy_factor,
            satellites=satellites,
            hdop=HDOP / share,
        )

    def _signal(self, t_s: float) -> float:
        """Share of the satellites that can be tracked."""
        share = 1.0
        for event in self._events:
            if isinstance(event, Outage) and event.on(t_s):
                return 0.0
            if isinstance(event, Jam) and event.on(t_s):
                share = min(share, max(0.0, 1.0 - (t_s - event.start_s) / event.fade_s) if event.fade_s > 0.0 else 0.0)
        return share

    def _spoofed(self, t_s: float) -> list[float]:
        """Offset by spoofing: position east, north, up, then velocity."""
        spoof_offset = [0.0] * 6
        for event in self._events:
            if isinstance(event, Jump) and event.on(t_s):
                spoof_offset[0] += event.east_m
                spoof_offset[1] += event.north_m
            if isinstance(event, Drag) and event.on(t_s):
                for i, rate_mps in enumerate((event.east_mps, event.north_mps)):
                    spoof_offset[i] += rate_mps * (t_s - event.start_s)
                    spoof_offset[3 + i] += rate_mps
        return spoof_offset
