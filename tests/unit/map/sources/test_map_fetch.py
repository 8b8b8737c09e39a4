"""Tile downloads from servers that are slow, broken, rate limited, or that disappear during the download."""

import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from email.utils import formatdate
from pathlib import Path
from types import SimpleNamespace

import pytest
import rasterio

import map_servers
from map_servers import Pyramid, Reply, Request, Server, serving
from terrafix.core.errors import MapError, OutputError, UsageError
from terrafix_tools.mapping.area.files import read_area
from terrafix_tools.mapping.area.polygons import Placed
from terrafix_tools.mapping.fetching import plan
from terrafix_tools.mapping.fetching.fetch import Client, FetchError, RefusedError
from terrafix_tools.mapping.fetching.pace import Limits
from terrafix_tools.mapping.fetching.plan import FetchEstimate
from terrafix_tools.mapping.fetching.tiles import MAX_CONSECUTIVE_FAILURES, TileDownload
from terrafix_tools.mapping.sources.tiles.files import MbtilesReader
from terrafix_tools.mapping.sources.tiles.grid import MERCATOR, Tile, TileRange, tiles_of
from terrafix_tools.mapping.sources.tiles.store import TileStore
from terrafix_tools.mapping.sources.tiles.url_template import UrlTemplate

FAST = Limits(requests_per_s=500.0, connections=4, first_wait_s=0.01, timeout_s=10.0)
WORLD = map_servers.pyramid(4, 5)
HERE = Path(__file__).resolve().parent
MANY = map_servers.pyramid(10, 10)


def wanted(pyramid: Pyramid = WORLD) -> TileRange:
    return tiles_of(Placed(read_area(pyramid.box_deg(0.1), buffer_km=0.0), MERCATOR), pyramid.zoom)


def download(server: Server, store: Path, limits: Limits = FAST, tiles: TileRange | None = None) -> TileDownload:
    """Fetches missing tiles and closes the store, as at the end of a program."""
    with TileStore(store, "test") as kept:
        job = TileDownload(Client("test", limits), UrlTemplate(server.url + "/{z}/{x}/{y}.png").url, kept, 256)
        job.run(kept.missing(tiles or wanted()), lambda _: None)
    return job


def first(answers: dict[str, list[Reply]], otherwise: Callable[[Request], Reply]) -> Callable[[Request], Reply]:
    """Replies to the first requests of each path; later requests get ``otherwise``."""
    lock = threading.Lock()

    def answer(request: Request) -> Reply:
        with lock:
            waiting = answers.get(request.path)
            return waiting.pop(0) if waiting else otherwise(request)

    return answer


def path_of(column: int, row: int) -> str:
    return f"/{WORLD.zoom}/{WORLD.column + column}/{WORLD.row + row}.png"


def assert_complete(store: Path) -> None:
    reader = MbtilesReader(store)
    for row in range(4):
        for column in range(5):
            tile = Tile(WORLD.zoom, WORLD.column + column, WORLD.row + row)
            assert reader.get(tile) == WORLD.tile(*tile)
    reader.close()


def test_every_tile_is_downloaded_exactly_once(tmp_path: Path) -> None:
    with serving(WORLD.answer) as server:
        job = download(server, tmp_path / "s.mbtiles")
        assert (job.progressed.tiles, job.progressed.absent, job.progressed.failed) == (20, 0, 0)
        assert Counter(a.path for a in server.requests) == Counter(
            {path_of(c, r): 1 for c in range(5) for r in range(4)}
        )
        download(server, tmp_path / "s.mbtiles")
        assert len(server.requests) == 20
    assert_complete(tmp_path / "s.mbtiles")


def test_gdal_reads_the_tile_store_as_mbtiles(tmp_path: Path) -> None:
    with serving(WORLD.answer) as server:
        download(server, tmp_path / "s.mbtiles")
    with rasterio.open(tmp_path / "s.mbtiles") as file:
        assert file.driver == "MBTiles" and file.crs.to_epsg() == 3857
        span_m = 2 * map_servers.HALF_M / (1 << WORLD.zoom)
        column = round((WORLD.column * span_m - map_servers.HALF_M - file.transform.c) / file.transform.a)
        row = round((file.transform.f - (map_servers.HALF_M - WORLD.row * span_m)) / file.transform.a)
        window = rasterio.windows.Window(column, row, 5 * 256, 4 * 256)
        assert (file.read([3, 2, 1], window=window).transpose(1, 2, 0) == WORLD.image).all()


