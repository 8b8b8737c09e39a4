"""Writer of the GeoPackage file: tables of the standard and of Terrafix; the output is deterministic."""

import json
import re
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pyproj import CRS
from pyproj.enums import WktVersion

from terrafix.map.checksum import EMPTY_DIGEST, write_file_digest
from terrafix.map.format import (
    APPLICATION_ID,
    DEM_NULL,
    DEM_TILE_PX,
    ELEVATION_TABLE,
    HASH_TABLE,
    MANIFEST_TABLE,
    SEAL_TABLE,
    SIGNATURE_TABLE,
    TILE_PX,
    DemGrid,
    Layer,
    Level,
    Manifest,
    checksum_of,
    manifest_rows,
    tile_sha256,
)
from terrafix_tools.mapping.imagery import Bounds
from terrafix_tools.mapping.package import gpkg_schema

GPKG_VERSION = 10300  # requirement 2: user_version MMmmPP
WGS84, WGS84_3D = 4326, 4979
CUSTOM_SRS_ID = 100_000  # id of the first CRS without an EPSG code
UNDATED = "1970-01-01"  # last_change is mandatory; a constant keeps builds of the same input identical
DUBLIN_CORE = "http://purl.org/dc/terms/"


class GpkgWriter:
    """Tables and tiles of one new package. The bytes depend on the order of the calls."""

    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db
        self._srs: dict[str, int] = {}
        self.tiles: dict[str, int] = {}  # by table
        db.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        db.execute(f"PRAGMA user_version = {GPKG_VERSION}")
        self.create(gpkg_schema.CORE)
        self.add_extension("gpkg_spatial_ref_sys", "definition_12_063", "gpkg_crs_wkt")
        self.add_extension("gpkg_metadata", None, "gpkg_metadata")
        self.add_extension("gpkg_metadata_reference", None, "gpkg_metadata")
        self._add_undefined_srs()
        self.add_contents(MANIFEST_TABLE, "attributes", "", "What this map is; written by Terrafix", None, None)
        self.add_contents(SIGNATURE_TABLE, "attributes", "", "Who vouches for it; written by Terrafix", None, None)
        self.add_extension(HASH_TABLE, None, "terrafix_map")
        self.add_extension(SEAL_TABLE, None, "terrafix_map")
        db.execute(f"INSERT INTO {SEAL_TABLE} (seal) VALUES (?)", (EMPTY_DIGEST,))

    def create(self, statements: str) -> None:
        for statement in re.split(r";\n(?=CREATE|$)", statements.strip() + "\n"):
            if statement.strip():
                self._db.execute(statement)

    def add_contents(
        self, table: str, kind: str, date: str, description: str, bounds: Bounds | None, srs_id: int | None
    ) -> None:
        changed = f"{date or UNDATED}T00:00:00.000Z"
        box = bounds or (None, None, None, None)
        row = (table, kind, table, description, changed, *box, srs_id)
        self._db.execute("INSERT INTO gpkg_contents VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", row)

    def add_extension(self, table: str, column: str | None, name: str) -> None:
        row = (table, column, name, *gpkg_schema.EXTENSIONS[name])
        self._db.execute("INSERT INTO gpkg_extensions VALUES (?, ?, ?, ?, ?)", row)

    def add_metadata(self, table: str, title: str, date: str, licence: str, source: str) -> None:
        """Descriptive metadata of a table, as Dublin Core."""
        text = json.dumps({"title": title, "date": date, "license": licence, "source": source}, ensure_ascii=False)
        md_id = self._db.execute(
            "INSERT INTO gpkg_metadata (md_scope, md_standard_uri, mime_type, metadata) VALUES (?, ?, ?, ?)",
            ("dataset", DUBLIN_CORE, "application/json", text),
        ).lastrowid
        row = ("table", table, None, None, f"{date or UNDATED}T00:00:00.000Z", md_id, None)
        self._db.execute("INSERT INTO gpkg_metadata_reference VALUES (?, ?, ?, ?, ?, ?, ?)", row)

    def add_imagery_table(self, layer: Layer, title: str) -> None:
        """Contents, tile matrices and the empty tile table of a layer."""
        srs_id = self.srs_id(CRS.from_user_input(layer.crs))
        description = ", ".join(text for text in (layer.date, layer.licence) if text)
        self._add_matrix(layer.table, "tiles", layer.date, description, layer.bounds, srs_id, layer.levels)
        self.add_metadata(layer.table, title, layer.date, layer.licence, layer.source)

    def add_elevation_table(self, grid: DemGrid, crs: CRS, level: Level, precision_m: float) -> None:
        """Contents, tile matrix, coverage and the empty tile table of the elevation (OGC 17-066r1)."""
        bounds = (
            grid.x_min,
            grid.y_max - grid.height_px * grid.pixel,
            grid.x_min + grid.width_px * grid.pixel,
            grid.y_max,
        )
        what = "Height above mean sea level, metres"
        self._add_matrix(ELEVATION_TABLE, "2d-gridded-coverage", "", what, bounds, self.srs_id(crs), (level,))
        self.create(gpkg_schema.COVERAGE)
        self._db.execute(
            "INSERT INTO gpkg_2d_gridded_coverage_ancillary (tile_matrix_set_name, datatype, scale, offset, precision,"
            " data_null, grid_cell_encoding, uom, field_name, quantity_definition)"
            " VALUES (?, 'integer', 1.0, 0.0, ?, ?, 'grid-value-is-center', 'm', 'Height', ?)",
            (ELEVATION_TABLE, precision_m, DEM_NULL, what),
        )
        for table in ("gpkg_2d_gridded_coverage_ancillary", "gpkg_2d_gridded_tile_ancillary"):
            self.add_extension(table, None, "gpkg_2d_gridded_coverage")
        self.add_extension(ELEVATION_TABLE, "tile_data", "gpkg_2d_gridded_coverage")
        self.add_metadata(ELEVATION_TABLE, what, "", grid.licence, grid.source)

    def add_descriptor_table(self, table: str, layer: Layer, name: str) -> None:
        """Contents and the empty table of the descriptors of a layer."""
        self.create(gpkg_schema.DESCRIPTORS.format(table=table))
        self.tiles[table] = 0
        self.add_contents(table, "attributes", layer.date, f"Descriptors of {layer.table}: {name}", None, None)
        self.add_extension(table, "tile_data", "terrafix_descriptors")
        self.add_metadata(table, f"Descriptors: {name}", layer.date, layer.licence, layer.source)

    def add_tile(self, table: str, zoom: int, column: int, row: int, data: bytes) -> None:
        """A tile of imagery (JPEG or PNG) or of its descriptors (PNG)."""
        self._add_tile(table, zoom, column, row, data, tile_sha256(data))

    def add_elevation_tile(
        self, column: int, row: int, data: bytes, scale: float, offset: float, statistics: tuple[float, ...]
    ) -> None:
        """A 16-bit PNG; ``statistics``: min, max, mean, standard deviation in metres."""
        tile_id = self._add_tile(ELEVATION_TABLE, 0, column, row, data, tile_sha256(data, scale, offset))
        self._db.execute(
            "INSERT INTO gpkg_2d_gridded_tile_ancillary (tpudt_name, tpudt_id, scale, offset, min, max, mean, std_dev)"
            " VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
            (ELEVATION_TABLE, tile_id, scale, offset, *statistics),
        )

    def add_manifest(self, manifest: Manifest) -> None:
        """Writes the manifest with its checksum."""
        hashes = self._db.execute(f"SELECT table_name, zoom_level, tile_column, tile_row, sha256 FROM {HASH_TABLE}")
        rows = dict(manifest_rows(manifest))
        rows["checksum"] = checksum_of(rows.items(), hashes.fetchall())
        self._db.executemany(f"INSERT INTO {MANIFEST_TABLE} (key, value) VALUES (?, ?)", rows.items())

    def srs_id(self, crs: CRS) -> int:
        """Id of a CRS; adds the CRS when it is new."""
        authority = crs.to_authority(min_confidence=100)
        wkt = crs.to_wkt(WktVersion.WKT1_GDAL)
        if wkt not in self._srs:
            if authority and authority[0] == "EPSG":
                srs_id, organisation = int(authority[1]), "EPSG"
            else:
                srs_id, organisation = CUSTOM_SRS_ID + len(self._srs), "NONE"
            self._srs[wkt] = srs_id
            row = (crs.name, srs_id, organisation, srs_id, wkt, "", crs.to_wkt(WktVersion.WKT2_2015))
            self._db.execute("INSERT OR IGNORE INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?, ?)", row)
        return self._srs[wkt]

    def _add_undefined_srs(self) -> None:
        """Requirement 11 of the core, and the row that the gridded coverage extension requires."""
        for name, srs_id in (("Undefined Cartesian SRS", -1), ("Undefined geographic SRS", 0)):
            row = (name, srs_id, "NONE", srs_id, "undefined", name.lower(), "undefined")
            self._db.execute("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?, ?)", row)
        self.srs_id(CRS.from_epsg(WGS84))
        wkt2 = CRS.from_epsg(WGS84_3D).to_wkt(WktVersion.WKT2_2015)
        row = ("WGS 84 3D", WGS84_3D, "EPSG", WGS84_3D, "undefined", "longitude, latitude and ellipsoidal height", wkt2)
        self._db.execute("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?, ?)", row)

    def _add_matrix(
        self,
        table: str,
        kind: str,
        date: str,
        description: str,
        bounds: Bounds,
        srs_id: int,
        levels: tuple[Level, ...],
    ) -> None:
        self.create(gpkg_schema.TILES.format(table=table))
        self.tiles[table] = 0
        self.add_contents(table, kind, date, description, bounds, srs_id)
        finest = levels[-1]
        x_max = bounds[0] + finest.columns * TILE_PX * finest.pixel_x
        y_min = bounds[3] - finest.rows * TILE_PX * finest.pixel_y
        row = (table, srs_id, bounds[0], y_min, x_max, bounds[3])
        self._db.execute("INSERT INTO gpkg_tile_matrix_set VALUES (?, ?, ?, ?, ?, ?)", row)
        side = DEM_TILE_PX if table == ELEVATION_TABLE else TILE_PX
        for level in levels:
            matrix = (table, level.zoom, level.columns, level.rows, side, side, level.pixel_x, level.pixel_y)
            self._db.execute("INSERT INTO gpkg_tile_matrix VALUES (?, ?, ?, ?, ?, ?, ?, ?)", matrix)

    def _add_tile(self, table: str, zoom: int, column: int, row: int, data: bytes, sha256: bytes) -> int:
        added = self._db.execute(
            f'INSERT INTO "{table}" (zoom_level, tile_column, tile_row, tile_data) VALUES (?, ?, ?, ?)',
            (zoom, column, row, data),
        )
        self._db.execute(f"INSERT INTO {HASH_TABLE} VALUES (?, ?, ?, ?, ?)", (table, zoom, column, row, sha256))
        self.tiles[table] += 1
        assert added.lastrowid is not None
        return added.lastrowid


@contextmanager
def new_package(path: Path) -> Iterator[tuple[GpkgWriter, sqlite3.Connection]]:
    """A writer on a new file; commits and writes the file digest at the end. On failure the caller deletes the file."""
    db = sqlite3.connect(path, isolation_level=None)
    try:
        # The file is private until it is complete, so a journal would be of no use.
        for pragma in ("page_size = 8192", "journal_mode = OFF", "synchronous = OFF", "locking_mode = EXCLUSIVE"):
            db.execute(f"PRAGMA {pragma}")
        db.execute("BEGIN")
        yield GpkgWriter(db), db
        db.execute("COMMIT")
    finally:
        db.close()
    write_file_digest(path)
