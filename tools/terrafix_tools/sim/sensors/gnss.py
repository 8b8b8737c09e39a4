"""A GNSS receiver: fixes with noise and delay, and what outage, jamming and spoofing make of them."""

import math
import random
from collections import deque
from collections.abc import Sequence

from terrafix.core.geodesy import LocalFrame
from terrafix_tools.sim.interfaces import GnssFix, State
from terrafix_tools.sim.sensors.gnss_events import AnyEvent, Drag, Jam, Jump, Outage

RATE_HZ = 5.0
DELAY_S = 0.12  # from measurement to the last byte on the wire (u-blox M8 at 5 Hz; ArduPilot assumes 0.1 to 0.22)
WANDER_M = (1.2, 1.2, 2.2)  # east, north, up: slow error, 1-sigma (u-blox M8: 2.5 m CEP at 24 h is the upper end)
WANDER_TIME_S = 120.0
NOISE_M = (0.12, 0.12, 0.25)
NOISE_MPS = (0.06, 0.06, 0.1)  # u-blox M8: 0.05 m/s, 50 %, at 30 m/s
CLAIM_M = (1.3, 2.0)  # horizontal, vertical accuracy as the receiver says it in the open
CLAIM_MPS = 0.25
SATELLITES, LEAST_SATELLITES = 14, 5
HDOP = 0.8
WORST = 25.0  # accuracies grow to this many times the best before the fix is lost
NO_FIX = GnssFix(1, 0.0, 0.0, 0.0, (0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0, 99.99)


class Gnss:
    """``read`` once for every state, in order of time."""

    def __init__(self, frame: LocalFrame, *, seed: int = 0, events: Sequence[AnyEvent] = ()) -> None:
        self._frame, self._events = frame, tuple(events)
        self._draw = random.Random(f"{seed} gnss").gauss
        self._wander_m = [sigma * self._draw(0.0, 1.0) for sigma in WANDER_M]
        self._next_s = 0.0
        self._waiting: deque[tuple[float, GnssFix]] = deque()

    def read(self, state: State) -> GnssFix | None:
        """The fix that leaves the receiver at this moment, measured DELAY_S before; None: nothing new."""
        if state.t_s >= self._next_s - 1e-6:
            self._next_s += 1.0 / RATE_HZ
            self._waiting.append((state.t_s + DELAY_S, self._measure(state)))
        if self._waiting and state.t_s >= self._waiting[0][0] - 1e-6:
            return self._waiting.popleft()[1]
        return None

    def _measure(self, state: State) -> GnssFix:
        share = self._signal(state.t_s)
        satellites = round(SATELLITES * share)
        keep = math.exp(-1.0 / (RATE_HZ * WANDER_TIME_S))
        kick = math.sqrt(1.0 - keep * keep)
        draws = [self._draw(0.0, 1.0) for _ in range(9)]
        for i in range(3):
            self._wander_m[i] = keep * self._wander_m[i] + kick * WANDER_M[i] * draws[i]
        if satellites < LEAST_SATELLITES:
            return NO_FIX
        worse = min(WORST, 1.0 / share**3)  # noise of code tracking as the signal sinks
        moved = self._spoofed(state.t_s)
        p = [
            float(state.p_b_in_w_m[i])
            + moved[i]
            + self._wander_m[i] * math.sqrt(worse)
            + NOISE_M[i] * worse * draws[3 + i]
            for i in range(3)
        ]
        v = [float(state.velocity_enu_mps[i]) + moved[3 + i] + NOISE_MPS[i] * worse * draws[6 + i] for i in range(3)]
        lat_deg, lon_deg = self._frame.to_wgs84(p[0], p[1])
        return GnssFix(
            fix_type=3,
            lat_deg=lat_deg,
            lon_deg=lon_deg,
            alt_amsl_m=p[2],
            velocity_ned_mps=(v[1], v[0], -v[2]),
            horizontal_m=CLAIM_M[0] * worse,
            vertical_m=CLAIM_M[1] * worse,
            speed_mps=CLAIM_MPS * worse,
            satellites=satellites,
            hdop=HDOP / share,
        )

    def _signal(self, t_s: float) -> float:
        """Share of the satellites that it can track."""
        share = 1.0
        for event in self._events:
            if isinstance(event, Outage) and event.on(t_s):
                return 0.0
            if isinstance(event, Jam) and event.on(t_s):
                share = min(share, max(0.0, 1.0 - (t_s - event.start_s) / event.fade_s) if event.fade_s > 0.0 else 0.0)
        return share

    def _spoofed(self, t_s: float) -> list[float]:
        """What spoofers add: position east, north, up, then velocity."""
        moved = [0.0] * 6
        for event in self._events:
            if isinstance(event, Jump) and event.on(t_s):
                moved[0] += event.east_m
                moved[1] += event.north_m
            if isinstance(event, Drag) and event.on(t_s):
                for i, rate_mps in enumerate((event.east_mps, event.north_mps)):
                    moved[i] += rate_mps * (t_s - event.start_s)
                    moved[3 + i] += rate_mps
        return moved
