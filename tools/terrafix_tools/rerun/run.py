"""Replays estimator and smoother from a flight record, and writes the same files as the replay of a source."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.console import Console

from terrafix.core.config import RecorderSection
from terrafix.core.errors import SourceError, UsageError
from terrafix.messages import InputOrder, MeasurementVerdict, Message, Origin
from terrafix.recorder.provenance import copied_header, device, versions
from terrafix.recorder.reader import ReadResult, check_format, flight_files, read_received
from terrafix_tools.replay_output import RECORD, ReplayOutput
from terrafix_tools.rerun.estimator import NAME, PROCESS, ReplayedEstimator
from terrafix_tools.rerun.ordered_inputs import OrderedInputs
from terrafix_tools.rerun.smoother import ReplayedSmoother

# Measurements of the MeasurementVerdicts that the link publishes; all others are the estimator's.
LINK_MEASUREMENTS = ("estimate", "wall clock", "telemetry")


def replay_record(record: Path, out: Path, *, progress: bool = False) -> dict[str, Any]:
    """Writes estimates.csv, flight.mcap and summary.json into ``out`` and returns the summary.

    Messages of estimator and smoother are computed again, all others are those of ``record`` (a file, or a folder of
    replay or run). Raises SourceError, UsageError, OutputError."""
    began_s = time.perf_counter()
    first, recorded_order = _examine(record)
    if any(file.resolve() == (out / RECORD).resolve() for file in first.files):
        raise UsageError(f"{out}: this folder has the record that is to be replayed; give another folder with --out")
    result = ReadResult()
    header = copied_header(first.header, versions=versions(), device=device())
    with ReplayOutput(out, header, RecorderSection()) as output, ReplayedEstimator() as estimator:
        inputs, smoother = OrderedInputs(NAME), ReplayedSmoother(first.header["config"])
        source = _recorded_order(record, result) if recorded_order else _input_order(record, result, inputs)
        for message, began_ns in source:
            if began_ns is None:
                output.take([message, *smoother.on(message)])
            else:
                for published in estimator.on(message, began_ns):
                    output.take([published, *smoother.on(published)])
        output.copy_images(record)
        summary = {
            "flight": record.resolve().name,
            "source": str(record),
            "record": {
                "files": [file.name for file in result.files],
                "cut_off": [file.name for file in result.truncated_files],
                "undecodable": result.undecodable,
                "input_order": not recorded_order,
                "missing_inputs": inputs.missing,
                "undelivered_inputs": inputs.undelivered,
                "restarts": estimator.restarts + smoother.restarts,
            },
            "config": first.header["config"],
            "versions": versions(),
            **output.counts(),
            "wall_s": round(time.perf_counter() - began_s, 2),
        }
        output.finish(summary)
    if progress:
        for line in _last_lines(summary, out):
            Console(stderr=True).print(line, markup=False, highlight=False)
    return summary


def _examine(record: Path) -> tuple[ReadResult, bool]:
    """-> what the record is, and whether it has to be replayed in the order of reception, for want of an InputOrder.

    Raises SourceError."""
    result = ReadResult()
    origin = ordered = False
    for _, _, message in _messages(record, result):
        origin = origin or isinstance(message, Origin)
        ordered = ordered or isinstance(message, InputOrder)
        if origin and ordered:
            break
    check_format(record, result)
    if not origin:
        raise SourceError(f"{record}: the record has no origin of a flight; was the source of the flight opened?")
    result.files = flight_files(record)
    return result, not ordered


def _recorded_order(record: Path, result: ReadResult) -> Iterator[tuple[Message, int | None]]:
    """-> the messages of the record without those of the estimator, each followed by itself as an input."""
    for _, _, message in _messages(record, result):
        if not is_output(message):
            yield message, None
        if isinstance(message, PROCESS.subscribes):
            yield message, 0


def _input_order(record: Path, result: ReadResult, inputs: OrderedInputs) -> Iterator[tuple[Message, int | None]]:
    """-> (message, None) for each message of the record without those of the estimator, and (message, began_ns) for
    each input at its turn."""
    for _, received_ns, message in _messages(record, result):
        if not is_output(message):
            yield message, None
        if isinstance(message, PROCESS.subscribes):
            inputs.put(message, received_ns)
        elif isinstance(message, InputOrder):
            inputs.order(message, received_ns)
        for began_ns, delivered in inputs.take(received_ns):
            yield delivered, began_ns
    for began_ns, delivered in inputs.finish():
        yield delivered, began_ns


def _messages(record: Path, result: ReadResult) -> Iterator[tuple[int, int, Message]]:
    for _, log_ns, received_ns, message in read_received(record, result):
        yield log_ns, received_ns, message


def is_output(message: Message) -> bool:
    """Whether estimator or smoother have published ``message``. Their InputOrder stays: the replay follows it."""
    if isinstance(message, MeasurementVerdict):
        return message.measurement not in LINK_MEASUREMENTS
    return isinstance(message, PROCESS.publishes) and not isinstance(message, InputOrder)


def _last_lines(summary: dict[str, Any], out: Path) -> Iterator[str]:
    """Lines of the summary for the user."""
    record = summary["record"]
    for name in record["cut_off"]:
        yield f"{name} ends in the middle of a record: what came before was replayed."
    if record["undecodable"]:
        yield f"{record['undecodable']} messages are of another version of this program, and were left out."
    if record["missing_inputs"]:
        yield (
            f"{record['missing_inputs']} messages that the estimator used are not in the record: the replay differs "
            "from the flight from there on."
        )
    yield f"{summary['localised']} of {summary['frames']} frames localised; written to {out}"
    yield summary["verdict"]["text"]
