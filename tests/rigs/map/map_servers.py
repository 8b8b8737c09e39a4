"""Small HTTP servers on this machine with the protocols of map servers, and with errors that tests choose."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np
from pyproj import Transformer

HALF_M = 20_037_508.342789244  # EPSG:3857
TILE_PX = 256


@dataclass
class Reply:
    """``content_length``: value of the header if it differs from the length of the body. ``delay_s``: delay of the
    whole reply."""

    status: int = 200
    body: bytes = b""
    headers: dict[str, str] = field(default_factory=dict)
    content_length: int | None = None
    delay_s: float = 0.0


@dataclass
class Request:
    """One request as the server received it. ``at_s``: monotonic time."""

    method: str
    path: str
    headers: dict[str, str]
    body: bytes
    at_s: float


class Server:
    """Replies to every request with ``answer(request)``. ``requests``: all received ones; ``completed``: number of
    complete replies of status 200, by path; ``max_concurrent``: largest number of requests in progress."""

    def __init__(self, answer: Callable[[Request], Reply]) -> None:
        self.requests: list[Request] = []
        self.completed: Counter[str] = Counter()
        self.max_concurrent = 0
        self._concurrent = 0
        self._lock = threading.Lock()
        self._stop = threading.Event()
        owner = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def handle_any(self) -> None:
                owner.serve(self, answer)

            do_GET = do_POST = handle_any

            def log_message(self, format: str, *args: object) -> None:
                pass

        self._http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._http.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._http.server_address[1]}"
        self._thread = threading.Thread(target=self._http.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._http.shutdown()
        self._http.server_close()

    def serve(self, handler: BaseHTTPRequestHandler, answer: Callable[[Request], Reply]) -> None:
        body = handler.rfile.read(int(handler.headers.get("Content-Length", 0)))
        request = Request(handler.command, handler.path, dict(handler.headers), body, time.monotonic())
        with self._lock:
            self.requests.append(request)
            self._concurrent += 1
            self.max_concurrent = max(self.max_concurrent, self._concurrent)
        try:
            reply = answer(request)
            self._stop.wait(reply.delay_s)
            handler.send_response(reply.status)
            for name, value in reply.headers.items():
                handler.send_header(name, value)
            if reply.status != 204:
                length = len(reply.body) if reply.content_length is None else reply.content_length
                handler.send_header("Content-Length", str(length))
            handler.end_headers()
            handler.wfile.write(reply.body)
            if reply.content_length is not None:
                handler.close_connection = True
            elif reply.status == 200:
                with self._lock:
                    self.completed[request.path] += 1
        except (BrokenPipeError, ConnectionResetError):
            handler.close_connection = True
        finally:
            with self._lock:
                self._concurrent -= 1


@contextmanager
def serving(answer: Callable[[Request], Reply]) -> Iterator[Server]:
    server = Server(answer)
    try:
        yield server
    finally:
        server.close()


def mercator(lon_deg: float, lat_deg: float) -> tuple[float, float]:
    x, y = Transformer.from_crs(4326, 3857, always_xy=True).transform(lon_deg, lat_deg)
    return float(x), float(y)


class Pyramid:
    """An image in EPSG:3857, aligned with the tile grid, as tiles of one zoom level. ``column``, ``row``: first
    tile."""

    def __init__(self, image: np.ndarray, zoom: int, column: int, row: int, side: int = TILE_PX) -> None:
        self.image, self.zoom, self.column, self.row, self.side = image, zoom, column, row, side

    def tile(self, zoom: int, column: int, row: int, suffix: str = ".png") -> bytes | None:
        """-> encoded tile; None outside the image and at other zoom levels."""
        r, c = (row - self.row) * self.side, (column - self.column) * self.side
        inside = 0 <= r < self.image.shape[0] and 0 <= c < self.image.shape[1]
        if zoom != self.zoom or not inside:
            return None
        return cv2.imencode(suffix, self.image[r : r + self.side, c : c + self.side])[1].tobytes()

    def answer(self, request: Request) -> Reply:
        """Replies to paths ``/z/x/y.png``."""
        z, x, y = request.path.split("?")[0].rsplit(".", 1)[0].strip("/").split("/")[-3:]
        data = self.tile(int(z), int(x), int(y))
        return Reply(404) if data is None else Reply(body=data, headers={"Content-Type": "image/png"})

    def box_deg(self, inset_tiles: float = 0.0) -> str:
        """-> bounding box of the image for ``--area``, reduced by ``inset_tiles`` on each side."""
        span_m = 2 * HALF_M / (1 << self.zoom)
        rows, columns = self.image.shape[0] / self.side, self.image.shape[1] / self.side
        x = [(self.column + c) * span_m - HALF_M for c in (inset_tiles, columns - inset_tiles)]
        y = [HALF_M - (self.row + r) * span_m for r in (inset_tiles, rows - inset_tiles)]
        lon_deg, lat_deg = Transformer.from_crs(3857, 4326, always_xy=True).transform(x, y)
        return f"{lon_deg[0]:.9f},{lat_deg[1]:.9f},{lon_deg[1]:.9f},{lat_deg[0]:.9f}"


def pyramid(rows: int, columns: int, *, zoom: int = 18, lon_deg: float = 13.4, lat_deg: float = 47.1) -> Pyramid:
    """-> a smooth random texture of ``rows`` by ``columns`` tiles from the tile of a place on, never black or white."""
    rng = np.random.default_rng(7)
    coarse = np.zeros((rows * TILE_PX // 4, columns * TILE_PX // 4, 3), np.float32)
    for sigma_px, weight in ((1.0, 1.0), (4.0, 1.5)):
        noise = cv2.GaussianBlur(rng.normal(size=coarse.shape).astype(np.float32), (0, 0), sigma_px)
        coarse += weight * noise / noise.std()
    image = cv2.resize(coarse, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    x, y = mercator(lon_deg, lat_deg)
    span_m = 2 * HALF_M / (1 << zoom)
    pixels = np.clip(128 + 35 * image, 5, 250).astype(np.uint8)
    return Pyramid(pixels, zoom, int((x + HALF_M) // span_m), int((HALF_M - y) // span_m))
