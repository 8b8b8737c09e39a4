"""The formats of an export: one table, one function that writes."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from terrafix.core.errors import OutputError, UsageError
from terrafix_tools.export import geographic, geotag, kml, photogrammetry, reconstruction, ros_bag, trajectory
from terrafix_tools.export.track import BEST, Track, read_track


@dataclass(frozen=True)
class Format:
    """``write``: gets the track, where to write, and the folder of the photos. ``ending``: of the name of the output,
    by which the format is known without --format."""

    what: str
    write: Callable[[Track, Path, Path | None], None]
    ending: str = ""
    is_folder: bool = False
    needs_photos: bool = False
    library: str = ""  # of an extra, that writes it

    def file_name(self, flight: str, name: str) -> str:
        """Of an output of the flight; ``name``: of the format. Some programs want a file by one name alone."""
        if self.ending:
            return f"{flight}{self.ending}" if self.ending.startswith(".") else self.ending
        return f"{flight}-{name}" if self.is_folder else f"{flight}-{name}.csv"


FORMATS = {
    "csv": Format("columns of estimates.csv", geographic.write_csv, ".csv"),
    "parquet": Format("the same for Arrow, pandas, DuckDB", geographic.write_parquet, ".parquet"),
    "geojson": Format("points", geographic.write_layers, ".geojson"),
    "gpkg": Format("GeoPackage: points, track", geographic.write_layers, ".gpkg"),
    "shp": Format("Shapefile: points", geographic.write_shapefile, ".shp"),
    "gpx": Format("one track", geographic.write_gpx, ".gpx"),
    "kml": Format("Google Earth: points, track, gx:Track", kml.write_kml, ".kml"),
    "kmz": Format("the same, packed", kml.write_kmz, ".kmz"),
    "waypoints": Format("mission of a ground station (QGC WPL 110)", geographic.write_waypoints, ".waypoints"),
    "odm": Format("geo.txt of OpenDroneMap and WebODM", photogrammetry.write_odm, "geo.txt"),
    "pix4d": Format("CSV of Pix4D: omega, phi, kappa, accuracies", photogrammetry.write_pix4d),
    "metashape": Format("CSV of Metashape: the same", photogrammetry.write_metashape),
    "photos": Format("copies of the photos with the position in them", geotag.write_photos, "", True, True),
    "colmap": Format("COLMAP text model: cameras and images", reconstruction.write_colmap, "", True),
    "opensfm": Format("OpenSfM reconstruction", reconstruction.write_opensfm, "reconstruction.json"),
    "tum": Format("trajectory: t x y z qx qy qz qw", trajectory.write_tum, ".tum"),
    "kitti": Format("trajectory: 3x4 matrices", trajectory.write_kitti, ".kitti"),
    "rosbag": Format("ROS 2 bag: NavSatFix, PoseWithCovarianceStamped", ros_bag.write_bag, "", True, library="rosbags"),
}


def format_of(out: Path, name: str = "") -> Format:
    """The format ``name``, or the one that the name of ``out`` ends with. Raises UsageError."""
    if name in FORMATS:
        return FORMATS[name]
    found = [f for f in FORMATS.values() if f.ending and out.name.lower().endswith(f.ending)]
    if name or not found:
        wrong = f"--format {name}" if name else f"{out}: no format is known by that name"
        raise UsageError(f"{wrong}; give --format with one of {', '.join(FORMATS)}")
    return found[0]


def export(folder: Path, out: Path, name: str = "", which: str = BEST, photos: Path | None = None) -> str:
    """Writes the track of a run, replay or record to ``out`` and returns the line for the user. Raises UsageError,
    SourceError, EvaluationError, OutputError."""
    chosen = format_of(out, name)
    if chosen.needs_photos and photos is None:
        raise UsageError(f"{out}: give --photos with the folder of the photos that are copied")
    if chosen.is_folder and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(f"{out}: exists and is not an empty folder; name a new one")
    track = read_track(folder, which)
    replaced = ", which was replaced" if out.is_file() else ""
    partial = out.with_name(f"{out.stem}.partial{out.suffix}")
    try:
        chosen.write(track, out if chosen.is_folder else partial, photos)
        if not chosen.is_folder:
            for written in partial.parent.glob(f"{partial.stem}.*"):  # a Shapefile is several files
                written.replace(out.with_name(out.stem + written.name.removeprefix(partial.stem)))
    except geographic.write_errors() as error:
        partial.unlink(missing_ok=True)
        raise OutputError(f"{out}: cannot be written ({error}); check the folder and its free space") from None
    kinds = sorted({pose.which for pose in track.poses})
    return f"{len(track.poses)} positions ({', '.join(kinds)}); written to {out}{replaced}"
