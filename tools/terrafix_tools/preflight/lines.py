"""What a check says: one line, with a reason and, where there is one, the fix."""

from enum import StrEnum

import msgspec


class Status(StrEnum):
    OK = "ok"
    WARN = "warn"  # it will fly, less well, or it cannot be seen from here
    FAIL = "fail"  # it will not work, or will end badly


class Change(msgspec.Struct, frozen=True, kw_only=True):
    """A parameter that ``--write`` sets."""

    name: str
    old: float
    new: float


class Line(msgspec.Struct, frozen=True, kw_only=True):
    check: str
    status: Status
    text: str  # what is, and why that is good or bad
    fix: str = ""  # what to do
    change: Change | None = None


def ok(check: str, text: str) -> Line:
    return Line(check=check, status=Status.OK, text=text)


def warn(check: str, text: str, fix: str) -> Line:
    return Line(check=check, status=Status.WARN, text=text, fix=fix)


def fail(check: str, text: str, fix: str) -> Line:
    return Line(check=check, status=Status.FAIL, text=text, fix=fix)


def number(value: float) -> str:
    """A parameter's value as parameter files have it: whole numbers whole, others to the 7 digits of a float32."""
    return str(int(value)) if value == int(value) else f"{value:.7g}"