def test_transient_server_errors_are_retried(tmp_path: Path) -> None:
    whole = WORLD.tile(WORLD.zoom, WORLD.column + 3, WORLD.row)
    jpeg = WORLD.tile(WORLD.zoom, WORLD.column, WORLD.row + 1, ".jpg")
    assert whole and jpeg
    troubles = {
        path_of(0, 0): [Reply(503, b"busy"), Reply(500)],
        path_of(1, 0): [Reply(429, headers={"Retry-After": "0"}), Reply(502)],
        path_of(2, 0): [Reply(200, b"<html><body>please log in</body></html>", {"Content-Type": "text/html"})],
        path_of(3, 0): [Reply(200, whole[:1000], content_length=len(whole))],  # the connection breaks
        path_of(4, 0): [Reply(200, whole[:1000])],  # a proxy that truncates the response and its length
        path_of(0, 1): [Reply(200, jpeg[:-500]), Reply(200, b"")],  # decoders would fill the rest with grey
        path_of(1, 1): [Reply(200, whole[:2000] + bytes(300) + whole[2300:])],  # corrupted bytes in the middle
    }
    count = sum(len(replies) for replies in troubles.values())
    with serving(first(troubles, WORLD.answer)) as server:
        job = download(server, tmp_path / "s.mbtiles")
        assert job.progressed.tiles == 20 and len(server.requests) == 20 + count
    assert_complete(tmp_path / "s.mbtiles")


def test_a_permanently_broken_tile_is_the_only_one_missing(tmp_path: Path) -> None:
    def answer(request: Request) -> Reply:
        return Reply(200, b"<html>no</html>") if request.path == path_of(2, 2) else WORLD.answer(request)

    with serving(answer) as server:
        with pytest.raises(FetchError, match=r"1 of 20 tiles did not come .*neither JPEG.*run the same command again"):
            download(server, tmp_path / "s.mbtiles")
        assert sum(a.path == path_of(2, 2) for a in server.requests) == FAST.attempts
    with serving(WORLD.answer) as server:
        download(server, tmp_path / "s.mbtiles")
        assert [a.path for a in server.requests] == [path_of(2, 2)]
    assert_complete(tmp_path / "s.mbtiles")


@pytest.mark.parametrize("status", [404, 204, 410])
def test_missing_tiles_are_not_requested_again(tmp_path: Path, status: int) -> None:
    def answer(request: Request) -> Reply:
        return Reply(status) if f"/{WORLD.column}/" in request.path else WORLD.answer(request)

    with serving(answer) as server:
        job = download(server, tmp_path / "s.mbtiles")
        assert (job.progressed.tiles, job.progressed.absent) == (16, 4)
        download(server, tmp_path / "s.mbtiles")
        assert len(server.requests) == 20
        # Maps are extended: a missing tile is requested again after a while.
        with sqlite3.connect(tmp_path / "s.mbtiles") as db:
            db.execute("UPDATE absent SET asked_s = asked_s - 8 * 86400")
        db.close()
        download(server, tmp_path / "s.mbtiles")
        assert len(server.requests) == 24


@pytest.mark.parametrize(("status", "advice"), [(403, "terms of use"), (401, "credentials"), (400, "address")])
def test_an_authorisation_error_ends_the_download(tmp_path: Path, status: int, advice: str) -> None:
    with serving(lambda _: Reply(status, b"key expired\nsecond line")) as server:
        with pytest.raises(RefusedError, match=rf"status {status}: key expired\); .*{advice}"):
            download(server, tmp_path / "s.mbtiles")
        assert len(server.requests) <= 2 * FAST.connections


