"""What is left of a record after kill -9 of the recorder and after truncation.

python -m terrafix_tools.bench.record_damage RECORD OUT [--kills N] [--cuts N] [--json FILE]

Kills: the messages of RECORD are handed to the recorder of a live run, in a process of its own, as fast as in flight.
The process is killed at a random moment. Lost is the time between the last message that was handed over and the last
one that is read. Cuts: RECORD is truncated at random places; everything in chunks that end before the cut, by the index
of the reference reader, has to be read. After each, the messages are the first ones of RECORD, and export, comparison
and report work."""

import multiprocessing
import random
import shutil
import time
from dataclasses import asdict, dataclass
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from mcap.reader import make_reader

from terrafix.core.config import Config
from terrafix.core.errors import OutputError, TerrafixError
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.node import NodeContext
from terrafix.messages import Message, Origin
from terrafix.recorder.node import make_edge
from terrafix.recorder.reader import flight_files, read_received
from terrafix_tools.bench.result_file import write_result
from terrafix_tools.compare.alignment import read_record
from terrafix_tools.compare.difference import compare_records
from terrafix_tools.log.export import export
from terrafix_tools.report.page import report
from terrafix_tools.standalone import run_standalone

NS = 1e9
SEED = 3
KILL_S = (1.0, 5.0)  # shortest and longest life of a recorder
Received = list[tuple[int, Message]]


@dataclass(frozen=True)
class Damage:
    """``lost_s``: of the worst and the median case. ``usable``: cases after which all commands worked."""

    cases: int
    lost_s_median: float
    lost_s_max: float
    altered: int  # cases in which a message differs from that of the record
    usable: int


def kills(record: Path, out: Path, count: int) -> Damage:
    received = _received(record)
    choice = random.Random(SEED)
    lost_s, altered, usable = [], 0, 0
    for i in range(count):
        folder = out / f"kill-{i:02d}"
        handed = multiprocessing.get_context("spawn").Value("q", 0)
        process = multiprocessing.get_context("spawn").Process(target=_record, args=(record, folder, handed))
        process.start()
        while handed.value == 0:
            time.sleep(0.01)
        time.sleep(choice.uniform(*KILL_S))
        process.kill()
        process.join()
        left = _received(folder)
        lost_s.append((handed.value - left[-1][0]) / NS)
        altered += not _is_beginning(left, received)
        usable += _works(folder, record)
    return _damage(lost_s, altered, usable)


def cuts(record: Path, out: Path, count: int) -> Damage:
    (file,) = flight_files(record)
    received = _received(record)
    data, chunk_ends = file.read_bytes(), _chunk_ends(file)
    choice = random.Random(SEED)
    lost_s, altered, usable = [], 0, 0
    for i in range(count):
        folder = out / f"cut-{i:02d}"
        folder.mkdir(parents=True)
        size = choice.randrange(chunk_ends[1][0], len(data))
        (folder / "flight-000.mcap").write_bytes(data[:size])
        left = _received(folder)
        promised_ns = max(end_ns for offset, end_ns in chunk_ends if offset <= size)
        lost_s.append(max(0.0, (promised_ns - max(message.t_ns for _, message in left)) / NS))
        altered += not _is_beginning(left, received)
        usable += _works(folder, record)
    return _damage(lost_s, altered, usable)


def _record(record: Path, folder: Path, handed: "Synchronized[int]") -> None:
    """Records as in flight until it is killed."""
    received = _received(record)
    edge = make_edge(NodeContext(Config(), MemoryFrameStore(1), None, folder))
    began_s, first_ns = time.perf_counter(), received[0][0]
    for received_ns, message in received:
        time.sleep(max(0.0, (received_ns - first_ns) / NS - (time.perf_counter() - began_s)))
        edge.poll(max(1, received_ns))
        edge.on_message(message)
        handed.value = max(1, received_ns)


def _received(path: Path) -> Received:
    return [(received_ns, message) for _, _, received_ns, message in read_received(path)]


def _is_beginning(left: Received, whole: Received) -> bool:
    """Whether the messages of ``left``, without a repeated Origin, are the first ones of ``whole``."""
    messages = [message for _, message in left if not isinstance(message, Origin)]
    return messages == [message for _, message in whole if not isinstance(message, Origin)][: len(messages)]


def _works(folder: Path, record: Path) -> bool:
    try:
        export(folder, folder / "track.csv")
        compare_records(read_record(folder), read_record(record))
        report(folder)
    except TerrafixError as error:
        typer.echo(f"{folder}: {error}", err=True)
        return False
    return True


def _chunk_ends(file: Path) -> list[tuple[int, int]]:
    """(offset of its end, time of its last message [ns]) of each chunk with messages, by the reference reader."""
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    ends = [(chunk.chunk_start_offset + chunk.chunk_length, chunk.message_end_time) for chunk in summary.chunk_indexes]
    return sorted(end for end in ends if end[1] > 0)


def _damage(lost_s: list[float], altered: int, usable: int) -> Damage:
    return Damage(
        cases=len(lost_s),
        lost_s_median=round(float(np.median(lost_s)), 3),
        lost_s_max=round(max(lost_s), 3),
        altered=altered,
        usable=usable,
    )


def bench(
    record: Annotated[Path, typer.Argument(help="Record file, or folder with one.")],
    out: Annotated[Path, typer.Argument(help="New folder for the damaged copies; removed at the end.")],
    kills_wanted: Annotated[int, typer.Option("--kills", help="Number of kills.")] = 50,
    cuts_wanted: Annotated[int, typer.Option("--cuts", help="Number of truncations.")] = 50,
    json_path: Annotated[Path | None, typer.Option("--json", help="File for the numbers of the table.")] = None,
) -> None:
    """Measure what kill -9 and truncation leave of a record."""
    if out.exists():
        raise OutputError(f"{out}: exists; give a new folder")
    try:
        result = {"cuts": asdict(cuts(record, out, cuts_wanted)), "kills": asdict(kills(record, out, kills_wanted))}
    finally:
        shutil.rmtree(out, ignore_errors=True)
    write_result(json_path, result)
    typer.echo("damage    cases  lost s, median     max  altered  usable")
    for name, row in result.items():
        typer.echo(
            f"{name:10}{row['cases']:5}{row['lost_s_median']:16.3f}{row['lost_s_max']:8.3f}{row['altered']:9}"
            f"{row['usable']:8}"
        )


if __name__ == "__main__":
    run_standalone("record_damage", bench)
