"""The outcomes of a fault matrix as text, and as a table in a page of the documentation."""

import re
import statistics
import textwrap
from collections.abc import Sequence
from pathlib import Path

from terrafix.core.errors import OutputError, SourceError
from terrafix_lab.chaos.verdict import NO_FIX, Outcome
from terrafix_lab.faults.fault import Phase
from terrafix_lab.faults.table import FAULTS, MATRIX
from terrafix_tools.report.text import GAP_S

# A dark cell is without effect up to this time from the last black image to a fix.
DARK_BACK_S = 1.5  # [measured: at most 1.4 s in docs/faults.md, of faults without an effect in the other phases]


def line(outcome: Outcome) -> str:
    """One line for the terminal."""
    worst = "-" if outcome.worst_sigmas is None else f"{outcome.worst_sigmas:.1f}"
    figures = {
        "silence": _s(outcome.silence_s),
        "without fix": _s(outcome.without_fix_s),
        "lost": str(outcome.fix_lost),
        "back after": _s(outcome.back_s),
        "worst": f"{worst} sigma",
        "not recorded": _s(outcome.not_recorded_s),
        "stop": _s(outcome.stop_s),
    }
    shown = ", ".join(f"{name} {value}" for name, value in {**figures, **outcome.criteria}.items())
    return f"{outcome.fault:28} {outcome.phase:21} {shown}: {outcome.verdict}"


def cell(outcome: Outcome | None) -> str:
    """Silence/time to a fix, in seconds; a broken promise in words; empty: no effect."""
    if outcome is None or outcome.verdict == NO_FIX:
        return "-"
    if outcome.silence_s is None:
        return outcome.verdict
    if is_without_effect(outcome):
        return ""
    back = "-" if outcome.back_s is None else f"{outcome.back_s:.1f}"
    figures = f"{outcome.silence_s:.1f}/{back}"
    return figures if outcome.verdict == "ok" else f"{figures} **{outcome.verdict}**"


def is_without_effect(outcome: Outcome) -> bool:
    """GPS_INPUT kept its interval, and no fix was lost but the one of the dark."""
    if outcome.verdict != "ok" or outcome.silence_s is None or outcome.back_s is None:
        return False
    return outcome.silence_s <= GAP_S and outcome.back_s <= (DARK_BACK_S if outcome.phase is Phase.DARK else 0.0)


def table(outcomes: Sequence[Outcome]) -> str:
    """Faults with an effect by phases, of the phases of which there is any outcome; the names of the other faults that
    were flown, and of those of MATRIX that were not; a line that sums all cells up."""
    flown = [o for o in outcomes if o.verdict != NO_FIX]
    phases = [phase for phase in Phase if any(o.phase == phase for o in outcomes)]
    rows = [f"| fault | {' | '.join(phases)} |", f"|---|{'---|' * len(phases)}"]
    quiet, missing = [], []
    for fault in FAULTS.values():
        of = {o.phase: o for o in flown if o.fault == fault.name}
        if not of:
            missing += [fault.name] if fault in MATRIX else []
        elif len(of) == len(phases) and all(is_without_effect(o) for o in of.values()):
            quiet.append(fault.name)
        else:
            rows.append(
                f"| {fault.name} |" + "".join(f" {cell(of.get(phase))} |" for phase in phases).replace("  ", " ")
            )
    notes = [
        f"{what}: {_grouped(names)}." for what, names in (("Without effect", quiet), ("Not flown", missing)) if names
    ]
    return "\n".join([*rows, "", *notes, *([""] if notes else []), _sum([o for o in flown if o.silence_s is not None])])


def _grouped(names: Sequence[str]) -> str:
    """Names of the form "part: fault" by what comes before the colon, in lines of a page."""
    parts: dict[str, list[str]] = {}
    for name in names:
        part, colon, fault = name.partition(": ")
        parts.setdefault(part, []).extend([fault] if colon else [])
    text = "; ".join(f"{part}: {', '.join(faults)}" if faults else part for part, faults in parts.items())
    return "\n".join(textwrap.wrap(text, 140))


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
