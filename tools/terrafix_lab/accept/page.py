"""acceptance.html: one self-contained page. Failed rows come first."""

from html import escape
from importlib.resources import files
from typing import TYPE_CHECKING

from terrafix_lab.accept.fly import Result
from terrafix_lab.accept.measuring.results import BROKEN, JudgedRow, Verdict, with_unit
from terrafix_tools.report.charts import Chart, spans_of

if TYPE_CHECKING:
    from terrafix_lab.accept.table import Acceptance

ERROR_FLOOR_M = 0.5  # of the logarithmic axis
ERROR_TOP_M = 2000.0  # the same for all charts, to compare them
WIDTH, HEIGHT = 400, 190  # of one chart, in its own units
STRIP = 6  # height of the source labels under the chart
WORDS = {"satellite_anchored": "map match", "visual_propagated": "odometry", "dead_reckoned": "dead reckoning"}
MARKS = {
    Verdict.PASS: ("good", "holds"),
    Verdict.BELOW: ("bad", "below floor"),
    Verdict.NOT_BUILT: ("bad", "not built"),
    Verdict.NOT_MEASURABLE: ("none", "–"),
}


def page(acceptance: "Acceptance") -> str:
    """The whole document."""
    sheets = (files("terrafix_tools") / "assets" / "report.css", files("terrafix_lab") / "assets" / "acceptance.css")
    style = "".join(sheet.read_text(encoding="utf-8") for sheet in sheets)
    flown = [result for result in acceptance.results if result.points]
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="color-scheme" content="light dark">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>Acceptance: {escape(acceptance.flight)}</title><style>{style}</style></head><body><main>"
        f"{_head(acceptance)}{_broken(acceptance)}{_matrix(acceptance)}{_pictures(flown)}{_rows(acceptance)}"
        "</main></body></html>\n"
    )


def _head(acceptance: "Acceptance") -> str:
    counts = {verdict: sum(row.verdict is verdict for row in acceptance.rows) for verdict in Verdict}
    figures = [
        (str(sum(bool(r.points) for r in acceptance.results)), "scenarios flown", ""),
        (str(counts[Verdict.PASS]), "rows hold their floor", "good"),
        (str(counts[Verdict.BELOW]), "rows below their floor", "bad" if counts[Verdict.BELOW] else ""),
        (str(counts[Verdict.NOT_BUILT]), "rows not built", "bad" if counts[Verdict.NOT_BUILT] else ""),
        (str(counts[Verdict.NOT_MEASURABLE]), "rows not measurable here", ""),
    ]
    machine = acceptance.machine
    facts = [
        f"map {acceptance.map}" if acceptance.map else "",
        f"seed {acceptance.seed}" if acceptance.seed is not None else "",
        "quick: short flights" if acceptance.quick else "",
        f"{machine['cpu']}, {machine['cores']} cores",
        f"terrafix {machine['versions'].get('terrafix', '')}",
    ]
    cells = "".join(f'<div><b class="{css}">{value}</b><span>{text}</span></div>' for value, text, css in figures)
    return (
        f"<header><h1>Acceptance</h1><p>{escape(acceptance.flight)}</p>"
        f"<p>{escape(' · '.join(fact for fact in facts if fact))}</p></header>"
        f'<div class="figures wide">{cells}</div>'
    )


def _broken(acceptance: "Acceptance") -> str:
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


def _matrix(acceptance: "Acceptance") -> str:
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
    return (
        '<h2>Scenarios and requirements</h2><p class="lead">Green holds its floor, red does not, grey could not be '
        "measured here. A cell shows the worst of its rows; point at it for all of them.</p>"
        f'<div class="scroll"><table class="matrix"><tr><th></th>{head}</tr>{body}</table></div>'
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
    figures = "".join(_picture(result) for result in results)
    return (
        "<h2>Error and claim, scenario by scenario</h2>"
        '<p class="lead">The line is the error, the shaded area the claimed 95 % radius: a consistent covariance '
        "covers the line. Grey: a fault. Below each picture, where the position came from.</p>"
        f'<div class="multiples">{figures}</div><div class="legend">'
        '<span><i class="key k-ink"></i> error</span><span><i class="key k-claim"></i> claimed 95 % radius</span>'
        '<span><i class="key k-sat"></i> map match</span><span><i class="key k-vis"></i> odometry</span>'
        '<span><i class="key k-dead"></i> dead reckoning</span><span><i class="key k-none"></i> no position</span>'
        "</div>"
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


def _rows(acceptance: "Acceptance") -> str:
    body = "".join(
        f"<tr><td>{escape(row.scenario)}</td><td>{row.ac}</td><td>{escape(row.what)}</td>"
        f"<td>{escape(with_unit(row.measured, row.unit))}</td><td>{escape(row.floor)}</td><td>{escape(row.goal)}</td>"
        f'<td class="{MARKS[row.verdict][0]}">{row.verdict}{", goal met" if row.goal_met else ""}</td>'
        f"<td>{escape(row.why)}</td></tr>"
        for row in acceptance.rows
    )
    head = "".join(f"<th>{t}</th>" for t in ("scenario", "row", "what", "measured", "floor", "goal", "verdict", ""))
    return (
        f'<details><summary>All {len(acceptance.rows)} rows</summary><div class="scroll">'
        f'<table class="rows"><tr>{head}</tr>{body}</table></div></details>'
    )
