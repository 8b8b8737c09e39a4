"""File digest ("seal") of a map package: a sha256 over every byte of the file, stored in the file itself.

The hashes of tiles and manifest protect the data that is used in flight; these hashes are what is signed. They do not
cover data that is not read in flight: the tables of the GeoPackage standard, indices, the free space in pages. The file
digest also detects one altered byte there. The digest is a BLOB that follows a marker; its own bytes count as zeros in
the hash. So do the header bytes that SQLite rewrites when a program such as QGIS opens the file for writing
(sqlite.org/fileformat2.html, 1.3: versions for writing and reading, change counter, version-valid-for, version)."""

import hashlib
import mmap
from pathlib import Path

DIGEST_MARKER = bytes.fromhex("9f1d0b7e54c6a238e06b4f93d17a85fc")  # precedes the digest in the file; a random constant
DIGEST_BYTES = 32
EMPTY_DIGEST = DIGEST_MARKER + bytes(DIGEST_BYTES)  # placeholder before the digest is computed
VOLATILE_HEADER_BYTES = ((18, 20), (24, 28), (92, 100))  # byte ranges of the SQLite header that count as zeros


def write_file_digest(path: Path) -> None:
    """Computes the digest of a file that contains ``EMPTY_DIGEST`` and writes it in place. Raises OSError."""
    with path.open("r+b") as file:
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            at = data.find(DIGEST_MARKER) + len(DIGEST_MARKER)
            digest = _digest(data, at)
        file.seek(at)
        file.write(digest)


def file_digest_matches(path: Path) -> bool:
    """True when the digest in the file matches its content, or is all zeros (signing was interrupted). Raises OSError.

    False when the file has no marker."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        at = data.find(DIGEST_MARKER) + len(DIGEST_MARKER)
        if at < len(DIGEST_MARKER):
            return False
        stored = data[at : at + DIGEST_BYTES]
        return not any(stored) or stored == _digest(data, at)


def _digest(data: mmap.mmap, at: int) -> bytes:
    digest = hashlib.sha256()
    done = 0
    with memoryview(data) as view:
        for start, end in sorted((*VOLATILE_HEADER_BYTES, (at, at + DIGEST_BYTES))):
            digest.update(view[done:start])
            digest.update(bytes(end - start))
            done = end
        digest.update(view[done:])
    return digest.digest()
