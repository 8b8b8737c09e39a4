"""Checks a file against the GeoPackage standard and lists the violated requirements by number.

Standards: OGC 12-128r18 (version 1.3.1) with its extensions for WKT of CRS, metadata and R-trees, and OGC 17-066r1
(tiled gridded coverages). The checks are independent of the writer: they use only SQLite, and OpenCV to decode
tiles."""

import math
import re
import sqlite3
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z")
# table -> columns: name, type, ! NOT NULL, * part of the primary key; 12-128r18 annex C, 17-066r1 clause 7
COLUMNS = {
    "gpkg_spatial_ref_sys": (
        "srs_name TEXT!, srs_id INTEGER!*, organization TEXT!, organization_coordsys_id INTEGER!, "
        "definition TEXT!, description TEXT, definition_12_063 TEXT!"
    ),
    "gpkg_contents": (
        "table_name TEXT!*, data_type TEXT!, identifier TEXT, description TEXT, last_change DATETIME!, "
        "min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER"
    ),
    "gpkg_extensions": "table_name TEXT, column_name TEXT, extension_name TEXT!, definition TEXT!, scope TEXT!",
    "gpkg_tile_matrix_set": (
        "table_name TEXT!*, srs_id INTEGER!, min_x DOUBLE!, min_y DOUBLE!, max_x DOUBLE!, max_y DOUBLE!"
    ),
    "gpkg_tile_matrix": (
        "table_name TEXT!*, zoom_level INTEGER!*, matrix_width INTEGER!, matrix_height INTEGER!, "
        "tile_width INTEGER!, tile_height INTEGER!, pixel_x_size DOUBLE!, pixel_y_size DOUBLE!"
    ),
    "gpkg_geometry_columns": (
        "table_name TEXT!*, column_name TEXT!*, geometry_type_name TEXT!, srs_id INTEGER!, z TINYINT!, m TINYINT!"
    ),
    "gpkg_metadata": "id INTEGER!*, md_scope TEXT!, md_standard_uri TEXT!, mime_type TEXT!, metadata TEXT!",
    "gpkg_metadata_reference": (
        "reference_scope TEXT!, table_name TEXT, column_name TEXT, row_id_value INTEGER, timestamp DATETIME!, "
        "md_file_id INTEGER!, md_parent_id INTEGER"
    ),
    "gpkg_2d_gridded_coverage_ancillary": (
        "id INTEGER!*, tile_matrix_set_name TEXT!, datatype TEXT!, scale REAL!, offset REAL!, precision REAL, "
        "data_null REAL, grid_cell_encoding TEXT, uom TEXT, field_name TEXT, quantity_definition TEXT"
    ),
    "gpkg_2d_gridded_tile_ancillary": (
        "id INTEGER!*, tpudt_name TEXT!, tpudt_id INTEGER!, scale REAL!, offset REAL!, min REAL, max REAL, "
        "mean REAL, std_dev REAL"
    ),
}
TILE_COLUMNS = "id INTEGER*, zoom_level INTEGER!, tile_column INTEGER!, tile_row INTEGER!, tile_data BLOB!"
GEOMETRIES = {"GEOMETRY", "POINT", "LINESTRING", "POLYGON", "MULTIPOINT", "MULTILINESTRING", "MULTIPOLYGON"}
RTREE = {f"rtree_{{}}_geom_{name}" for name in ("insert", "update1", "update2", "update3", "update4", "delete")}
COVERAGE = "2d-gridded-coverage"

Find = Callable[..., list[tuple]]


def violations(path: Path) -> list[str]:
    """-> one text for each violation; empty: the file passes all checks."""
    db = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
    try:

        def find(sql: str, *values: object) -> list[tuple]:
            return db.execute(sql, values).fetchall()

        checks = (_file, _tables, _contents, _references, _extensions, _tiles, _features, _coverage, _metadata)
        return [problem for check in checks for problem in check(path, find)]
    finally:
        db.close()


def _names(find: Find) -> set[str]:
    return {name for (name,) in find("SELECT name FROM sqlite_master WHERE type = 'table'")}


def _file(path: Path, find: Find) -> Iterator[str]:
    head = path.read_bytes()[:100]
    if head[:16] != b"SQLite format 3\0":
        yield "1: not an SQLite 3 file"
    if head[68:72] != b"GPKG" or find("PRAGMA user_version")[0][0] not in range(10200, 10500):
        yield "2: application_id or user_version"
    if path.suffix != ".gpkg":
        yield "3: the name does not end in .gpkg"
    if find("PRAGMA integrity_check") != [("ok",)]:
        yield "6: integrity_check"
    if find("PRAGMA foreign_key_check"):
        yield "7: foreign_key_check"


