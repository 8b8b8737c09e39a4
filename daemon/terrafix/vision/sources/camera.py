"""Live camera: V4L2 device, GStreamer pipeline, or MJPEG over HTTP. Reconnects after a loss and does not end."""

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

import cv2

from terrafix.core import logs
from terrafix.core.clock import now_ns
from terrafix.core.errors import SourceError
from terrafix.messages import Camera, Frame, Origin
from terrafix.vision.sources.contract import Shot
from terrafix.vision.sources.description import camera_of, origin_of, read_description
from terrafix.vision.sources.facts import Fact, camera_facts, mount_fact, start_fact
from terrafix.vision.sources.mjpeg import MjpegCapture

RECONNECT_S = 1.0  # a USB camera needs about this long to re-enumerate
READ_TIMEOUT_MS = 2000  # OpenCV's default of 10 s would delay the exit of the process
# An image that arrives later after its stamp is not used: it says little about now, and if its stamp is wrong instead,
# the position is wrong by seconds of flight. [spec: range of the time offset, estimator/integrity/time_offset.py]
MAX_LATE_NS = 2_000_000_000
MAX_DRIVER_AGE_NS = 1_000_000_000  # an older driver timestamp belongs to another clock


class Capture(Protocol):
    """The used part of cv2.VideoCapture."""

    def grab(self) -> bool: ...

    def retrieve(self) -> tuple[bool, Any]: ...

    def get(self, prop: int) -> float: ...

    def release(self) -> None: ...


