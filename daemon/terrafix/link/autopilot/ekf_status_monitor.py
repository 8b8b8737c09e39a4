"""Monitors whether the autopilot's EKF uses our position, by its status message, and informs the pilot."""

from collections.abc import Iterator

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.clock import NS_PER_S
from terrafix.link.pilot_text.debounce import Debounce
from terrafix.messages import EkfStatus

# Time from the first 3D fix after which the EKF must use it. Measured: an EKF on the ground takes 21 s until it uses a
# GPS; in the air it returns to one after 10 s. [tuned]
USE_TIMEOUT_NS = 30 * NS_PER_S
EKF_STATUS_TIMEOUT_NS = 5 * NS_PER_S  # an older status is ignored [tuned]
NO_POSITION_FLAGS = mavlink.EKF_CONST_POS_MODE | mavlink.EKF_UNINITIALIZED


class EkfStatusMonitor:
    """``on_status`` stores each EkfStatus; ``check`` is called at every send and returns the texts for the pilot."""

    def __init__(self) -> None:
        self._status: EkfStatus | None = None
        self._fix_since_ns: int | None = None
        self._debounce = Debounce[bool]()
        self._debounce.reported = True

    def on_status(self, status: EkfStatus) -> None:
        self._status = status

    def check(self, now_ns: int, *, has_fix: bool) -> Iterator[tuple[bool, str]]:
        """``has_fix``: a 3D fix is sent now. -> (True if the EKF uses a position, text for the pilot)."""
        self._fix_since_ns = (self._fix_since_ns or now_ns) if has_fix else None
        status = self._status
        if self._fix_since_ns is None or status is None or now_ns - status.t_ns > EKF_STATUS_TIMEOUT_NS:
            return
        uses_position = bool(status.flags & mavlink.EKF_POS_HORIZ_ABS) and not status.flags & NO_POSITION_FLAGS
        if not uses_position and now_ns - self._fix_since_ns < USE_TIMEOUT_NS:
            return
        if self._debounce.due(uses_position, now_ns, clears=uses_position):
            yield (
                uses_position,
                "autopilot uses a position again" if uses_position else "autopilot does not use the position",
            )
