"""MJPEG over HTTP, as IP cameras send it: multipart/x-mixed-replace (RFC 2046, section 5.1), one JPEG per part.

The header ``X-Timestamp-Ns`` of a part may carry the exposure time on CLOCK_MONOTONIC of this computer; without it, the
time of arrival is used."""

import http.client
import socket
import urllib.parse
from collections.abc import Callable

import cv2
import numpy as np

from terrafix.core.clock import now_ns
from terrafix.core.errors import SourceError
from terrafix.messages import STAMP_SIGMA_S
from terrafix.vision.sources.capture import NETWORK_SIGMA_S, STALL_S, Stamp
from terrafix.vision.sources.images import stated_size

MAX_PART_BYTES = 64 << 20  # limit; larger than the images of any camera
MAX_LINE_BYTES = 8192
MAX_PIXELS = 50_000_000  # of an image, 150 MB; larger than those of any camera that streams
JPEG_HEAD = b"\xff\xd8"
MAX_MJPEG_STAMP_AGE_NS = 60_000_000_000  # a timestamp that is older, or in the future, belongs to another clock
STAMP_HEADER = "x-timestamp-ns"


class MjpegCapture:
    """An open stream (``capture.Capture``)."""

    why = "the stream has ended, stalled or is malformed"

    def __init__(self, url: str, on_connect: Callable[[socket.socket], None] = lambda _socket: None) -> None:
        """``on_connect``: is given the socket before the camera has answered; another thread that shuts it down ends a
        wait for the camera. Raises SourceError: no connection, or the response is not an MJPEG stream."""
        self.stamp_ns: int | None = None  # timestamp of the grabbed image on the monotonic clock; None: it has none
        self._jpeg = b""
        self._at_part = False  # the boundary before the next part is already read
        address = urllib.parse.urlsplit(url)
        connection_type = http.client.HTTPSConnection if address.scheme == "https" else http.client.HTTPConnection
        try:
            self._connection = connection_type(address.hostname or "", address.port, timeout=STALL_S)
            self._connection.connect()
            on_connect(self._connection.sock)
            self._connection.request("GET", address._replace(scheme="", netloc="").geturl() or "/")
            self._response = self._connection.getresponse()
        except (OSError, ValueError, http.client.HTTPException) as error:
            raise SourceError(f"{url}: no response from the stream ({error}); is the camera on?") from None
        headers = self._response.headers
        boundary = headers.get_boundary() if headers.get_content_maintype() == "multipart" else None
        if self._response.status != http.client.OK or not boundary:
            self.release()
            raise SourceError(
                f"{url}: answers {self._response.status} {headers.get_content_type()}, not an MJPEG stream "
                "(multipart/x-mixed-replace); look up the address of the stream in the camera's manual"
            )
        self._boundary = b"--" + boundary.removeprefix("--").encode()  # some cameras include the dashes in the header

    def grab(self) -> bool:
        """Waits for the next image. False: end of stream, time-out (STALL_S), or malformed stream."""
        try:
            while not self._at_part:
                self._at_part = self._read_line().startswith(self._boundary)
            self._at_part = False
            headers = http.client.parse_headers(self._response)
            length = headers.get("content-length")
            self._jpeg = self._read_to_boundary() if length is None else self._read_exactly(int(length))
        except (OSError, ValueError, http.client.HTTPException):
            return False
        self.stamp_ns = _valid_stamp(headers.get(STAMP_HEADER, ""), now_ns())
        return True

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        """-> whether the grabbed image could be decoded, and the image (H, W, 3) uint8 BGR."""
        size = stated_size(self._jpeg) if self._jpeg.startswith(JPEG_HEAD) else None
        if size is None or size[0] * size[1] > MAX_PIXELS:
            return False, None
        image = cv2.imdecode(np.frombuffer(self._jpeg, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        return image is not None, image

    def stamp(self, arrival_ns: int) -> Stamp:
        if self.stamp_ns is None:
            return Stamp(arrival_ns, True, NETWORK_SIGMA_S)
        return Stamp(self.stamp_ns, True, STAMP_SIGMA_S)

    def size(self) -> tuple[int, int] | None:
        return None

    def described(self) -> str:
        return "MJPEG over HTTP"

    def release(self) -> None:
        self._connection.close()
        self._response.close()

    def _read_line(self) -> bytes:
        line = self._response.readline(MAX_LINE_BYTES)
        if not line:
            raise ConnectionResetError("the stream ended")
        return line

    def _read_exactly(self, size: int) -> bytes:
        if not 0 <= size <= MAX_PART_BYTES:
            raise ValueError(f"a part of {size} bytes")
        body = self._response.read(size)
        if len(body) < size:
            raise ConnectionResetError("the stream ended inside a part")
        return body

    def _read_to_boundary(self) -> bytes:
        """Reads a part without a content length."""
        lines: list[bytes] = []
        size = 0
        while not (line := self._read_line()).startswith(self._boundary):
            lines.append(line)
            size += len(line)
            if size > MAX_PART_BYTES:
                raise ValueError("a part without an end")
        self._at_part = True
        return b"".join(lines).removesuffix(b"\r\n")


def _valid_stamp(text: str, arrival_ns: int) -> int | None:
    """A plausible timestamp of the monotonic clock, else None."""
    if not text.strip().isdecimal():
        return None
    stamp_ns = int(text.strip())
    return stamp_ns if 0 <= arrival_ns - stamp_ns <= MAX_MJPEG_STAMP_AGE_NS else None
