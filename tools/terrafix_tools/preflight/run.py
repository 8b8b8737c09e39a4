"""`terrafix preflight`: every check, what it says to people and programs, and the parameters that it may set."""

import tempfile
import time
from pathlib import Path

import msgspec
import typer

from terrafix.core.config import Config, load
from terrafix.core.errors import LinkError, OutputError, UsageError
from terrafix_tools.preflight import computer, ground, vehicle
from terrafix_tools.preflight.autopilot import Autopilot
from terrafix_tools.preflight.judge import changes_of, judge, names_of
from terrafix_tools.preflight.lines import Change, Line, Status, fail, number
from terrafix_tools.preflight.rules import Context

MARKS = {Status.OK: "ok  ", Status.WARN: "warn", Status.FAIL: "FAIL"}


class Preflight(msgspec.Struct, frozen=True, kw_only=True):
    """What ``--json`` prints. ``ready``: nothing failed."""

    ready: bool
    lines: list[Line]
    written: list[Change] = []
    saved_to: str = ""  # the old values of what was written


def preflight(
    configs: list[Path],
    *,
    link: str = "",
    map_path: Path | None = None,
    mission: Path | None = None,
    out: Path = Path("out"),
    write: bool = False,
    yes: bool = False,
    as_json: bool = False,
    with_computer: bool = True,
) -> bool:
    """Prints every line. -> nothing failed. Raises ConfigError, OutputError, UsageError; LinkError in writing."""
    if write and as_json and not yes:
        raise UsageError("--write asks before it sets anything, which --json cannot; add --yes")
    config = _configured(load(configs), link, map_path)
    lines, written, saved_to = [], [], ""
    with tempfile.TemporaryDirectory() as folder:
        try:
            with Autopilot(config.link) as autopilot:
                autopilot.connect()
                if write and autopilot.armed:
                    raise UsageError("the autopilot is armed; disarm it before parameters are set")
                of_vehicle = list(_of_vehicle(autopilot, config))
                lines += of_vehicle
                if mission is None:
                    on_board = Path(folder) / "mission on board"
                    none = vehicle.save_mission(autopilot, on_board)
                    lines += [none] if none is not None else []
                    mission = on_board if none is None else None
                if not as_json:
                    show(lines)
                changes = changes_of(of_vehicle)
                if write and changes and (yes or _confirmed(changes)):
                    saved_to = str(_save(changes, out))
                    for change in changes:
                        autopilot.write(change.name, change.new)
                        written.append(change)
        except LinkError as error:
            if written or saved_to:
                raise
            text, _, todo = str(error).partition("; ")
            lines.append(fail("autopilot", text, todo))
            if not as_json:
                show(lines)
        shown = len(lines)
        if with_computer:
            lines += [*ground.about(config.link), *computer.about(config, mission, out)]
    said = Preflight(
        ready=all(
            line.status is not Status.FAIL for line in lines if line.change not in written or line.change is None
        ),
        lines=lines,
        written=written,
        saved_to=saved_to,
    )
    if as_json:
        typer.echo(msgspec.json.format(msgspec.json.encode(said), indent=2).decode())
    else:
        show(lines[shown:])
        _conclude(said)
    return said.ready


def show(lines: list[Line]) -> None:
    for line in lines:
        fix = f" -> {line.fix}" if line.fix else ""
        typer.echo(f"{MARKS[line.status]}  {line.check:<16} {line.text}{fix}")


def _configured(config: Config, link: str, map_path: Path | None) -> Config:
    """The command line wins."""
    if link:
        config = msgspec.structs.replace(config, link=msgspec.structs.replace(config.link, device=link))
    if map_path is not None:
        config = msgspec.structs.replace(config, map=msgspec.structs.replace(config.map, path=str(map_path)))
    return config


def _of_vehicle(autopilot: Autopilot, config: Config) -> list[Line]:
    round_trip_ms = autopilot.round_trip_ms()
    lines = list(vehicle.about(autopilot, config.link, round_trip_ms))
    delay_ms = vehicle.delay_advice_ms(config.link, round_trip_ms)
    firmware = vehicle.firmware_of(autopilot.newest.get(("AUTOPILOT_VERSION", autopilot.sysid)))
    context = Context(config.link, autopilot.plane, autopilot.sysid, delay_ms, firmware)
    return lines + list(judge(autopilot.read(names_of(context)), context))


def _confirmed(changes: list[Change]) -> bool:
    typer.echo("\nThese parameters of the autopilot would be set:")
    for change in changes:
        typer.echo(f"  {change.name:<16} {number(change.old)} -> {number(change.new)}")
    return typer.confirm("Set them?", default=False)


def _save(changes: list[Change], out: Path) -> Path:
    """The old values as a parameter file, before anything is set. Raises OutputError."""
    path = out / f"parameters-before-{time.strftime('%Y%m%d-%H%M%S', time.gmtime())}.param"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(f"{c.name},{number(c.old)}\n" for c in changes), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another --out") from None
    return path


def _conclude(said: Preflight) -> None:
    count = {status: sum(line.status is status for line in said.lines) for status in Status}
    if said.written:
        typer.echo(f"\n{len(said.written)} parameters set; their old values are in {said.saved_to}")
        typer.echo("Restart the autopilot, and run this again.")
    typer.echo(
        f"\n{count[Status.OK]} ok, {_many(count[Status.WARN], 'warning')}, {_many(count[Status.FAIL], 'failure')}"
    )


def _many(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
