"""Table of many flights: one line per scenario and place, and one per scenario over all places."""

import statistics
from collections.abc import Callable
from dataclasses import dataclass

import msgspec

from terrafix_lab.accept.fly import Result
from terrafix_lab.accept.measuring.criteria import CRITERIA
from terrafix_lab.accept.measuring.results import JudgedRow, Verdict, with_unit
from terrafix_lab.accept.run import AcceptOptions
from terrafix_lab.accept.table import Acceptance

NEVER = "never"


@dataclass(frozen=True)
class Case:
    """One flight, with which all scenarios are flown."""

    name: str
    options: AcceptOptions


class CaseLine(msgspec.Struct, frozen=True, kw_only=True):
    """One scenario over one place. None: not measured. ``why``: the reason if nothing was measured."""

    scenario: str
    place: str
    frames: int
    within_20m: float | None  # share
    false_fixes: float | None  # total
    late_false_fixes: float | None  # later than the allowed detection time
    notice_s: float | None  # from the start of the false input to the last false fix
    recovery_frames: float | None
    never_recovered: bool
    claim_width: float | None
    broken: int  # rows below their floor
    why: str = ""


def lines_of(case: Case, acceptance: Acceptance) -> list[CaseLine]:
    return [_line(case.name, result) for result in acceptance.results]


def _line(place: str, result: Result) -> CaseLine:
    rows = {row.what: row for row in result.rows}

    def value(*names: str) -> float | None:
        """Of the first of these criteria in the scenario's rows."""
        return next((rows[CRITERIA[n].what].measured for n in names if CRITERIA[n].what in rows), None)

    recovery: JudgedRow | None = rows.get(CRITERIA["recovery"].what)
    return CaseLine(
        scenario=result.scenario,
        place=place,
        frames=result.frames,
        within_20m=value("within 20 m", "near at all"),
        false_fixes=value("false fixes in all", "false fixes"),
        late_false_fixes=value("late false fixes", "false fixes"),
        notice_s=value("time to notice"),
        recovery_frames=value("recovery"),
        never_recovered=recovery is not None and recovery.measured is None and recovery.verdict is Verdict.BELOW,
        claim_width=value("claim width"),
        broken=sum(row.verdict is Verdict.BELOW for row in result.rows),
        why="" if result.frames else result.rows[0].why,
    )


def markdown(lines: list[CaseLine]) -> str:
    """First the table over all places, then that of each flight."""
    names = list(dict.fromkeys(line.scenario for line in lines))
    head = ("frames", "within 20 m", "false", "late false", "to notice", "recovery", "claim", "broken")
    return "\n".join(
        [
            "# Lies",
            "",
            "Late: later than 3 s and 5 frames into the lie. To notice: from its beginning to the last false fix.",
            "Recovery: frames after its end, worst. Claim: claimed 1-sigma over that of the error, median.",
            "",
            *_table(("scenario", "flights", *head), [_pooled(n, [x for x in lines if x.scenario == n]) for n in names]),
            "",
            *_table(("scenario", "place", *head), [_one(line) for line in lines]),
            "",
        ]
    )


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    return ["| " + " | ".join(cells) + " |" for cells in (head, ("---",) * len(head), *rows)]


def _pooled(name: str, lines: list[CaseLine]) -> tuple[str, ...]:
    flown = [line for line in lines if line.frames]
    frames = sum(line.frames for line in flown)
    within = sum((line.within_20m or 0.0) * line.frames for line in flown) / frames if frames else None
    never = sum(line.never_recovered for line in flown)
    recovery = _over(max, [line.recovery_frames for line in flown], "")
    return (
        name,
        str(len(flown)),
        str(frames),
        with_unit(within, "%"),
        _over(sum, [line.false_fixes for line in flown], ""),
        _over(sum, [line.late_false_fixes for line in flown], ""),
        _over(max, [line.notice_s for line in flown], "s"),
        f"{recovery}, {never} {NEVER}" if never else recovery,
        _over(statistics.median, [line.claim_width for line in flown], ""),
        f"{sum(line.broken > 0 for line in flown)} of {len(flown)}",
    )


def _one(line: CaseLine) -> tuple[str, ...]:
    if not line.frames:
        return (line.scenario, line.place, f"not flown: {line.why}", *[""] * 7)
    return (
        line.scenario,
        line.place,
        str(line.frames),
        with_unit(line.within_20m, "%"),
        with_unit(line.false_fixes, ""),
        with_unit(line.late_false_fixes, ""),
        with_unit(line.notice_s, "s"),
        NEVER if line.never_recovered else with_unit(line.recovery_frames, ""),
        with_unit(line.claim_width, ""),
        str(line.broken),
    )


def _over(how: Callable[[list[float]], float], values: list[float | None], unit: str) -> str:
    known = [value for value in values if value is not None]
    return with_unit(how(known) if known else None, unit)
