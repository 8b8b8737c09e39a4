"""acceptance.html: one self-contained page. Failed rows come first."""

import json
from html import escape
from pathlib import Path

import msgspec

from terrafix_tools.accept.fly import Result
from terrafix_tools.accept.measuring.results import BROKEN, JudgedRow, Verdict, with_unit
from terrafix_tools.accept.table import NAME, Acceptance, markdown
from terrafix_tools.pages.charts import Chart, spans_of
from terrafix_tools.pages.document import (
    Figure,
    Html,
    document,
    figures,
    folded,
    header,
    legend,
    scroll,
    section,
    table,
    write_file,
)

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
    Verdict.NOT_BUILT: ("bad", "not built"),
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
    flown = [result for result in acceptance.results if result.points]
    return document(
        f"Acceptance: {acceptance.flight}",
        f"{_head(acceptance)}{_broken(acceptance)}{_matrix(acceptance)}{_pictures(flown)}{_rows(acceptance)}",
    )


def _head(acceptance: Acceptance) -> str:
    counts = {verdict: sum(row.verdict is verdict for row in acceptance.rows) for verdict in Verdict}
    shown = [
        Figure(str(sum(bool(r.points) for r in acceptance.results)), "", "scenarios flown"),
        Figure(str(counts[Verdict.PASS]), "", "rows hold their floor", "good"),
        Figure(str(counts[Verdict.BELOW]), "", "rows below their floor", "bad" if counts[Verdict.BELOW] else ""),
        Figure(str(counts[Verdict.NOT_BUILT]), "", "rows not built", "bad" if counts[Verdict.NOT_BUILT] else ""),
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
    return header("", "Acceptance", acceptance.flight, line) + figures(shown)


def _broken(acceptance: Acceptance) -> str:
    rows = [row for row in acceptance.rows if row.verdict in BROKEN]
    if not rows:
        return "<h2>Every floor that was measured holds</h2>"
    items = "".join(
        f"<li><b>{escape(name)}</b><div>"
        + "".join(
            f"<span>{row.ac}: {escape(row.what)} {_number(row)}{', floor ' + escape(row.floor) if row.floor else ''}"
            f"{'; ' + escape(row.why) if row.why else ''}</span>"
            for row in rows
            if row.scenario == name
        )
        + "</div></li>"
        for name in dict.fromkeys(row.scenario for row in rows)
    )
    return f'<h2>What does not pass</h2><ul class="broken">{items}</ul>'


def _number(row: JudgedRow) -> str:
    return (
        f'<b class="bad">{escape(with_unit(row.measured, row.unit) if row.measured is not None else row.verdict)}</b>'
    )


def _matrix(acceptance: Acceptance) -> str:
    """Scenarios down, requirements across; a cell shows its worst row."""
    columns = sorted({row.ac for row in acceptance.rows}, key=lambda ac: (ac[:2], int(ac.split("-")[1])))
    names = list(dict.fromkeys(row.scenario for row in acceptance.rows))
    head = "".join(f"<th>{ac}</th>" for ac in columns)
    body = ""
    for name in names:
        cells = "".join(
            _cell([row for row in acceptance.rows if row.scenario == name and row.ac == ac]) for ac in columns
        )
        body += f"<tr><th>{escape(name)}</th>{cells}</tr>"
    return section(
        "Scenarios and requirements",
        "Green holds its floor, red does not, grey could not be measured here. A cell shows the worst of its rows; "
        "point at it for all of them.",
        scroll(f'<table class="matrix"><tr><th></th>{head}</tr>{body}</table>'),
    )


def _cell(rows: list[JudgedRow]) -> str:
    if not rows:
        return "<td></td>"
    order = (Verdict.BELOW, Verdict.NOT_BUILT, Verdict.PASS, Verdict.NOT_MEASURABLE)
    worst = min(rows, key=lambda row: order.index(row.verdict))
    tip = "\n".join(
        f"{r.what}: {with_unit(r.measured, r.unit)}, {r.verdict}{'; ' + r.why if r.why else ''}" for r in rows
    )
    text = with_unit(worst.measured, worst.unit) if worst.measured is not None else MARKS[worst.verdict][1]
    css = MARKS[worst.verdict][0]
    return f'<td class="m-{css}" title="{escape(tip)}">{escape(text)}</td>'


def _pictures(results: list[Result]) -> str:
    return section(
        "Error and claim, scenario by scenario",
        "The line is the error, the shaded area the claimed 95 % radius: a consistent covariance covers the line. "
        "Grey: a fault. Below each picture, where the position came from.",
        f'<div class="multiples">{"".join(map(_picture, results))}</div>{legend(KEYS)}',
    )


def _picture(result: Result) -> str:
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
    broken = sum(row.verdict in BROKEN for row in result.rows)
    css, words = ("bad", f"{broken} below floor or not built") if broken else ("good", "holds")
    return (
        f'<figure class="multiple"><figcaption><b>{escape(result.scenario)}</b> <span class="{css}">{words}</span>'
        f"<br>{escape(result.promise)}</figcaption>{chart.svg(f'Error and claim: {result.scenario}')}</figure>"
    )


def _rows(acceptance: Acceptance) -> str:
    columns = ("scenario", "row", "what", "measured", "floor", "goal", "verdict", "")
    rows = []
    for row in acceptance.rows:
        verdict = f'<span class="{MARKS[row.verdict][0]}">{row.verdict}{", goal met" if row.goal_met else ""}</span>'
        measured = with_unit(row.measured, row.unit)
        rows.append([row.scenario, row.ac, row.what, measured, row.floor, row.goal, Html(verdict), row.why])
    return folded(f"All {len(rows)} rows", table(columns, rows, css="rows"))