class LiveCamera:
    """Frames with ``t_ns`` on the monotonic clock: the driver's timestamp if there is one, else the time of arrival."""

    live = True

    def __init__(
        self,
        spec: str,
        start: tuple[float, float] | None = None,
        camera: Path | None = None,
        rate_hz: float = 2.0,
        *,
        wait: bool = False,
        open_capture: Callable[[str, Camera], Capture | None] | None = None,
        reconnect_s: float = RECONNECT_S,
    ) -> None:
        """``wait``: no error when the device is missing now. ``open_capture(spec, camera)`` -> None: it is missing.

        Raises SourceError: no camera description, the device cannot be opened, or it has another image size."""
        if camera is None:
            raise SourceError(
                f"{spec}: a camera does not say its own focal length; set [source] camera in the configuration to a "
                "camera description (config/cameras has an example)"
            )
        self.spec = f"/dev/video{spec}" if spec.isdecimal() else spec
        self._described, self._description = camera, read_description(camera)
        self._origin = origin_of(self._description, camera_of(camera, self._description), start)
        self._period_ns = round(1e9 / rate_hz)
        self._open = open_capture or self._open_capture
        self._reconnect_s = reconnect_s
        self._closed = threading.Event()
        self._streaming = False
        self._late = False  # the last image was too late
        self._socket: socket.socket | None = None  # of a stream
        self._capture = self._try_open() if wait else self._open(self.spec, self._origin.camera)
        if self._capture is not None:
            self._check_size(self._capture)
        elif not wait:
            raise SourceError(f"{self.spec}: the camera cannot be opened; is it plugged in, and free?")

    def origin(self) -> Origin:
        return self._origin

    def length(self) -> int | None:
        return None

    def name(self) -> str:
        return self._description.name or self.spec

    def map_hint(self) -> Path | None:
        return None

    def facts(self) -> list[Fact]:
        camera, described = self._origin.camera, self._described.name
        return [
            *camera_facts(camera, f"[camera] of {described}"),
            mount_fact(camera, f"[mount] of {described}"),
            start_fact(self._origin, "--start, [source] start or the description"),
            Fact("clock", "exposure by the driver's time stamp where it has one, else arrival"),
        ]

    def close(self) -> None:
        """Ends ``shots``, from any thread; the thread that runs ``shots`` releases the device.

        It does not wait for a stream that is connected and sends nothing."""
        self._closed.set()
        if self._socket is not None:
            _shut_down(self._socket)
        if not self._streaming:
            self._disconnect()

    def shots(self, from_s: float = 0.0) -> Iterator[Shot]:
        """``from_s`` is ignored: a camera has no earlier frames."""
        frame_id, due_ns = 0, 0
        self._streaming = True
        try:
            while not self._closed.is_set():
                capture = self._ensure_connected()
                if capture is None:
                    continue
                if not capture.grab():
                    self._disconnect()
                    if not self._closed.is_set():
                        logs.get().warning("camera lost; reconnecting", source=self.spec)
                    continue
                arrival_ns = now_ns()
                t_ns, buffered = _timestamp_ns(capture, arrival_ns)
                if self._is_late(arrival_ns - t_ns) or t_ns < due_ns:
                    continue
                due_ns = max(due_ns + self._period_ns, t_ns + self._period_ns // 2)  # keeps the mean rate, no bursts
                yield self._shot(capture, frame_id, t_ns, buffered=buffered)
                frame_id += 1
        finally:
            self._streaming = False
            self._disconnect()

    def _is_late(self, age_ns: int) -> bool:
        """Whether an image that arrives ``age_ns`` after its stamp is left out. Beginning and end are in the log."""
        late = age_ns > MAX_LATE_NS
        if late != self._late:
            self._late = late
            if late:
                logs.get().warning(
                    "images too late",
                    source=self.spec,
                    age_s=round(age_ns / 1e9, 1),
                    todo="compare the clock of the camera's time stamps; shorten its buffers",
                )
            else:
                logs.get().info("images in time again", source=self.spec)
        return late

    def _shot(self, capture: Capture, frame_id: int, t_ns: int, *, buffered: bool) -> Shot:
        camera = self._origin.camera
        decoded, image = capture.retrieve()
        error = "" if decoded else "cannot be decoded"
        if decoded and image.shape != (camera.height, camera.width, 3):
            error = f"wrong size: {image.shape[1]}x{image.shape[0]}, the camera says {camera.width}x{camera.height}"
        frame = Frame(
            t_ns=t_ns,
            frame_id=frame_id,
            file="",
            width=camera.width,
            height=camera.height,
            error=error,
            buffered=buffered,
        )
        return Shot(frame, (), None if error else image)

    def _ensure_connected(self) -> Capture | None:
        """The capture, reopened after a loss; None when the attempt failed after a wait."""
        if self._capture is None and not self._closed.wait(self._reconnect_s):
            self._capture = self._try_open()
            if self._capture is not None:
                logs.get().info("camera connected", source=self.spec)
        return self._capture

    def _try_open(self) -> Capture | None:
        """Opens the capture; None on failure, since in flight a missing camera is not a configuration error."""
        try:
            return self._open(self.spec, self._origin.camera)
        except SourceError as error:
            logs.get().debug("camera not available yet", source=self.spec, why=str(error))
            return None

    def _open_capture(self, spec: str, camera: Camera) -> Capture | None:
        return MjpegCapture(spec, self._connected) if is_stream_url(spec) else _open_device(spec, camera)

    def _connected(self, connection: socket.socket) -> None:
        self._socket = connection
        if self._closed.is_set():
            _shut_down(connection)

    def _disconnect(self) -> None:
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def _check_size(self, capture: Capture) -> None:
        camera = self._origin.camera
        size = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        unknown = size == (0, 0)  # the size of a stream is unknown before its first image
        if not unknown and size != (camera.width, camera.height):
            self._disconnect()
            raise SourceError(
                f"{self.spec}: the camera gives {size[0]}x{size[1]}, its description says "
                f"{camera.width}x{camera.height}; choose a mode that it has"
            )


def is_stream_url(spec: str) -> bool:
    """True when ``spec`` is a stream URL; a GStreamer pipeline may contain one."""
    return spec.startswith(("http://", "https://")) and "!" not in spec


def _timestamp_ns(capture: Capture, arrival_ns: int) -> tuple[int, bool]:
    """-> timestamp of the grabbed frame, and whether a buffer may lie between the exposure and it. V4L2 uses the
    monotonic clock (V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC) and OpenCV returns it as POS_MSEC."""
    if isinstance(capture, MjpegCapture):
        return capture.stamp_ns or arrival_ns, True
    driver_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
    stamped = 0 <= arrival_ns - driver_ns <= MAX_DRIVER_AGE_NS
    return (driver_ns, False) if stamped else (arrival_ns, True)


def _shut_down(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):  # the camera has closed it
        connection.shutdown(socket.SHUT_RDWR)


def _open_device(spec: str, camera: Camera) -> Capture | None:
    if "!" in spec:
        if not cv2.videoio_registry.hasBackend(cv2.CAP_GSTREAMER):
            raise SourceError(
                f"'{spec}': this OpenCV was built without GStreamer; use a /dev/video device, or install an OpenCV "
                "with GStreamer (JetPack brings one)"
            )
        capture = cv2.VideoCapture(spec, cv2.CAP_GSTREAMER)
    else:
        if not Path(spec).exists():
            return None
        capture = cv2.VideoCapture(spec, cv2.CAP_V4L2)
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, camera.width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, camera.height)
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # deliver the newest frame, not the oldest
    capture.set(cv2.CAP_PROP_READ_TIMEOUT_MSEC, READ_TIMEOUT_MS)
    if not capture.isOpened():
        capture.release()
        return None
    return capture
