"""Signs a map package: an Ed25519 signature over its checksum, stored in the package."""

import sqlite3
from pathlib import Path

from terrafix.core.errors import OutputError
from terrafix.core.signature import TrustedKey, sign
from terrafix.map.checksum import EMPTY_DIGEST, write_file_digest
from terrafix.map.format import SEAL_TABLE, SIGNATURE_TABLE, signed_bytes
from terrafix.map.package import DATABASE_ERRORS, MapPackage


def sign_package(package: Path, private_key: Path) -> TrustedKey:
    """Verifies every tile, then signs. Returns the public key. A new signature of the same key replaces the old one;
    those of other keys remain. Raises MapError, UsageError, OutputError."""
    _finish_interrupted(package)
    opened = MapPackage.open(package, verify=True)
    manifest = opened.manifest
    opened.close()
    key, signature = sign(private_key, signed_bytes(manifest.checksum))
    try:
        db = sqlite3.connect(package)
        try:
            with db:  # one transaction: an interrupted one is rolled back
                db.execute(
                    f"INSERT OR REPLACE INTO {SIGNATURE_TABLE} (key_id, public_key, signature) VALUES (?, ?, ?)",
                    (key.key_id, key.raw, signature),
                )
                if manifest.sealed:  # an interruption after this leaves a blank file digest and a valid signature
                    db.execute(f"UPDATE {SEAL_TABLE} SET seal = ?", (EMPTY_DIGEST,))
        finally:
            db.close()
        if manifest.sealed:
            write_file_digest(package)
    except (sqlite3.OperationalError, OSError) as error:
        raise OutputError(f"{package}: cannot be written ({error}); check permissions and space") from None
    MapPackage.open(package, trusted=[key]).close()
    return key


def _finish_interrupted(package: Path) -> None:
    """Rolls back an interrupted signing: SQLite does that when it opens the file for writing."""
    if package.with_name(f"{package.name}-journal").exists():
        db = sqlite3.connect(package)
        try:
            db.execute("SELECT count(*) FROM sqlite_master").fetchone()
        except DATABASE_ERRORS:
            pass  # reported by the opening that follows
        finally:
            db.close()
