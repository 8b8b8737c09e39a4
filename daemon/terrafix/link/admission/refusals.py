"""Rejected telemetry, reported to the record (MeasurementVerdict), as a fault by its cause and in LinkStatus."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

from terrafix.link.pilot_text.statustext import ATTITUDE_JUMPS, TIME_JUMPS, TWO_SENDERS
from terrafix.messages import NO_FRAME_ID, CalibrationFault, MeasurementVerdict, Verdict

REFUSAL_PERIOD_NS = 1_000_000_000  # shortest time between two verdicts for the same reason [tuned]
EPISODE_TIMEOUT_NS = 10_000_000_000  # an episode ends after this time without a rejection [tuned]
# Rejected messages of an episode before it is a fault; a gap in the sequence numbers alone costs five. [tuned]
MIN_FAULT_MESSAGES = 10


class RejectionReason(StrEnum):
    """The values are published in verdicts and LinkStatus."""

    SENDER = "second sender"  # another address with the autopilot's system id
    SEQUENCE = "sequence"  # sequence number outside of the series
    BOOT_TIME = "boot time"  # step in the time since boot
    ATTITUDE = "attitude"  # turn that the gyroscopes did not measure


QUANTITIES = {  # of the faults; served_autopilot.py has the text for a second sender
    RejectionReason.SEQUENCE: TWO_SENDERS,
    RejectionReason.BOOT_TIME: TIME_JUMPS,
    RejectionReason.ATTITUDE: ATTITUDE_JUMPS,
}


@dataclass
class _Episode:
    """Rejections for one reason without a pause of ``EPISODE_TIMEOUT_NS``."""

    first_ns: int
    newest_ns: int
    detail: str = ""
    messages: int = 0
    unreported: int = 0  # messages since the last verdict
    reported_ns: int | None = None
    is_fault: bool = False


class RejectionLog:
    """Collects rejected messages by reason. ``verdicts`` and ``faults`` return what is due to be published."""

    def __init__(self) -> None:
        self._episodes: dict[RejectionReason, _Episode] = {}

    def add(self, reason: RejectionReason, detail: str, now_ns: int) -> None:
        episode = self._episodes.get(reason)
        if episode is None or not _is_current(episode, now_ns):
            episode = self._episodes[reason] = _Episode(
                now_ns, now_ns, is_fault=episode is not None and episode.is_fault
            )
        episode.detail, episode.newest_ns = detail, now_ns
        episode.messages, episode.unreported = episode.messages + 1, episode.unreported + 1

    def verdicts(self, now_ns: int) -> Iterator[MeasurementVerdict]:
        """-> one verdict per reason: at its first rejection, then at most one per second with the message count."""
        for reason, episode in self._episodes.items():
            if not episode.unreported or (
                episode.reported_ns is not None and now_ns - episode.reported_ns < REFUSAL_PERIOD_NS
            ):
                continue
            times = f" ({episode.unreported} messages)" if episode.unreported > 1 else ""
            episode.unreported, episode.reported_ns = 0, now_ns
            yield MeasurementVerdict(
                t_ns=now_ns,
                frame_id=NO_FRAME_ID,
                measurement="telemetry",
                verdict=Verdict.IMPLAUSIBLE,
                detail=f"{reason}: {episode.detail}{times}",
            )

    def faults(self, now_ns: int) -> Iterator[CalibrationFault]:
        """-> the faults that begin or end: one per episode, from its first rejection to its newest one."""
        for reason, episode in self._episodes.items():
            active = episode.messages >= MIN_FAULT_MESSAGES and _is_current(episode, now_ns)
            if reason not in QUANTITIES or active == episode.is_fault:
                continue
            episode.is_fault = active
            t_ns, detail = (episode.first_ns if active else episode.newest_ns), episode.detail
            yield CalibrationFault(t_ns=t_ns, quantity=QUANTITIES[reason], factor=None, detail=detail, active=active)

    def notes(self, now_ns: int) -> Iterator[str]:
        """-> texts for ``LinkStatus`` about the current episodes."""
        for reason, episode in self._episodes.items():
            if reason in QUANTITIES and _is_current(episode, now_ns):
                yield f"telemetry refused, {reason}: {episode.detail}"


def _is_current(episode: _Episode, now_ns: int) -> bool:
    return now_ns - episode.newest_ns < EPISODE_TIMEOUT_NS
