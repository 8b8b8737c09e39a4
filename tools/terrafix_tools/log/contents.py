"""`terrafix log info` and `check`: contents and damage of a record."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from terrafix.messages import Frame, Message, NavEstimate, Origin, WallClock
from terrafix.recorder.reader import ReadResult, check_format, read_received

NS = 1_000_000_000
CHECKSUM_DIGITS = 12  # that are shown


@dataclass
class Contents:
    """What one pass over a record finds. Times in ns on the clock of the record."""

    path: Path
    result: ReadResult
    counts: Counter[str] = field(default_factory=Counter)
    first_ns: int | None = None
    last_ns: int = 0
    origin: Origin | None = None
    unix_offset_ns: int | None = None  # Unix time minus the clock of the record
    frames: set[int] = field(default_factory=set)
    localised: set[int] = field(default_factory=set)

    def take(self, t_ns: int, message: Message) -> None:
        """Takes the next message of the record, whose time is ``t_ns``."""
        self.counts[type(message).__name__] += 1
        if isinstance(message, Origin):
            self.origin = self.origin or message
            return
        self.first_ns = t_ns if self.first_ns is None else min(self.first_ns, t_ns)
        self.last_ns = max(self.last_ns, t_ns)
        if isinstance(message, Frame):
            self.frames.add(message.frame_id)
        elif isinstance(message, NavEstimate) and message.is_placed:
            self.localised.add(message.frame_id)
        elif isinstance(message, WallClock) and message.unix_ns is not None:
            self.unix_offset_ns = message.unix_ns - message.t_ns

    @property
    def duration_s(self) -> float:
        return 0.0 if self.first_ns is None else (self.last_ns - self.first_ns) / NS

    @property
    def start_utc(self) -> str | None:
        """Wall clock time of the first message; None when no clock was plausible in flight."""
        if self.unix_offset_ns is None or self.first_ns is None:
            return None
        return datetime.fromtimestamp((self.first_ns + self.unix_offset_ns) / NS, UTC).isoformat(timespec="seconds")

    @property
    def damage(self) -> list[str]:
        return damage_of(self.result)


def damage_of(result: ReadResult) -> list[str]:
    """One line for each thing that is wrong with a record."""
    lines = [f"{line}: left out" for line in result.damaged]
    lines += [f"{file.name}: ends in the middle of a record" for file in result.truncated_files]
    if result.undecodable:
        lines.append(f"{result.undecodable} messages are of another version of this program: left out")
    return lines


def read_contents(path: Path) -> Contents:
    """Reads a record: a file, or the folder of a replay or run. Raises SourceError."""
    found = Contents(path, ReadResult())
    for _, t_ns, _, message in read_received(path, found.result):
        found.take(t_ns, message)
    check_format(path, found.result)
    return found


def as_json(found: Contents) -> dict[str, Any]:
    header, origin = found.result.header, found.origin
    return {
        "path": str(found.path),
        "files": [{"name": file.name, "bytes": file.stat().st_size} for file in found.result.files],
        "format": header["format"],
        "versions": header["versions"],
        "source": header["config"].get("source", {}).get("path", ""),
        "map": header.get("map", {}).get("path", "") or header["config"].get("map", {}).get("path", ""),
        "map_checksum": header.get("map", {}).get("checksum", ""),
        "models": header.get("models", {}),
        "device": header.get("device", {}),
        "calibration": header.get("calibration", {}),
        "start_utc": found.start_utc,
        "duration_s": round(found.duration_s, 3),
        "start": None if origin is None else {"lat_deg": origin.lat_deg, "lon_deg": origin.lon_deg},
        "frames": len(found.frames),
        "localised": len(found.localised),
        "messages": dict(sorted(found.counts.items())),
        "damage": found.damage,
    }


def info_lines(found: Contents) -> Iterator[str]:
    """Lines for a terminal."""
    about = as_json(found)
    size_mb = sum(file["bytes"] for file in about["files"]) / 1e6
    yield f"{found.path}: {len(about['files'])} files, {size_mb:.1f} MB, format {about['format']}"
    version = about["versions"]
    yield f"terrafix {version.get('terrafix', '?')} {version.get('git', '')}, {version.get('platform', '')}"
    yield f"duration {about['duration_s']:.1f} s, start {about['start_utc'] or 'at an unknown time of day'}"
    if about["start"] is not None:
        yield f"from {about['start']['lat_deg']:.6f}, {about['start']['lon_deg']:.6f}"
    if about["source"]:
        yield f"source {about['source']}"
    if about["map"]:
        checksum = about["map_checksum"][:CHECKSUM_DIGITS]
        yield f"map {about['map']}" + (f", checksum {checksum}" if checksum else "")
    for slot, model in about["models"].items():
        yield f"model {slot}: {model['path']}, sha256 {model['sha256'][:CHECKSUM_DIGITS] or 'unknown'}"
    if about["device"]:
        yield "computer " + ", ".join(filter(None, (about["device"].get(key, "") for key in ("product", "processor"))))
    yield f"{about['localised']} of {about['frames']} frames localised"
    for kind, count in about["messages"].items():
        rate = count / found.duration_s if found.duration_s > 0 else 0.0
        yield f"  {kind:<22} {count:>8}  {rate:8.2f} Hz"
    yield from found.damage
