"""What `terrafix map check` says to a person."""

from terrafix_tools.mapping.check import MapCheck
from terrafix_tools.mapping.check_mission import Stretch

SHOWN = 3  # stretches of each kind; the rest is counted


def lines_of(said: MapCheck) -> list[tuple[str, str]]:
    """(what, text) rows, in the order in which they matter."""
    age = "of unknown date" if said.age_years is None else f"of {said.date}, {said.age_years:.1f} years old"
    signed = f"signed by {', '.join(said.signed_by)}" if said.signed_by else "not signed"
    rows = [
        (
            "map",
            f"{said.package}, {said.layer} {age}, {said.map_gsd_m:.2f} m/px, "
            f"{said.licence or 'no licence stated'}, {signed}",
        ),
        (
            "camera",
            f"{said.camera}; at {said.agl_m:.0f} m above ground {said.frame_gsd_m:.2f} m/px; "
            f"the matcher works on cells of {said.cell_m:.2f} m, "
            f"{said.frame_cells} of them along the shorter side of a frame",
        ),
        (
            "sight",
            f"sees {said.sees:.0%}, weak {said.weak:.0%}, blind {said.blind:.0%} of the map, "
            f"looked at every {said.cell_step_m:.0f} m",
        ),
    ]
    if said.mission is not None:
        rows += _mission_rows(said)
    rows.append(
        (
            "expect",
            f"a median error of about {said.expected_error_m:.0f} m where it sees "
            f"(map {said.ce90_m:.0f} m CE90, {said.ce90_origin}; matching one cell); "
            "elsewhere it grows with the distance flown",
        )
    )
    return rows + [("note", text) for text in said.warnings]


def _mission_rows(said: MapCheck) -> list[tuple[str, str]]:
    mission = said.mission
    assert mission is not None
    rows = [
        (
            "mission",
            f"{mission.file}: {_length(mission.length_m)}, with fixes to be expected on {mission.seen_share:.0%} of it",
        )
    ]
    for name, stretches in (("outside", mission.outside), ("blind", mission.blind)):
        rows += [(name, where(stretch)) for stretch in stretches[:SHOWN]]
        if len(stretches) > SHOWN:
            rows.append((name, f"and {len(stretches) - SHOWN} shorter stretches"))
    return rows


def where(stretch: Stretch) -> str:
    """A stretch as one would say it on the phone."""
    after = f"after item {stretch.after_item}" if stretch.after_item else "from home"
    (lat_0, lon_0), (lat_1, lon_1) = stretch.start, stretch.end
    return f"{_length(stretch.length_m)} {after}, from {lat_0:.6f}, {lon_0:.6f} to {lat_1:.6f}, {lon_1:.6f}"


def _length(length_m: float) -> str:
    return f"{length_m / 1000:.1f} km" if length_m >= 1000 else f"{length_m:.0f} m"
