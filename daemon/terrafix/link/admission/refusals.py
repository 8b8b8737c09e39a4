"""Rejected telemetry, reported to the record (MeasurementVerdict), the pilot (STATUSTEXT) and LinkStatus."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

from terrafix.messages import NO_FRAME_ID, MeasurementVerdict, Verdict

REFUSAL_PERIOD_NS = 1_000_000_000  # shortest time between two verdicts for the same reason [tuned]
EPISODE_TIMEOUT_NS = 10_000_000_000  # an episode ends after this time without a rejection [tuned]
# Rejected messages of an episode before the pilot is informed; a gap in the sequence numbers alone costs five. [tuned]
MIN_PILOT_TEXT_MESSAGES = 10


class RejectionReason(StrEnum):
    """The values are published in verdicts and LinkStatus."""

    SENDER = "second sender"  # another address with the autopilot's system id
    SEQUENCE = "sequence"  # sequence number outside of the series
    BOOT_TIME = "boot time"  # step in the time since boot
    ATTITUDE = "attitude"  # turn that the gyroscopes did not measure


PILOT_TEXTS = {  # at most 40 characters; served_autopilot.py has the text for a second sender
    RejectionReason.SEQUENCE: "telemetry of two senders, one ignored",
    RejectionReason.BOOT_TIME: "autopilot rebooted, or its time jumps",
    RejectionReason.ATTITUDE: "attitude jumps without gyros, ignored",
}


@dataclass
class _Episode:
    """Rejections for one reason without a pause of ``EPISODE_TIMEOUT_NS``."""

    detail: str = ""
    newest_ns: int | None = None
    messages: int = 0
    unreported: int = 0  # messages since the last verdict
    reported_ns: int | None = None
    pilot_informed: bool = False


class RejectionLog:
    """Collects rejected messages by reason. ``verdicts`` and ``pilot_texts`` return what is due to be published."""

    def __init__(self) -> None:
        self._episodes: dict[RejectionReason, _Episode] = {}

    def add(self, reason: RejectionReason, detail: str, now_ns: int) -> None:
        episode = self._episodes.get(reason)
        if episode is None or not _is_current(episode, now_ns):
            episode = self._episodes[reason] = _Episode()
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

    def pilot_texts(self) -> Iterator[str]:
        """-> one text per episode."""
        for reason, episode in self._episodes.items():
            if reason in PILOT_TEXTS and episode.messages >= MIN_PILOT_TEXT_MESSAGES and not episode.pilot_informed:
                episode.pilot_informed = True
                yield PILOT_TEXTS[reason]

    def notes(self, now_ns: int) -> Iterator[str]:
        """-> texts for ``LinkStatus`` about the current episodes."""
        for reason, episode in self._episodes.items():
            if reason in PILOT_TEXTS and _is_current(episode, now_ns):
                yield f"telemetry refused, {reason}: {episode.detail}"


def _is_current(episode: _Episode, now_ns: int) -> bool:
    return episode.newest_ns is not None and now_ns - episode.newest_ns < EPISODE_TIMEOUT_NS
