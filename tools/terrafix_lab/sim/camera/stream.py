"""Streams rendered frames to the daemon without disk access, as a network camera on this machine.

MJPEG over HTTP, which `terrafix run --source http://127.0.0.1:PORT/` opens like any IP camera; every image has a
header with its exposure time. The sender does not block: a slow viewer gets only the newest images.
"""

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
BACKLOG = 8  # images queued for a slow viewer; the size of a camera's buffer
BOUNDARY = "frame"


class FrameStream:
    """A server on 127.0.0.1 for any number of viewers. A context manager."""

    def __init__(self, port: int = 0, *, jpeg_quality: int = JPEG_QUALITY) -> None:
        """``port`` 0: any free one. Raises UsageError when the port is taken."""
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
                with contextlib.suppress(OSError):  # the viewer has disconnected
                    for part in stream._parts():
                        self.wfile.write(part)

            def log_message(self, format: str, *args: object) -> None:
                """No log output."""

        try:
            self._server = http.server.ThreadingHTTPServer(("127.0.0.1", port), Handler)
        except (OSError, OverflowError) as error:
            raise UsageError(f"port {port}: frames cannot be streamed there ({error}); choose another, or 0") from None
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), name="frames", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """URL for ``terrafix run --source``."""
        return f"http://127.0.0.1:{self._server.server_address[1]}/"

    def push(self, image_bgr: np.ndarray, t_ns: int) -> None:
        """Sends an image (H, W, 3) uint8 with exposure time ``t_ns`` on CLOCK_MONOTONIC to all connected viewers."""
        quality = [cv2.IMWRITE_JPEG_QUALITY, self._quality]
        self.push_jpeg(cv2.imencode(".jpg", image_bgr, quality)[1].tobytes(), t_ns)

    def push_jpeg(self, jpeg: bytes, t_ns: int) -> None:
        """Like ``push``, for a compressed image; invalid bytes are sent unchanged."""
        head = (
            f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\nX-Timestamp-Ns: {t_ns}\r\n\r\n"
        )
        with self._changed:
            for queue in self._viewers:
                queue.append(head.encode() + jpeg + b"\r\n")
            self._changed.notify_all()

    def wait_for_viewer(self, timeout_s: float) -> bool:
        """Returns True as soon as a viewer is connected."""
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
        """Yields the parts for one viewer until the stream is closed."""
        queue: deque[bytes] = deque(maxlen=BACKLOG)
        with self._changed:
            self._viewers.append(queue)
            self._changed.notify_all()
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: bool(queue) or self._closed)
                    if self._closed:
                        return
                    part = queue.popleft()
                yield part
        finally:
            with self._changed:
                self._viewers = [one for one in self._viewers if one is not queue]
