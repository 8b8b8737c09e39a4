"""Replaces the manifest of an unsigned package and updates checksum and file digest."""

import sqlite3
from pathlib import Path

from terrafix.map.checksum import EMPTY_DIGEST, write_file_digest
from terrafix.map.format import HASH_TABLE, MANIFEST_TABLE, SEAL_TABLE, Manifest, checksum_of, manifest_rows


def rewrite_manifest(package: Path, manifest: Manifest) -> None:
    """``manifest``: the new manifest; tables and tiles are unchanged."""
    db = sqlite3.connect(package)
    try:
        hashes = db.execute(f"SELECT table_name, zoom_level, tile_column, tile_row, sha256 FROM {HASH_TABLE}")
        rows = dict(manifest_rows(manifest))
        rows["checksum"] = checksum_of(rows.items(), hashes.fetchall())
        with db:
            db.executemany(f"UPDATE {MANIFEST_TABLE} SET value = ? WHERE key = ?", [(v, k) for k, v in rows.items()])
            db.execute(f"UPDATE {SEAL_TABLE} SET seal = ?", (EMPTY_DIGEST,))
    finally:
        db.close()
    write_file_digest(package)
