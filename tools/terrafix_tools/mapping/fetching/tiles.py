"""Downloads tiles into a store: parallel, rate limited, resumable; a tile is stored after it was decoded completely."""

import threading
from collections.abc import Callable, Iterator

from terrafix.core.errors import TerrafixError
from terrafix_tools.mapping.fetching.fetch import Client, Damaged, FetchError, RefusedError
from terrafix_tools.mapping.fetching.pace import Stopped
from terrafix_tools.mapping.fetching.progress import DownloadProgress, OnProgress
from terrafix_tools.mapping.sources.tiles.grid import Tile, TileRange
from terrafix_tools.mapping.sources.tiles.image import TileDamage, decode
from terrafix_tools.mapping.sources.tiles.store import TileStore

MAX_TILE_BYTES = 8 << 20
POLL_S = 0.2  # interval of the progress display
MAX_CONSECUTIVE_FAILURES = 20  # consecutive failed tiles after which the server counts as down


class TileDownload:
    """``url_of`` maps a tile to its URL."""

    def __init__(self, client: Client, url_of: Callable[[Tile], str], store: TileStore, tile_px: int) -> None:
        self._client, self._url_of, self._store, self._tile_px = client, url_of, store, tile_px
        self._lock = threading.Lock()
        self.progressed = DownloadProgress(0)
        self._failed_in_a_row = 0
        self._error: TerrafixError | None = None
        self._last_failure = ""

    def run(self, tiles: TileRange, on_progress: OnProgress) -> None:
        """Fetches all tiles and stores each one at once. ``on_progress`` is called in the caller's thread.

        Raises FetchError (some tiles are missing; the others are stored), RefusedError, OutputError (disk full)."""
        self.progressed.total = tiles.count
        todo = iter(tiles)
        threads = [
            threading.Thread(target=self._work, args=(todo,), daemon=True)
            for _ in range(min(self._client.limits.connections, max(1, tiles.count)))
        ]
        for thread in threads:
            thread.start()
        try:
            for thread in threads:
                while thread.is_alive():
                    thread.join(POLL_S)
                    on_progress(self.progressed)
        finally:
            self._client.pace.stop()  # after Ctrl-C the threads end after their current tile
            for thread in threads:
                thread.join()
        if self._error:
            raise self._error
        if self.progressed.failed:
            raise FetchError(
                f"{self._client.name}: {self.progressed.failed} of {tiles.count} tiles did not come "
                f"({self._last_failure}); the others are kept, run the same command again"
            )

    def _work(self, todo: Iterator[Tile]) -> None:
        try:
            while not self._error:
                with self._lock:
                    tile = next(todo, None)
                if tile is None:
                    return
                self._fetch(tile)
        except Stopped:
            return
        except TerrafixError as error:
            self._abort(error)

    def _fetch(self, tile: Tile) -> None:
        try:
            response = self._client.request("GET", self._url_of(tile), check=self._check, max_bytes=MAX_TILE_BYTES)
        except RefusedError:
            raise
        except FetchError as error:
            with self._lock:
                self.progressed.failed += 1
                self._failed_in_a_row += 1
                self._last_failure = str(error).removeprefix(f"{self._client.name}: ")
            if self._failed_in_a_row >= MAX_CONSECUTIVE_FAILURES:
                raise FetchError(
                    f"{error}; {MAX_CONSECUTIVE_FAILURES} tiles in a row: what came is kept, run again later"
                ) from None
            return
        self._store.add(tile, response)
        with self._lock:
            self._failed_in_a_row = 0
            self.progressed.tiles += response is not None
            self.progressed.absent += response is None
            self.progressed.size_bytes += len(response or b"")

    def _check(self, data: bytes) -> None:
        try:
            decode(data, self._tile_px)
        except TileDamage as damage:
            raise Damaged(str(damage)) from None

    def _abort(self, error: TerrafixError) -> None:
        with self._lock:
            self._error = self._error or error
        self._client.pace.stop()
