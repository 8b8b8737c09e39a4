"""Image geolocation for photogrammetry: OpenDroneMap's geo.txt, CSV of Pix4D and Metashape.

Angles are about true east, north and up at the origin of the flight; heights are above mean sea level."""

import csv
import math
from pathlib import Path

from terrafix.core.errors import UsageError
from terrafix_tools.export.track import Track, TrackPose

PIX4D_HEADER = (
    "imagename", "latitude [decimal degrees]", "longitude [decimal degrees]", "altitude [meter]",
    "omega [degrees]", "phi [degrees]", "kappa [degrees]",
    "accuracy horizontal [meter]", "accuracy vertical [meter]",
)  # fmt: skip
METASHAPE_HEADER = (
    "#Label", "X/Longitude", "Y/Latitude", "Z/Altitude", "Omega", "Phi", "Kappa",
    "X_accuracy", "Y_accuracy", "Z_accuracy", "Omega_accuracy", "Phi_accuracy", "Kappa_accuracy",
)  # fmt: skip


def write_odm(track: Track, out: Path, _photos: Path | None) -> None:
    """https://docs.opendronemap.org/geo: name, longitude, latitude, altitude, yaw, pitch, roll (camera down: 0, 0),
    accuracies. Angles that are not known are nan; a height that is not known ends the line, since the columns go by
    position. Raises UsageError."""
    lines = ["EPSG:4326"]
    for pose in track.poses:
        cells = [one_word(pose.name), f"{pose.lon_deg:.8f}", f"{pose.lat_deg:.8f}"]
        if pose.row.alt_amsl_m is not None:
            angles = pose.yaw_pitch_roll_deg() if pose.r_w_c is not None else (math.nan,) * 3
            cells += [f"{pose.row.alt_amsl_m:.3f}", *(f"{angle:.4f}" for angle in angles)]
            if pose.sigma_h_m is not None and pose.sigma_u_m is not None:
                cells += [f"{pose.sigma_h_m:.3f}", f"{pose.sigma_u_m:.3f}"]
        lines.append(" ".join(cells))
    out.write_text("\n".join(lines) + "\n", encoding="utf-8")


def one_word(name: str) -> str:
    """Raises UsageError: a name that a file with columns between spaces cannot hold."""
    if any(c.isspace() for c in name):
        raise UsageError(
            f"'{name}': this format separates its columns by spaces; rename the images, or export as pix4d"
        )
    return name


def write_pix4d(track: Track, out: Path, _photos: Path | None) -> None:
    """ "Image geolocation" of Pix4D: WGS 84, order latitude, longitude, altitude."""
    rows = []
    for pose in track.poses:
        place = (_degrees(pose.lat_deg), _degrees(pose.lon_deg), _metres(pose.row.alt_amsl_m))
        rows.append([pose.name, *place, *_angles(pose), _metres(pose.sigma_h_m), _metres(pose.sigma_u_m)])
    _write(out, PIX4D_HEADER, rows)


def write_metashape(track: Track, out: Path, _photos: Path | None) -> None:
    """Reference > Import of Metashape: rotation angles "Omega, Phi, Kappa", with accuracies."""
    rows = []
    for pose in track.poses:
        place = (_degrees(pose.lon_deg), _degrees(pose.lat_deg), _metres(pose.row.alt_amsl_m))
        sigmas = (_metres(sigma) for sigma in (pose.row.sigma_e_m, pose.row.sigma_n_m, pose.sigma_u_m))
        rows.append([pose.name, *place, *_angles(pose), *sigmas, *_angle_sigmas(pose)])
    _write(out, METASHAPE_HEADER, rows)


def _write(out: Path, header: tuple[str, ...], rows: list[list[str]]) -> None:
    with out.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)


def _angles(pose: TrackPose) -> tuple[str, ...]:
    return ("", "", "") if pose.r_w_c is None else tuple(f"{angle:.5f}" for angle in pose.omega_phi_kappa_deg())


def _angle_sigmas(pose: TrackPose) -> tuple[str, ...]:
    """Omega, phi and kappa turn about east, north and up, for a camera that looks down."""
    if pose.cov is None:
        return ("", "", "")
    return tuple(f"{math.degrees(math.sqrt(pose.cov[i, i])):.4f}" for i in (3, 4, 5))


def _degrees(value: float) -> str:
    return f"{value:.8f}"


def _metres(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"