def _tables(_: Path, find: Find) -> Iterator[str]:
    names = _names(find)
    for table in ("gpkg_spatial_ref_sys", "gpkg_contents"):
        if table not in names:
            yield f"10, 13: no {table}"
    for table in names & set(COLUMNS):
        yield from _same_columns(table, find, COLUMNS[table])


def _columns(words: str) -> dict[str, tuple[str, int, int]]:
    """-> column: (type, NOT NULL, part of the primary key)."""
    columns = (column.split() for column in words.split(", "))
    return {name: (kind.rstrip("!*"), int("!" in kind), int("*" in kind)) for name, kind in columns}


def _same_columns(table: str, find: Find, words: str) -> Iterator[str]:
    found = {row[1]: (row[2], row[3], int(row[5] > 0)) for row in find(f'PRAGMA table_info("{table}")')}
    for column, (kind, required, key) in _columns(words).items():
        # A primary key of one INTEGER column cannot be NULL, with or without NOT NULL in the table definition.
        if column not in found or found[column][::2] != (kind, key) or (not key and found[column][1] != required):
            yield f"annex C: {table}.{column} is {found.get(column)}, not {(kind, required, key)}"


def _contents(_: Path, find: Find) -> Iterator[str]:
    srs = {
        row[0]: row[1:]
        for row in find("SELECT srs_id, organization, organization_coordsys_id FROM gpkg_spatial_ref_sys")
    }
    for srs_id, organization, code in ((4326, "EPSG", 4326), (-1, "NONE", -1), (0, "NONE", 0)):
        if srs.get(srs_id, ("", 0))[0].upper() != organization or srs[srs_id][1] != code:
            yield f"11: srs {srs_id}"
    names = _names(find)
    for name, changed in find("SELECT table_name, last_change FROM gpkg_contents"):
        if name not in names:
            yield f"14: contents lists {name}, which does not exist"
        if not TIME.fullmatch(changed):
            yield f"15: last_change {changed}"
    used = {
        row[0]
        for table in ("gpkg_contents", "gpkg_tile_matrix_set")
        if table in names
        for row in find(f"SELECT srs_id FROM {table}")
    }
    if not used - {None} <= set(srs):
        yield f"14, 41: srs {used - set(srs)} not defined"
    listed = {row[0] for row in find("SELECT table_name FROM gpkg_contents")}
    declared = {row[0] for row in find("SELECT table_name FROM gpkg_extensions")}
    for name in names:
        if not name.startswith(("gpkg_", "sqlite_", "rtree_")) and name not in listed | declared:
            yield f"58: table {name} is neither content nor declared as an extension"


def _references(_: Path, find: Find) -> Iterator[str]:
    """WKT of a CRS: extension gpkg_crs_wkt."""
    for srs_id, wkt1, wkt2 in find("SELECT srs_id, definition, definition_12_063 FROM gpkg_spatial_ref_sys"):
        known = srs_id > 0
        if known and wkt1 == wkt2 == "undefined":
            yield f"117: srs {srs_id} has no definition"
        if known and wkt2 != "undefined" and not re.match(r"(PROJCRS|GEOGCRS|GEODCRS|BOUNDCRS|COMPOUNDCRS)\[", wkt2):
            yield f"116: srs {srs_id} is not WKT of ISO 19162"
        if known and wkt1 != "undefined" and not re.match(r"(PROJCS|GEOGCS|COMPD_CS)\[", wkt1):
            yield f"10: srs {srs_id} is not WKT of OGC 01-009"


