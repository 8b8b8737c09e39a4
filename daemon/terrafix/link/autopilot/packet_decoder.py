"""The served autopilot: converts its MAVLink packets to messages and stores the state that the outputs need."""

import math
from collections.abc import Iterator
from typing import Any

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.link.autopilot.gnss_receiver import RECEIVERS, gnss_reading
from terrafix.link.autopilot.telemetry import TelemetryDecoder
from terrafix.link.mavlink.timesync import TimeSync
from terrafix.link.output.odometry import GeodeticPoint, VehicleAttitude
from terrafix.link.output.selection import AutopilotState
from terrafix.messages import EkfStatus, Message, VehicleState

ATTITUDE_TIMEOUT_NS = 500_000_000  # an older attitude is not used for the outputs [tuned]
POSITION_TIMEOUT_NS = 1_000_000_000  # an older position of its EKF is not published [spec: EkfStatus]
# The bits that mean the same in ESTIMATOR_STATUS_FLAGS and EKF_STATUS_FLAGS. [spec: MAVLink common.xml]
COMMON_EKF_FLAGS = 2 * mavlink.ESTIMATOR_PRED_POS_HORIZ_ABS - 1


class PacketDecoder:
    """Processes the messages of the served autopilot (served_autopilot.py)."""

    def __init__(self, timesync: TimeSync) -> None:
        self.telemetry = TelemetryDecoder(timesync)
        self._state: VehicleState | None = None  # the newest
        self._origin: GeodeticPoint | None = None  # of its EKF
        self._position: tuple[int, float, float] | None = None  # of its EKF: time received, latitude, longitude

    @property
    def sysid(self) -> int:
        return self.telemetry.sysid

    @property
    def firmware(self) -> str:
        return self.telemetry.firmware

    def on_message(self, message: Any, now_ns: int, own_receiver: int | None) -> Iterator[Message]:
        """``own_receiver``: index of the GPS instance that carries our GPS_INPUT; it is not reported as a receiver.
        None: there is none."""
        state = self.telemetry.on_message(message, now_ns)
        if state is not None:
            if isinstance(state, VehicleState):
                self._state = state
            yield state
        for other in (self.telemetry.on_gimbal(message, now_ns), self.telemetry.on_exposure(message, now_ns)):
            if other is not None:
                yield other
        kind = message.get_type()
        if kind in RECEIVERS and RECEIVERS[kind] != own_receiver:
            yield gnss_reading(message, now_ns)
        elif kind == "GPS_GLOBAL_ORIGIN":
            self._origin = GeodeticPoint(message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3)
        elif kind == "GLOBAL_POSITION_INT":
            self._position = now_ns, message.lat / 1e7, message.lon / 1e7
        elif kind == "EKF_STATUS_REPORT":
            for status in _ekf_status(message, now_ns):
                yield self._with_position(status)
        elif kind == "ESTIMATOR_STATUS":
            yield self._with_position(_estimator_status(message, now_ns))

    def _with_position(self, status: EkfStatus) -> EkfStatus:
        if self._position is None or status.t_ns - self._position[0] > POSITION_TIMEOUT_NS:
            return status
        _, lat_deg, lon_deg = self._position
        return msgspec.structs.replace(status, lat_deg=lat_deg, lon_deg=lon_deg)

    def snapshot(self, now_ns: int) -> AutopilotState:
        """-> the state that the outputs need, without the attitude if that is too old."""
        state, attitude = self._state, None
        if state is not None and now_ns - state.t_ns < ATTITUDE_TIMEOUT_NS:
            angles_rad = [a for a in (state.roll_rad, state.pitch_rad, state.yaw_rad) if a is not None]
            attitude = VehicleAttitude(*angles_rad) if len(angles_rad) == 3 else None
        return AutopilotState(self.firmware, self.sysid, attitude, self._origin)


def _ekf_status(message: Any, now_ns: int) -> Iterator[EkfStatus]:
    """ArduPilot's EKF_STATUS_REPORT. Its ``*_variance`` fields contain innovation test ratios."""
    ratios = (message.pos_horiz_variance, message.velocity_variance)
    if all(math.isfinite(ratio) for ratio in ratios):
        yield EkfStatus(t_ns=now_ns, flags=message.flags, position_ratio=ratios[0], velocity_ratio=ratios[1])


def _estimator_status(message: Any, now_ns: int) -> EkfStatus:
    """PX4's ESTIMATOR_STATUS. A test ratio is NaN if no such measurement arrives, as the one of the velocity without a
    receiver."""
    ratios = [ratio if math.isfinite(ratio) else 0.0 for ratio in (message.pos_horiz_ratio, message.vel_ratio)]
    flags = message.flags & COMMON_EKF_FLAGS
    return EkfStatus(t_ns=now_ns, flags=flags, position_ratio=ratios[0], velocity_ratio=ratios[1])
