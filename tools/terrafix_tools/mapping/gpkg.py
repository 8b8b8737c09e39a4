"""The GeoPackage file itself: OGC tables (OGC 12-128r18, version 1.3) and ours, written the same way every time."""

import hashlib
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pyproj import CRS
from pyproj.enums import WktVersion

from terrafix.anchor.map_format import (
    APPLICATION_ID,
    DEM_TABLE,
    HASH_TABLE,
    IMAGERY_TABLE,
    MANIFEST_TABLE,
    TILE_PX,
    Level,
    Manifest,
    checksum_of,
    manifest_rows,
)

GPKG_VERSION = 10300  # requirement 2: user_version MMmmPP
CUSTOM_SRS_ID = 100_000  # a CRS without an EPSG code
UNDATED = "1970-01-01"  # last_change must be set, and must not make two builds of one input differ

SCHEMA = f"""
CREATE TABLE gpkg_spatial_ref_sys (
  srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY, organization TEXT NOT NULL,
  organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (
  table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE, description TEXT DEFAULT '',
  last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_tile_matrix_set (
  table_name TEXT NOT NULL PRIMARY KEY, srs_id INTEGER NOT NULL,
  min_x DOUBLE NOT NULL, min_y DOUBLE NOT NULL, max_x DOUBLE NOT NULL, max_y DOUBLE NOT NULL,
  CONSTRAINT fk_gtms_table_name FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gtms_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_tile_matrix (
  table_name TEXT NOT NULL, zoom_level INTEGER NOT NULL, matrix_width INTEGER NOT NULL, matrix_height INTEGER NOT NULL,
  tile_width INTEGER NOT NULL, tile_height INTEGER NOT NULL, pixel_x_size DOUBLE NOT NULL, pixel_y_size DOUBLE NOT NULL,
  CONSTRAINT pk_ttm PRIMARY KEY (table_name, zoom_level),
  CONSTRAINT fk_tmm_table_name FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name));
CREATE TABLE {IMAGERY_TABLE} (
  id INTEGER PRIMARY KEY AUTOINCREMENT, zoom_level INTEGER NOT NULL, tile_column INTEGER NOT NULL,
  tile_row INTEGER NOT NULL, tile_data BLOB NOT NULL, UNIQUE (zoom_level, tile_column, tile_row));
CREATE TABLE {MANIFEST_TABLE} (id INTEGER PRIMARY KEY AUTOINCREMENT, key TEXT NOT NULL UNIQUE, value TEXT NOT NULL);
CREATE TABLE {HASH_TABLE} (
  zoom_level INTEGER NOT NULL, tile_column INTEGER NOT NULL, tile_row INTEGER NOT NULL, sha256 BLOB NOT NULL,
  PRIMARY KEY (zoom_level, tile_column, tile_row)) WITHOUT ROWID;
CREATE TABLE {DEM_TABLE} (
  tile_column INTEGER NOT NULL, tile_row INTEGER NOT NULL, tile_data BLOB NOT NULL,
  PRIMARY KEY (tile_column, tile_row));
"""