def _extensions(_: Path, find: Find) -> Iterator[str]:
    names = _names(find)
    rows = find("SELECT table_name, column_name, extension_name, definition, scope FROM gpkg_extensions")
    for table, column, name, definition, scope in rows:
        if table is not None and table not in names:
            yield f"60: extension {name} refers to {table}, which does not exist"
        elif column is not None and column not in {row[1] for row in find(f'PRAGMA table_info("{table}")')}:
            yield f"61: extension {name} refers to {table}.{column}, which does not exist"
        if not re.fullmatch(r"[a-zA-Z0-9]+_\w+", name) or not definition:
            yield f"62, 63: extension {name}: {definition}"
        if scope not in ("read-write", "write-only"):
            yield f"64: scope {scope}"
    declared = {row[2]: {(r[0], r[1]) for r in rows if r[2] == row[2]} for row in rows}
    coverages = {row[0] for row in find("SELECT table_name FROM gpkg_contents WHERE data_type = ?", COVERAGE)}
    wanted = {"gpkg_crs_wkt": {("gpkg_spatial_ref_sys", "definition_12_063")}}
    if "gpkg_metadata" in names:
        wanted["gpkg_metadata"] = {("gpkg_metadata", None), ("gpkg_metadata_reference", None)}
    if coverages:
        wanted["gpkg_2d_gridded_coverage"] = {(table, "tile_data") for table in coverages} | {
            ("gpkg_2d_gridded_coverage_ancillary", None),
            ("gpkg_2d_gridded_tile_ancillary", None),
        }
    trees = {name for name in names if re.fullmatch(r"rtree_\w+_geom", name)}
    if trees:
        wanted["gpkg_rtree_index"] = {(name[len("rtree_") : -len("_geom")], "geom") for name in trees}
    for name, places in wanted.items():
        if declared.get(name) != places:
            yield f"extension {name} is declared for {declared.get(name)}, not {places}"


def _tiles(_: Path, find: Find) -> Iterator[str]:
    rasters = find(
        "SELECT c.table_name, c.data_type, c.srs_id, m.srs_id, m.min_x, m.min_y, m.max_x, m.max_y FROM gpkg_contents c"
        " LEFT JOIN gpkg_tile_matrix_set m USING (table_name) WHERE c.data_type IN ('tiles', ?)",
        COVERAGE,
    )
    for table, kind, srs_id, matrix_srs_id, min_x, min_y, max_x, max_y in rasters:
        if matrix_srs_id is None or srs_id != matrix_srs_id or not (max_x > min_x and max_y > min_y):
            yield f"38 to 41: no tile matrix set of {table}, or another CRS"
            continue
        yield from _same_columns(table, find, TILE_COLUMNS)
        if not any(row[2] for row in find(f'PRAGMA index_list("{table}")')):
            yield f"54: {table} has no UNIQUE (zoom_level, tile_column, tile_row)"
        matrices = find(
            "SELECT zoom_level, matrix_width, matrix_height, tile_width, tile_height, pixel_x_size, pixel_y_size"
            " FROM gpkg_tile_matrix WHERE table_name = ? ORDER BY zoom_level",
            table,
        )
        before: tuple | None = None
        for matrix in matrices:
            zoom, columns, rows, width, height, pixel_x, pixel_y = matrix
            if zoom < 0 or min(columns, rows, width, height) < 1 or min(pixel_x, pixel_y) <= 0:
                yield f"46 to 52: {table} zoom {zoom}"
            across, down = columns * width * pixel_x, rows * height * pixel_y
            if not (
                math.isclose(across, max_x - min_x, rel_tol=1e-9) and math.isclose(down, max_y - min_y, rel_tol=1e-9)
            ):
                yield f"45: the matrix of {table} zoom {zoom} does not span the tile matrix set"
            if before and not (zoom == before[0] + 1 and math.isclose(before[5], 2 * pixel_x, rel_tol=1e-9)):
                yield f"35, 53: {table} zoom {zoom} is not twice as fine as the one before"
            before = matrix
        zooms = {matrix[0]: matrix for matrix in matrices}
        for zoom, column, row, data in find(f'SELECT zoom_level, tile_column, tile_row, tile_data FROM "{table}"'):
            if zoom not in zooms or not (0 <= column < zooms[zoom][1] and 0 <= row < zooms[zoom][2]):
                yield f"44, 56, 57: tile {zoom}/{column}/{row} of {table} is outside"
                continue
            png, jpeg = data[:8] == b"\x89PNG\r\n\x1a\n", data[:3] == b"\xff\xd8\xff"
            if not png and (not jpeg or kind != "tiles"):
                yield f"36: tile {zoom}/{column}/{row} of {table} is neither PNG nor JPEG"
                continue
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
            if image is None or image.shape[:2] != zooms[zoom][4:2:-1]:
                yield f"49, 50: tile {zoom}/{column}/{row} of {table} does not decode, or has another size"


