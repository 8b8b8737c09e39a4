"""Rendered frames to the real daemon without touching the disk: a camera on the network that only this machine sees.

MJPEG over HTTP, which `terrafix run --source http://127.0.0.1:PORT/` opens as any IP camera; every picture says when it
was exposed. Nobody waits: a viewer that is slower than the camera gets the newest pictures."""

import contextlib
import http.server
import threading
from collections import deque
from collections.abc import Iterator
from types import TracebackType

import cv2
import numpy as np

from terrafix.core.errors import UsageError

JPEG_QUALITY = 92
BACKLOG = 8  # pictures that wait for a slow viewer; what a camera's own buffer holds
BOUNDARY = "frame"


class FrameStream:
    """A server on 127.0.0.1 for any number of viewers. A context manager."""

    def __init__(self, port: int = 0, *, jpeg_quality: int = JPEG_QUALITY) -> None:
        """``port`` 0: any free one. Raises UsageError: the port is taken."""
        self._quality = jpeg_quality
        self._changed = threading.Condition()
        self._viewers: list[deque[bytes]] = []
        self._closed = False
        stream = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={BOUNDARY}")
                self.end_headers()
                with contextlib.suppress(OSError):  # the viewer went away: its right
                    for part in stream._parts():
                        self.wfile.write(part)

            def log_message(self, format: str, *args: object) -> None:
                """A camera does not talk."""

        try:
            self._server = http.server.ThreadingHTTPServer(("127.0.0.1", port), Handler)
        except (OSError, OverflowError) as error:
            raise UsageError(f"port {port}: frames cannot be streamed there ({error}); choose another, or 0") from None
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), name="frames", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """For ``terrafix run --source``."""
        return f"http://127.0.0.1:{self._server.server_address[1]}/"

    def push(self, image_bgr: np.ndarray, t_ns: int) -> None:
        """A picture (H, W, 3) uint8 whose exposure was at ``t_ns`` on CLOCK_MONOTONIC, to everybody who looks now."""
        quality = [cv2.IMWRITE_JPEG_QUALITY, self._quality]
        self.push_jpeg(cv2.imencode(".jpg", image_bgr, quality)[1].tobytes(), t_ns)

    def push_jpeg(self, jpeg: bytes, t_ns: int) -> None:
        """As ``push``, for a picture that is already compressed; broken bytes go out as they are."""
        head = (
            f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\nX-Timestamp-Ns: {t_ns}\r\n\r\n"
        )
        with self._changed:
            for waiting in self._viewers:
                waiting.append(head.encode() + jpeg + b"\r\n")
            self._changed.notify_all()

    def wait_for_viewer(self, timeout_s: float) -> bool:
        """True as soon as somebody looks."""
        with self._changed:
            return self._changed.wait_for(lambda: bool(self._viewers), timeout_s)

    def close(self) -> None:
        """Ends the stream of every viewer and frees the port."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def __enter__(self) -> "FrameStream":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _parts(self) -> Iterator[bytes]:
        """What one viewer is sent, until the stream is closed."""
        mine: deque[bytes] = deque(maxlen=BACKLOG)
        with self._changed:
            self._viewers.append(mine)
            self._changed.notify_all()
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: bool(mine) or self._closed)
                    if self._closed:
                        return
                    part = mine.popleft()
                yield part
        finally:
            with self._changed:
                self._viewers = [one for one in self._viewers if one is not mine]
