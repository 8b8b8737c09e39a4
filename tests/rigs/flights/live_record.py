"""A record as a live run writes it: the estimator handles its inputs in another order than the recorder receives them,
publishes InputOrder, and may be restarted from its checkpoint."""

from collections.abc import Iterator
from pathlib import Path

from recorded_flight import messages
from simulated_flight import Flight
from terrafix.core.config import Config
from terrafix.messages import MapMatch, Message, VehicleState
from terrafix.recorder.provenance import header
from terrafix.recorder.writer import FlightWriter
from terrafix.runtime.input_order import InputLog
from terrafix.smoother.node import SmootherNode
from terrafix_tools.rerun.estimator import NAME, PROCESS, ReplayedEstimator

LATE = 3  # messages by which the recorder receives telemetry later than the estimator does
MS = 1_000_000


def write(
    path: Path, flight: Flight, *, restart_at: int | None = None, lost: frozenset[int] = frozenset(), order: bool = True
) -> list[Message]:
    """Writes the record and returns what estimator and smoother published.

    ``restart_at``: number of the input before which the estimator was killed and restarted. ``lost``: numbers of inputs
    that the recorder received and the estimator did not. ``order`` False: without InputOrder, as old versions did."""
    published: list[Message] = []
    written: list[tuple[int, Message]] = []
    log, smoother = InputLog(NAME, 1), SmootherNode()
    first, *rest = messages(flight)
    list(smoother.on(first))
    with ReplayedEstimator() as estimator:
        began_ns = 1
        for number, message in enumerate([first, *rest]):
            received_ns = number * MS
            late = isinstance(message, VehicleState | MapMatch)
            written.append((received_ns + (LATE * MS if late else 0), message))
            if number in lost or not isinstance(message, PROCESS.subscribes):
                continue
            if number == restart_at:
                began_ns = 2
                log = InputLog(NAME, began_ns)
                log.add(first)
                estimator.on(first, began_ns)  # the Origin, which the bus sends again
            log.add(message)
            outputs = estimator.on(message, began_ns)
            taken = log.take(received_ns) if outputs else None
            if order and taken is not None:
                written.append((received_ns, taken))
            followed = [given for output in outputs for given in (output, *smoother.on(output))]
            written += [(received_ns, given) for given in followed]
            published += followed
    _write(path, written)
    return published


def _write(path: Path, written: list[tuple[int, Message]]) -> None:
    writer = FlightWriter(path, header(Config()))
    for received_ns, message in sorted(written, key=lambda item: item[0]):
        writer.write(message, received_ns)
    writer.close()


def estimator_messages(recorded: Iterator[tuple[str, int, Message]]) -> list[Message]:
    """-> the messages of a record that estimator and smoother have published, in order."""
    return [message for _, _, message in recorded if isinstance(message, PROCESS.publishes)]
