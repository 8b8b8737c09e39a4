"""The whole table: rows of all scenarios and rows over all of them; acceptance.md."""

import statistics
from typing import Any

import msgspec

from terrafix.core.gate import CHI2_95
from terrafix_lab.accept.fly import Result
from terrafix_lab.accept.known_shortfalls import KNOWN_SHORTFALLS, explained, holding_again
from terrafix_lab.accept.measuring.consistency import COVERAGE, RUN_CONFIDENCE, judge_claims
from terrafix_lab.accept.measuring.results import Bounds, JudgedRow, Verdict, with_unit
from terrafix_tools.timing import machine

NAME = "acceptance"
OVERALL = "all scenarios"
MAX_WIDTH = Bounds(high=2.0)  # published 1-sigma over that of the error
MIN_FLIGHTS = 5  # with fewer the median of the widths says little


class Acceptance(msgspec.Struct, frozen=True, kw_only=True):
    """Content of acceptance.json."""

    flight: str
    map: str
    quick: bool
    seed: int | None
    machine: dict[str, Any]
    broken: int  # rows below their floor that are no known shortfall
    rows: list[JudgedRow]
    hold_again: list[str]  # known shortfalls whose floor holds in this run
    results: list[Result]


def conclude(
    results: list[Result], *, flight: str, map_path: str, quick: bool, seed: int | None, whole: bool
) -> Acceptance:
    """``seed``: of the generated world, where each scenario has a map error of its own; None: a given flight.
    ``whole``: all scenarios were selected; adds the rows that belong to no scenario."""
    overall = [_coverage_row(results, one_map=seed is None), _width_row(results)]
    overall += _not_replayable() if whole else []
    known = {} if seed is None else KNOWN_SHORTFALLS
    results = [
        msgspec.structs.replace(result, rows=[explained(row, known) for row in result.rows]) for result in results
    ]
    rows = [row for result in results for row in result.rows] + [explained(row, known) for row in overall]
    return Acceptance(
        flight=flight,
        map=map_path,
        quick=quick,
        seed=seed,
        machine=machine(),
        broken=sum(row.verdict is Verdict.BELOW for row in rows),
        rows=rows,
        hold_again=holding_again(rows, known),
        results=results,
    )


def _coverage_row(results: list[Result], *, one_map: bool) -> JudgedRow:
    """AC-13 over all flights: every flight counts once, because its errors are correlated.

    ``one_map``: all flights are over the same map with the same error, one draw together."""
    flown = [r.nees for r in results if r.nees]
    row = {
        "scenario": OVERALL,
        "ac": "AC-13",
        "what": "truth inside the 95 % ellipse, every flight counted once",
        "unit": "%",
        "floor": COVERAGE.text("%"),
        "goal": "",
        "goal_met": None,
    }
    if not flown:
        why = "no flight with truth and true inputs"
        return JudgedRow(**row, measured=None, verdict=Verdict.NOT_MEASURABLE, why=why)  # type: ignore[arg-type]
    inside = sum(sum(v <= CHI2_95 for v in nees) / len(nees) for nees in flown) / len(flown)
    mean = sum(sum(nees) / len(nees) for nees in flown) / len(flown)
    verdict, why = judge_claims(inside, mean, 1 if one_map else len(flown), RUN_CONFIDENCE)
    why = f"{len(flown)} flights; {why}"
    return JudgedRow(**row, measured=round(inside, 6), verdict=verdict, why=why)  # type: ignore[arg-type]


def _width_row(results: list[Result]) -> JudgedRow:
    """Median over all flights of published over real 1-sigma, where inputs are true."""
    widths = [r.claim_width for r in results if r.claim_width is not None]
    row = {
        "scenario": OVERALL,
        "ac": "AC-13",
        "what": "claimed 1-sigma over that of the error, median of the flights",
        "unit": "",
        "floor": MAX_WIDTH.text(""),
        "goal": "",
        "goal_met": None,
    }
    if len(widths) < MIN_FLIGHTS:
        why = f"{len(widths)} flights: too few to judge; {MIN_FLIGHTS} are the least that can tell"
        return JudgedRow(**row, measured=None, verdict=Verdict.NOT_MEASURABLE, why=why)  # type: ignore[arg-type]
    width = statistics.median(widths)
    verdict = Verdict.PASS if MAX_WIDTH.holds(width) else Verdict.BELOW
    why = f"{len(widths)} flights, {min(widths):.1f} to {max(widths):.1f}"
    return JudgedRow(**row, measured=round(width, 6), verdict=verdict, why=why)  # type: ignore[arg-type]


def _not_replayable() -> list[JudgedRow]:
    """Rows that a replay cannot measure."""
    return [
        JudgedRow(
            scenario=OVERALL, ac="AC-17", what="object in a frame to position", measured=None, unit="m",
            floor="<= 20 m", goal="", verdict=Verdict.NOT_MEASURABLE, goal_met=None,
            why="needs objects with known positions: python -m terrafix_lab.bench.locate"),
    ]  # fmt: skip


def markdown(acceptance: Acceptance) -> str:
    """The table, row by row."""
    lines = [
        f"# Acceptance: {acceptance.flight}",
        "",
        f"{headline(acceptance)}",
        "",
        "| scenario | row | what | measured | floor | goal | verdict | |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in acceptance.rows:
        verdict = row.verdict + (", goal met" if row.goal_met else "")
        verdict = f"**{verdict}**" if row.verdict is Verdict.BELOW else verdict
        cells = (
            row.scenario,
            row.ac,
            row.what,
            with_unit(row.measured, row.unit),
            row.floor,
            row.goal,
            verdict,
            row.why,
        )
        lines.append("| " + " | ".join(cell.replace("|", "/") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def headline(acceptance: Acceptance) -> str:
    """One line: number of rows by verdict, and the known shortfalls that hold again."""
    counts = {verdict: sum(row.verdict is verdict for row in acceptance.rows) for verdict in Verdict}
    flown = sum(bool(result.points) for result in acceptance.results)
    words = ", ".join(f"{count} {verdict}" for verdict, count in counts.items() if count)
    again = "; ".join(acceptance.hold_again)
    again = f" Known shortfalls that hold again (see accept/known_shortfalls.py): {again}." if again else ""
    return f"{flown} scenarios flown: {words}.{again}"
