"""Live camera: CSI, V4L2 device, network stream, GStreamer pipeline. Reconnects after a loss and does not end."""

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

from terrafix.core import logs
from terrafix.core.clock import now_ns
from terrafix.core.errors import SourceError
from terrafix.core.passwords import without_password
from terrafix.messages import STAMP_SIGMA_S, Camera, Fact, Frame
from terrafix.vision.sources.capture import Capture, Stamp, open_device, open_stream
from terrafix.vision.sources.contract import UNKNOWN_TIMING, Shot, SourceBase, Timing
from terrafix.vision.sources.description import camera_of, origin_of, read_description
from terrafix.vision.sources.facts import camera_facts, mount_fact, start_fact
from terrafix.vision.sources.gst import GstCapture, gstreamer
from terrafix.vision.sources.mjpeg import MjpegCapture
from terrafix.vision.sources.stream_address import DEVICE, HTTP, NETWORK

RECONNECT_S = 1.0  # a USB camera needs about this long to re-enumerate
# An image that arrives later after its stamp is not used: it says little about now, and if its stamp is wrong instead,
# the position is wrong by seconds of flight. [spec: range of the time offset, estimator/integrity/time_offset.py]
MAX_LATE_NS = 2_000_000_000


class LiveCamera(SourceBase):
    """Frames with ``t_ns`` on the monotonic clock: the driver's timestamp if there is one, else the time of arrival;
    the stated latency is taken off."""

    live = True

    def __init__(
        self,
        spec: str,
        start: tuple[float, float] | None = None,
        camera: Path | None = None,
        rate_hz: float = 2.0,
        *,
        timing: Timing = UNKNOWN_TIMING,
        wait: bool = False,
        open_capture: Callable[[str, Camera], Capture] | None = None,
        reconnect_s: float = RECONNECT_S,
    ) -> None:
        """``wait``: no error when the device is missing now. ``open_capture(spec, camera)`` raises SourceError.

        Raises SourceError: no camera description, the device cannot be opened, or it has another image size."""
        if camera is None:
            raise SourceError(
                f"{without_password(spec)}: a camera does not say its own focal length; set [source] camera in "
                "the configuration to a camera description (config/cameras has an example)"
            )
        self.spec = f"/dev/video{spec}" if spec.isdecimal() else spec
        self._shown = without_password(self.spec)
        self._described, self._description = camera, read_description(camera)
        self._origin = origin_of(self._description, camera_of(camera, self._description), start)
        self._period_ns = round(1e9 / rate_hz)
        self._open = open_capture or self._open_capture
        self._reconnect_s = reconnect_s
        self._closed = threading.Event()
        self._takes: Callable[[int], bool] = lambda _t_ns: True
        self._streaming = False
        self._late = False  # the last image was too late
        self._timing = timing
        self._error = ""  # of the last image, or of the last attempt to connect
        self._read_by = ""  # capture and decoder
        self._socket: socket.socket | None = None  # of a stream
        self._capture = self._try_open() if wait else self._opened()
        if self._capture is not None and not wait:
            self._check_size(self._capture)

    def name(self) -> str:
        return self._description.name or self._shown

    def facts(self) -> list[Fact]:
        camera, described = self._origin.camera, self._described.name
        return [
            *camera_facts(camera, f"[camera] of {described}"),
            mount_fact(camera, f"[mount] of {described}"),
            start_fact(self._origin, "--start, [source] start or the description"),
            *([Fact("camera", f"read by {self._read_by}")] if self._read_by else []),
            Fact("clock", self._clock()),
        ]

    def select(self, takes: Callable[[int], bool]) -> bool:
        self._takes = takes
        return True

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
                        logs.get().warning("camera lost; reconnecting", source=self._shown, why=capture.why)
                    continue
                arrival_ns = now_ns()
                stamp = self._stamp(capture, arrival_ns)
                if self._is_late(arrival_ns - stamp.t_ns) or stamp.t_ns < due_ns:
                    continue
                due_ns = max(due_ns, stamp.t_ns - self._period_ns // 2) + self._period_ns  # the mean rate, no bursts
                if self._takes(stamp.t_ns):
                    yield self._shot(capture, frame_id, stamp)
                frame_id += 1
        finally:
            self._streaming = False
            self._disconnect()

    def _is_late(self, age_ns: int) -> bool:
        """Whether an image that arrives ``age_ns`` after its stamp is left out. Beginning and end are in the log."""
        before, self._late = self._late, age_ns > MAX_LATE_NS
        if self._late and not before:
            todo = "compare the clock of the camera's time stamps; shorten its buffers"
            logs.get().warning("images too late", source=self._shown, age_s=round(age_ns / 1e9, 1), todo=todo)
        elif before and not self._late:
            logs.get().info("images in time again", source=self._shown)
        return self._late

    def _stamp(self, capture: Capture, arrival_ns: int) -> Stamp:
        stamp = capture.stamp(arrival_ns)
        latency_s, sigma_s, _ = self._timing
        if latency_s and not sigma_s:
            sigma_s = min(stamp.sigma_s, STAMP_SIGMA_S)
        return Stamp(stamp.t_ns - round(latency_s * 1e9), stamp.buffered, sigma_s or stamp.sigma_s)

    def _clock(self) -> str:
        latency_s, sigma_s, sender_clock = self._timing
        by = "the sender's clock" if sender_clock else "the driver's time stamp where it has one, else arrival"
        sigma = f" (1-sigma {1e3 * sigma_s:g} ms)" if sigma_s else ""
        return f"exposure by {by}" + (f", less {1e3 * latency_s:g} ms of stated latency{sigma}" if latency_s else sigma)

    def _shot(self, capture: Capture, frame_id: int, stamp: Stamp) -> Shot:
        camera = self._origin.camera
        decoded, image = capture.retrieve()
        error = "" if decoded else "cannot be decoded"
        if image is not None and image.shape != (camera.height, camera.width, 3):
            error = f"wrong size: {image.shape[1]}x{image.shape[0]}, the camera says {camera.width}x{camera.height}"
        if error and error != self._error:
            logs.get().warning("images cannot be used", source=self._shown, why=error)
        elif self._error and not error:
            logs.get().info("images can be used again", source=self._shown)
        self._error = error
        frame = Frame(
            t_ns=stamp.t_ns,
            frame_id=frame_id,
            file="",
            width=camera.width,
            height=camera.height,
            error=error,
            buffered=stamp.buffered,
            stamp_sigma_s=stamp.sigma_s,
        )
        return Shot(frame, (), None if error else image)

    def _ensure_connected(self) -> Capture | None:
        """The capture, reopened after a loss; None when the attempt failed after a wait."""
        if self._capture is None and not self._closed.wait(self._reconnect_s):
            self._capture = self._try_open()
        return self._capture

    def _try_open(self) -> Capture | None:
        """Opens the capture; None on failure, since in flight a missing camera is not a configuration error."""
        try:
            return self._opened()
        except SourceError as error:
            if str(error) != self._error and not self._closed.is_set():
                self._error = str(error)
                logs.get().warning("camera not available", source=self._shown, why=str(error))
            return None

    def _opened(self) -> Capture:
        capture = self._open(self.spec, self._origin.camera)
        self._error, self._read_by = "", capture.described()
        logs.get().info("camera connected", source=self._shown, by=self._read_by)
        return capture

    def _open_capture(self, spec: str, camera: Camera) -> Capture:
        """The choice: MJPEG over HTTP by our own reader, all others by GStreamer, else by OpenCV where that can."""
        if spec.startswith(HTTP):
            return MjpegCapture(spec, self._connected)
        if spec.startswith(DEVICE) and not Path(spec).exists():
            raise SourceError(f"{spec}: the camera cannot be opened; is it plugged in, and free?")
        Gst, version = gstreamer()
        if Gst is not None:
            return GstCapture(spec, camera, self._closed.is_set, self._timing.sender_clock)
        if spec.startswith(DEVICE):
            return open_device(spec, camera, version)
        if spec.startswith(NETWORK):
            return open_stream(spec, version, self._closed.is_set)
        raise SourceError(f"{self._shown}: {version}")

    def _connected(self, connection: socket.socket) -> None:
        self._socket = connection
        if self._closed.is_set():
            _shut_down(connection)

    def _disconnect(self) -> None:
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def _check_size(self, capture: Capture) -> None:
        camera, size = self._origin.camera, capture.size()
        if size is not None and size != (camera.width, camera.height):
            self._disconnect()
            raise SourceError(
                f"{self._shown}: the camera gives {size[0]}x{size[1]}, its description says "
                f"{camera.width}x{camera.height}; choose a mode that it has"
            )


def _shut_down(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):  # the camera has closed it
        connection.shutdown(socket.SHUT_RDWR)
