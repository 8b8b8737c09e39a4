"""The format of a map package: tables, manifest, checksum, and the checks at opening."""

import hashlib
import sqlite3
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import msgspec

from terrafix.core.errors import MapError

FORMAT_VERSION = 1
APPLICATION_ID = 0x47504B47  # "GPKG", OGC 12-128r18 requirement 2
IMAGERY_TABLE = "imagery"
MANIFEST_TABLE = "terrafix_manifest"
HASH_TABLE = "terrafix_tile_hash"
DEM_TABLE = "terrafix_dem"
TILE_PX = 256
DEM_TILE_PX = 256  # plus one column and row of the next tile, so that bilinear interpolation stays inside a tile


class DemGrid(msgspec.Struct, frozen=True, kw_only=True):
    """Placement of the elevation grid in the map's CRS; x_min, y_max is the outer corner of the first pixel."""

    x_min: float
    y_max: float
    pixel: float  # CRS units
    width_px: int
    height_px: int


class Manifest(msgspec.Struct, frozen=True, kw_only=True):
    """What the package says about itself; one row each in the table terrafix_manifest."""

    format_version: int
    name: str
    gsd_m: float  # ground metres per pixel of the finest level at the centre of the map
    crs: str  # "EPSG:32651", or WKT
    bounds_wgs84: tuple[float, float, float, float]  # west, south, east, north, degrees
    date: str  # of the imagery, YYYY-MM-DD; empty = unknown
    licence: str
    source: str  # file name
    source_sha256: str
    built_with: str
    has_dem: bool
    dem: DemGrid | None
    tiles: int  # imagery and elevation tiles together
    checksum: str  # sha256 over the other rows and every tile's sha256
    ce90_m: float | None = None  # radius that holds 90 % of the errors of position of this map; None: not stated


@dataclass(frozen=True)
class Level:
    """One zoom level: tile matrix of 256 px tiles. Units of the CRS."""

    zoom: int
    pixel_x: float
    pixel_y: float
    columns: int
    rows: int


def manifest_rows(manifest: Manifest) -> list[tuple[str, str]]:
    """(key, value) rows of the table: text as it is, everything else as JSON."""
    rows = []
    for name in manifest.__struct_fields__:
        value = getattr(manifest, name)
        rows.append((name, value if isinstance(value, str) else msgspec.json.encode(value).decode()))
    return rows


def checksum_of(rows: list[tuple[str, str]], hashes: list[tuple[int, int, int, bytes]]) -> str:
    """sha256 over the manifest rows but `checksum`, and over (zoom, column, row, sha256) of every tile, sorted."""
    digest = hashlib.sha256()
    for key, value in sorted(rows):
        if key != "checksum":
            digest.update(f"{key}={value}\n".encode())
    for zoom, column, row, tile_hash in sorted(hashes):
        digest.update(f"{zoom}/{column}/{row}:".encode() + tile_hash)
    return digest.hexdigest()


def connect(path: Path) -> sqlite3.Connection:
    """Read-only connection after the checks that need no SQL."""
    if not path.is_file():
        raise MapError(f"{path}: no such map package; make one with 'terrafix map build IMAGERY.tif --out MAP.gpkg'")
    try:
        with path.open("rb") as file:
            head = file.read(100)
    except OSError as error:
        raise MapError(f"{path}: cannot be read ({error.strerror})") from None
    if head[:16] != b"SQLite format 3\x00" or len(head) < 100:
        raise MapError(f"{path}: not a map package; make one with 'terrafix map build {path.name} --out MAP.gpkg'")
    page = int.from_bytes(head[16:18], "big")
    expected = (65536 if page == 1 else page) * int.from_bytes(head[28:32], "big")  # sqlite.org/fileformat2.html
    actual = path.stat().st_size
    if actual < expected:
        raise MapError(f"{path}: truncated map package ({actual} of {expected} bytes); copy or build it again")
    # immutable: no locks and no journal beside the file, so that a read-only medium will do.
    return sqlite3.connect(f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1", uri=True)


def read_manifest(path: Path, db: sqlite3.Connection) -> Manifest:
    tables = {row[0] for row in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if db.execute("PRAGMA application_id").fetchone()[0] != APPLICATION_ID or MANIFEST_TABLE not in tables:
        raise MapError(f"{path}: not a Terrafix map package; make one with 'terrafix map build {path.name} --out ...'")
    rows: dict[str, str] = dict(db.execute(f"SELECT key, value FROM {MANIFEST_TABLE}"))
    version = rows.get("format_version", "")
    if version.isdigit() and int(version) > FORMAT_VERSION:
        raise MapError(
            f"{path}: map package of format {version}, this Terrafix reads up to {FORMAT_VERSION}; update Terrafix"
        )
    fields: dict[str, Any] = {}
    try:
        for field in msgspec.structs.fields(Manifest):
            if field.name not in rows and not field.required:
                continue
            text = rows[field.name]
            fields[field.name] = text if field.type is str else msgspec.json.decode(text, type=field.type)
    except (KeyError, msgspec.DecodeError) as error:
        raise MapError(f"{path}: damaged manifest ({error}); build or copy the package again") from None
    manifest = Manifest(**fields)
    needed = {"gpkg_contents", "gpkg_tile_matrix", "gpkg_tile_matrix_set", IMAGERY_TABLE, HASH_TABLE}
    missing = needed - tables
    if missing:
        raise MapError(f"{path}: damaged map package (no table {min(missing)}); build or copy it again")
    hashes = db.execute(f"SELECT zoom_level, tile_column, tile_row, sha256 FROM {HASH_TABLE}").fetchall()
    if len(hashes) != manifest.tiles or checksum_of(list(rows.items()), hashes) != manifest.checksum:
        raise MapError(f"{path}: checksum mismatch, the package was altered; build or copy it again")
    return manifest
