"""A flight to the east in real time: its course for a simulated autopilot, and estimates for the link."""

import math
import time

import msgspec

from link_rig import ALT, LAT, LON, MS, SPEED_EAST, covariance, estimate
from terrafix import messages as m
from terrafix.link.integrity.output_predictor import offset
from terrafix_lab.sim.autopilot.course import PeerState


def eastward(t_s: float, north_m: float = 0.0) -> PeerState:
    """``north_m``: north of the course of the estimates."""
    lat, lon = offset(LAT, LON, SPEED_EAST * t_s, north_m)
    return PeerState(lat, lon, ALT, 120.0, math.pi / 2, 0.02, 0.0, 0.0, SPEED_EAST, 0.0)


class LiveFlight:
    """Clock and estimates for link and simulated autopilot: 4 Hz, 150 ms late, with an error ``east_m``."""

    def __init__(self, zero_ns: int | None = None) -> None:
        """``zero_ns``: monotonic time of its start; None: now."""
        self._zero_ns = time.monotonic_ns() if zero_ns is None else zero_ns
        self._next_ns = 0
        self.east_m = 0.0

    def clock(self) -> float:
        return (time.monotonic_ns() - self._zero_ns) * 1e-9

    def feed(self, now_ns: int) -> list[m.Message]:
        if now_ns < self._next_ns:
            return []
        self._next_ns = now_ns + 250 * MS
        at_ns = now_ns - 150 * MS
        late = estimate(at_ns - self._zero_ns, east_m=self.east_m, cov=covariance(3.0))
        return [msgspec.structs.replace(late, t_ns=at_ns, emitted_at_ns=now_ns)]
