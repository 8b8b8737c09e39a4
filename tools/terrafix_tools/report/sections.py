"""Upper sections of the report: accuracy, states, verdicts. Each returns HTML, or "" when there is no data."""

from typing import Any

from terrafix_tools.pages.charts import HALF_WIDTH, Band, Chart, Point, spans_of, stamp, strips
from terrafix_tools.pages.document import kit
from terrafix_tools.report.data import FlightView, RejectedMatch, radius95_m

MAX_REJECTED = 20  # rows of the table of rejected map matches
ERROR_FLOOR_M = 0.5  # lower end of the logarithmic axis; the available ground truth does not resolve smaller errors
LABELS = {
    "satellite_anchored": "map match",
    "visual_propagated": "propagated by odometry",
    "dead_reckoned": "dead reckoning",
    "not_placed": "not placed",
    "": "no position",
}


def accuracy(view: FlightView) -> str:
    """Error and reported accuracy over time; without ground truth the reported accuracy and the age of the last map
    match.
    """
    reported: list[Point] = [(r.t_s, radius95_m(r)) for r in view.rows]
    values = [v for _, v in reported if v is not None]
    if not values:
        return ""
    errors: list[Point] = [(r.t_s, view.error_m(r)) for r in view.rows]
    refined: list[Point] = [(r.t_s, view.refined_error_m(r)) for r in view.rows]
    error_values = [v for _, v in errors if v is not None]
    if not error_values:
        return _reported_only(view, reported, max(values))
    top = max([*values, *error_values, 2.0 * ERROR_FLOOR_M]) * 1.15
    chart = Chart(x_max=end_s(view), y_min=ERROR_FLOOR_M, y_max=top, height=330, log_y=True)
    chart.area(reported, "claim")
    for limit in (20.0, 50.0):
        if limit < top:
            chart.level(limit)
    chart.line(refined, "refined")
    chart.line(errors, "error")
    chart.line(reported, "claim")
    keys = [("k-ink", "error of the immediate estimate"), ("k-claim", "reported 95 % radius")]
    if any(v is not None for _, v in refined):
        keys.insert(1, ("k-good", "error after refinement"))
    return kit.section(
        "Error and reported accuracy",
        "Consistent accuracy: the error is inside the shaded 95 % radius in 95 of 100 frames, and the radius is not "
        "larger than necessary.",
        kit.scroll(chart.svg("Error and reported radius over time")),
        kit.legend(keys),
        _cumulative(view),
    )


def _reported_only(view: FlightView, reported: list[Point], top: float) -> str:
    chart = Chart(x_max=end_s(view), y_min=0.0, y_max=top * 1.15, height=240)
    chart.area(reported, "claim")
    chart.line(reported, "claim")
    age: list[Point] = [
        (r.t_s, r.anchor_age_ms / 1000 if r.anchor_age_ms is not None and r.anchor_age_ms >= 0 else None)
        for r in view.rows
    ]
    oldest = max((v for _, v in age if v is not None), default=0.0)
    second = Chart(x_max=end_s(view), y_min=0.0, y_max=max(2.0, oldest * 1.1), height=150, y_unit="s")
    second.area(age, "age")
    second.line(age, "age")
    return kit.section(
        "Reported accuracy",
        "Radius of the reported 95 % ellipse; below it the time since the last accepted map match. There is no ground "
        "truth for this flight.",
        kit.scroll(chart.svg("Reported radius over time"), second.svg("Age of the last map match")),
    )


def _cumulative(view: FlightView) -> str:
    """Share of the frames within a distance; frames without position count as not within any."""
    total = len(view.compared)
    immediate = sorted(c.error_m for c in view.compared.values() if c.error_m is not None)
    refined = sorted(c.refined_error_m for c in view.compared.values() if c.refined_error_m is not None)
    top = max([2.0, *immediate, *refined]) * 1.1
    chart = Chart(
        x_min=1.0,
        x_max=top,
        y_min=0.0,
        y_max=100.0,
        height=300,
        width=HALF_WIDTH,
        log_x=True,
        x_unit="m",
        y_unit="%",
        follow=False,
    )
    for i, limit in enumerate((20.0, 50.0)):
        share = 100 * sum(e <= limit for e in immediate) / total
        if limit < top:
            chart.vertical_line(limit, f"{share:.1f} % within {limit:.0f} m", row=12 - i)
    for errors, css in ((refined, "refined"), (immediate, "error")):
        steps: list[Point] = [(max(1.0, e), 100 * (i + 1) / total) for i, e in enumerate(errors)]
        chart.line([*steps, (top, 100 * len(errors) / total)] if steps else [], css)
    return kit.two(
        kit.block("Share of frames within a distance of the truth", chart.svg("Cumulative error")),
        kit.block("Metrics", kit.facts(_accuracy_rows(view.evaluation or {}))),
    )


