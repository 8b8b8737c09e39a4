"""`terrafix preflight`: runs all checks, prints text or JSON, and optionally sets parameters."""

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import typer

from terrafix.core.config import Config, load
from terrafix.core.errors import LinkError, OutputError, UsageError
from terrafix_tools.preflight import computer, ground, position_source, vehicle
from terrafix_tools.preflight.autopilot import Autopilot
from terrafix_tools.preflight.lines import CheckStatus, Line, ParameterChange, fail, number
from terrafix_tools.preflight.parameter_check import check_parameters, parameter_names, proposed_changes
from terrafix_tools.preflight.position_source import changes_to_restore
from terrafix_tools.preflight.rules import Context

MARKS = {CheckStatus.OK: "ok  ", CheckStatus.WARN: "warn", CheckStatus.FAIL: "FAIL"}


class Preflight(msgspec.Struct, frozen=True, kw_only=True):
    """Output of ``--json``. ``ready``: no check failed."""

    ready: bool
    lines: list[Line]
    written: list[ParameterChange] = []
    saved_to: str = ""  # file with the previous values of the written parameters


def preflight(
    configs: list[Path],
    *,
    link: str = "",
    map_path: Path | None = None,
    mission: Path | None = None,
    out: Path = Path("out"),
    write: bool = False,
    restore: bool = False,
    yes: bool = False,
    as_json: bool = False,
    with_computer: bool = True,
) -> bool:
    """Runs and prints all checks; returns True when none failed. ``write``: sets wrong parameters; ``restore``: only
    the source of position that a flight has changed. Raises ConfigError, OutputError, UsageError; LinkError while
    writing.
    """
    if (write or restore) and as_json and not yes:
        raise UsageError("setting parameters needs a confirmation, which --json cannot request; add --yes")
    config = _with_options(load(configs), link, map_path)
    checks = _Checks(mission=mission, choose=changes_to_restore if restore else proposed_changes)
    with tempfile.TemporaryDirectory() as folder:
        try:
            _check_autopilot(
                checks, config, Path(folder), quiet=as_json, write_to=out if write or restore else None, confirmed=yes
            )
        except LinkError as error:
            if checks.written or checks.saved_to:
                raise
            text, _, todo = str(error).partition("; ")
            checks.lines.append(fail("autopilot", text, todo))
            if not as_json:
                show(checks.lines)
        shown = len(checks.lines)
        if with_computer:
            checks.lines += [*ground.check_lines(config.link), *computer.check_lines(config, checks.mission, out)]
    result = checks.result()
    if as_json:
        typer.echo(msgspec.json.format(msgspec.json.encode(result), indent=2).decode())
    else:
        show(checks.lines[shown:])
        _print_summary(result)
    return result.ready


@dataclass
class _Checks:
    """State of a run. ``mission``: mission file to check; None: none is known. ``choose``: which changes to make."""

    mission: Path | None
    choose: Callable[[list[Line]], list[ParameterChange]]
    lines: list[Line] = field(default_factory=list)
    written: list[ParameterChange] = field(default_factory=list)
    saved_to: str = ""

    def result(self) -> Preflight:
        return Preflight(
            ready=all(line.status is not CheckStatus.FAIL for line in self.lines),
            lines=self.lines,
            written=self.written,
            saved_to=self.saved_to,
        )


def _check_autopilot(
    checks: _Checks, config: Config, folder: Path, *, quiet: bool, write_to: Path | None, confirmed: bool
) -> None:
    """Adds the autopilot's lines to ``checks`` and sets wrong parameters if ``write_to`` (folder of the previous
    values) is given. Without a mission file the mission on board is saved in ``folder``. Raises LinkError, UsageError.
    """
    with Autopilot(config.link) as autopilot:
        autopilot.connect()
        if write_to is not None and autopilot.armed:
            raise UsageError("the autopilot is armed; disarm it before parameters are set")
        context, checks.lines = _vehicle_lines(autopilot, config)
        parameters = _parameter_lines(autopilot, context)
        checks.lines += parameters
        if checks.mission is None:
            on_board = folder / "mission on board"
            none = vehicle.save_mission(autopilot, on_board)
            checks.lines += [none] if none is not None else []
            checks.mission = on_board if none is None else None
        if not quiet:
            show(checks.lines)
        changes = checks.choose(parameters)
        if write_to is None or not changes or not (confirmed or _confirmed(changes)):
            return
        checks.saved_to = str(_save(changes, write_to))
        for change in changes:
            autopilot.write(change.name, change.new)
            checks.written.append(change)
        again = _parameter_lines(autopilot, context)
        if not any(line.check == position_source.CHECK for line in again):
            position_source.forget(autopilot.sysid)
        checks.lines = [line for line in checks.lines if line not in parameters] + again
        if not quiet:
            typer.echo("\nRead back from the autopilot:")
            show(again)


def show(lines: list[Line]) -> None:
    for line in lines:
        fix = f" -> {line.fix}" if line.fix else ""
        typer.echo(f"{MARKS[line.status]}  {line.check:<16} {line.text}{fix}")


def _with_options(config: Config, link: str, map_path: Path | None) -> Config:
    """Applies the options of the command line, which override the configuration."""
    if link:
        config = msgspec.structs.replace(config, link=msgspec.structs.replace(config.link, device=link))
    if map_path is not None:
        config = msgspec.structs.replace(config, map=msgspec.structs.replace(config.map, path=str(map_path)))
    return config


def _vehicle_lines(autopilot: Autopilot, config: Config) -> tuple[Context, list[Line]]:
    round_trip_ms = autopilot.round_trip_ms()
    lines = list(vehicle.check_lines(autopilot, config.link, round_trip_ms))
    delay_ms = vehicle.delay_advice_ms(config.link, round_trip_ms)
    firmware = vehicle.firmware_version(autopilot.newest.get(("AUTOPILOT_VERSION", autopilot.sysid)))
    return Context(config.link, autopilot.plane, autopilot.sysid, delay_ms, firmware), lines


def _parameter_lines(autopilot: Autopilot, context: Context) -> list[Line]:
    values = autopilot.read(parameter_names(context))
    return [*position_source.check_lines(autopilot.sysid, values), *check_parameters(values, context)]


def _confirmed(changes: list[ParameterChange]) -> bool:
    typer.echo("\nThese parameters of the autopilot will be set:")
    for change in changes:
        typer.echo(f"  {change.name:<16} {number(change.old)} -> {number(change.new)}")
    return typer.confirm("Set them?", default=False)


def _save(changes: list[ParameterChange], out: Path) -> Path:
    """Saves the previous values as a parameter file before anything is set. Raises OutputError."""
    path = out / f"parameters-before-{time.strftime('%Y%m%d-%H%M%S', time.gmtime())}.param"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(f"{c.name},{number(c.old)}\n" for c in changes), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another --out") from None
    return path


def _print_summary(result: Preflight) -> None:
    count = {status: sum(line.status is status for line in result.lines) for status in CheckStatus}
    if result.written:
        typer.echo(f"\n{len(result.written)} parameters set; their previous values are in {result.saved_to}")
        typer.echo("Restart the autopilot: some take effect only then.")
    typer.echo(
        f"\n{count[CheckStatus.OK]} ok, {_plural(count[CheckStatus.WARN], 'warning')}, "
        f"{_plural(count[CheckStatus.FAIL], 'failure')}"
    )


def _plural(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
