"""Local tile files: MBTiles (1.3, also the format of the download store) and PMTiles (version 3)."""

import gzip
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
from terrafix_tools.mapping.sources.tiles.grid import Tile
from terrafix_tools.mapping.sources.tiles.store import mbtiles_row

PICTURES = (TileType.PNG, TileType.JPEG, TileType.WEBP)
DIRECTORIES = 64  # decompressed directories of a PMTiles file in the cache
HEADER_BYTES = 127
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
        except sqlite3.DatabaseError as error:
            raise MapError(f"{path}: not an MBTiles file ({error}); check the source") from None
        self.zooms = [int(row[0]) for row in rows]
        if not self.zooms:
            raise MapError(f"{path}: holds no tile; check the source")

    def get(self, tile: Tile) -> bytes | None:
        query = "SELECT CAST(tile_data AS BLOB) FROM tiles WHERE zoom_level = ? AND tile_column = ? AND tile_row = ?"
        try:
            found = self._db.execute(query, (tile.zoom, tile.column, mbtiles_row(tile.zoom, tile.row))).fetchone()
        except sqlite3.DatabaseError as error:
            raise MapError(f"{self.path}: damaged near tile {tile} ({error}); copy or download it again") from None
        return found[0] if found else None

    def first(self, zoom: int) -> bytes:
        """Any non-empty tile of the zoom; empty when there is none."""
        query = "SELECT CAST(tile_data AS BLOB) FROM tiles WHERE zoom_level = ? AND length(tile_data) > 0 LIMIT 1"
        try:
            found = self._db.execute(query, (zoom,)).fetchone()
        except sqlite3.DatabaseError as error:
            raise MapError(f"{self.path}: damaged ({error}); copy or download it again") from None
        return bytes(found[0]) if found else b""

    def close(self) -> None:
        self._close()


class PmtilesReader:
    """Caches decompressed directories; the library's own reader decompresses them for every tile."""

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