def _features(_: Path, find: Find) -> Iterator[str]:
    names = _names(find)
    listed = find("SELECT table_name, srs_id FROM gpkg_contents WHERE data_type = 'features'")
    if listed and "gpkg_geometry_columns" not in names:
        yield "22: features without gpkg_geometry_columns"
        return
    for table, srs_id in listed:
        columns = find(
            "SELECT column_name, geometry_type_name, srs_id, z, m FROM gpkg_geometry_columns WHERE table_name = ?",
            table,
        )
        if len(columns) != 1 or columns[0][1] not in GEOMETRIES or columns[0][2] != srs_id:
            yield f"22 to 26: geometry column of {table}"
            continue
        if not {columns[0][3], columns[0][4]} <= {0, 1, 2}:
            yield f"27: z or m of {table}"
        if [row[5] for row in find(f'PRAGMA table_info("{table}")') if row[2] == "INTEGER"] != [1]:
            yield f"29: {table} has no integer primary key"
        geometries = [blob for (blob,) in find(f'SELECT "{columns[0][0]}" FROM "{table}"')]
        yield from _geometries(table, srs_id, geometries)
        if f"rtree_{table}_geom" in names:
            yield from _rtree(
                table, sum(_has_header(blob, srs_id) and not _is_empty(blob) for blob in geometries), find
            )
    for (table,) in find("SELECT table_name FROM gpkg_contents WHERE data_type = 'attributes'"):
        if [row[5] for row in find(f'PRAGMA table_info("{table}")') if row[2] == "INTEGER"] != [1]:
            yield f"119: {table} has no integer primary key"


def _has_header(blob: bytes, srs_id: int) -> bool:
    """True for the binary header of GeoPackage with this CRS."""
    return blob[:3] == b"GP\0" and struct.unpack("<i" if blob[3] & 1 else ">i", blob[4:8])[0] == srs_id


def _is_empty(blob: bytes) -> bool:
    """True for the flag of an empty geometry in the header."""
    return bool(blob[3] & 0x10)


def _geometries(table: str, srs_id: int, geometries: list[bytes]) -> Iterator[str]:
    for blob in geometries:
        if not _has_header(blob, srs_id):
            yield f"19: a geometry of {table} has no header of GeoPackage"
        elif not _is_empty(blob) and len(blob) <= 8 + (0, 32, 48, 48, 64)[(blob[3] >> 1) & 7]:
            yield f"19: a geometry of {table} has no WKB"


def _rtree(table: str, features: int, find: Find) -> Iterator[str]:
    """``features``: number of non-empty features of the table."""
    triggers = {name for (name,) in find("SELECT name FROM sqlite_master WHERE type = 'trigger'")}
    if {name.format(table) for name in RTREE} - triggers:
        yield f"75: triggers of the R-tree of {table}"
    if find(f'SELECT count(*) FROM "rtree_{table}_geom"') != [(features,)]:
        yield f"77: the R-tree of {table} does not have the {features} non-empty features"


def _coverage(_: Path, find: Find) -> Iterator[str]:
    for (table,) in find("SELECT table_name FROM gpkg_contents WHERE data_type = ?", COVERAGE):
        rows = find(
            "SELECT datatype, data_null FROM gpkg_2d_gridded_coverage_ancillary WHERE tile_matrix_set_name = ?", table
        )
        if len(rows) != 1 or rows[0][0] != "integer":
            yield f"gridded coverage 7, 9: ancillary row of {table}"
        if find("SELECT count(*) FROM gpkg_spatial_ref_sys WHERE srs_id = 4979") != [(1,)]:
            yield "gridded coverage 3: no srs 4979"
        described = {
            row[0] for row in find("SELECT tpudt_id FROM gpkg_2d_gridded_tile_ancillary WHERE tpudt_name = ?", table)
        }
        if described != {row[0] for row in find(f'SELECT id FROM "{table}"')}:
            yield f"gridded coverage 10 to 12: not every tile of {table} has its ancillary row"
        for (data,) in find(f'SELECT tile_data FROM "{table}"'):
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
            if data[:4] != b"\x89PNG" or image is None or image.dtype != np.uint16 or image.ndim != 2:
                yield f"gridded coverage 13: a tile of {table} is no grey PNG of 16 bits"


def _metadata(_: Path, find: Find) -> Iterator[str]:
    if "gpkg_metadata" not in _names(find):
        return
    for (scope,) in find("SELECT md_scope FROM gpkg_metadata"):
        if scope not in ("undefined", "dataset", "series", "feature", "tile", "attribute"):
            yield f"94: md_scope {scope}"
    rows = find("SELECT reference_scope, table_name, column_name, row_id_value, timestamp FROM gpkg_metadata_reference")
    for scope, table, column, row, time in rows:
        if scope not in ("geopackage", "table", "column", "row", "row/col"):
            yield f"96: reference_scope {scope}"
        if scope == "table" and (table is None or column is not None or row is not None):
            yield f"97 to 99: a reference to the table {table} names a column or a row"
        if not TIME.fullmatch(time):
            yield f"100: timestamp {time}"
