"""acceptance.html: one self-contained page. Failed rows come first."""

import json
from pathlib import Path

import msgspec

from terrafix_lab.accept.fly import Result
from terrafix_lab.accept.measuring.results import BELOW_FLOOR, JudgedRow, Verdict, with_unit
from terrafix_lab.accept.table import NAME, Acceptance, markdown
from terrafix_tools.pages.charts import Chart, spans_of
from terrafix_tools.pages.document import Figure, kit, macros, write_file

OWN = macros("terrafix_lab/acceptance.html")
ERROR_FLOOR_M = 0.5  # of the logarithmic axis
ERROR_TOP_M = 2000.0  # the same for all charts, to compare them
WIDTH, HEIGHT = 400, 190  # of one chart, in its own units
STRIP = 6  # height of the source labels under the chart
WORDS = {"satellite_anchored": "map match", "visual_propagated": "odometry", "dead_reckoned": "dead reckoning"}
KEYS = [("k-ink", "error"), ("k-claim", "claimed 95 % radius"), ("k-sat", "map match"), ("k-vis", "odometry")]
KEYS += [("k-dead", "dead reckoning"), ("k-none", "no position")]
MARKS = {
    Verdict.PASS: ("good", "holds"),
    Verdict.BELOW: ("bad", "below floor"),
    Verdict.KNOWN: ("bad", "known shortfall"),
    Verdict.NOT_MEASURABLE: ("none", "–"),
}


def write(acceptance: Acceptance, out: Path) -> None:
    """acceptance.json, acceptance.md, acceptance.html. Raises OutputError."""
    text = {
        "json": json.dumps(msgspec.to_builtins(acceptance), indent=1, allow_nan=False) + "\n",
        "md": markdown(acceptance),
        "html": page(acceptance),
    }
    for suffix, content in text.items():
        write_file(out / f"{NAME}.{suffix}", content, "; choose another --out")


def page(acceptance: Acceptance) -> str:
    """The whole document."""
    parts = (_head(acceptance), _broken(acceptance), _matrix(acceptance), _pictures(acceptance), _rows(acceptance))
    return kit.document(f"Acceptance: {acceptance.flight}", "", *parts)


def _head(acceptance: Acceptance) -> str:
    counts = {verdict: sum(row.verdict is verdict for row in acceptance.rows) for verdict in Verdict}
    shown = [
        Figure(str(sum(bool(r.points) for r in acceptance.results)), "", "scenarios flown"),
        Figure(str(counts[Verdict.PASS]), "", "rows hold their floor", "good"),
        Figure(str(counts[Verdict.BELOW]), "", "rows below their floor", "bad" if counts[Verdict.BELOW] else ""),
        Figure(str(counts[Verdict.KNOWN]), "", "rows below it for a known reason"),
        Figure(str(counts[Verdict.NOT_MEASURABLE]), "", "rows not measurable here"),
    ]
    machine = acceptance.machine
    facts = [
        f"map {acceptance.map}" if acceptance.map else "",
        f"seed {acceptance.seed}" if acceptance.seed is not None else "",
        "quick: short flights" if acceptance.quick else "",
        f"{machine['cpu']}, {machine['cores']} cores",
        f"terrafix {machine['versions'].get('terrafix', '')}",
    ]
    line = " · ".join(fact for fact in facts if fact)
    return kit.header("", "Acceptance", acceptance.flight, line) + kit.figures(shown)


def _broken(acceptance: Acceptance) -> str:
    rows = [row for row in acceptance.rows if row.verdict in BELOW_FLOOR]
    if not rows:
        return kit.section("Every floor that was measured holds", "")
    scenarios = [
        (name, [_broken_row(row) for row in rows if row.scenario == name])
        for name in dict.fromkeys(row.scenario for row in rows)
    ]
    return kit.section("What does not pass", "", OWN.broken(scenarios))


