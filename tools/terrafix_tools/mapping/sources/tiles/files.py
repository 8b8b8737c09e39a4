"""Local tile files: MBTiles (1.3, also the format of the download store) and PMTiles (version 3)."""

import gzip
import math
import mmap
import sqlite3
import struct
import weakref
import zlib
from functools import lru_cache
from pathlib import Path
from urllib.parse import quote

from pmtiles.tile import (
    Compression,
    Entry,
    MagicNumberNotFound,
    SpecVersionUnsupported,
    TileType,
    deserialize_directory,
    deserialize_header,
    find_tile,
    zxy_to_tileid,
)

from terrafix.core.errors import MapError
from terrafix_tools.mapping.sources.tiles.grid import MAX_ZOOM, Tile
from terrafix_tools.mapping.sources.tiles.store import mbtiles_row

# SQLite's message about a damaged file may quote its bytes, which then are not valid UTF-8; a length in it may be more
# than there is memory.
DATABASE_ERRORS = (sqlite3.DatabaseError, UnicodeDecodeError, MemoryError)
PICTURES = (TileType.PNG, TileType.JPEG, TileType.WEBP)
DIRECTORIES = 64  # decompressed directories of a PMTiles file in the cache
HEADER_BYTES = 127
MERCATOR_END_DEG = 85.051129  # latitude at which the square of Web Mercator ends
FITS = 0.5  # share of common rows; of a wrong reading it is zero but near the equator
MAX_DIRECTORY_DEPTH = 4  # maximum depth; a PMTiles directory is at most three levels below the root


class MbtilesReader:
    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.is_file():
            raise MapError(f"{path}: no such file; check the path of the source")
        try:
            self._db = sqlite3.connect(f"file:{quote(str(path.resolve()))}?mode=ro", uri=True)
            self._close = weakref.finalize(self, self._db.close)  # also of a file that is refused below
            rows = self._db.execute("SELECT DISTINCT zoom_level FROM tiles ORDER BY zoom_level").fetchall()
        except DATABASE_ERRORS as error:
            raise MapError(f"{path}: not an MBTiles file ({error}); check the source") from None
        self.zooms = [row[0] for row in rows]
        if not self.zooms:
            raise MapError(f"{path}: holds no tile; check the source")
        if not all(isinstance(zoom, int) and 0 <= zoom <= MAX_ZOOM for zoom in self.zooms):
            raise MapError(f"{path}: a zoom level of it is none of 0 to {MAX_ZOOM}; check the source")
        self.from_north, self.notes = self._rows()

    def _rows(self) -> tuple[bool, tuple[str, ...]]:
        """Whether its rows count from the north, against the specification, and a word about it.

        Of its bounds that reading is taken which they fit; without bounds the key `scheme` that some programs write."""
        zoom = self.zooms[-1]
        query = "SELECT MIN(tile_row), MAX(tile_row) FROM tiles WHERE zoom_level = ?"
        try:
            low, high = self._db.execute(query, (zoom,)).fetchone()
            metadata = self._metadata()
        except DATABASE_ERRORS as error:
            raise MapError(f"{self.path}: damaged ({error}); copy or download it again") from None
        if not isinstance(low, int) or not isinstance(high, int) or not 0 <= low <= high < 1 << zoom:
            raise MapError(f"{self.path}: a row of its tiles is none of zoom {zoom}; check the source")
        says_north = metadata.get("scheme", "").strip().lower() in ("xyz", "zxy")
        expected = _rows_of_bounds(metadata.get("bounds", ""), zoom)
        if expected is None:
            return says_north, ("rows count from the north, as its scheme says",) if says_north else ()
        south = _overlap((mbtiles_row(zoom, high), mbtiles_row(zoom, low)), expected)
        north = _overlap((low, high), expected)
        if max(south, north) < FITS:
            return False, ("its bounds contradict its rows; rows count from the south, as specified",)
        if north >= FITS and (south < FITS or says_north):
            return True, ("rows count from the north, against the specification: so its bounds fit",)
        return False, ()

    def _metadata(self) -> dict[str, str]:
        """Empty without the table."""
        if not self._db.execute("SELECT 1 FROM sqlite_master WHERE name = 'metadata'").fetchone():
            return {}
        return {str(name): str(value) for name, value in self._db.execute("SELECT name, value FROM metadata")}

    def get(self, tile: Tile) -> bytes | None:
        query = "SELECT CAST(tile_data AS BLOB) FROM tiles WHERE zoom_level = ? AND tile_column = ? AND tile_row = ?"
        try:
            row = tile.row if self.from_north else mbtiles_row(tile.zoom, tile.row)
            found = self._db.execute(query, (tile.zoom, tile.column, row)).fetchone()
        except DATABASE_ERRORS as error:
            raise MapError(f"{self.path}: damaged near tile {tile} ({error}); copy or download it again") from None
        return found[0] if found else None

    def first(self, zoom: int) -> bytes:
        """Any non-empty tile of the zoom; empty when there is none."""
        query = "SELECT CAST(tile_data AS BLOB) FROM tiles WHERE zoom_level = ? AND length(tile_data) > 0 LIMIT 1"
        try:
            found = self._db.execute(query, (zoom,)).fetchone()
        except DATABASE_ERRORS as error:
            raise MapError(f"{self.path}: damaged ({error}); copy or download it again") from None
        return bytes(found[0]) if found else b""

    def close(self) -> None:
        self._close()