def test_a_server_that_is_down_is_not_requested_for_every_tile(tmp_path: Path) -> None:
    with serving(lambda _: Reply(503)) as server:
        with pytest.raises(FetchError, match="tiles in a row"):
            download(server, tmp_path / "s.mbtiles", Limits(500.0, 4, attempts=3, first_wait_s=0.01), wanted(MANY))
        assert len(server.requests) <= (MAX_CONSECUTIVE_FAILURES + 4) * 3


@pytest.mark.slow
def test_an_unreachable_tile_server_is_reported(tmp_path: Path) -> None:
    with serving(WORLD.answer) as server:
        pass
    with pytest.raises(FetchError, match="no connection"):
        download(server, tmp_path / "s.mbtiles")


@pytest.mark.slow
@pytest.mark.parametrize("as_date", [False, True])
def test_retry_after_pauses_all_connections(tmp_path: Path, as_date: bool) -> None:
    said_s: list[float] = []

    def answer(request: Request) -> Reply:
        if request.path == path_of(2, 1) and not said_s:
            said_s.append(request.at_s)
            return Reply(429, headers={"Retry-After": formatdate(time.time() + 2.0, usegmt=True) if as_date else "1"})
        return Reply(**{**WORLD.answer(request).__dict__, "delay_s": 0.01})

    with serving(answer) as server:
        download(server, tmp_path / "s.mbtiles", Limits(20.0, 4, first_wait_s=0.01))
        after_s = [a.at_s - said_s[0] for a in server.requests if a.at_s > said_s[0]]
    quiet_s = max(b - a for a, b in zip([0.0, *sorted(after_s)], sorted(after_s), strict=False))
    assert quiet_s > 0.8  # of 1 s, or of a date 1 to 2 s ahead
    assert sum(t < 0.8 for t in after_s) <= 4  # requests that were already in progress
    assert_complete(tmp_path / "s.mbtiles")


def test_a_retry_after_longer_than_the_limit_is_reported(tmp_path: Path) -> None:
    impatient = serving(lambda _: Reply(429, headers={"Retry-After": "7200"}))
    with impatient as server, pytest.raises(RefusedError, match="pause of 120 minutes"):
        download(server, tmp_path / "s.mbtiles")


def test_the_request_rate_limit_covers_all_connections(tmp_path: Path) -> None:
    with serving(WORLD.answer) as server:
        download(server, tmp_path / "s.mbtiles", Limits(requests_per_s=25.0, connections=4))
        at_s = sorted(a.at_s for a in server.requests)
    assert at_s[-1] - at_s[0] > 0.6 * 19 / 25.0  # 20 slots, 40 ms apart; the first may arrive late


def test_slow_responses_overlap_up_to_the_connection_limit(tmp_path: Path) -> None:
    def answer(request: Request) -> Reply:
        return Reply(**{**WORLD.answer(request).__dict__, "delay_s": 0.1})

    with serving(answer) as server:
        download(server, tmp_path / "s.mbtiles", Limits(requests_per_s=500.0, connections=3))
        assert server.max_concurrent == 3


def test_an_endless_response_is_aborted(tmp_path: Path) -> None:
    with serving(lambda _: Reply(200, bytes(9 << 20))) as server, pytest.raises(FetchError, match="larger than 8 MB"):
        download(server, tmp_path / "s.mbtiles", Limits(500.0, 1, attempts=2, first_wait_s=0.01), one_tile())


def one_tile() -> TileRange:
    tiles = wanted()
    tiles.touched[:] = False
    tiles.touched[0, 0] = True
    return tiles


def test_tiles_of_an_unexpected_size_are_reported(tmp_path: Path) -> None:
    double = map_servers.Pyramid(WORLD.image, WORLD.zoom, WORLD.column, WORLD.row, side=512)
    with serving(double.answer) as server, pytest.raises(FetchError, match="is 512x512 px, not 256: set tile_px"):
        download(server, tmp_path / "s.mbtiles", Limits(500.0, 1, attempts=2, first_wait_s=0.01), one_tile())


