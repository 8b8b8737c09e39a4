"""The record of telemetry that is not believed: a verdict at once for each reason, then one a second with how many."""

from collections.abc import Iterator
from dataclasses import dataclass

from terrafix.messages import MeasurementVerdict, Verdict

EVERY_NS = 1_000_000_000
NO_FRAME = -1


@dataclass
class _Count:
    detail: str
    messages: int = 0
    said_ns: int | None = None


class Refusals:
    """``add`` each message that is refused, ``verdicts`` at every look."""

    def __init__(self) -> None:
        self._counts: dict[str, _Count] = {}

    def add(self, reason: str, detail: str) -> None:
        """``reason``: what is counted together. ``detail``: of this message."""
        count = self._counts.setdefault(reason, _Count(detail))
        count.messages, count.detail = count.messages + 1, detail

    def verdicts(self, now_ns: int) -> Iterator[MeasurementVerdict]:
        for reason, count in self._counts.items():
            if not count.messages or (count.said_ns is not None and now_ns - count.said_ns < EVERY_NS):
                continue
            times = f" ({count.messages} messages)" if count.messages > 1 else ""
            count.messages, count.said_ns = 0, now_ns
            yield MeasurementVerdict(
                t_ns=now_ns,
                frame_id=NO_FRAME,
                measurement="telemetry",
                verdict=Verdict.IMPLAUSIBLE,
                detail=f"{reason}: {count.detail}{times}",
            )
