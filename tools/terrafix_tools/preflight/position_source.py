"""The autopilot's source of position after a flight that ended while it navigated by Terrafix.

`[link] gnss = "act"` changes GPS_AUTO_SWITCH and GPS_PRIMARY in flight, and these survive a power cycle. What they were
is in a file until the autopilot has it again (terrafix.link.gnss.previous_source)."""

from collections.abc import Iterable, Iterator

from terrafix.core.state_folder import state_folder
from terrafix.link.gnss.previous_source import PreviousSourceFile
from terrafix_tools.preflight.lines import CheckStatus, Line, ParameterChange, number
from terrafix_tools.preflight.rules import Values

CHECK = "position source"
NAMES = ("GPS_AUTO_SWITCH", "GPS_PRIMARY")


def check_lines(sysid: int, values: Values) -> Iterator[Line]:
    """Yields a failure for each parameter that is not what it was before Terrafix changed it."""
    for name, before in _previous(sysid).items():
        now = values.get(name)
        if now is not None and now != before:
            yield Line(
                check=CHECK,
                status=CheckStatus.FAIL,
                text=f"{name} is {number(now)} since a flight that ended on Terrafix; it was {number(before)}",
                fix="terrafix preflight --restore, or start Terrafix, which restores it while disarmed",
                change=ParameterChange(name=name, old=now, new=before),
            )


def changes_to_restore(lines: Iterable[Line]) -> list[ParameterChange]:
    """-> changes back to what was before; for an autopilot of which no file says that, to what the rules want."""
    lines = list(lines)
    known = [line.change for line in lines if line.check == CHECK and line.change is not None]
    return known or [line.change for line in lines if line.check in NAMES and line.change is not None]


def forget(sysid: int) -> None:
    """The autopilot has again what it had before."""
    if _previous(sysid):
        PreviousSourceFile(state_folder()).remove()


def _previous(sysid: int) -> dict[str, float]:
    previous = PreviousSourceFile(state_folder()).load()
    return previous.parameters if previous is not None and previous.sysid == sysid else {}
