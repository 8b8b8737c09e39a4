"""`terrafix report`: one self-contained HTML page about a flight."""

from pathlib import Path

from markupsafe import Markup

from terrafix_tools.estimates import Row
from terrafix_tools.flight_map import map_of_flight
from terrafix_tools.flight_verdict import FlightVerdict
from terrafix_tools.pages.charts import clock, stamp
from terrafix_tools.pages.document import kit, macros, write_file
from terrafix_tools.report.data import FlightView, radius95_m
from terrafix_tools.report.gather import gather
from terrafix_tools.report.map_picture import map_svg
from terrafix_tools.report.moments import Moment, worst_moments
from terrafix_tools.report.sections import accuracy, rejected_map_matches, states, verdicts
from terrafix_tools.report.sections_autopilot import link
from terrafix_tools.report.sections_computer import computer
from terrafix_tools.report.sections_gnss import gnss
from terrafix_tools.report.sections_innovations import innovations
from terrafix_tools.report.sections_moments import moments_sections
from terrafix_tools.report.sections_run import camera_images, finalised, picture_rows, provenance, timing
from terrafix_tools.report.text import events, verdict_of
from terrafix_tools.report.text import figures as key_figures

OWN = macros("terrafix_tools/report.html")
NAME = "report.html"
SOURCE_KEYS = (  # css class, text, source of the estimate
    ("k-sat", "map match", "satellite_anchored"),
    ("k-vis", "propagated by odometry", "visual_propagated"),
    ("k-dead", "dead reckoning", "dead_reckoned"),
)
MAX_POINTED = 2500  # frames that the pointer finds on the map and in the charts; of a longer flight, evenly spread ones


def report(folder: Path, truth_path: Path | None = None, map_path: Path | None = None) -> Path:
    """Writes FOLDER/report.html and returns its path. Raises subclasses of TerrafixError.

    Defaults: ``truth_path``: truth.csv in the folder, if it exists; ``map_path``: the map of the flight.
    """
    view = gather(folder, truth_path)
    page = _page(view, map_of_flight(folder, map_path, view.summary, view.header))
    write_file(folder / NAME, page)
    return folder / NAME


def _page(view: FlightView, map_path: Path | None) -> str:
    verdict = verdict_of(view)
    moments = worst_moments(view, trusted=verdict.is_trusted)
    pointed = pointed_rows(view, moments)
    worst, details = moments_sections(view, moments, map_path)
    sections = [
        _map_section(view, map_path, moments, pointed),
        _events(view),
        worst,
        accuracy(view),
        states(view),
        *map(
            _folded,
            (
                finalised(view),
                innovations(view),
                verdicts(view),
                rejected_map_matches(view),
                link(view),
                gnss(view),
                timing(view),
                computer(view),
                details,
                camera_images(view),
                provenance(view),
            ),
        ),
    ]
    frames = [{"i": i, "t": round(view.rows[i].t_s, 3), "h": _tip(view, view.rows[i])} for i in pointed]
    return kit.document(f"{view.title} - flight report", OWN.pointed(frames), *_head(view, verdict), *sections)


def _folded(section: str) -> str:
    """A section of which only the heading is seen until it is opened."""
    head, end, rest = section.partition("</h2>")
    return OWN.folded(Markup(head + end), Markup(rest)) if end else section


def pointed_rows(view: FlightView, moments: list[Moment]) -> list[int]:
    """Rows with a dot on the map and a tooltip, in their order."""
    stride = max(1, -(-len(view.rows) // MAX_POINTED))
    chosen = {*range(0, len(view.rows), stride), *picture_rows(view), *(moment.row for moment in moments)}
    return sorted(chosen)


def _head(view: FlightView, verdict: FlightVerdict) -> tuple[str, ...]:
    kind = "live record" if view.live else "replay, unfinished" if view.unfinished else "replay"
    named = view.summary.get("map", {})
    facts = [
        f"{len(view.rows)} frames in {clock(round(view.duration_s))}",
        f"map {Path(named['source']).stem}" if named.get("source") else "",
        ", ".join(view.summary.get("models", {})) or ("" if view.live else "no learned model"),
    ]
    line = " · ".join(fact for fact in facts if fact)
    mood = "good" if verdict.is_trusted else "fair" if verdict.spans else "bad"
    shown = key_figures(view)
    colours = "Green: as the requirements ask; amber: less; red: far less; no colour: not rated."
    return (
        kit.header(f"Terrafix flight report, {kind}", view.title, line),
        OWN.verdict(verdict.text(), mood),
        kit.figures(shown),
        kit.quiet(colours) if any(one.mood for one in shown) else "",
    )


def _map_section(view: FlightView, map_path: Path | None, moments: list[Moment], pointed: list[int]) -> str:
    svg = map_svg(view, map_path, [moment.row for moment in moments], pointed)
    labels = {row.source_label for row in view.rows}
    keys = [(css, text) for css, text, label in SOURCE_KEYS if label in labels]
    layers = [("estimates", True, keys or [("", "estimates")])]
    if view.truth_track:
        layers.append(("truth", True, [("k-truth", "ground truth")]))
    if any(row.refined_lat_deg is not None for row in view.rows):
        layers.append(("refined", False, [("k-refined", "refined afterwards")]))
    if view.finalised:
        layers.append(("finalised", True, [("k-finalised", "finalised after landing")]))
    layers.append(("ellipses", True, [("", "95 % ellipses")]))
    if moments:
        layers.append(("worst-marks", True, [("", "worst moments")]))
    return OWN.map(svg, layers)


def _events(view: FlightView) -> str:
    return kit.section("Events", "", kit.timeline((stamp(t), text) for t, text in events(view)))


def _tip(view: FlightView, row: Row) -> str:
    """HTML tooltip of a frame."""
    error, lines = "", []
    if row.localised:
        if (error_m := view.error_m(row)) is not None:
            error = f"{error_m:.1f} m"
        if (radius := radius95_m(row)) is not None:
            lines.append(f"reported 95 % radius {radius:.1f} m")
        if row.anchor_age_ms is not None and row.anchor_age_ms >= 0:
            lines.append(f"last map match {row.anchor_age_ms / 1000:.1f} s ago")
        if row.agl_m is not None:
            lines.append(f"{row.agl_m:.0f} m above ground")
    words = row.source_label.replace("_", " ") if row.localised else "no position"
    process = f"{row.process_ms:.0f} ms" if row.process_ms is not None else ""
    return OWN.tip(row.file, clock(round(row.t_s, 1)), words, error, lines, process)
