"""Whether the autopilot's filter uses the position that it is sent. It says so itself; the pilot should know."""

from collections.abc import Iterator

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.link.pilot_text.debounce import Debounce
from terrafix.messages import FilterStatus

NS_PER_S = 1_000_000_000
# From the first 3D fix on: a filter on the ground takes 21 s to use a GPS (measured), one in the air 10 s to come back.
USED_AFTER_NS = 30 * NS_PER_S
FRESH_NS = 5 * NS_PER_S  # a status that is older says nothing
WITHOUT = mavlink.EKF_CONST_POS_MODE | mavlink.EKF_UNINITIALIZED


class FilterWatch:
    """``status`` each one that comes, ``look`` at every send: what the pilot should read comes out."""

    def __init__(self) -> None:
        self._status: FilterStatus | None = None
        self._good_since_ns: int | None = None
        self._said = Debounce[bool]()
        self._said.told = True

    def status(self, status: FilterStatus) -> None:
        self._status = status

    def look(self, now_ns: int, *, good: bool) -> Iterator[tuple[bool, str]]:
        """``good``: a 3D fix is sent now. -> (whether it uses a position, text)"""
        self._good_since_ns = (self._good_since_ns or now_ns) if good else None
        status = self._status
        if self._good_since_ns is None or status is None or now_ns - status.t_ns > FRESH_NS:
            return
        uses = bool(status.flags & mavlink.EKF_POS_HORIZ_ABS) and not status.flags & WITHOUT
        if not uses and now_ns - self._good_since_ns < USED_AFTER_NS:
            return
        if self._said.due(uses, now_ns, clears=uses):
            yield uses, "autopilot uses a position again" if uses else "autopilot does not use the position"
