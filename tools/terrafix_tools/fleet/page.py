"""`terrafix fleet page`: trends of a fleet and where it fails, as one HTML page without other files."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from terrafix_tools.fleet.places import KEYS, PlaceGrid, grids, picture, words, worst
from terrafix_tools.fleet.query import FleetTables
from terrafix_tools.pages.charts import Chart, Point
from terrafix_tools.pages.document import Figure, kit, macros, write_file

OWN = macros("terrafix_tools/fleet.html")
MAX_GROUPS = 12  # rows of a trend
LEAST_MONTHS = 5  # of the chart by month; over fewer the trend by season says as much
MAX_MAPS, MAX_WORST, MAX_ERRORS = 12, 12, 20

# Of all flights, or of a group: sums over frames, so that a long flight counts for more than a short one.
MEASURES = """
    count(*) AS flights, sum(duration_s) / 3600 AS hours, sum(distance_m) / 1000 AS km, sum(frames) AS frames,
    sum(localised) / nullif(sum(frames), 0) AS availability, sum(refusals) / nullif(sum(fixes + refusals), 0) AS refused
"""
SIGMAS = "SELECT {group} AS name, median(sigma_m) AS sigma_m FROM frames JOIN flights USING (flight) GROUP BY name"
GROUPS = (
    ("Map", "map"),
    ("Season", "season"),
    ("Camera", "camera"),
    ("Height above ground", "CAST(floor(agl_median_m / 50) * 50 AS INTEGER)"),
    ("Version", "concat_ws(' ', version, git)"),
)
HEIGHT = GROUPS[3][0]
SEASONS = ("spring", "summer", "autumn", "winter")
MONTHS = f"SELECT date_trunc('month', date) AS month, {MEASURES} FROM flights WHERE date IS NOT NULL GROUP BY month"
REASONS = """
SELECT reason, count(*) AS frames FROM frames WHERE reason IS NOT NULL GROUP BY reason ORDER BY frames DESC, reason
"""


def write_page(fleet: Path, out: Path) -> None:
    """Raises SourceError, UsageError, OutputError."""
    with FleetTables(fleet, keep=True) as tables:
        text = page(tables, fleet)
    write_file(out, text, "; choose another --out")


def page(tables: FleetTables, fleet: Path) -> str:
    name = fleet.resolve().name
    parts = (_head(tables, name), months(tables), _trends(tables), _reasons(tables), _places(tables), _errors(tables))
    return kit.document(f"{name} - fleet", "", *parts)


def _head(tables: FleetTables, name: str) -> str:
    more = "min(date) AS first, max(date) AS last, count(*) FILTER (NOT live) AS replays"
    about = tables.ask(f"SELECT {MEASURES}, {more} FROM flights").objects()[0]
    sigma_m = tables.ask("SELECT median(sigma_m) FROM frames").rows[0][0]
    hours, km = about["hours"] or 0.0, about["km"] or 0.0
    tiles = [
        Figure(f"{about['flights']}", "", "flights"),
        Figure(f"{hours:.1f}", "h", "recorded") if hours >= 1 else Figure(f"{60 * hours:.1f}", "min", "recorded"),
        Figure(f"{km:.0f}" if km >= 10 else f"{km:.1f}", "km", "flown"),
        Figure(_percent(about["availability"]), "%", "frames with a position"),
        Figure(_percent(about["refused"]), "%", "map matches refused"),
        Figure("-" if sigma_m is None else f"{sigma_m:.1f}", "m", "stated 1-sigma, median"),
    ]
    dates = f"{about['first']} to {about['last']}" if about["first"] else "no flight has a date"
    dates += f"; {about['replays']} of the flights are replays" if about["replays"] else ""
    return kit.header("Terrafix fleet", name, dates) + kit.figures(tiles)


def months(tables: FleetTables) -> str:
    rows = tables.ask(f"{MONTHS} ORDER BY month").objects()
    if not rows:
        return ""
    first = rows[0]["month"].year * 12
    at = [row["month"].year * 12 + row["month"].month - first for row in rows]
    if at[-1] - at[0] + 1 < LEAST_MONTHS:
        return ""
    top = max(
        5.0, *(100 * value for row in rows for value in (row["refused"], 1 - (row["availability"] or 0)) if value)
    )
    chart = Chart(
        x_min=at[0] - 0.5,
        x_max=at[-1] + 0.5,
        y_min=0.0,
        y_max=1.1 * top,
        height=230,
        x_unit="",
        y_unit="%",
        follow=False,
    )
    for month, row in zip(at, rows, strict=True):
        tip = f"{row['month']:%Y-%m}: {_percent(row['refused'])} % refused, {row['flights']} flights"
        chart.bar(month - 0.4, month + 0.4, 100 * (row["refused"] or 0), "refused", tip)
    share_of = {month: row["availability"] for month, row in zip(at, rows, strict=True)}
    without: list[Point] = [
        (month, None if share_of.get(month) is None else 100 * (1 - share_of[month]))
        for month in range(at[0], at[-1] + 1)
    ]
    chart.line(without, "none")
    return kit.section(
        "By month",
        f"Months from January {rows[0]['month'].year}. Bars: share of the map matches that were refused; line: frames "
        "without a position.",
        kit.scroll(chart.svg("Refused map matches by month")),
    )


def _trends(tables: FleetTables) -> str:
    return kit.section(
        "Trends",
        "Shares of all frames of a group; sigma is the median of the stated horizontal 1-sigma. Refused: map matches "
        "that a check has rejected, of all frames that were matched. Of a flight without a date (a replay) the season "
        "is unknown.",
        *(_trend(tables, title, group) for title, group in GROUPS),
    )


def _trend(tables: FleetTables, title: str, group: str) -> str:
    rows = tables.ask(f"SELECT {group} AS name, {MEASURES} FROM flights GROUP BY name ORDER BY flights DESC").objects()
    sigmas = dict(tables.ask(SIGMAS.format(group=group)).rows)
    shown = sorted(rows[:MAX_GROUPS], key=lambda row: _order(row["name"]))
    most = max([value for value in sigmas.values() if value is not None], default=1.0)
    lines = [_group(title, row, sigmas.get(row["name"]), most) for row in shown]
    heads = ("", "flights", "hours", "with a position", "refused", "sigma")
    return kit.block(title, kit.table(heads, lines, css="trend"), _more(rows, MAX_GROUPS))


def _more(found: Sequence[Any], shown: int, what: str = "") -> str:
    return kit.quiet(f"and {len(found) - shown} more{what}") if len(found) > shown else ""


def _group(title: str, row: dict[str, Any], sigma_m: float | None, most_m: float) -> list[object]:
    name = "unknown" if row["name"] in (None, "") else str(row["name"])
    if title == HEIGHT and row["name"] is not None:
        name = f"{row['name']} to {row['name'] + 50} m"
    sigma = "-" if sigma_m is None else f"{sigma_m:.1f} m"
    return [
        name,
        row["flights"],
        f"{row['hours'] or 0:.2f}",
        kit.share_bar(row["availability"] or 0, "k-good", f"{_percent(row['availability'])} %"),
        kit.share_bar(row["refused"] or 0, "k-dead", f"{_percent(row['refused'])} %"),
        kit.share_bar((sigma_m or 0) / max(most_m, 1e-9), "k-claim", sigma),
    ]


def _order(name: Any) -> tuple[int, Any]:
    """Seasons as in the year, numbers by size, texts by the alphabet, unknown last."""
    if name in (None, ""):
        return 3, ""
    if name in SEASONS:
        return 0, SEASONS.index(name)
    return (1, name) if isinstance(name, int) else (2, name)


def _reasons(tables: FleetTables) -> str:
    rows = tables.ask(REASONS).objects()
    if not rows:
        return ""
    return kit.section(
        "Reasons of refusal", "", kit.counts([(words(row["reason"]), row["frames"], "k-dead") for row in rows])
    )


def _places(tables: FleetTables) -> str:
    found = grids(tables)
    if not found:
        return ""
    shown = [
        (grid.map or "map unknown", f"{grid.frames} frames, cells of {grid.cell_m} m", picture(grid))
        for grid in found[:MAX_MAPS]
    ]
    return kit.section(
        "Where it fails",
        "Share of the matched frames in each cell that were refused, north up. "
        "A frame without a position is in no cell.",
        kit.legend(KEYS),
        OWN.places(shown),
        _more(found, MAX_MAPS, " maps"),
        _worst(found),
    )


def _worst(found: list[PlaceGrid]) -> str:
    cells = worst(found, MAX_WORST)
    if not cells:
        return ""
    rows: list[list[object]] = [
        [
            grid.map or "unknown",
            f"{cell.lat_deg:.5f}, {cell.lon_deg:.5f}",
            cell.frames,
            f"{cell.share:.0%}",
            words(cell.reason),
        ]
        for grid, cell in cells
    ]
    return kit.block("Worst cells", kit.table(["map", "latitude, longitude", "frames", "refused", "mostly"], rows))


def _errors(tables: FleetTables) -> str:
    rows = tables.ask("SELECT record, error FROM errors ORDER BY record").rows
    if not rows:
        return ""
    shown = kit.table(["record", "reason"], rows[:MAX_ERRORS])
    return kit.section("Records that could not be read", "", shown, _more(rows, MAX_ERRORS))


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.{0 if share in (0.0, 1.0) else 1}f}"
