"""The autopilot that we talk to: what it says becomes messages, and what is known of it is kept for what is sent."""

import math
from collections.abc import Iterator
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.link.autopilot.gnss_receiver import RECEIVERS, reading_of
from terrafix.link.autopilot.telemetry import Telemetry
from terrafix.link.mavlink.timesync import TimeSync
from terrafix.link.output.odometry import Attitude, Place
from terrafix.link.output.selection import Autopilot
from terrafix.messages import FilterStatus, Message, VehicleState

ATTITUDE_FRESH_NS = 500_000_000
SHARED_FLAGS = 2 * mavlink.ESTIMATOR_PRED_POS_HORIZ_ABS - 1  # those below are the same as in EKF_STATUS_FLAGS


class AutopilotPeer:
    """``take`` every message of the autopilot that is served (served_autopilot.py)."""

    def __init__(self, timesync: TimeSync) -> None:
        self.telemetry = Telemetry(timesync)
        self._state: VehicleState | None = None  # the newest
        self._origin: Place | None = None  # of its filter

    @property
    def sysid(self) -> int:
        return self.telemetry.sysid

    @property
    def firmware(self) -> str:
        return self.telemetry.autopilot

    def take(self, message: Any, now_ns: int, our_receiver: int | None) -> Iterator[Message]:
        """``our_receiver``: the GPS that is we ourselves, and no receiver; None: none is."""
        state = self.telemetry.take(message, now_ns)
        if state is not None:
            if isinstance(state, VehicleState):
                self._state = state
            yield state
        kind = message.get_type()
        if kind in RECEIVERS and RECEIVERS[kind] != our_receiver:
            yield reading_of(message, now_ns)
        elif kind == "GPS_GLOBAL_ORIGIN":
            self._origin = Place(message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3)
        elif kind == "EKF_STATUS_REPORT":
            yield from _filter_status(message, now_ns)
        elif kind == "ESTIMATOR_STATUS":
            yield _estimator_status(message, now_ns)

    def now(self, now_ns: int) -> Autopilot:
        state, attitude = self._state, None
        if state is not None and now_ns - state.t_ns < ATTITUDE_FRESH_NS:
            angles = [a for a in (state.roll_rad, state.pitch_rad, state.yaw_rad) if a is not None]
            attitude = Attitude(*angles) if len(angles) == 3 else None
        return Autopilot(self.firmware, self.sysid, attitude, self._origin)


def _filter_status(message: Any, now_ns: int) -> Iterator[FilterStatus]:
    ratios = (message.pos_horiz_variance, message.velocity_variance)  # "variance" by name, test ratios in truth
    if all(math.isfinite(ratio) for ratio in ratios):
        yield FilterStatus(t_ns=now_ns, flags=message.flags, position_ratio=ratios[0], velocity_ratio=ratios[1])


def _estimator_status(message: Any, now_ns: int) -> FilterStatus:
    """PX4's. A ratio is NaN where nothing of that kind comes in: without a receiver, that of the velocity."""
    ratios = [ratio if math.isfinite(ratio) else 0.0 for ratio in (message.pos_horiz_ratio, message.vel_ratio)]
    flags = message.flags & SHARED_FLAGS
    return FilterStatus(t_ns=now_ns, flags=flags, position_ratio=ratios[0], velocity_ratio=ratios[1])
