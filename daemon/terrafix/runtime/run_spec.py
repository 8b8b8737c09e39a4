"""Specification of a run, written by the supervisor for its processes and for a supervisor that resumes the run."""

import os
from pathlib import Path

import msgspec

from terrafix import messages
from terrafix.core.config import Config
from terrafix.messages import Message
from terrafix.processes import Process


class ProcessSpec(msgspec.Struct, frozen=True, kw_only=True):
    """One row of the process table, with messages by name."""

    name: str
    module: str
    subscribes: list[str]
    publishes: list[str]
    tick_hz: float
    stuck_after_s: float
    newest: list[str]
    nice: int


class Spec(msgspec.Struct, frozen=True, kw_only=True):
    """The content of one file (spec.json in the run folder), so that all processes read the same settings."""

    table: list[ProcessSpec]
    config: Config
    map_path: str | None
    out_dir: str
    ground_amsl_m: float | None


def spec_of(
    table: tuple[Process, ...], config: Config, map_path: Path | None, out_dir: Path, ground_amsl_m: float | None = None
) -> Spec:
    rows = [
        ProcessSpec(
            name=p.name,
            module=p.module,
            subscribes=_names(p.subscribes),
            publishes=_names(p.publishes),
            tick_hz=p.tick_hz,
            stuck_after_s=p.stuck_after_s,
            newest=_names(p.newest),
            nice=p.nice,
        )
        for p in table
    ]
    package = str(map_path) if map_path else None
    return Spec(table=rows, config=config, map_path=package, out_dir=str(out_dir), ground_amsl_m=ground_amsl_m)


def is_camera(source: str) -> bool:
    """Whether the source is live. A recorded source is not resumed after a restart but starts from its beginning."""
    return source.startswith("/dev/") or not os.path.exists(os.path.expanduser(source))


def table_of(spec: Spec) -> tuple[Process, ...]:
    return tuple(
        Process(
            r.name,
            r.module,
            _kinds(r.subscribes),
            _kinds(r.publishes),
            r.tick_hz,
            r.stuck_after_s,
            _kinds(r.newest),
            r.nice,
        )
        for r in spec.table
    )


def _names(kinds: tuple[type[Message], ...]) -> list[str]:
    return [kind.__name__ for kind in kinds]


def _kinds(names: list[str]) -> tuple[type[Message], ...]:
    return tuple(getattr(messages, name) for name in names)
