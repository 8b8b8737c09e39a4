"""Telemetry that is not believed, for the record, the pilot and LinkStatus."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

from terrafix.messages import MeasurementVerdict, Verdict

EVERY_NS = 1_000_000_000  # between two verdicts for the same reason
EPISODE_NS = 10_000_000_000  # without a refusal: it is over
MANY = 10  # messages of an episode that are worth a word to the pilot; a gap in the numbers costs five
NO_FRAME = -1


class Reason(StrEnum):
    SENDER = "second sender"  # another address with the autopilot's system id
    SEQUENCE = "sequence"  # packet numbers that do not go on
    BOOT_TIME = "boot time"
    ATTITUDE = "attitude"


PILOT_TEXTS = {  # at most 40 characters; of a second sender served_autopilot.py tells
    Reason.SEQUENCE: "telemetry of two senders, one ignored",
    Reason.BOOT_TIME: "autopilot rebooted, or its time jumps",
    Reason.ATTITUDE: "attitude jumps without gyros, ignored",
}


@dataclass
class _Episode:
    detail: str = ""
    newest_ns: int | None = None
    messages: int = 0
    unsaid: int = 0  # messages since the last verdict
    said_ns: int | None = None
    told: bool = False  # the pilot was


class Refusals:
    """``add`` each message that is refused; ``verdicts`` and ``pilot_texts`` at every look."""

    def __init__(self) -> None:
        self._episodes: dict[Reason, _Episode] = {}

    def add(self, reason: Reason, detail: str, now_ns: int) -> None:
        episode = self._episodes.get(reason)
        if episode is None or not _goes_on(episode, now_ns):
            episode = self._episodes[reason] = _Episode()
        episode.detail, episode.newest_ns = detail, now_ns
        episode.messages, episode.unsaid = episode.messages + 1, episode.unsaid + 1

    def verdicts(self, now_ns: int) -> Iterator[MeasurementVerdict]:
        """At once for each reason, then one a second with how many messages it stands for."""
        for reason, episode in self._episodes.items():
            if not episode.unsaid or (episode.said_ns is not None and now_ns - episode.said_ns < EVERY_NS):
                continue
            times = f" ({episode.unsaid} messages)" if episode.unsaid > 1 else ""
            episode.unsaid, episode.said_ns = 0, now_ns
            yield MeasurementVerdict(
                t_ns=now_ns,
                frame_id=NO_FRAME,
                measurement="telemetry",
                verdict=Verdict.IMPLAUSIBLE,
                detail=f"{reason}: {episode.detail}{times}",
            )

    def pilot_texts(self) -> Iterator[str]:
        """Once an episode."""
        for reason, episode in self._episodes.items():
            if reason in PILOT_TEXTS and episode.messages >= MANY and not episode.told:
                episode.told = True
                yield PILOT_TEXTS[reason]

    def notes(self, now_ns: int) -> Iterator[str]:
        """For LinkStatus."""
        for reason, episode in self._episodes.items():
            if reason in PILOT_TEXTS and _goes_on(episode, now_ns):
                yield f"telemetry refused, {reason}: {episode.detail}"


def _goes_on(episode: _Episode, now_ns: int) -> bool:
    return episode.newest_ns is not None and now_ns - episode.newest_ns < EPISODE_NS
