"""Selects the served autopilot (one system id at one address) and classifies all other senders on its link.

On a listening port any vehicle in the network may send. GPS_INPUT has no target field: every autopilot that receives it
uses it. In a test with two copters on one port the position estimate of the second one was 66 km off. Therefore the
position goes to one autopilot only, and only packets with its system and component id from its address count as its
telemetry.

That is the one that ``link.autopilot_sysid`` names; else the one that was received first, as long as it is alone. The
camera may be on any of several. Then none is served until the estimator knows which of them turns as the images do
(estimator/integrity/camera_vehicle.py). A vehicle that was confirmed so stays served, whoever else is heard later."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.clock import NS_PER_S
from terrafix.core.mavlink.vehicles import AUTOPILOT_COMPONENT
from terrafix.link.autopilot.checkpoint import LinkCheckpoint
from terrafix.link.mavlink.transport import MAX_PEERS, Address

# Silence after which the same vehicle is accepted at another address (after a reboot, or with a new network address):
# three heartbeats. [tuned]
ADDRESS_CHANGE_TIMEOUT_NS = 3 * NS_PER_S
# Silence after which another vehicle is served (the served one was switched off): longer than a reboot or a radio
# outage. Does not apply if the served one was armed when last received: this computer is on board of it. [tuned]
VEHICLE_CHANGE_TIMEOUT_NS = 30 * NS_PER_S
# The autopilot of this computer answers requests, and without telemetry there is no position. One that has sent nothing
# but heartbeats for this long, armed or not, is replaced by one that sends telemetry, or after this silence by any.
# [spec: MAVLink heartbeat protocol, lost after 4 to 5 missing heartbeats of 1 Hz]
HEARTBEATS_ONLY_NS = 5 * NS_PER_S
OTHER_TIMEOUT_NS = 10 * NS_PER_S  # silence after which another sender is forgotten [tuned]
# A link that was restarted while it was unclear which vehicle carries the camera hears the others within this time.
# [spec: MAVLink heartbeat protocol, 1 Hz]
LISTEN_NS = 3 * NS_PER_S // 2
MAX_RIVALS = MAX_PEERS - 1  # whose turns are compared; of more vehicles one has to be named [spec: transport.py]


class Role(Enum):
    """Role of the sender of one packet."""

    AUTOPILOT = "autopilot"  # the served autopilot
    OTHER = "other"  # a ground station, a gimbal, a vehicle behind the same router
    INCONSISTENT = "inconsistent"  # the served autopilot, but the packet contradicts earlier ones (packet_filter.py)
    CANDIDATE = "candidate"  # another autopilot, while it is unclear which one carries the camera
    REJECTED = "rejected"  # at the address of another vehicle, or of a second sender with the autopilot's id


@dataclass(frozen=True)
class OtherAutopilot:
    """An autopilot besides the served one. ``address`` None: on the same wire, or behind the same router."""

    sysid: int
    address: Address | None


@dataclass
class _Rival:
    """Another autopilot that may carry the camera. ``heard_ns``: time of its last packet."""

    address: Address | None
    heard_ns: int
    armed: bool


class ServedAutopilot:
    """``sysid`` and ``address`` of the served autopilot, and the other autopilots on the link. ``confirmed``: system id
    of the vehicle that turns as the images do; 0: not known yet."""

    def __init__(self, required_sysid: int, *, is_listening: bool, checkpoint: LinkCheckpoint | None = None) -> None:
        """``required_sysid``: system id of the autopilot; 0: not configured. ``is_listening``: the link is a
        listening port with several possible senders. ``checkpoint``: of the previous link process of this flight."""
        self._required_sysid, self._is_listening = required_sysid, is_listening
        self.sysid = self.confirmed = 0  # 0: none received yet
        self.address: Address | None = None
        self._armed = False
        self._with_telemetry: set[int] = set()  # system ids of autopilots that have sent more than heartbeats
        self._received_ns: int | None = None
        self._served_since_ns = 0
        self._others: dict[OtherAutopilot, int] = {}  # time of the last reception
        self._reported: set[OtherAutopilot] = set()
        self._rivals: dict[int, _Rival] = {}  # by system id
        self._listens_first = checkpoint is not None and checkpoint.last is None  # it had sent no fix
        if checkpoint is not None and required_sysid in (0, checkpoint.autopilot.sysid):
            self.sysid, self.address, self._armed = checkpoint.autopilot.sysid, checkpoint.peer, True
            if checkpoint.last is not None:  # a state of its EKF at our last fix
                self._with_telemetry.add(self.sysid)

    @property
    def reachable(self) -> bool:
        """True if the position may be sent. A point-to-point transport needs no prior reception, unless a system id is
        required."""
        if self._is_listening:
            return self.address is not None
        return self.sysid != 0 or not self._required_sysid

    def classify(self, message: Any, sender: Address | None, now_ns: int) -> Role:
        """-> role of the sender of a message. ``sender``: address on a listening port, None on a point-to-point
        transport. Selects the served autopilot by its heartbeats."""
        sysid, compid = message.get_srcSystem(), message.get_srcComponent()
        if self._received_ns is None:
            self._received_ns = self._served_since_ns = now_ns
        is_heartbeat = is_autopilot_heartbeat(message)
        if is_heartbeat and self._may_become_served(sysid, sender, now_ns):
            self._serve(sysid, sender, now_ns)
        elif is_heartbeat and sysid != self.sysid and not self._required_sysid:
            self._on_rival(message, sender, now_ns)
        is_served = (sysid, compid) == (self.sysid, AUTOPILOT_COMPONENT)
        if is_served and self.address is None:
            self.address = sender  # of an autopilot that the checkpoint names without an address
        is_other_autopilot = compid == AUTOPILOT_COMPONENT and not is_served
        if (is_other_autopilot or (is_served and sender == self.address)) and message.get_type() != "HEARTBEAT":
            self._with_telemetry.add(sysid)
        if is_served and sender == self.address:
            self._received_ns = now_ns
            if is_heartbeat:
                self._armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            return Role.AUTOPILOT
        if is_served or (is_heartbeat and sysid != self.sysid):
            self._others[OtherAutopilot(sysid, None if sender == self.address else sender)] = now_ns
        rival = self._rivals.get(sysid) if is_other_autopilot else None
        if rival is not None and rival.address == sender and self.is_contested(now_ns):
            rival.heard_ns = now_ns
            return Role.CANDIDATE
        return Role.REJECTED if self._is_address_of_other(sender, now_ns) else Role.OTHER

    def is_contested(self, now_ns: int) -> bool:
        """True if another vehicle may carry the camera: one is there and none was confirmed, or the confirmed one is
        not the served one. Then no telemetry is used."""
        if self._required_sysid or (self.confirmed and self.confirmed == self.sysid):
            return False
        self._rivals = {
            sysid: rival
            for sysid, rival in self._rivals.items()
            if not self._is_gone(sysid, rival.heard_ns, rival.armed, now_ns)
        }
        return bool(self._rivals or self.confirmed)

    def candidates(self, now_ns: int) -> dict[int, Address | None]:
        """-> system id -> address of the vehicles that may carry the camera. Empty if it is clear which one does, and
        the position may be sent: it is confirmed, or alone, or named in the configuration."""
        if not self.sysid or not (self.is_contested(now_ns) or self._listens(now_ns)):
            return {}
        return {self.sysid: self.address} | {sysid: rival.address for sysid, rival in self._rivals.items()}

    def confirm(self, sysid: int) -> None:
        """The vehicle ``sysid`` turns as the images do, and no other. While it is not there, none is served."""
        self.confirmed = sysid
        rival = self._rivals.get(sysid)
        if rival is not None:
            self._serve(sysid, rival.address, rival.heard_ns)
            self._received_ns, self._armed = rival.heard_ns, rival.armed

    def others(self, now_ns: int) -> list[OtherAutopilot]:
        """-> other autopilots received within ``OTHER_TIMEOUT_NS``, sorted."""
        self._others = {o: at_ns for o, at_ns in self._others.items() if now_ns - at_ns < OTHER_TIMEOUT_NS}
        self._others.pop(OtherAutopilot(self.sysid, None), None)
        return sorted(self._others, key=lambda other: (other.sysid, str(other.address)))

    def new_others(self, now_ns: int) -> Iterator[OtherAutopilot]:
        """-> those that are new since the last call."""
        present = self.others(now_ns)
        yield from (other for other in present if other not in self._reported)
        self._reported = set(present)

    def _listens(self, now_ns: int) -> bool:
        """True if another vehicle, which the link before a restart had heard, may not have been heard yet."""
        if not self._listens_first or self._required_sysid or self.confirmed == self.sysid:
            return False
        return self._received_ns is None or now_ns - self._served_since_ns < LISTEN_NS

    def _may_become_served(self, sysid: int, sender: Address | None, now_ns: int) -> bool:
        """True if the autopilot with this heartbeat replaces the served one (or becomes the first)."""
        if self._required_sysid and sysid != self._required_sysid:
            return False
        if self.sysid == 0:
            return True
        received_ns = self._received_ns or 0
        if sysid == self.sysid:
            return now_ns - received_ns > ADDRESS_CHANGE_TIMEOUT_NS
        if self.sysid not in self._with_telemetry and sysid in self._with_telemetry:
            return now_ns - self._served_since_ns > HEARTBEATS_ONLY_NS
        return self._is_gone(self.sysid, received_ns, self._armed, now_ns)

    def _is_gone(self, sysid: int, heard_ns: int, armed: bool, now_ns: int) -> bool:
        """True if the silence of an autopilot means that it is not the one of this computer, or was switched off."""
        if sysid not in self._with_telemetry:
            return now_ns - heard_ns > HEARTBEATS_ONLY_NS
        return now_ns - heard_ns > VEHICLE_CHANGE_TIMEOUT_NS and not armed

    def _serve(self, sysid: int, address: Address | None, now_ns: int) -> None:
        """Serves ``sysid`` at ``address``. One that was served until now and is still there is a rival."""
        before, heard_ns = self.sysid, self._received_ns or 0
        if sysid != before:
            self._served_since_ns = now_ns
            if before and not self._is_gone(before, heard_ns, self._armed, now_ns):
                self._rivals[before] = _Rival(self.address, heard_ns, self._armed)
        self.sysid, self.address = sysid, address
        self._rivals.pop(sysid, None)
        self._others.pop(OtherAutopilot(sysid, address), None)

    def _on_rival(self, beat: Any, sender: Address | None, now_ns: int) -> None:
        """Heartbeat of another autopilot. One that is known at another address keeps that, until it is silent."""
        sysid, armed = beat.get_srcSystem(), bool(beat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        known = self._rivals.get(sysid)
        if known is None and len(self._rivals) == MAX_RIVALS:
            return
        moves = known is None or now_ns - known.heard_ns > ADDRESS_CHANGE_TIMEOUT_NS
        if moves or (known is not None and known.address == sender):
            self._rivals[sysid] = _Rival(sender, now_ns, armed)

    def _is_address_of_other(self, sender: Address | None, now_ns: int) -> bool:
        if sender is None or sender == self.address:
            return False
        return any(
            other.address == sender and now_ns - at_ns < OTHER_TIMEOUT_NS for other, at_ns in self._others.items()
        )


def is_autopilot_heartbeat(message: Any) -> bool:
    """True for a HEARTBEAT of component 1 that names a firmware."""
    return bool(
        message.get_type() == "HEARTBEAT"
        and message.autopilot != mavlink.MAV_AUTOPILOT_INVALID
        and message.get_srcComponent() == AUTOPILOT_COMPONENT
    )


def pilot_text(other: OtherAutopilot, served_sysid: int) -> str:
    """-> STATUSTEXT about another autopilot, at most 40 characters."""
    if other.sysid == served_sysid:
        return f"a second sender is system {other.sysid}, ignored"
    if other.address is None:
        return f"vehicle {other.sysid} on our link gets GPS_INPUT"
    return f"vehicle {other.sysid} on our port gets nothing"


def unclear_text(candidates: Iterable[int]) -> str:
    """-> STATUSTEXT while it is unclear which vehicle carries the camera, at most 40 characters."""
    first, *rest = sorted(candidates)
    named = ", ".join(map(str, (first, *rest[:1]))) + (", ..." if len(rest) > 1 else "")
    return f"no fix: camera on vehicle {named}?"


def camera_texts(sysid: int) -> Iterator[str]:
    """-> STATUSTEXTs when that is clear, at most 40 characters each."""
    yield f"camera is on vehicle {sysid}"
    yield f"set link.autopilot_sysid = {sysid}"


def change_text(before_sysid: int, served_sysid: int) -> str:
    """-> STATUSTEXT about a change of the served autopilot, at most 40 characters."""
    return f"vehicle {served_sysid} is served, {before_sysid} is not"


def status_note(others: list[OtherAutopilot], served_sysid: int, *, sysid_configured: bool) -> str:
    """-> text for ``LinkStatus``; empty without other autopilots. ``sysid_configured``: link.autopilot_sysid is set."""
    same_address = [str(o.sysid) for o in others if o.address is None]
    elsewhere = [f"{o.sysid} at {o.address[0]}:{o.address[1]}" for o in others if o.address and o.sysid != served_sysid]
    duplicates = [f"{o.address[0]}:{o.address[1]}" for o in others if o.address and o.sysid == served_sysid]
    notes = []
    if same_address:
        what_to_do = "give each a link of its own" if sysid_configured else "name yours in link.autopilot_sysid"
        also = "GPS_INPUT has no target, and reaches them too"
        notes.append(
            f"more than one autopilot: {served_sysid} is served, {', '.join(same_address)} is not; {also}; {what_to_do}"
        )
    if elsewhere:
        notes.append(f"more than one autopilot: {served_sysid} is served, {', '.join(elsewhere)} gets nothing")
    if duplicates:
        notes.append(f"a second sender of system {served_sysid} at {', '.join(duplicates)} is ignored")
    return "; ".join(notes)
