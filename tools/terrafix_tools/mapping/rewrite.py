"""Writes another manifest into a package that nobody has signed, with checksum and seal."""

import sqlite3
from pathlib import Path

from terrafix.map.checksum import BLANK, write_seal
from terrafix.map.format import HASH_TABLE, MANIFEST_TABLE, SEAL_TABLE, Manifest, checksum_of, manifest_rows


def rewrite_manifest(package: Path, manifest: Manifest) -> None:
    """``manifest``: that of the package, changed; its tables and tiles stay as they are."""
    db = sqlite3.connect(package)
    try:
        hashes = db.execute(f"SELECT table_name, zoom_level, tile_column, tile_row, sha256 FROM {HASH_TABLE}")
        rows = dict(manifest_rows(manifest))
        rows["checksum"] = checksum_of(rows.items(), hashes.fetchall())
        with db:
            db.executemany(f"UPDATE {MANIFEST_TABLE} SET value = ? WHERE key = ?", [(v, k) for k, v in rows.items()])
            db.execute(f"UPDATE {SEAL_TABLE} SET seal = ?", (BLANK,))
    finally:
        db.close()
    write_seal(package)
