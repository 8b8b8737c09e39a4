"""Which autopilot is served: one system id at one address. Who else speaks on its link, and may be heard.

On a listening port every vehicle of the neighbourhood may speak. GPS_INPUT has no target: whoever gets it takes it. Two
copters on one port were measured; the second believed itself 66 km off. So the position goes to the autopilot that was
heard first, and from the address at which that one speaks nothing else is taken for its telemetry."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.link.autopilot.checkpoint import LinkCheckpoint
from terrafix.link.mavlink.transport import Address

NS_PER_S = 1_000_000_000
# The same vehicle at another address (it has rebooted, or has got another address of its network): three heartbeats.
MOVED_AFTER_NS = 3 * NS_PER_S
# Another vehicle, where the one that was served is switched off: longer than a reboot, or a radio shadow. Never while
# the one that is served was armed when it was last heard: this computer flies on it.
OTHER_AFTER_NS = 30 * NS_PER_S
FRESH_NS = 10 * NS_PER_S  # who has not spoken for so long is not there any more
# A ground station, a camera or another companion has a heartbeat too; an autopilot names its firmware.
AUTOPILOT_COMPONENT = mavlink.MAV_COMP_ID_AUTOPILOT1


class Role(Enum):
    AUTOPILOT = "autopilot"  # the one that is served
    OTHER = "other"  # a ground station, a gimbal, a vehicle behind the same router
    CONTRADICTS = "contradicts"  # the same, and not to be believed (admission.py)
    REFUSED = "refused"  # at an address of another vehicle, or of a second sender with our autopilot's id


@dataclass(frozen=True)
class Other:
    """An autopilot besides the one that is served. ``address`` None: on the same wire, or behind the same router."""

    sysid: int
    address: Address | None


class Served:
    """``take`` every message with its sender (None where there is one other end only)."""

    def __init__(self, only_sysid: int, *, listens: bool, found: LinkCheckpoint | None = None) -> None:
        """``only_sysid``: system id of the autopilot; 0: the first that is heard. ``listens``: the link is a port at
        which several may speak. ``found``: what the link before this one served."""
        self._only_sysid, self._listens = only_sysid, listens
        self.sysid = 0  # 0: none was heard yet
        self.address: Address | None = None
        self._armed = False
        self._heard_ns: int | None = None
        self._others: dict[Other, int] = {}  # when heard last
        self._warned: set[Other] = set()
        if found is not None and only_sysid in (0, found.autopilot.sysid):
            self.sysid, self.address, self._armed = found.autopilot.sysid, found.peer, True

    @property
    def reachable(self) -> bool:
        """There is somebody to whom the position may be sent. A wire with one other end needs nobody to be heard
        first, unless that one has to prove its system id."""
        if self._listens:
            return self.address is not None
        return self.sysid != 0 or not self._only_sysid

    def take(self, message: Any, sender: Address | None, now_ns: int) -> Role:
        sysid, compid = message.get_srcSystem(), message.get_srcComponent()
        if self._heard_ns is None:
            self._heard_ns = now_ns
        beats = is_autopilot_heartbeat(message)
        if beats and self._may_serve(sysid, sender, now_ns):
            self.sysid, self.address = sysid, sender
        ours = (sysid, compid) == (self.sysid, AUTOPILOT_COMPONENT)
        if ours and self.address is None:
            self.address = sender  # of one that was served before a restart
        if ours and sender == self.address:
            self._heard_ns = now_ns
            if beats:
                self._armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            return Role.AUTOPILOT
        if ours or (beats and sysid != self.sysid):
            self._others[Other(sysid, None if sender == self.address else sender)] = now_ns
        return Role.REFUSED if self._is_of_another(sender, now_ns) else Role.OTHER

    def others(self, now_ns: int) -> list[Other]:
        """Who was heard lately."""
        self._others = {o: at_ns for o, at_ns in self._others.items() if now_ns - at_ns < FRESH_NS}
        self._others.pop(Other(self.sysid, None), None)
        return sorted(self._others, key=lambda other: (other.sysid, str(other.address)))

    def warnings(self, now_ns: int) -> Iterator[Other]:
        """Those that are new since the last call."""
        there = self.others(now_ns)
        yield from (other for other in there if other not in self._warned)
        self._warned = set(there)

    def _may_serve(self, sysid: int, sender: Address | None, now_ns: int) -> bool:
        if self._only_sysid and sysid != self._only_sysid:
            return False
        if self.sysid == 0:
            return True
        silent_ns = now_ns - (self._heard_ns or 0)
        if sysid == self.sysid:
            return silent_ns > MOVED_AFTER_NS
        return silent_ns > OTHER_AFTER_NS and not self._armed

    def _is_of_another(self, sender: Address | None, now_ns: int) -> bool:
        if sender is None or sender == self.address:
            return False
        return any(other.address == sender and now_ns - at_ns < FRESH_NS for other, at_ns in self._others.items())


def is_autopilot_heartbeat(message: Any) -> bool:
    return bool(
        message.get_type() == "HEARTBEAT"
        and message.autopilot != mavlink.MAV_AUTOPILOT_INVALID
        and message.get_srcComponent() == AUTOPILOT_COMPONENT
    )


def pilot_text(other: Other, served_sysid: int) -> str:
    """For the pilot's screen, at most 40 characters."""
    if other.sysid == served_sysid:
        return f"a second sender is system {other.sysid}, ignored"
    if other.address is None:
        return f"vehicle {other.sysid} on our link hears us too"
    return f"vehicle {other.sysid} on our port gets nothing"


def note(others: list[Other], served_sysid: int, *, named: bool) -> str:
    """For LinkStatus; empty: nobody else is there. ``named``: link.autopilot_sysid is set."""
    here = [str(o.sysid) for o in others if o.address is None]
    away = [f"{o.sysid} at {o.address[0]}:{o.address[1]}" for o in others if o.address and o.sysid != served_sysid]
    twice = [f"{o.address[0]}:{o.address[1]}" for o in others if o.address and o.sysid == served_sysid]
    notes = []
    if here:
        what_to_do = "give each a link of its own" if named else "name yours in link.autopilot_sysid"
        also = "GPS_INPUT has no target, and reaches them too"
        notes.append(
            f"more than one autopilot: {served_sysid} is served, {', '.join(here)} is not; {also}; {what_to_do}"
        )
    if away:
        notes.append(f"more than one autopilot: {served_sysid} is served, {', '.join(away)} gets nothing")
    if twice:
        notes.append(f"a second sender of system {served_sysid} at {', '.join(twice)} is ignored")
    return "; ".join(notes)