def _rows_of_bounds(text: str, zoom: int) -> tuple[int, int] | None:
    """First and last row, counted from the north, of "W,S,E,N" in degrees; None: no bounds."""
    try:
        _, south_deg, _, north_deg = (float(part) for part in text.split(","))
    except ValueError:
        return None
    if not -90.0 <= south_deg < north_deg <= 90.0:
        return None
    rows = []
    for lat_deg in (north_deg, south_deg):
        lat = math.radians(min(max(lat_deg, -MERCATOR_END_DEG), MERCATOR_END_DEG))
        rows.append((1.0 - math.asinh(math.tan(lat)) / math.pi) / 2.0 * (1 << zoom))
    return math.floor(rows[0]), max(math.ceil(rows[1]) - 1, math.floor(rows[0]))


def _overlap(a: tuple[int, int], b: tuple[int, int]) -> float:
    """Common rows of two ranges, as a share of the shorter one."""
    common = min(a[1], b[1]) - max(a[0], b[0]) + 1
    return common / min(a[1] - a[0] + 1, b[1] - b[0] + 1)


class PmtilesReader:
    """Caches decompressed directories; the library's own reader decompresses them for every tile."""

    notes: tuple[str, ...] = ()

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with path.open("rb") as file:
                self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            header = deserialize_header(self._bytes(0, HEADER_BYTES))
        except FileNotFoundError:
            raise MapError(f"{path}: no such file; check the path of the source") from None
        except (OSError, ValueError, IndexError, struct.error, MagicNumberNotFound, SpecVersionUnsupported):
            raise MapError(f"{path}: not a PMTiles file of version 3; check the source") from None
        if header["tile_type"] not in PICTURES:
            raise MapError(f"{path}: contains no images but {header['tile_type'].name} tiles; give imagery")
        if header["internal_compression"] != Compression.GZIP:
            raise MapError(f"{path}: its directories are not gzip; write it again with the pmtiles program")
        self._header = header
        self.zooms = list(range(header["min_zoom"], header["max_zoom"] + 1))
        self._directory = lru_cache(maxsize=DIRECTORIES)(self._read_directory)

    def get(self, tile: Tile) -> bytes | None:
        wanted = zxy_to_tileid(*tile)
        offset, length = self._header["root_offset"], self._header["root_length"]
        for _ in range(MAX_DIRECTORY_DEPTH):
            entry = find_tile(self._directory(offset, length), wanted)
            if entry is None:
                return None
            if entry.run_length:
                return self._decompress(self._bytes(self._header["tile_data_offset"] + entry.offset, entry.length))
            offset, length = self._header["leaf_directory_offset"] + entry.offset, entry.length
        raise MapError(f"{self.path}: damaged directory near tile {tile}; copy or download it again")

    def first(self, zoom: int) -> bytes:
        """Any tile: all images of a PMTiles file have the same size."""
        entry = self._directory(self._header["root_offset"], self._header["root_length"])[0]
        while not entry.run_length:
            entry = self._directory(self._header["leaf_directory_offset"] + entry.offset, entry.length)[0]
        return self._decompress(self._bytes(self._header["tile_data_offset"] + entry.offset, entry.length))

    def close(self) -> None:
        self._map.close()

    def _bytes(self, offset: int, length: int) -> bytes:
        return self._map[offset : offset + length]

    def _read_directory(self, offset: int, length: int) -> list[Entry]:
        try:
            return deserialize_directory(self._bytes(offset, length))
        except (OSError, EOFError, ValueError, IndexError, zlib.error) as error:
            raise MapError(f"{self.path}: damaged directory ({error}); copy or download it again") from None

    def _decompress(self, data: bytes) -> bytes:
        if self._header["tile_compression"] != Compression.GZIP:
            return data
        try:
            return gzip.decompress(data)
        except (OSError, EOFError, zlib.error) as error:
            raise MapError(f"{self.path}: damaged tile ({error}); copy or download it again") from None


def open_tiles(path: Path) -> MbtilesReader | PmtilesReader:
    """Reader by file name. Raises MapError."""
    return PmtilesReader(path) if path.suffix.lower() == ".pmtiles" else MbtilesReader(path)
