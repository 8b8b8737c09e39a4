"""Downloaded tiles in one MBTiles file (github.com/mapbox/mbtiles-spec 1.3); stored tiles are not fetched again.

Every tile is a transaction of its own in write-ahead mode, so that a killed process loses at most the current tile."""

import sqlite3
import threading
import time
import weakref
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from terrafix.core.errors import MapError, OutputError
from terrafix_tools.mapping.sources.tiles.grid import Tile, TileRange

ABSENT_FOR_S = 7 * 86_400.0  # after this time an absent tile is requested again
ROWS_AT_A_TIME = 100_000
BUSY_S = 60.0  # time-out when another process is writing
SCHEMA = """
CREATE TABLE IF NOT EXISTS metadata (name TEXT PRIMARY KEY, value TEXT);
CREATE TABLE IF NOT EXISTS tiles (
  zoom_level INTEGER NOT NULL, tile_column INTEGER NOT NULL, tile_row INTEGER NOT NULL, tile_data BLOB NOT NULL,
  PRIMARY KEY (zoom_level, tile_column, tile_row));
CREATE TABLE IF NOT EXISTS absent (
  zoom_level INTEGER NOT NULL, tile_column INTEGER NOT NULL, tile_row INTEGER NOT NULL, asked_s REAL NOT NULL,
  PRIMARY KEY (zoom_level, tile_column, tile_row));
"""
WITHIN = "zoom_level = ? AND tile_column BETWEEN ? AND ? AND tile_row BETWEEN ? AND ?"


class TileStore:
    """Thread-safe. A context manager."""

    def __init__(self, path: Path, name: str) -> None:
        self.path = path
        self._lock = threading.Lock()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._db = sqlite3.connect(path, isolation_level=None, check_same_thread=False, timeout=BUSY_S)
            self._close = weakref.finalize(self, self._db.close)  # also of a store that is refused below
            self._db.execute("PRAGMA journal_mode = WAL")
            self._db.execute("PRAGMA synchronous = NORMAL")
            self._db.executescript(SCHEMA)
            self._db.execute("INSERT OR REPLACE INTO metadata VALUES ('name', ?)", (name,))
        except (OSError, sqlite3.OperationalError) as error:
            raise OutputError(f"{path}: the store of tiles cannot be made ({error}); choose another --cache") from None
        except sqlite3.DatabaseError as error:
            raise MapError(f"{path}: the store of tiles is damaged ({error}); delete it and start again") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def add(self, tile: Tile, data: bytes | None) -> None:
        """Stores a tile; None: absent on the server. Raises OutputError when the disk is full."""
        key = tile.zoom, tile.column, mbtiles_row(tile.zoom, tile.row)
        with self._lock:
            try:
                if data is None:
                    self._db.execute("INSERT OR REPLACE INTO absent VALUES (?, ?, ?, ?)", (*key, time.time()))
                else:
                    self._db.execute("INSERT OR REPLACE INTO tiles VALUES (?, ?, ?, ?)", (*key, data))
            except sqlite3.OperationalError as error:
                raise OutputError(f"{self.path}: a tile cannot be stored ({error}); check the space") from None

    def missing(self, wanted: TileRange) -> TileRange:
        """The tiles of a range that are neither stored nor known to be absent."""
        left = wanted.touched.copy()
        recent = f"SELECT tile_column, tile_row FROM absent WHERE {WITHIN} AND asked_s > ?"
        with self._lock:
            for query, more in (
                (f"SELECT tile_column, tile_row FROM tiles WHERE {WITHIN}", ()),
                (recent, (_expired(),)),
            ):
                found = self._db.execute(query, (*_box(wanted), *more))
                while here := found.fetchmany(ROWS_AT_A_TIME):
                    columns, tms_rows = np.array(here).T
                    left[mbtiles_row(wanted.zoom, tms_rows) - wanted.row, columns - wanted.column] = False
        return TileRange(wanted.zoom, wanted.column, wanted.row, left)

    def any_of(self, wanted: TileRange) -> bool:
        """True when there is a tile in the box around a range."""
        with self._lock:
            return self._db.execute(f"SELECT 1 FROM tiles WHERE {WITHIN} LIMIT 1", _box(wanted)).fetchone() is not None


def _expired() -> float:
    """Unix time before which a recorded absence has expired."""
    return time.time() - ABSENT_FOR_S


def _box(wanted: TileRange) -> tuple[int, int, int, int, int]:
    """Zoom, first and last column, first and last row in MBTiles numbering."""
    rows, columns = wanted.touched.shape
    south, north = mbtiles_row(wanted.zoom, wanted.row + rows - 1), mbtiles_row(wanted.zoom, wanted.row)
    return wanted.zoom, wanted.column, wanted.column + columns - 1, south, north


def mbtiles_row(zoom: int, row: Any) -> Any:
    """Row in MBTiles numbering, which counts from the south."""
    return (1 << zoom) - 1 - row
