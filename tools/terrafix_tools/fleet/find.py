"""Finds flight records below a folder, or in a bucket."""

import re
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import pyarrow
from pyarrow import fs

from terrafix.core.errors import SourceError

RECORD_NAMES = re.compile(r"flight-\d+\.mcap|flight\.mcap(\.partial)?")  # of the run folders of recorder/reader.py
RECORD_SUFFIXES = (".mcap", ".mcap.partial")
SOURCE = "flight.toml"  # a folder with it is a recorded source, not that of a run
SUMMARY = "summary.json"  # of a replay: has the map


@dataclass(frozen=True)
class Record:
    """The record of a run or replay folder, or a single record file; both may be read again when they have grown."""

    path: str  # for people: absolute path, or address in the bucket
    folder: str  # in the file system
    names: tuple[str, ...]  # files of the record in the folder, and the summary of a replay
    run: bool  # all files of a run or replay folder; False: one file
    size: int  # bytes
    modified_ns: int  # of the newest file


@dataclass(frozen=True)
class Place:
    """A folder or a bucket. ``files`` is picklable, also for workers on other computers."""

    path: str  # for people
    root: str  # in the file system
    files: fs.FileSystem

    @property
    def local(self) -> bool:
        return isinstance(self.files, fs.LocalFileSystem)


def open_place(text: str) -> Place:
    """A folder, or an address such as s3://bucket/folder. Raises SourceError: there is no such folder."""
    try:
        if "://" in text:
            files, root = fs.FileSystem.from_uri(text)
        else:
            files, root = fs.LocalFileSystem(), str(Path(text).absolute())
        place = Place(text.rstrip("/") if "://" in text else root, root, files)
        kind = files.get_file_info(root).type
    except (OSError, ValueError, pyarrow.ArrowException) as error:
        raise SourceError(f"{text}: cannot be opened ({first_line(error)}); check address and access") from None
    if kind != fs.FileType.Directory:
        reason = "no such folder" if kind == fs.FileType.NotFound else "not a folder"
        raise SourceError(f"{text}: {reason}; give a folder or a bucket with flight records below it")
    return place


def find_records(place: Place) -> list[Record]:
    """All records below a place, by path. Raises SourceError when there is none, or when it cannot be listed."""
    try:
        infos = place.files.get_file_info(fs.FileSelector(place.root, recursive=True))
    except OSError as error:
        raise SourceError(f"{place.path}: cannot be listed ({first_line(error)}); check the access") from None
    found = _records(place, (info for info in infos if info.type == fs.FileType.File))
    if not found:
        raise SourceError(f"{place.path}: no flight record below it (flight.mcap, flight-000.mcap, *.mcap)")
    return found


def _records(place: Place, infos: Iterable[fs.FileInfo]) -> list[Record]:
    by_folder: defaultdict[str, list[fs.FileInfo]] = defaultdict(list)
    for info in infos:
        by_folder[info.path.rpartition("/")[0]].append(info)
    records = []
    for folder, inside in by_folder.items():
        named = {info.base_name: info for info in inside}
        run = [] if SOURCE in named else [info for name, info in named.items() if RECORD_NAMES.fullmatch(name)]
        if run:
            summary = [named[SUMMARY]] if SUMMARY in named else []
            records.append(_record(place, folder, [*run, *summary], run=True))
        alone = [info for info in inside if info.base_name.endswith(RECORD_SUFFIXES) and info not in run]
        records += [_record(place, folder, [info], run=False) for info in alone]
    return sorted(records, key=lambda record: record.path)


def _record(place: Place, folder: str, infos: list[fs.FileInfo], *, run: bool) -> Record:
    below = (folder if run else infos[0].path).removeprefix(place.root.rstrip("/")).strip("/")
    return Record(
        path=f"{place.path.rstrip('/')}/{below}".rstrip("/"),
        folder=folder,
        names=tuple(sorted(info.base_name for info in infos)),
        run=run,
        size=sum(info.size for info in infos),
        modified_ns=max(info.mtime_ns or 0 for info in infos),
    )


def first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0]