def _accuracy_rows(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    def pair(key: str, scale: float, unit: str) -> str:
        values = [metrics.get(key), metrics.get(f"refined_{key}") if metrics.get("refined") else None]
        texts = [f"{scale * v:.1f}\u00a0{unit}" for v in values if v is not None]
        return " →\u00a0".join(texts) if texts else "-"

    rows = [(f"within {limit} m", pair(f"within_{limit}m", 100, "%")) for limit in (5, 10, 20, 50)]
    rows += [("median error", pair("median_m", 1, "m")), ("95 % of errors below", pair("p95_m", 1, "m"))]
    rows += [("largest error", pair("max_m", 1, "m"))]
    if metrics.get("ellipse95_coverage") is not None:
        rows.append(("truth inside the 95 % ellipse", f"{100 * metrics['ellipse95_coverage']:.1f} %"))
    if metrics.get("mean_nees") is not None:
        rows.append(("mean NEES (2 when consistent)", f"{metrics['mean_nees']:.2f}"))
    rows.append(("errors over 50 m and 3 sigma", str(metrics.get("false_fixes", 0))))
    return rows


def states(view: FlightView) -> str:
    """Source of the estimates frame by frame, and the state of the computer."""
    end = end_s(view)
    bands = [Band("position", spans([(r.t_s, r.source_label) for r in view.rows], end, "f-", LABELS))]
    matches = [(r.t_s, view.map_verdict.get(i, "")) for i, r in zip(view.frame_ids, view.rows, strict=False)]
    ticks = []
    for from_s, to_s, verdict in spans_of([(t, v) for t, v in matches], end):
        if verdict:
            css = "f-accepted" if verdict == "accepted" else "f-rejected"
            ticks.append((from_s, to_s, css, f"{stamp(from_s)}  {verdict.replace('_', ' ')}"))
    bands.append(Band("map", ticks))
    bands.append(Band("covar.", spans([(r.t_s, r.covariance_mode) for r in view.rows], end, "f-", {"": "none"})))
    if view.health:
        bands.append(Band("thermal", spans([(t, str(health.band)) for t, health in view.health], end, "f-", {})))
    keys = [
        ("k-sat", "map match, accepted, marginals"),
        ("k-vis", "odometry, Jacobian, hot"),
        ("k-dead", "dead reckoning, rejected, critical"),
        ("k-none", "no position"),
    ]
    return kit.section(
        "Sources and states",
        "The source of each position, whether the map match of the frame was accepted, how the covariance was "
        "computed, and the temperature band.",
        kit.scroll(strips(bands, end, "States over time")),
        kit.legend(keys),
    )


def verdicts(view: FlightView) -> str:
    """The verdicts on all measurements."""
    if not view.verdicts:
        return ""
    blocks = []
    for measurement, found in view.verdicts.items():
        ranked = sorted(found.items(), key=lambda kv: (kv[0] != "accepted", -kv[1]))
        rows = [(why.replace("_", " "), n, "k-sat" if why == "accepted" else "k-dead") for why, n in ranked]
        blocks.append(kit.counts(rows, measurement))
    matched = sum(view.matched_by.values())
    shares = [f"{by} {100 * n / matched:.0f} %" for by, n in sorted(view.matched_by.items())]
    by = f" Frames matched with the map by: {', '.join(shares)}." if shares else ""
    return kit.section(
        "Verdicts",
        f"Verdicts per measurement; rejected ones by reason.{by}",
        kit.two(*blocks),
        kit.legend([("k-sat", "accepted"), ("k-dead", "rejected")]),
    )


def rejected_map_matches(view: FlightView) -> str:
    """Table of the rejected map matches with the largest test ratios; those without one fill the rest."""
    if not view.rejected_maps:
        return ""
    ranked = sorted(view.rejected_maps, key=lambda match: 0.0 if match.test_ratio is None else -match.test_ratio)
    shown = sorted(ranked[:MAX_REJECTED], key=lambda match: match.t_s)
    return kit.section(
        "Rejected map matches",
        f"{len(shown)} of {len(view.rejected_maps)} rejected map matches, those with the largest test ratios (squared "
        "Mahalanobis distance over the limit of the gate).",
        kit.table(
            ("time", "frame", "verdict", "raised by", "test ratio", "detail"), map(_rejected_row, shown), css="texts"
        ),
    )


def _rejected_row(match: RejectedMatch) -> tuple[str, ...]:
    ratio = "-" if match.test_ratio is None else f"{match.test_ratio:.2f}"
    raised_by = "anchor" if match.by_anchor else "estimator"
    return f"{match.t_s:.1f} s", str(match.frame_id), match.verdict.replace("_", " "), raised_by, ratio, match.detail


def end_s(view: FlightView) -> float:
    return max(view.duration_s, 1.0)


def spans(
    samples: list[tuple[float, str]], end: float, prefix: str, labels: dict[str, str]
) -> list[tuple[float, float, str, str]]:
    return [
        (from_s, to_s, f"{prefix}{state or 'none'}", f"{stamp(from_s)}  {labels.get(state, state)}")
        for from_s, to_s, state in spans_of(samples, end)
    ]
