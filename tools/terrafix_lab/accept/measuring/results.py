"""Result of one acceptance number: measured value, floor, goal, verdict. Terms as in docs/acceptance.md."""

from dataclasses import dataclass
from enum import StrEnum

import msgspec

from terrafix_lab.faults.edits import Span


class Verdict(StrEnum):
    PASS = "pass"
    BELOW = "below floor"
    KNOWN = "known shortfall"  # below its floor, with a reason in known_shortfalls.py
    NOT_MEASURABLE = "not measurable here"


BELOW_FLOOR = (Verdict.BELOW, Verdict.KNOWN)


@dataclass(frozen=True)
class Bounds:
    """Limits of a number, both included; None: no limit on that side."""

    low: float | None = None
    high: float | None = None

    def holds(self, value: float) -> bool:
        return (self.low is None or value >= self.low) and (self.high is None or value <= self.high)

    def text(self, unit: str) -> str:
        """ ">= 80 %", "<= 50 m", "93 to 98 %", "0"."""
        if self.low is not None and self.high is not None:
            if self.low == self.high:
                return with_unit(self.low, unit)
            low = with_unit(self.low, "%" if unit == "%" else "").removesuffix(" %")
            return f"{low} to {with_unit(self.high, unit)}"
        if self.low is not None:
            return f">= {with_unit(self.low, unit)}"
        return f"<= {with_unit(self.high, unit)}"


class Marks(msgspec.Struct, frozen=True, kw_only=True):
    """Faults that a scenario put into the flight, for criteria and charts."""

    spans: tuple[Span, ...] = ()
    wrong_files: frozenset[str] = frozenset()  # frames that are foreign, or have a wrong map fix
    breaks_s: tuple[float, ...] = ()  # the first frame after each gap in the overlap
    lie: Span | None = None  # span with a false input; None: all inputs are true (they may be missing)


@dataclass(frozen=True)
class Measured:
    """One number of a flight. ``value`` None: not measurable, or ``verdict`` has the result."""

    value: float | None
    why: str = ""
    verdict: Verdict | None = None


class JudgedRow(msgspec.Struct, frozen=True, kw_only=True):
    """One line of the table."""

    scenario: str
    ac: str
    what: str
    measured: float | None
    unit: str  # "%", "m", "s", "ms", "px", "MB" or ""; shares are 0..1
    floor: str
    goal: str
    verdict: Verdict
    goal_met: bool | None  # None: no goal beyond the floor, or nothing measured
    why: str = ""


def with_unit(value: float | None, unit: str) -> str:
    """A number with its unit; shares as per cent."""
    if value is None:
        return "-"
    if unit == "%":
        return f"{_short(100 * value)} %"
    return f"{_short(value)} {unit}".strip()


def _short(value: float) -> str:
    if abs(value - round(value)) < 1e-9:
        return f"{round(value)}"
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"