def _broken_row(row: JudgedRow) -> tuple[str, str, str, str]:
    measured = with_unit(row.measured, row.unit) if row.measured is not None else str(row.verdict)
    more = (f", floor {row.floor}" if row.floor else "") + (f"; {row.why}" if row.why else "")
    return row.ac, row.what, measured, more


def _matrix(acceptance: Acceptance) -> str:
    """Scenarios down, requirements across; a cell shows its worst row."""
    columns = sorted({row.ac for row in acceptance.rows}, key=lambda ac: (ac[:2], int(ac.split("-")[1])))
    rows = [
        (name, [_cell([row for row in acceptance.rows if (row.scenario, row.ac) == (name, ac)]) for ac in columns])
        for name in dict.fromkeys(row.scenario for row in acceptance.rows)
    ]
    return kit.section(
        "Scenarios and requirements",
        "Green holds its floor, red does not, grey could not be measured here. A cell shows the worst of its rows; "
        "point at it for all of them.",
        OWN.matrix(columns, rows),
    )


def _cell(rows: list[JudgedRow]) -> tuple[str, str, str] | None:
    """CSS class, tip, text."""
    if not rows:
        return None
    order = (Verdict.BELOW, Verdict.KNOWN, Verdict.PASS, Verdict.NOT_MEASURABLE)
    worst = min(rows, key=lambda row: order.index(row.verdict))
    tip = "\n".join(
        f"{r.what}: {with_unit(r.measured, r.unit)}, {r.verdict}{'; ' + r.why if r.why else ''}" for r in rows
    )
    css, word = MARKS[worst.verdict]
    return css, tip, with_unit(worst.measured, worst.unit) if worst.measured is not None else word


def _pictures(acceptance: Acceptance) -> str:
    return kit.section(
        "Error and claim, scenario by scenario",
        "The line is the error, the shaded area the claimed 95 % radius: a consistent covariance covers the line. "
        "Grey: a fault. Below each picture, where the position came from.",
        OWN.pictures([_picture(result) for result in acceptance.results if result.points]),
        kit.legend(KEYS),
    )


def _picture(result: Result) -> tuple[str, str, str, str, str]:
    """Name, css class and words of its verdict, promise, SVG."""
    zero_s, end_s = result.points[0].t_s, result.points[-1].t_s
    chart = Chart(
        x_max=max(end_s - zero_s, 1.0), y_min=ERROR_FLOOR_M, y_max=ERROR_TOP_M, width=WIDTH, height=HEIGHT, log_y=True,
        follow=False,
    )  # fmt: skip
    for span in result.spans:
        chart.band(span.from_s - zero_s, span.to_s - zero_s, "trouble", span.text)
    claim = [(p.t_s - zero_s, p.radius_m) for p in result.points]
    chart.area(claim, "claim")
    chart.line(claim, "claim")
    chart.level(50.0, "")
    chart.line([(p.t_s - zero_s, p.error_m) for p in result.points], "error")
    labels = spans_of([(p.t_s - zero_s, p.label) for p in result.points], end_s - zero_s)
    for low, high, label in labels:
        chart.bottom_strip(low, high, f"f-{label or 'none'}", WORDS.get(label, "no position"), STRIP)
    broken = sum(row.verdict in BELOW_FLOOR for row in result.rows)
    css, words = ("bad", f"{broken} below floor") if broken else ("good", "holds")
    return result.scenario, css, words, result.promise, chart.svg(f"Error and claim: {result.scenario}")


def _rows(acceptance: Acceptance) -> str:
    columns = ("scenario", "row", "what", "measured", "floor", "goal", "verdict", "")
    rows = []
    for row in acceptance.rows:
        verdict = OWN.verdict(MARKS[row.verdict][0], f"{row.verdict}{', goal met' if row.goal_met else ''}")
        measured = with_unit(row.measured, row.unit)
        rows.append([row.scenario, row.ac, row.what, measured, row.floor, row.goal, verdict, row.why])
    return kit.folded(f"All {len(rows)} rows", kit.table(columns, rows, css="rows"))
