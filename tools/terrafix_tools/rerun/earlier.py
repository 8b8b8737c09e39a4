"""The part of a flight that an ended replay has computed, from its record, which a replay of the rest begins with."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from terrafix.core.errors import SourceError
from terrafix.core.node import Node
from terrafix.messages import Frame, Imu, Message, Origin, SourceEnded, VehicleState
from terrafix.recorder.reader import flight_files, read_flight
from terrafix_tools.in_process import InProcessShell
from terrafix_tools.rerun.frames import OTHERS
from terrafix_tools.rerun.run import is_output

KEPT = "earlier.mcap"  # the record, until the new one has all of it
REBUILT = ("estimator", "smoother")  # by the recorded messages of the others, to the same state
FROM_SOURCE = (VehicleState, Imu, *OTHERS)  # what a source says before a frame


@dataclass(frozen=True)
class EarlierPart:
    """``frames``: number of frames that it has."""

    record: Path
    frames: int

    def steps(self) -> Iterator[list[Message]]:
        """Recorded messages of the origin, then of each frame, without those of the processes in REBUILT."""
        step: list[Message] = []
        for message in _recorded(self.record):
            if isinstance(message, Frame):
                if message.frame_id == self.frames:
                    break
                yield step
                step = []
            step.append(message)
        while step and isinstance(step[-1], FROM_SOURCE):  # of the next frame: its source says them again
            step.pop()
        yield step


def earlier_part(out: Path, most: int) -> EarlierPart | None:
    """Of the replay that was ended in folder ``out``, at most the first ``most`` frames, whose results were stored
    after their messages; None: it has none. Takes the record out of the way of the next replay."""
    kept = out / KEPT
    try:
        if not kept.is_file():
            flight_files(out)[0].replace(kept)
        recorded = 1 + max((m.frame_id for m in _recorded(kept) if isinstance(m, Frame)), default=-1)
    except SourceError:
        return None
    frames = min(most, recorded)
    return EarlierPart(kept, frames) if frames > 0 else None


def begin_with(
    earlier: EarlierPart, nodes: Mapping[str, Node], published: list[Message], step_done: Callable[[], None]
) -> int:
    """Brings the nodes in REBUILT to their state after the earlier part; the others begin as after a restart in flight.
    ``published`` gets the messages of each step, before ``step_done``. -> time of the last frame, ns."""
    rebuilt = {name: node for name, node in nodes.items() if name in REBUILT}
    shell = InProcessShell(rebuilt, lambda _who, message: published.append(message))
    origin: Origin | None = None
    last_ns = 0
    for step in earlier.steps():
        for message in step:
            shell.feed(message)
            origin = message if isinstance(message, Origin) else origin
            last_ns = message.t_ns if isinstance(message, Frame) else last_ns
        step_done()
    assert origin is not None  # a record begins with it
    for name, node in nodes.items():
        if name not in REBUILT:
            published.extend(node.on(origin))
    return last_ns


def _recorded(record: Path) -> Iterator[Message]:
    for _, _, message in read_flight(record):
        if not is_output(message) and not isinstance(message, SourceEnded):
            yield message
