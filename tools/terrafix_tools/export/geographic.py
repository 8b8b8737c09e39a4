"""Tables and the vector formats of GDAL."""

import csv
import struct
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from terrafix_tools.estimates import COLUMNS, Row, cells
from terrafix_tools.export.track import Track, TrackPose

WGS84 = "EPSG:4326"
POINT_Z, LINE_Z = 1001, 1002  # ISO WKB geometry types
DRIVERS = {".geojson": "GeoJSON", ".gpkg": "GPKG"}
# Names of a Shapefile have ten letters at most (dBASE III).
SHAPEFILE_NAMES = {
    "file": "file",
    "t_s": "t_s",
    "time_utc": "time_utc",
    "which": "which",
    "lat_deg": "lat_deg",
    "lon_deg": "lon_deg",
    "alt_amsl_m": "alt_amsl",
    "agl_m": "agl",
    "sigma_e_m": "sigma_e",
    "sigma_n_m": "sigma_n",
    "sigma_u_m": "sigma_u",
    "yaw_deg": "yaw_deg",
    "source_label": "source",
}


def columns(track: Track) -> dict[str, list[Any]]:
    """Columns of estimates.csv, ``which``, ``sigma_u_m``, and ``time_utc`` where it is known."""
    found: dict[str, list[Any]] = {f.name: [getattr(pose.row, f.name) for pose in track.poses] for f in fields(Row)}
    found["which"] = [pose.which for pose in track.poses]
    found["sigma_u_m"] = [pose.sigma_u_m for pose in track.poses]
    if any(pose.time_utc for pose in track.poses):
        found["time_utc"] = [pose.time_utc for pose in track.poses]
    return found


def write_csv(track: Track, out: Path, _photos: Path | None) -> None:
    more = {name: values for name, values in columns(track).items() if name not in COLUMNS}
    with out.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([*COLUMNS, *more])
        for pose, values in zip(track.poses, zip(*more.values(), strict=True), strict=True):
            writer.writerow([*cells(pose.row), *("" if value is None else value for value in values)])


def write_parquet(track: Track, out: Path, _photos: Path | None) -> None:
    import pyarrow
    from pyarrow import parquet

    parquet.write_table(pyarrow.table(columns(track)), out)


def write_layers(track: Track, out: Path, _photos: Path | None) -> None:
    """A point for each frame; the track as a line where the format has layers."""
    driver = DRIVERS[out.suffix.lower()]
    names, data = _field_data(columns(track))
    _write(out, "frames", _points(track), "Point Z", names, data, driver)
    if driver != "GeoJSON":
        line = np.array([_line(track.poses)], dtype=object)
        about: list[np.ndarray] = [np.array([track.name], dtype=object), np.array([len(track.poses)])]
        _write(out, "track", line, "LineString Z", ["flight", "frames"], about, driver, append=True)


def write_shapefile(track: Track, out: Path, _photos: Path | None) -> None:
    names, data = _field_data({SHAPEFILE_NAMES[k]: v for k, v in columns(track).items() if k in SHAPEFILE_NAMES})
    _write(out, out.stem, _points(track), "Point Z", names, data, "ESRI Shapefile")


def write_gpx(track: Track, out: Path, _photos: Path | None) -> None:
    """One track with the name of the flight; GDAL takes its points with the fields of the layer track_points."""
    count = len(track.poses)
    heights = np.array([np.nan if pose.row.alt_amsl_m is None else pose.row.alt_amsl_m for pose in track.poses])
    zeros, texts = np.zeros(count, dtype=np.int64), ([track.name] * count, [pose.name for pose in track.poses])
    data: list[np.ndarray] = [
        zeros,
        zeros,
        np.arange(count),
        *(np.array(text, dtype=object) for text in texts),
        heights,
    ]
    names = ["track_fid", "track_seg_id", "track_seg_point_id", "track_name", "name", "ele"]
    if all(pose.time_utc for pose in track.poses):
        names.append("time")
        data.append(np.array([str(pose.time_utc)[:23] for pose in track.poses], dtype="datetime64[ms]"))
    _write(out, "track_points", _points(track), "Point Z", names, data, "GPX")


def _field_data(values_of: dict[str, list[Any]]) -> tuple[list[str], list[np.ndarray]]:
    """-> names and arrays for GDAL: numbers with NaN for unknown, or texts."""
    data = []
    for values in values_of.values():
        if any(isinstance(value, str) for value in values):
            data.append(np.array([value or "" for value in values], dtype=object))
        else:
            data.append(np.array([np.nan if value is None else float(value) for value in values]))
    return list(values_of), data


def _write(
    out: Path,
    layer: str,
    geometry: np.ndarray,
    kind: str,
    names: list[str],
    data: list[np.ndarray],
    driver: str,
    *,
    append: bool = False,
) -> None:
    from pyogrio.raw import write

    write(
        out,
        geometry=geometry,
        field_data=data,
        fields=np.array(names),
        layer=layer,
        driver=driver,
        geometry_type=kind,
        crs=WGS84,
        append=append,
    )


def _points(track: Track) -> np.ndarray:
    return np.array([struct.pack("<BI3d", 1, POINT_Z, *_coordinates(pose)) for pose in track.poses], dtype=object)


def _coordinates(pose: TrackPose) -> tuple[float, float, float]:
    """Longitude, latitude, height above mean sea level (0 where it is unknown)."""
    return pose.lon_deg, pose.lat_deg, pose.alt_m


def _line(poses: list[TrackPose]) -> bytes:
    points = b"".join(struct.pack("<3d", *_coordinates(pose)) for pose in poses)
    return struct.pack("<BII", 1, LINE_Z, len(poses)) + points


def write_errors() -> tuple[type[Exception], ...]:
    """What writing a file raises when it cannot be written."""
    from pyogrio.errors import DataLayerError, DataSourceError

    return OSError, DataSourceError, DataLayerError
