"""Finds flight records below a folder, or in a bucket."""

import os
import re
import stat
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pyarrow
from pyarrow import fs

from terrafix.core.errors import SourceError

RECORD_NAMES = re.compile(r"flight-\d+\.mcap|flight\.mcap(\.partial)?")  # of the run folders of recorder/reader.py
RECORD_SUFFIXES = (".mcap", ".mcap.partial")
KEYS = re.compile(r"//[^/]*@")  # of the account, in an address
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

    path: str  # for people: absolute path, or address
    root: str  # in the file system
    files: fs.FileSystem

    @property
    def local(self) -> bool:
        return isinstance(self.files, fs.LocalFileSystem)


def open_place(text: str) -> Place:
    """A folder, or an address such as s3://bucket/folder. Raises SourceError: there is no such folder."""
    try:
        place = _place(text)
        kind = place.files.get_file_info(place.root).type
    except (OSError, ValueError, pyarrow.ArrowException) as error:
        shown = KEYS.sub("//", text.partition("?")[0])
        reason = first_line(error).replace(text, shown)
        raise SourceError(f"{shown}: cannot be opened ({reason}); check address and access") from None
    if kind != fs.FileType.Directory:
        reason = "no such folder" if kind == fs.FileType.NotFound else "not a folder"
        raise SourceError(f"{place.path}: {reason}; give a folder or a bucket with flight records below it")
    return place


def _place(text: str) -> Place:
    """The path that is shown and stored is without the keys and options that an address may have."""
    scheme, separator, _ = text.partition("://")
    if separator:
        files, root = fs.FileSystem.from_uri(text)
        return Place(f"{scheme}://{root}".rstrip("/"), root, files)
    root = str(Path(text).absolute())
    return Place(root, root, fs.LocalFileSystem())


def find_records(place: Place) -> tuple[list[Record], list[tuple[str, str]]]:
    """-> all records below a place, by path, and the folders that cannot be listed, with the reason. Links to folders
    are not followed.

    Raises SourceError: there is no record, or a bucket cannot be listed."""
    unlisted: list[tuple[str, str]] = []
    try:
        listed = list(_below_folder(place.root, unlisted) if place.local else _below_bucket(place))
    except OSError as error:
        raise SourceError(f"{place.path}: cannot be listed ({first_line(error)}); check the access") from None
    found = _records(place, listed)
    if not found:
        raise SourceError(f"{place.path}: no flight record below it (flight.mcap, flight-000.mcap, *.mcap)")
    return found, unlisted


@dataclass(frozen=True)
class _File:
    folder: str
    name: str
    size: int
    modified_ns: int


def _below_folder(root: str, unlisted: list[tuple[str, str]]) -> Iterator[_File]:
    """Names that are no text (UTF-8) are kept as Python keeps them, by surrogates."""

    def note(error: OSError) -> None:
        unlisted.append((_shown(error.filename), f"cannot be listed ({error.strerror})"))

    for folder, _, names in os.walk(root, onerror=note):
        for name in names:
            path = os.path.join(folder, name)
            try:
                about = os.stat(path)
            except OSError:  # a link without its file: an error when it is read
                about = os.lstat(path)
            if not stat.S_ISDIR(about.st_mode):
                yield _File(folder, name, about.st_size, about.st_mtime_ns)


def _below_bucket(place: Place) -> Iterator[_File]:
    for info in place.files.get_file_info(fs.FileSelector(place.root, recursive=True)):
        if info.type == fs.FileType.File:
            folder = info.path.rpartition("/")[0]
            yield _File(folder, info.base_name, info.size or 0, info.mtime_ns or 0)


def _records(place: Place, listed: Iterable[_File]) -> list[Record]:
    by_folder: defaultdict[str, list[_File]] = defaultdict(list)
    for file in listed:
        by_folder[file.folder].append(file)
    records = []
    for folder, inside in by_folder.items():
        named = {file.name: file for file in inside}
        run = [] if SOURCE in named else [file for file in inside if RECORD_NAMES.fullmatch(file.name)]
        if run:
            summary = [named[SUMMARY]] if SUMMARY in named else []
            records.append(_record(place, folder, [*run, *summary], run=True))
        alone = [file for file in inside if file.name.endswith(RECORD_SUFFIXES) and file not in run]
        records += [_record(place, folder, [file], run=False) for file in alone]
    return sorted(records, key=lambda record: record.path)


def _record(place: Place, folder: str, files: list[_File], *, run: bool) -> Record:
    path = folder if run else f"{folder}/{files[0].name}"
    below = path.removeprefix(place.root.rstrip("/")).strip("/")
    return Record(
        path=_shown(f"{place.path.rstrip('/')}/{below}".rstrip("/")),
        folder=folder,
        names=tuple(sorted(file.name for file in files)),
        run=run,
        size=sum(file.size for file in files),
        modified_ns=max(file.modified_ns for file in files),
    )


def _shown(path: str) -> str:
    return path.encode("utf-8", "backslashreplace").decode()


def first_line(error: Exception) -> str:
    return _shown(str(error).strip().partition("\n")[0])
