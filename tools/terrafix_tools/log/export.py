"""`terrafix log export`: the track of a flight in the formats of other programs, written by GDAL and Arrow."""

import struct
import zipfile
from collections.abc import Callable
from dataclasses import fields
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from terrafix.core.errors import OutputError, SourceError, UsageError
from terrafix.messages import WallClock
from terrafix.recorder.reader import is_record, read_flight
from terrafix_tools.estimates import NS, Row, write_rows
from terrafix_tools.evaluate import flight_rows
from terrafix_tools.mission.file import track_mission, write_mission

WGS84 = "EPSG:4326"
POINT_Z, LINE_Z = 1001, 1002  # ISO WKB geometry types
DRIVERS = {".geojson": "GeoJSON", ".kml": "LIBKML", ".gpkg": "GPKG"}


def export(folder: Path, out: Path) -> int:
    """Writes the track of a run, replay or record to ``out`` and returns its number of positions. The format is that of
    the suffix. Raises UsageError, SourceError, EvaluationError, OutputError."""
    writers: dict[str, Callable[[list[Row], list[str | None], Path], None]] = {
        ".csv": _write_csv,
        ".parquet": _write_parquet,
        ".gpx": _write_gpx,
        ".kmz": _write_kmz,
        ".waypoints": _write_waypoints,
        **dict.fromkeys(DRIVERS, _write_features),
    }
    write = writers.get(out.suffix.lower())
    if write is None:
        raise UsageError(f"{out}: no format is known by that suffix; use {', '.join(sorted(writers))}")
    rows = flight_rows(folder)
    located = [row for row in rows if row.localised]
    if not located:
        raise SourceError(f"{folder}: no frame has a position; there is nothing to export")
    partial = out.with_name(f"{out.stem}.partial{out.suffix}")
    try:
        write(located, utc_times(folder, located), partial)
        partial.replace(out)
    except (OSError, _gdal_errors()) as error:
        partial.unlink(missing_ok=True)
        raise OutputError(f"{out}: cannot be written ({error}); check the folder and its free space") from None
    return len(located)


def utc_times(folder: Path, rows: list[Row]) -> list[str | None]:
    """-> ISO 8601 time of each row; None where no clock was plausible in flight, as in a replay."""
    offset_ns: int | None = None
    if is_record(folder):
        for _, _, message in read_flight(folder):
            if isinstance(message, WallClock) and message.unix_ns is not None:
                offset_ns = message.unix_ns - message.t_ns
    if offset_ns is None:
        return [None] * len(rows)
    return [_iso(row.t_s + offset_ns / NS) for row in rows]


def _iso(unix_s: float) -> str:
    return datetime.fromtimestamp(unix_s, UTC).isoformat(timespec="milliseconds")


def _columns(rows: list[Row], times: list[str | None]) -> dict[str, list[Any]]:
    """Columns of estimates.csv, and ``time_utc`` where it is known."""
    columns: dict[str, list[Any]] = {f.name: [getattr(row, f.name) for row in rows] for f in fields(Row)}
    if any(times):
        columns["time_utc"] = list(times)
    return columns


def _write_csv(rows: list[Row], times: list[str | None], out: Path) -> None:
    with out.open("w", encoding="utf-8", newline="") as stream:
        write_rows(stream, rows)


def _write_parquet(rows: list[Row], times: list[str | None], out: Path) -> None:
    import pyarrow
    from pyarrow import parquet

    parquet.write_table(pyarrow.table(_columns(rows, times)), out)


def _write_features(rows: list[Row], times: list[str | None], out: Path) -> None:
    """A point for each frame, with the columns of estimates.csv; the track as a line where the format has layers."""
    driver = DRIVERS[out.suffix.lower()]
    names, data = _field_data(_columns(rows, times))
    geometry = np.array([_point(row) for row in rows], dtype=object)
    _write(out, "frames", geometry, "Point Z", names, data, driver)
    if driver != "GeoJSON":
        line = np.array([_line(rows)], dtype=object)
        _write(out, "track", line, "LineString Z", ["frames"], [np.array([len(rows)])], driver, append=True)


def _write_kmz(rows: list[Row], times: list[str | None], out: Path) -> None:
    """The KML file in a ZIP archive; GDAL keeps only the last layer that is appended to a KMZ."""
    with TemporaryDirectory() as folder:
        document = Path(folder) / "doc.kml"
        _write_features(rows, times, document)
        with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.write(document, document.name)


def _write_gpx(rows: list[Row], times: list[str | None], out: Path) -> None:
    """One track; GDAL takes its points with the fields of the layer track_points."""
    zeros = np.zeros(len(rows), dtype=np.int64)
    names = ["track_fid", "track_seg_id", "track_seg_point_id", "ele"]
    heights = np.array([row.alt_amsl_m if row.alt_amsl_m is not None else np.nan for row in rows])
    data: list[np.ndarray] = [zeros, zeros, np.arange(len(rows)), heights]
    if all(times):
        names.append("time")
        data.append(np.array([str(time)[:23] for time in times], dtype="datetime64[ms]"))
    geometry = np.array([_point(row) for row in rows], dtype=object)
    _write(out, "track_points", geometry, "Point Z", names, data, "GPX")


def _write_waypoints(rows: list[Row], times: list[str | None], out: Path) -> None:
    """The newest position of each frame, for a ground station."""
    write_mission(out, track_mission(out.name, [_newest(row) for row in rows]))


def _newest(row: Row) -> tuple[float, float, float | None]:
    """Latitude, longitude, height above mean sea level: refined, where there is a refined position."""
    if row.refined_lat_deg is not None and row.refined_lon_deg is not None:
        return row.refined_lat_deg, row.refined_lon_deg, row.refined_alt_amsl_m
    assert row.lat_deg is not None and row.lon_deg is not None
    return row.lat_deg, row.lon_deg, row.alt_amsl_m


def _field_data(columns: dict[str, list[Any]]) -> tuple[list[str], list[np.ndarray]]:
    """-> names and arrays for GDAL: numbers with NaN for unknown, or texts."""
    data = []
    for values in columns.values():
        if any(isinstance(value, str) for value in values):
            data.append(np.array([value or "" for value in values], dtype=object))
        else:
            data.append(np.array([np.nan if value is None else float(value) for value in values]))
    return list(columns), data


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


def _coordinates(row: Row) -> tuple[float, float, float]:
    """Longitude, latitude, height above mean sea level (0 where it is unknown)."""
    assert row.lon_deg is not None and row.lat_deg is not None
    return row.lon_deg, row.lat_deg, 0.0 if row.alt_amsl_m is None else row.alt_amsl_m


def _point(row: Row) -> bytes:
    return struct.pack("<BI3d", 1, POINT_Z, *_coordinates(row))


def _line(rows: list[Row]) -> bytes:
    points = b"".join(struct.pack("<3d", *_coordinates(row)) for row in rows)
    return struct.pack("<BII", 1, LINE_Z, len(rows)) + points


def _gdal_errors() -> type[Exception]:
    from pyogrio.errors import DataSourceError

    return DataSourceError
