"""`terrafix log cut`, `merge` and `recover`: a new record of a part, of several files, or of what is readable."""

from collections.abc import Callable, Iterator
from pathlib import Path

from terrafix.core.errors import OutputError, SourceError, UsageError
from terrafix.messages import Frame, Message, Origin, SourceFacts
from terrafix.recorder.provenance import copied_header
from terrafix.recorder.reader import (
    ReadResult,
    check_format,
    flight_files,
    read_frame_images,
    read_received,
    read_thumbnails,
)
from terrafix.recorder.writer import FlightWriter

NS = 1_000_000_000

Takes = Callable[[Message, int], bool]  # message and its time on the clock of the record [ns]


def cut(record: Path, out: Path, from_s: float, to_s: float) -> int:
    """Writes the messages between two times since the start of the flight, with its Origin. -> number of messages.

    Raises SourceError, UsageError, OutputError."""
    if not from_s < to_s:
        raise UsageError(f"--from {from_s:g} --to {to_s:g}: the first time must be below the second")
    zero_ns = origin_of(record).t_ns
    written = rewrite([record], out, lambda message, t_ns: from_s <= (t_ns - zero_ns) / NS <= to_s)
    if written <= 1:
        raise SourceError(f"{record}: no message lies between {from_s:g} and {to_s:g} s; see 'terrafix log info'")
    return written


def merge(records: list[Path], out: Path) -> int:
    """Writes all messages of several records of one flight, in the order of the files given, and its Origin once.

    Raises SourceError, also for records of two flights, UsageError, OutputError."""
    origins = {record: origin_of(record) for record in records}
    first, *others = origins.items()
    for record, origin in others:
        if origin != first[1]:
            raise SourceError(f"{record} is of another flight than {first[0]}; merge the files of one flight")
    return rewrite(records, out, lambda message, t_ns: True)


def recover(record: Path, out: Path) -> tuple[int, ReadResult]:
    """Writes what is readable of a damaged record. -> number of messages, and what was damaged."""
    result = ReadResult()
    return rewrite([record], out, lambda message, t_ns: True, result), result


def origin_of(record: Path, result: ReadResult | None = None) -> Origin:
    """Raises SourceError for a record without one. ``result``: gets the header."""
    result = ReadResult() if result is None else result
    for _, _, _, message in read_received(record, result):
        if isinstance(message, Origin):
            return message
    check_format(record, result)
    raise SourceError(f"{record}: the record has no origin of a flight; was the source of the flight opened?")


def rewrite(records: list[Path], out: Path, takes: Takes, result: ReadResult | None = None) -> int:
    """Writes a record of the messages that ``takes`` selects, of each Origin once, and of the images of their
    frames. -> number of messages."""
    header = _header(records[0])
    if out.suffix != ".mcap":
        raise UsageError(f"{out}: a record ends in .mcap; choose another name")
    if any(out.resolve() == file.resolve() for record in records for file in flight_files(record)):
        raise UsageError(f"{out}: this is a file of the record itself; choose another name")
    partial = out.with_name(f"{out.name}.partial")
    writer = FlightWriter(partial, header)
    count = 0
    frames_ns: dict[int, int] = {}
    try:
        for message, t_ns, received_ns in _messages(records, takes, ReadResult() if result is None else result):
            writer.write(message, received_ns)
            count += 1
            if isinstance(message, Frame):
                frames_ns[message.frame_id] = t_ns
        for record in records:
            for frame_id, jpeg in read_thumbnails(record):
                if frame_id in frames_ns:
                    writer.write_thumbnail(frames_ns[frame_id], frame_id, jpeg)
            for image in read_frame_images(record):
                if image.frame_id in frames_ns:
                    writer.write_frame_image(frames_ns[image.frame_id], image.frame_id, image.data, image.image_format)
        writer.close()
        partial.replace(out)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); check the folder and its free space") from None
    return count


def _messages(records: list[Path], takes: Takes, result: ReadResult) -> Iterator[tuple[Message, int, int]]:
    """Yields (message, time, time of reception). A segment repeats Origin and SourceFacts, and merged files may overlap
    by them."""
    repeated: list[Message] = []
    for record in records:
        for _, t_ns, received_ns, message in read_received(record, result):
            if isinstance(message, (Origin, SourceFacts)):
                if message in repeated:
                    continue
                repeated.append(message)
            elif not takes(message, t_ns):
                continue
            yield message, t_ns, received_ns
        check_format(record, result)


def _header(record: Path) -> dict[str, str]:
    """The header of the first file of ``record``, in the present format: its messages are converted when read."""
    result = ReadResult()
    next(read_received(record, result), None)
    check_format(record, result)
    return copied_header(result.header)
