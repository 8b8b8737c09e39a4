"""Which packets of the autopilot contradict what it has said before: in their numbers, in time, or in attitude."""

import math
from typing import Any

from terrafix.core.mavlink.imu import KINDS, boot_ns, readings_of
from terrafix.link.admission.boot_clock import NS_PER_MS, BootClock
from terrafix.link.admission.refusals import Reason
from terrafix.link.admission.sequence_numbers import Sequence
from terrafix.link.admission.turn_check import TurnCheck, said

TIMED = frozenset({"ATTITUDE", "GLOBAL_POSITION_INT", "ALTITUDE", "SYSTEM_TIME", "SCALED_PRESSURE", *KINDS})


class TelemetryCheck:
    """``refuses`` every packet of the autopilot that is served. ``reboots``: how often its time began anew."""

    def __init__(self) -> None:
        self._sequence = Sequence()
        self._clock = BootClock()  # of time_boot_ms
        self._imu_clock = BootClock()  # of time_usec, which need not begin where that does
        self._turns = TurnCheck()

    @property
    def reboots(self) -> int:
        return self._clock.reboots

    def refuses(self, message: Any, now_ns: int) -> tuple[Reason, str] | None:
        """-> why it is not taken; None: it is."""
        if why := self._sequence.refuses(message.get_seq(), now_ns):
            return Reason.SEQUENCE, why
        if (kind := message.get_type()) not in TIMED:
            return None
        since_boot_ns = boot_ns(message)
        if since_boot_ns is None:
            return None
        reboots = self.reboots
        clock = self._clock if hasattr(message, "time_boot_ms") else self._imu_clock
        if why := clock.refuses(since_boot_ns // NS_PER_MS, now_ns):
            return Reason.BOOT_TIME, f"{kind}: {why}"
        if self.reboots != reboots:
            self._turns = TurnCheck()
        if kind == "ATTITUDE":
            angles = (message.yaw, message.pitch, message.roll)
            rates = (message.rollspeed, message.pitchspeed, message.yawspeed)
            if all(map(math.isfinite, angles)) and (why := self._turns.refuses(said(since_boot_ns, angles, rates))):
                return Reason.ATTITUDE, why
        elif kind in KINDS and (readings := readings_of(message)) is not None:
            self._turns.add(since_boot_ns, readings[3:])
        return None
