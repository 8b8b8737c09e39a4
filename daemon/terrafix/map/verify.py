"""Checks when a map package is opened, before its first tile is used."""

import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import msgspec

from terrafix.core.errors import MapError
from terrafix.core.signature import TrustedKey, is_signed
from terrafix.map.format import (
    APPLICATION_ID,
    DRAWN_TABLE,
    FORMAT_VERSION,
    HASH_TABLE,
    IMAGERY_TABLE,
    MANIFEST_TABLE,
    SIGNATURE_TABLE,
    HashRow,
    Manifest,
    checksum_of,
    signed_bytes,
)
from terrafix.map.rows import typed_rows


def connect(path: Path) -> sqlite3.Connection:
    """Opens a read-only connection, after the checks that need no SQL. Raises MapError."""
    if not path.is_file():
        raise MapError(f"{path}: no such map package; make one with 'terrafix map build IMAGERY.tif --out MAP.gpkg'")
    try:
        with path.open("rb") as file:
            header = file.read(100)
    except OSError as error:
        raise MapError(f"{path}: cannot be read ({error.strerror})") from None
    if header[:16] != b"SQLite format 3\x00" or len(header) < 100:
        raise MapError(f"{path}: not a map package; make one with 'terrafix map build IMAGERY.tif --out MAP.gpkg'")
    page = int.from_bytes(header[16:18], "big")
    expected = (65536 if page == 1 else page) * int.from_bytes(header[28:32], "big")  # sqlite.org/fileformat2.html
    actual = path.stat().st_size
    if actual < expected:
        raise MapError(f"{path}: truncated map package ({actual} of {expected} bytes); copy or build it again")
    if path.with_name(f"{path.name}-journal").exists():
        raise MapError(f"{path}: signing it was interrupted; run 'terrafix map sign' again")
    # immutable: SQLite takes no locks and writes no journal beside the file, so the file may be on a read-only medium.
    # check_same_thread: the last view of a package may be dropped, and so be closed, by another thread than its reader.
    return sqlite3.connect(f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1", uri=True, check_same_thread=False)


def read_manifest(path: Path, db: sqlite3.Connection) -> Manifest:
    """Reads the manifest and verifies its checksum (over the manifest rows and the tile hashes). Raises MapError."""
    tables = {row[0] for row in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if db.execute("PRAGMA application_id").fetchone()[0] != APPLICATION_ID or MANIFEST_TABLE not in tables:
        raise MapError(
            f"{path}: not a Terrafix map package; make one with 'terrafix map build IMAGERY.tif --out MAP.gpkg'"
        )
    rows = dict(typed_rows(db, f"SELECT key, value FROM {MANIFEST_TABLE}", tuple[str, str]))
    version = rows.get("format_version", "")
    if version.isdigit() and int(version) != FORMAT_VERSION:
        remedy = "update Terrafix" if int(version) > FORMAT_VERSION else "build it again"
        raise MapError(f"{path}: map package of format {version}, this Terrafix reads {FORMAT_VERSION}; {remedy}")
    pictures = DRAWN_TABLE if DRAWN_TABLE in tables else IMAGERY_TABLE
    missing = {pictures, HASH_TABLE} - tables
    if missing:
        raise MapError(f"{path}: damaged map package (no table {min(missing)}); build or copy it again")
    columns = "table_name, zoom_level, tile_column, tile_row, sha256"
    hashes: list[HashRow] = typed_rows(db, f"SELECT {columns} FROM {HASH_TABLE}", tuple[str, int, int, int, bytes])
    if checksum_of(rows.items(), hashes) != rows.get("checksum"):
        raise MapError(f"{path}: checksum mismatch, the package was altered; build or copy it again")
    fields: dict[str, Any] = {}
    try:
        for field in msgspec.structs.fields(Manifest):
            if field.name not in rows and not field.required:
                continue
            text = rows[field.name]
            fields[field.name] = text if field.type is str else msgspec.json.decode(text, type=field.type)
        manifest = Manifest(**fields)
    except (KeyError, TypeError, msgspec.DecodeError) as error:
        raise MapError(f"{path}: damaged manifest ({error}); build or copy the package again") from None
    if len(hashes) != manifest.tiles or not manifest.layers:
        raise MapError(f"{path}: damaged manifest (tiles or layers missing); build or copy the package again")
    return manifest


def check_signature(
    path: Path, db: sqlite3.Connection, manifest: Manifest, trusted: Sequence[TrustedKey] | None
) -> tuple[str, ...]:
    """Verifies all signatures; returns the ids of the keys that signed the package.

    ``trusted``: at least one of these keys must have signed; None: an unsigned package is accepted.
    Raises MapError: a signature is wrong (altered after signing), no trusted key signed, or it is not signed."""
    tables = {row[0] for row in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    signed: list[str] = []
    if SIGNATURE_TABLE in tables:
        query = f"SELECT key_id, public_key, signature FROM {SIGNATURE_TABLE}"
        for key_id, public_key, signature in typed_rows(db, query, tuple[str, bytes, bytes]):
            key = TrustedKey(public_key)
            if key.key_id != key_id or not is_signed(key, signed_bytes(manifest.checksum), signature):
                raise MapError(
                    f"{path}: wrong signature (key {key_id}), the package was altered after it was signed; "
                    "copy it again, or sign it again if you know why"
                )
            signed.append(key.key_id)
    if trusted is not None and not signed:
        raise MapError(
            f"{path}: not signed, and [map] require_signature asks for it; "
            f"sign it: terrafix map sign {path.name} --key KEY"
        )
    if trusted is not None and not {key.key_id for key in trusted} & set(signed):
        raise MapError(
            f"{path}: signed by {', '.join(signed)}, which is not in [map] trusted_keys "
            f"({', '.join(key.key_id for key in trusted)}); add its public key, or use a package that you trust"
        )
    return tuple(signed)
