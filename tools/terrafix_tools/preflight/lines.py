"""Result of a check: one line with a reason and, if there is one, a fix."""

from enum import StrEnum

import msgspec


class CheckStatus(StrEnum):
    OK = "ok"
    WARN = "warn"  # flight possible with reduced performance, or the state cannot be determined from here
    FAIL = "fail"  # will not work, or is unsafe


class ParameterChange(msgspec.Struct, frozen=True, kw_only=True):
    """A parameter change that ``--write`` applies."""

    name: str
    old: float
    new: float


class Line(msgspec.Struct, frozen=True, kw_only=True):
    check: str
    status: CheckStatus
    text: str  # current state, and why that is good or bad
    fix: str = ""  # remedy
    change: ParameterChange | None = None


def ok(check: str, text: str) -> Line:
    return Line(check=check, status=CheckStatus.OK, text=text)


def warn(check: str, text: str, fix: str) -> Line:
    return Line(check=check, status=CheckStatus.WARN, text=text, fix=fix)


def fail(check: str, text: str, fix: str) -> Line:
    return Line(check=check, status=CheckStatus.FAIL, text=text, fix=fix)


def number(value: float) -> str:
    """Formats a parameter as in parameter files: integers without fraction, others with the 7 digits of a float32."""
    return str(int(value)) if value == int(value) else f"{value:.7g}"
