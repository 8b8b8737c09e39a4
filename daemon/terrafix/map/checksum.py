"""The seal of a map package: a sha256 over every byte of the file, kept in the file itself.

Hashes of tiles and manifest say that what flies is right, and are what is signed. They leave out what nothing in flight
reads: the tables of the standard, indices, the free space in pages. The seal finds one altered byte there, too. It is a
blob whose place the marker shows, and stands for zeros in what is hashed. So do the bytes of the header that SQLite
changes when somebody has looked at the file with a program that opens it for writing, like QGIS
(sqlite.org/fileformat2.html, 1.3: versions for writing and reading, change counter, version-valid-for, version)."""

import hashlib
import mmap
from pathlib import Path

MARKER = bytes.fromhex("9f1d0b7e54c6a238e06b4f93d17a85fc")
DIGEST_BYTES = 32
BLANK = MARKER + bytes(DIGEST_BYTES)  # not sealed yet
VOLATILE = ((18, 20), (24, 28), (92, 100))


def write_seal(path: Path) -> None:
    """Seals a file in which ``BLANK`` stands somewhere. Raises OSError."""
    with path.open("r+b") as file:
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            at = data.find(MARKER) + len(MARKER)
            digest = _digest(data, at)
        file.seek(at)
        file.write(digest)


def is_sealed(path: Path) -> bool:
    """Whether the file is what was sealed. A blank seal says nothing: signing was interrupted. Raises OSError."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        at = data.find(MARKER) + len(MARKER)
        if at < len(MARKER):
            return False
        kept = data[at : at + DIGEST_BYTES]
        return not any(kept) or kept == _digest(data, at)


def _digest(data: mmap.mmap, at: int) -> bytes:
    digest = hashlib.sha256()
    done = 0
    with memoryview(data) as view:
        for start, end in sorted((*VOLATILE, (at, at + DIGEST_BYTES))):
            digest.update(view[done:start])
            digest.update(bytes(end - start))
            done = end
        digest.update(view[done:])
    return digest.digest()
