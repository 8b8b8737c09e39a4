"""Pictures over HTTP, as IP cameras send them: multipart/x-mixed-replace, one JPEG a part.

A part may say when its exposure was, in ``X-Timestamp-Ns`` on CLOCK_MONOTONIC of this machine; without it the time of
arrival counts. Format: RFC 2046, section 5.1."""

import http.client
import urllib.parse

import cv2
import numpy as np

from terrafix.core.clock import now_ns
from terrafix.core.errors import SourceError

STALL_S = 5.0  # a camera that is silent for longer is taken for lost: at 2 Hz that is ten pictures
MAX_PART_BYTES = 64 << 20  # no camera sends more; what does is not a camera
MAX_LINE_BYTES = 8192
MAX_AGE_NS = 60_000_000_000  # an older stamp, or one of the future, is of another clock
STAMP_HEADER = "x-timestamp-ns"


class MjpegCapture:
    """An open stream, with the methods of cv2.VideoCapture that a live camera needs."""

    def __init__(self, url: str) -> None:
        """Raises SourceError: nobody answers there, or the answer is no MJPEG stream."""
        self.stamp_ns: int | None = None  # of the grabbed picture, on our clock; None: it did not say
        self._jpeg = b""
        self._at_part = False  # the boundary before the next part was already read
        place = urllib.parse.urlsplit(url)
        kind = http.client.HTTPSConnection if place.scheme == "https" else http.client.HTTPConnection
        try:
            self._connection = kind(place.hostname or "", place.port, timeout=STALL_S)
            self._connection.request("GET", place._replace(scheme="", netloc="").geturl() or "/")
            self._answer = self._connection.getresponse()
        except (OSError, ValueError, http.client.HTTPException) as error:
            raise SourceError(f"{url}: nobody sends pictures there ({error}); is the camera on?") from None
        said = self._answer.headers
        boundary = said.get_boundary() if said.get_content_maintype() == "multipart" else None
        if self._answer.status != http.client.OK or not boundary:
            self.release()
            raise SourceError(
                f"{url}: answers {self._answer.status} {said.get_content_type()}, not an MJPEG stream "
                "(multipart/x-mixed-replace); look up the address of the stream in the camera's manual"
            )
        self._boundary = b"--" + boundary.removeprefix("--").encode()  # some cameras write the dashes into the header

    def grab(self) -> bool:
        """Waits for the next picture; False: the stream ended, was silent for STALL_S, or is no stream of pictures."""
        try:
            while not self._at_part:
                self._at_part = self._line().startswith(self._boundary)
            self._at_part = False
            said = http.client.parse_headers(self._answer)
            length = said.get("content-length")
            self._jpeg = self._up_to_boundary() if length is None else self._exactly(int(length))
        except (OSError, ValueError, http.client.HTTPException):
            return False
        self.stamp_ns = _plausible(said.get(STAMP_HEADER, ""), now_ns())
        return True

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        """-> whether the grabbed picture could be decoded, (H, W, 3) uint8 BGR."""
        image = cv2.imdecode(np.frombuffer(self._jpeg, np.uint8), cv2.IMREAD_COLOR) if self._jpeg else None
        return image is not None, image

    def get(self, prop: int) -> float:
        """0, "not known", for every property: a stream does not say its size before the first picture."""
        return 0.0

    def release(self) -> None:
        self._connection.close()
        self._answer.close()

    def _line(self) -> bytes:
        line = self._answer.readline(MAX_LINE_BYTES)
        if not line:
            raise ConnectionResetError("the stream ended")
        return line

    def _exactly(self, size: int) -> bytes:
        if not 0 <= size <= MAX_PART_BYTES:
            raise ValueError(f"a picture of {size} bytes")
        body = self._answer.read(size)
        if len(body) < size:
            raise ConnectionResetError("the stream ended inside a picture")
        return body

    def _up_to_boundary(self) -> bytes:
        """The part of a camera that does not say how long it is."""
        lines: list[bytes] = []
        size = 0
        while not (line := self._line()).startswith(self._boundary):
            lines.append(line)
            size += len(line)
            if size > MAX_PART_BYTES:
                raise ValueError("a picture without an end")
        self._at_part = True
        return b"".join(lines).removesuffix(b"\r\n")


def _plausible(text: str, arrival_ns: int) -> int | None:
    """A stamp of our own clock, or None."""
    if not text.strip().isdecimal():
        return None
    stamp_ns = int(text)
    return stamp_ns if 0 <= arrival_ns - stamp_ns <= MAX_AGE_NS else None
