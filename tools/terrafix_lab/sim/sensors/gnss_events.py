"""GNSS events of a flight: outage, jamming, spoofing; defined in a TOML file or in code."""

import math
import tomllib
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from terrafix.core.errors import SourceError
from terrafix.core.toml_file import read_toml

NotNegative = Annotated[float, Meta(ge=0.0)]


class Event(msgspec.Struct, frozen=True, kw_only=True, tag_field="kind", forbid_unknown_fields=True):
    """An event from ``start_s`` to ``end_s`` (absent: to the end of the flight)."""

    start_s: NotNegative
    end_s: NotNegative | None = None

    def on(self, t_s: float) -> bool:
        return t_s >= self.start_s and (self.end_s is None or t_s < self.end_s)


class Outage(Event, frozen=True, kw_only=True, tag="outage"):
    """Immediate loss of all signals, as under a roof."""


class Jam(Event, frozen=True, kw_only=True, tag="jam"):
    """The carrier-to-noise ratio falls: accuracies grow, satellites are lost, and after ``fade_s`` there is no fix."""

    fade_s: NotNegative = 8.0


class Jump(Event, frozen=True, kw_only=True, tag="jump"):
    """Spoofing with a step: the position jumps from one fix to the next."""

    east_m: float = 300.0
    north_m: float = 0.0


class Drag(Event, frozen=True, kw_only=True, tag="drag"):
    """Spoofing with a ramp: the position starts correct and drifts away, with a consistent velocity."""

    east_mps: float = 2.0
    north_mps: float = 0.0


AnyEvent = Outage | Jam | Jump | Drag


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    gnss: tuple[AnyEvent, ...] = ()


def read_events(path: Path) -> tuple[AnyEvent, ...]:
    """Reads a TOML file with ``[[gnss]]`` tables, each with a ``kind`` and the fields of that event. Raises
    SourceError.
    """
    try:
        table = read_toml(path)
        read = msgspec.convert(table, _File)
    except FileNotFoundError:
        raise SourceError(f"{path}: no such file; check --events") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise SourceError(f"{path}: cannot be read as TOML ({error})") from None
    except msgspec.ValidationError as error:
        raise SourceError(f"{path}: {error}; kinds are outage, jam, jump, drag, each with start_s") from None
    for number, event in enumerate(read.gnss, start=1):
        values = [value for value in msgspec.structs.astuple(event) if value is not None]
        if not all(math.isfinite(value) for value in values):
            raise SourceError(f"{path}: [[gnss]] number {number} contains nan or inf; write numbers")
        if event.end_s is not None and event.end_s <= event.start_s:
            raise SourceError(
                f"{path}: [[gnss]] number {number} ends at {event.end_s:g} s, before it starts ({event.start_s:g} s)"
            )
    return read.gnss
