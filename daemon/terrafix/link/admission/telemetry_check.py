"""Rejects packets of the autopilot that contradict earlier ones, by sequence number, time since boot or attitude."""

import math
from typing import Any

from terrafix.core.clock import NS_PER_MS
from terrafix.core.mavlink.imu import IMU_MESSAGES, boot_ns, imu_readings
from terrafix.link.admission.boot_clock import BootClock
from terrafix.link.admission.refusals import RejectionReason
from terrafix.link.admission.sequence_numbers import SequenceCheck
from terrafix.link.admission.turn_check import TurnCheck, attitude_sample

TIMESTAMPED_KINDS = frozenset(
    {"ATTITUDE", "GLOBAL_POSITION_INT", "ALTITUDE", "SYSTEM_TIME", "SCALED_PRESSURE", *IMU_MESSAGES}
)


class TelemetryCheck:
    """Checks every packet of the served autopilot. ``reboots``: number of reboots detected."""

    def __init__(self) -> None:
        self._sequence = SequenceCheck()
        self._clock = BootClock()  # of time_boot_ms
        self._imu_clock = BootClock()  # of time_usec, which may have another origin than time_boot_ms
        self._turn_check = TurnCheck()

    @property
    def reboots(self) -> int:
        return self._clock.reboots

    def rejection(self, message: Any, now_ns: int) -> tuple[RejectionReason, str] | None:
        """-> reason for the rejection with a detail; None if the packet is accepted."""
        if why := self._sequence.rejection_reason(message.get_seq(), now_ns):
            return RejectionReason.SEQUENCE, why
        if (kind := message.get_type()) not in TIMESTAMPED_KINDS:
            return None
        since_boot_ns = boot_ns(message)
        if since_boot_ns is None:
            return None
        reboots = self.reboots
        clock = self._clock if hasattr(message, "time_boot_ms") else self._imu_clock
        if why := clock.rejection_reason(since_boot_ns // NS_PER_MS, now_ns):
            return RejectionReason.BOOT_TIME, f"{kind}: {why}"
        if self.reboots != reboots:
            self._turn_check = TurnCheck()
        if kind == "ATTITUDE":
            angles = (message.yaw, message.pitch, message.roll)
            rates = (message.rollspeed, message.pitchspeed, message.yawspeed)
            if all(map(math.isfinite, angles)) and (
                why := self._turn_check.rejection_reason(attitude_sample(since_boot_ns, angles, rates))
            ):
                return RejectionReason.ATTITUDE, why
        elif kind in IMU_MESSAGES and (readings := imu_readings(message)) is not None:
            self._turn_check.add(since_boot_ns, readings[3:])
        return None