class GpkgWriter:
    """Tables and tiles of one new package. The order of the calls decides the bytes."""

    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db
        self.tiles = 0
        self.tile_bytes = 0
        db.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        db.execute(f"PRAGMA user_version = {GPKG_VERSION}")
        for statement in SCHEMA.split(";\n"):
            if statement.strip():
                db.execute(statement)

    def add_tile(self, zoom: int, column: int, row: int, data: bytes) -> None:
        """An imagery tile (JPEG or PNG), or with zoom -1 an elevation tile."""
        if zoom < 0:
            self._db.execute(f"INSERT INTO {DEM_TABLE} VALUES (?, ?, ?)", (column, row, data))
        else:
            self._db.execute(
                f"INSERT INTO {IMAGERY_TABLE} (zoom_level, tile_column, tile_row, tile_data) VALUES (?, ?, ?, ?)",
                (zoom, column, row, data),
            )
        digest = hashlib.sha256(data).digest()
        self._db.execute(f"INSERT INTO {HASH_TABLE} VALUES (?, ?, ?, ?)", (zoom, column, row, digest))
        self.tiles += 1
        self.tile_bytes += len(data)

    def add_imagery_tables(
        self,
        crs: CRS,
        levels: list[Level],
        bounds: tuple[float, float, float, float],
        name: str,
        date: str,
        licence: str,
    ) -> None:
        """Spatial reference, contents and tile matrices. `bounds`: x_min, y_min, x_max, y_max of the imagery."""
        srs_id = self._add_srs(crs)
        changed = f"{date or UNDATED}T00:00:00.000Z"
        self._db.execute(
            "INSERT INTO gpkg_contents VALUES (?, 'tiles', ?, ?, ?, ?, ?, ?, ?, ?)",
            (IMAGERY_TABLE, name, licence, changed, *bounds, srs_id),
        )
        self._db.execute(
            "INSERT INTO gpkg_contents VALUES (?, 'attributes', ?, ?, ?, NULL, NULL, NULL, NULL, NULL)",
            (MANIFEST_TABLE, MANIFEST_TABLE, "What this map is; written by Terrafix", changed),
        )
        finest = levels[-1]
        x_min, y_max = bounds[0], bounds[3]
        x_max = x_min + finest.columns * TILE_PX * finest.pixel_x
        y_min = y_max - finest.rows * TILE_PX * finest.pixel_y
        self._db.execute(
            "INSERT INTO gpkg_tile_matrix_set VALUES (?, ?, ?, ?, ?, ?)",
            (IMAGERY_TABLE, srs_id, x_min, y_min, x_max, y_max),
        )
        for level in levels:
            self._db.execute(
                "INSERT INTO gpkg_tile_matrix VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
                (IMAGERY_TABLE, level.zoom, level.columns, level.rows, TILE_PX, TILE_PX, level.pixel_x, level.pixel_y),
            )

    def add_manifest(self, manifest: Manifest) -> Manifest:
        """Writes the manifest with its checksum; returns what was written."""
        hashes = self._db.execute(f"SELECT zoom_level, tile_column, tile_row, sha256 FROM {HASH_TABLE}").fetchall()
        rows = dict(manifest_rows(manifest))
        rows["checksum"] = checksum_of(list(rows.items()), hashes)
        self._db.executemany(f"INSERT INTO {MANIFEST_TABLE} (key, value) VALUES (?, ?)", rows.items())
        return manifest

    def _add_srs(self, crs: CRS) -> int:
        wgs84 = CRS.from_epsg(4326).to_wkt(WktVersion.WKT1_GDAL)
        rows: list[tuple[str, int, str, int, str, str]] = [
            ("Undefined Cartesian SRS", -1, "NONE", -1, "undefined", "undefined Cartesian"),
            ("Undefined geographic SRS", 0, "NONE", 0, "undefined", "undefined geographic"),
            ("WGS 84 geodetic", 4326, "EPSG", 4326, wgs84, "longitude/latitude on the WGS 84 ellipsoid"),
        ]
        authority = crs.to_authority(min_confidence=100)
        wkt = crs.to_wkt(WktVersion.WKT1_GDAL)
        if authority and authority[0] == "EPSG":
            srs_id = int(authority[1])
            rows.append((crs.name, srs_id, "EPSG", srs_id, wkt, ""))
        else:
            srs_id = CUSTOM_SRS_ID
            rows.append((crs.name, srs_id, "NONE", srs_id, wkt, ""))
        self._db.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)", rows)
        return srs_id


@contextmanager
def new_package(path: Path) -> Iterator[GpkgWriter]:
    """A writer on a new file; commits at the end. The caller throws the file away when this fails."""
    db = sqlite3.connect(path, isolation_level=None)
    try:
        # The file is private until it is complete, so that a journal would protect nothing.
        for pragma in ("page_size = 8192", "journal_mode = OFF", "synchronous = OFF", "locking_mode = EXCLUSIVE"):
            db.execute(f"PRAGMA {pragma}")
        db.execute("BEGIN")
        yield GpkgWriter(db)
        db.execute("COMMIT")
    finally:
        db.close()
