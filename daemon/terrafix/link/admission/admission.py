"""Which packets are heard, and as whose: who speaks (served_autopilot.py), and whether what is said contradicts
itself."""

from collections.abc import Iterator
from typing import Any

from terrafix.core.config import LinkSection
from terrafix.link.admission.refusals import Reason, Refusals
from terrafix.link.admission.served_autopilot import Role, Served, note, pilot_text
from terrafix.link.admission.telemetry_check import TelemetryCheck
from terrafix.link.autopilot.checkpoint import LinkCheckpoint
from terrafix.link.mavlink.transport import Address
from terrafix.messages import MeasurementVerdict


class Admission:
    """``take`` every packet of the autopilot's link. ``reboots``: of the autopilot, since this link began."""

    def __init__(self, config: LinkSection, *, listens: bool, found: LinkCheckpoint | None) -> None:
        """``listens``, ``found``: see Served."""
        self.served = Served(config.autopilot_sysid, listens=listens, found=found)
        self.reboots = 0
        self._named = bool(config.autopilot_sysid)
        self._check = TelemetryCheck()
        self._checked = (self.served.sysid, self.served.address)  # whose
        self._refusals = Refusals()

    def take(self, message: Any, sender: Address | None, now_ns: int) -> Role:
        served = self.served
        role = served.take(message, sender, now_ns)
        if role is Role.REFUSED and message.get_srcSystem() == served.sysid and sender is not None:
            self._refusals.add(Reason.SENDER, f"system {served.sysid} at {sender[0]}:{sender[1]}", now_ns)
        return Role.CONTRADICTS if role is Role.AUTOPILOT and self._contradicts(message, now_ns) else role

    def verdicts(self, now_ns: int) -> Iterator[MeasurementVerdict]:
        return self._refusals.verdicts(now_ns)

    def pilot_texts(self, now_ns: int) -> Iterator[str]:
        """Of what is new since the last call, at most 40 characters each."""
        for other in self.served.warnings(now_ns):
            yield pilot_text(other, self.served.sysid)
        yield from self._refusals.pilot_texts()

    def notes(self, now_ns: int) -> Iterator[str]:
        """For LinkStatus; an empty one says nothing."""
        yield note(self.served.others(now_ns), self.served.sysid, named=self._named)
        yield from self._refusals.notes(now_ns)

    def _contradicts(self, message: Any, now_ns: int) -> bool:
        """The autopilot, or who passes for it, contradicts what it has said before."""
        whose = (self.served.sysid, self.served.address)
        if whose != self._checked:
            self._checked, self._check = whose, TelemetryCheck()
        reboots = self._check.reboots
        why = self._check.refuses(message, now_ns)
        if why is not None:
            self._refusals.add(*why, now_ns)
        self.reboots += self._check.reboots - reboots
        return why is not None
