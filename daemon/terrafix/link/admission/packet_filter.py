"""Admission of packets on the autopilot's link: classifies the sender (``ServedAutopilot``) and rejects telemetry that
contradicts earlier telemetry (``TelemetryCheck``)."""

from collections.abc import Iterator
from typing import Any

from terrafix.core.clock import NS_PER_S
from terrafix.core.config import LinkSection
from terrafix.link.admission.refusals import RejectionLog, RejectionReason
from terrafix.link.admission.served_autopilot import (
    Role,
    ServedAutopilot,
    camera_texts,
    change_text,
    pilot_text,
    status_note,
    unclear_text,
)
from terrafix.link.admission.telemetry_check import TelemetryCheck
from terrafix.link.autopilot.checkpoint import LinkCheckpoint
from terrafix.link.mavlink.transport import Address
from terrafix.messages import CalibrationFault, MeasurementVerdict

UNCLEAR_TEXT_NS = 30 * NS_PER_S  # between two texts that name the vehicles [spec: as of prior_request.py]


class Admission:
    """Classifies every packet of the autopilot's link. ``reboots``: reboots of the autopilot since this link began."""

    def __init__(self, config: LinkSection, *, is_listening: bool, checkpoint: LinkCheckpoint | None) -> None:
        """``is_listening``, ``checkpoint``: see ``ServedAutopilot``."""
        self.served = ServedAutopilot(config.autopilot_sysid, is_listening=is_listening, checkpoint=checkpoint)
        self.reboots = 0
        self._reported_sysid = self.served.sysid  # of the served autopilot
        self._sysid_configured = bool(config.autopilot_sysid)
        self._unclear_text_ns: int | None = None  # time of the last text that names the candidates; None: it is clear
        self._check = TelemetryCheck()
        self._checked_sender = (self.served.sysid, self.served.address)  # of the packets that _check has seen
        self._rejections = RejectionLog()

    def classify(self, message: Any, sender: Address | None, now_ns: int) -> Role:
        """-> role of the sender. A packet rejected for its content, or from a second sender, is recorded."""
        served = self.served
        role = served.classify(message, sender, now_ns)
        if role is Role.REJECTED and message.get_srcSystem() == served.sysid and sender is not None:
            self._rejections.add(RejectionReason.SENDER, f"system {served.sysid} at {sender[0]}:{sender[1]}", now_ns)
        return Role.INCONSISTENT if role is Role.AUTOPILOT and self._is_inconsistent(message, now_ns) else role

    def rejections(self, now_ns: int) -> Iterator[MeasurementVerdict | CalibrationFault]:
        yield from self._rejections.verdicts(now_ns)
        yield from self._rejections.faults(now_ns)

    def pilot_texts(self, now_ns: int) -> Iterator[str]:
        """-> warnings that are new since the last call, at most 40 characters each."""
        if self.served.sysid != self._reported_sysid:
            if self._reported_sysid:
                yield change_text(self._reported_sysid, self.served.sysid)
            self._reported_sysid = self.served.sysid
        yield from self._camera_texts(now_ns)
        if self._unclear_text_ns is None:
            for other in self.served.new_others(now_ns):
                yield pilot_text(other, self.served.sysid)

    def notes(self, now_ns: int) -> Iterator[str]:
        """-> texts for ``LinkStatus``; may be empty strings."""
        if self.served.is_contested(now_ns):
            named = ", ".join(map(str, sorted(self.served.candidates(now_ns))))
            what_to_do = "no position is sent until one turns as the images do; name yours in link.autopilot_sysid"
            yield f"the camera may be on vehicle {named}: {what_to_do}"
        else:
            yield status_note(self.served.others(now_ns), self.served.sysid, sysid_configured=self._sysid_configured)
        yield from self._rejections.notes(now_ns)

    def _camera_texts(self, now_ns: int) -> Iterator[str]:
        """-> texts when it becomes unclear which vehicle carries the camera, every 30 s while it is, and when it is
        known."""
        if self.served.is_contested(now_ns):
            if self._unclear_text_ns is None or now_ns - self._unclear_text_ns >= UNCLEAR_TEXT_NS:
                self._unclear_text_ns = now_ns
                yield unclear_text(self.served.candidates(now_ns))
        elif self._unclear_text_ns is not None:
            self._unclear_text_ns = None
            if self.served.confirmed:
                yield from camera_texts(self.served.sysid)

    def _is_inconsistent(self, message: Any, now_ns: int) -> bool:
        """True if a packet of the autopilot, or of a sender with its id and address, contradicts earlier packets."""
        sender_identity = (self.served.sysid, self.served.address)
        if sender_identity != self._checked_sender:
            self._checked_sender, self._check = sender_identity, TelemetryCheck()
        reboots = self._check.reboots
        why = self._check.rejection(message, now_ns)
        if why is not None:
            self._rejections.add(*why, now_ns)
        self.reboots += self._check.reboots - reboots
        return why is not None