def test_redirects_are_followed_and_a_user_agent_is_sent(tmp_path: Path) -> None:
    def answer(request: Request) -> Reply:
        if request.path.startswith("/moved"):
            return Reply(302, headers={"Location": request.path.removeprefix("/moved")})
        return WORLD.answer(request)

    with serving(answer) as server:
        client = Client("test", Limits(500.0, user_agent="Me <me@example.org>"), {"Referer": "https://example.org"})
        got = client.request("GET", server.url + "/moved" + path_of(0, 0))
        assert got == WORLD.tile(WORLD.zoom, WORLD.column, WORLD.row)
        assert all(a.headers["User-Agent"] == "Me <me@example.org>" for a in server.requests)
        assert all(a.headers["Referer"] == "https://example.org" for a in server.requests)


# A separate program, so that it can be killed: fetches from the server argv[1] into the store argv[2].
FETCHER = """
import sys
from pathlib import Path
sys.path[:0] = sys.argv[3:]
import test_map_fetch as t
class Far:
    url = sys.argv[1]
print("started", flush=True)
t.download(Far(), Path(sys.argv[2]), t.Limits(100.0, 4), t.wanted(t.MANY))
"""


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_a_killed_download_resumes(tmp_path: Path, how: signal.Signals) -> None:
    store = tmp_path / "s.mbtiles"
    half = threading.Event()

    def answer(request: Request) -> Reply:
        if len(server.requests) >= 50:
            half.set()
        return MANY.answer(request)

    with serving(answer) as server:
        command = [
            sys.executable,
            "-c",
            FETCHER,
            server.url,
            str(store),
            str(HERE),
            str(HERE.parents[2] / "rigs" / "map"),
        ]
        fetcher = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            assert half.wait(60)
        finally:
            fetcher.send_signal(how)
            assert fetcher.wait(60) != 0
        before = len(server.requests)
        assert before < 100
        download(server, store, tiles=wanted(MANY))
        again = {path: count for path, count in server.completed.items() if count > 1}
    # Only the requests in progress when the process died, one per connection, are repeated.
    assert len(again) <= 4 and len(server.completed) == 100
    reader = MbtilesReader(store)
    for tile in wanted(MANY):
        assert reader.get(tile) == MANY.tile(*tile)
    reader.close()


def test_an_invalid_tile_store_is_reported(tmp_path: Path) -> None:
    (tmp_path / "s.mbtiles").write_bytes(b"not a database, but long enough to be taken for one" * 100)
    with pytest.raises(MapError, match=r"damaged .*delete it"):
        TileStore(tmp_path / "s.mbtiles", "test")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="choose another --cache"):
        TileStore(tmp_path / "file" / "s.mbtiles", "test")


def test_a_tile_sample_is_an_evenly_spread_subset() -> None:
    many = wanted(MANY)
    sample = plan.spread_sample(many)
    assert sample.count == plan.SAMPLES and not (sample.touched & ~many.touched).any()
    assert sample.touched[:3].any() and sample.touched[-3:].any()


def test_a_large_download_needs_confirmation_and_a_small_disk_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small, large = FetchEstimate("s", 10, 10, 1e6, 5.0), FetchEstimate("s", 99, 99, 3e9, 5.0)
    slow = FetchEstimate("s", 99, 99, 1e6, 7200.0)
    plan.check_consent([small], agreed=False)
    plan.check_consent([large, slow], agreed=True)
    with pytest.raises(UsageError, match=r"3\.0 GB in 5 s .*--yes"):
        plan.check_consent([large], agreed=False)
    with pytest.raises(UsageError, match=r"1\.0 MB in 2\.0 h"):
        plan.check_consent([slow], agreed=False)
    usage = SimpleNamespace(free=2 * 10**9)
    monkeypatch.setattr(plan.shutil, "disk_usage", lambda _: usage)
    plan.check_room([small], tmp_path / "not yet" / "cache", 1e9, tmp_path / "m.gpkg")
    with pytest.raises(OutputError, match=r"about 3\.4 GB are needed and 2\.0 GB are free"):
        plan.check_room([large], tmp_path / "cache", 0.0, tmp_path / "m.gpkg")
    with pytest.raises(OutputError, match="make room"):
        plan.check_room([small], tmp_path, 2e9, tmp_path / "m.gpkg")
