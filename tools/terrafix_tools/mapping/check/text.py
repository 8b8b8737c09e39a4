"""Text output of `terrafix map check`."""

from terrafix_tools.mapping.check.mission import Stretch
from terrafix_tools.mapping.check.sight import START_SIGMA_M
from terrafix_tools.mapping.check.suitability import MapCheck

MAX_LISTED = 3  # stretches listed per kind; the others are counted


def lines_of(report: MapCheck) -> list[tuple[str, str]]:
    """(what, text) rows, in order of importance."""
    age = "of unknown date" if report.age_years is None else f"of {report.date}, {report.age_years:.1f} years old"
    signed = f"signed by {', '.join(report.signed_by)}" if report.signed_by else "not signed"
    rows = [
        (
            "map",
            f"{report.package}, {report.layer} {age}, {report.map_gsd_m:.2f} m/px, "
            f"{report.licence or 'no licence stated'}, {signed}",
        ),
        (
            "camera",
            f"{report.camera}; at {report.agl_m:.0f} m above ground {report.frame_gsd_m:.2f} m/px; "
            f"the matcher works on cells of {report.cell_m:.2f} m, "
            f"{report.frame_cells} of them along the shorter side of a frame",
        ),
        (
            "alone",
            f"{report.alone:.0%} of frames are expected to be placed alone: {report.sees + report.weak:.0%} while the "
            f"ground looks as on the map, {report.sees:.0%} in another season or years later, from a start known to "
            f"{START_SIGMA_M:.0f} m (looked at every {report.cell_step_m:.0f} m)",
        ),
    ]
    if report.mission is not None:
        rows += _mission_rows(report)
    rows.append(
        (
            "expect",
            f"a median error of about {report.expected_error_m:.0f} m where it sees "
            f"(map {report.ce90_m:.0f} m CE90, {report.ce90_origin}; matching one cell); "
            "elsewhere it grows with the distance flown",
        )
    )
    rows += [("input", text) for text in report.inputs]
    return rows + [("note", text) for text in report.warnings]


def _mission_rows(report: MapCheck) -> list[tuple[str, str]]:
    mission = report.mission
    assert mission is not None
    rows = [
        (
            "mission",
            f"{mission.file}: {_length(mission.length_m)}, with fixes to be expected on {mission.seen_share:.0%} of it",
        )
    ]
    for name, stretches in (("outside", mission.outside), ("blind", mission.blind)):
        rows += [(name, where(stretch)) for stretch in stretches[:MAX_LISTED]]
        if len(stretches) > MAX_LISTED:
            rows.append((name, f"and {len(stretches) - MAX_LISTED} shorter stretches"))
    return rows


def where(stretch: Stretch) -> str:
    """A short description of a stretch."""
    after = f"after item {stretch.after_item}" if stretch.after_item else "from home"
    (lat_0, lon_0), (lat_1, lon_1) = stretch.start, stretch.end
    return f"{_length(stretch.length_m)} {after}, from {lat_0:.6f}, {lon_0:.6f} to {lat_1:.6f}, {lon_1:.6f}"


def _length(length_m: float) -> str:
    return f"{length_m / 1000:.1f} km" if length_m >= 1000 else f"{length_m:.0f} m"
