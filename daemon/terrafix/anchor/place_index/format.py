"""Files of a place index, a folder that ``terrafix map index`` writes on the ground:

header.json     ``Header``
vectors.npy     (N, D) float16, unit vectors
positions.npy   (N, 2) int32, latitude and longitude of the disc's centre, degrees times 1e7
ivf.faiss       the same vectors for FAISS; only in an index that is searched by FAISS

The sha256 of each file is in the header. The header is made of data that the packages hold, so it is not signed: a
wrong index can only make a search slower or without a result, because every place that it proposes is verified with the
signed map."""

import hashlib
from pathlib import Path

import msgspec
import numpy as np

from terrafix.core.errors import MapError

INDEX_VERSION = 1  # another version is refused [spec: of this page]
HEADER_FILE, VECTORS, POSITIONS, FAISS = "header.json", "vectors.npy", "positions.npy", "ivf.faiss"
DEGREES = 1e-7  # unit of the positions [spec: MAVLink degE7]
BLOCK_BYTES = 1 << 20  # [spec: 1 MiB]


class IndexedLayer(msgspec.Struct, frozen=True, kw_only=True):
    """One imagery layer of a package: the vectors [first, first + count)."""

    package: str  # file name
    checksum: str  # of the package's manifest: a package that was built again is another one
    table: str
    first: int
    count: int


class File(msgspec.Struct, frozen=True, kw_only=True):
    size_bytes: int
    sha256: str


class Header(msgspec.Struct, frozen=True, kw_only=True):
    """``descriptor``: name of the place descriptor, with the checksum of its weights; ``model``: name by which it is
    opened. ``side_m``: side of the squares, the diameter of the discs; ``step_m``: distance of their centres."""

    version: int
    descriptor: str
    model: str
    size: int
    side_m: float
    step_m: float
    layers: tuple[IndexedLayer, ...]
    files: dict[str, File]

    @property
    def count(self) -> int:
        return sum(layer.count for layer in self.layers)


def read_header(folder: Path, *, verify: bool) -> Header:
    """Reads the header and compares the sizes of all files with it; with ``verify`` their sha256, too, which reads them
    completely. Raises MapError."""
    again = "make it again: terrafix map index"
    try:
        header = msgspec.json.decode((folder / HEADER_FILE).read_bytes(), type=Header)
    except FileNotFoundError:
        raise MapError(f"{folder}: no place index ({HEADER_FILE} is missing); {again}") from None
    except OSError as error:
        raise MapError(f"{folder}: cannot be read ({error.strerror}); check path and permissions") from None
    except msgspec.DecodeError as error:
        raise MapError(f"{folder / HEADER_FILE}: damaged ({error}); {again}") from None
    if header.version != INDEX_VERSION:
        raise MapError(f"{folder}: place index of version {header.version}, not {INDEX_VERSION}; {again}")
    for name, expected in header.files.items():
        if file_of(folder / name, hashed=verify) not in (expected, File(size_bytes=expected.size_bytes, sha256="")):
            raise MapError(f"{folder / name}: altered or incomplete; copy it again, or {again}")
    return header


def file_of(path: Path, *, hashed: bool) -> File:
    """Size and sha256 of a file; the sha256 is empty if not ``hashed``. Raises MapError."""
    try:
        if not hashed:
            return File(size_bytes=path.stat().st_size, sha256="")
        digest = hashlib.sha256()
        with path.open("rb") as file:
            while block := file.read(BLOCK_BYTES):
                digest.update(block)
        return File(size_bytes=path.stat().st_size, sha256=digest.hexdigest())
    except OSError as error:
        raise MapError(f"{path}: cannot be read ({error.strerror}); make it again: terrafix map index") from None


def map_array(path: Path, shape: tuple[int, int], dtype: type) -> np.ndarray:
    """The array of a file, memory-mapped. Raises MapError: it is another array."""
    try:
        array: np.ndarray = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError) as error:
        raise MapError(f"{path}: cannot be read ({error}); make it again: terrafix map index") from None
    if array.shape != shape or array.dtype != dtype:
        raise MapError(f"{path}: is {array.shape} {array.dtype}, not {shape}; make it again: terrafix map index")
    return array
