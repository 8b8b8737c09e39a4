"""The outcomes of a fault matrix as text, and as a table in a page of the documentation."""

import re
import statistics
from collections.abc import Sequence
from pathlib import Path

from terrafix.core.errors import OutputError, SourceError
from terrafix_lab.chaos.verdict import NO_FIX, Outcome
from terrafix_lab.faults.fault import Phase
from terrafix_lab.faults.table import FAULTS, MATRIX


def line(outcome: Outcome) -> str:
    """One line for the terminal."""
    worst = "-" if outcome.worst_sigmas is None else f"{outcome.worst_sigmas:.1f}"
    figures = {
        "silence": _s(outcome.silence_s),
        "without fix": _s(outcome.without_fix_s),
        "back after": _s(outcome.back_s),
        "worst": f"{worst} sigma",
        "not recorded": _s(outcome.not_recorded_s),
        "stop": _s(outcome.stop_s),
    }
    shown = ", ".join(f"{name} {value}" for name, value in {**figures, **outcome.criteria}.items())
    return f"{outcome.fault:28} {outcome.phase:21} {shown}: {outcome.verdict}"


def cell(outcome: Outcome | None) -> str:
    """Silence, and time without a fix, in seconds; a broken promise in words."""
    if outcome is None or outcome.verdict == NO_FIX:
        return "-"
    if outcome.silence_s is None:
        return outcome.verdict
    figures = f"{_s(outcome.silence_s)}, {_s(outcome.back_s)}"
    return figures if outcome.verdict == "ok" else f"{figures} **{outcome.verdict}**"


def table(outcomes: Sequence[Outcome]) -> str:
    """Faults by phases (those of MATRIX, others if flown; phases of which there is any outcome), and a line that sums
    all cells up."""
    found = {(o.fault, o.phase): o for o in outcomes}
    phases = [phase for phase in Phase if any(o.phase == phase for o in outcomes)]
    rows = [f"| fault | {' | '.join(phases)} |", f"|---|{'---|' * len(phases)}"]
    for fault in FAULTS.values():
        if fault not in MATRIX and not any((fault.name, phase) in found for phase in phases):
            continue
        cells = (cell(found.get((fault.name, phase))) for phase in phases)
        rows.append(f"| {fault.name} | {' | '.join(cells)} |")
    return "\n".join([*rows, "", _sum([o for o in outcomes if o.silence_s is not None and o.verdict != NO_FIX])])


def _sum(flown: Sequence[Outcome]) -> str:
    fixes, wrong = sum(o.fixes for o in flown), sum(o.wrong for o in flown)
    text = f"{len(flown)} cells with {fixes} positions, {wrong} of them wrong"
    sigmas = [o.worst_sigmas for o in flown if o.worst_sigmas is not None]
    loads = [o.load for o in flown if o.load is not None]
    if sigmas:
        text += f"; the worst error is {max(sigmas):.1f} times its horiz_accuracy"
    if loads:
        text += f"; load average per core {statistics.median(loads):.1f} in the median, at most {max(loads):.1f}"
    return text + "."


def write_table(page: Path, outcomes: Sequence[Outcome], name: str = "chaos") -> None:
    """Replaces the table between the marks of a page: ``<!-- table: NAME -->`` and ``<!-- end -->``. Raises
    SourceError, OutputError."""
    marks = re.compile(rf"(<!-- table: {re.escape(name)} -->).*?(<!-- end -->)", re.S)
    try:
        text, count = marks.subn(lambda m: f"{m[1]}\n{table(outcomes)}\n{m[2]}", page.read_text(encoding="utf-8"))
    except OSError as error:
        raise SourceError(f"{page}: cannot be read ({error.strerror})") from None
    if count != 1:
        raise SourceError(f"{page}: has no marks '<!-- table: {name} -->' and '<!-- end -->' for the table")
    try:
        page.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{page}: cannot be written ({error.strerror})") from None


def _s(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f} s"
