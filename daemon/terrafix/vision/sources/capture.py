"""What a live camera is read by: the contract (``Capture``), and OpenCV's captures for devices and network streams."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Protocol

import cv2
import numpy as np

from terrafix.core.errors import SourceError
from terrafix.messages import STAMP_SIGMA_S, Camera
from terrafix.vision.sources.stream_address import NetworkAddress, listen_for_codec, parse_network
from terrafix.vision.sources.video import FFMPEG_QUIET

STALL_S = 5.0  # without an image after which a stream counts as lost; ten images at 2 Hz
READ_TIMEOUT_MS = 2000  # OpenCV's default of 10 s would delay the exit of the process
MAX_DRIVER_AGE_NS = 1_000_000_000  # an older driver timestamp belongs to another clock
PROTOCOLS = "file,rtp,rtsp,rtsps,rtmp,rtmps,udp,tcp,tls,crypto"  # that FFmpeg may use; a file: the session description
# 1-sigma of the time from exposure to the arrival of an image over a network, whose latency nobody has stated
# [spec: 110 ms (Herelink), 150 ms (SIYI HM30) to the screen; IP cameras with B frames or deep buffers up to 500 ms]
NETWORK_SIGMA_S = 0.2


class Stamp(NamedTuple):
    """Time stamp of an image on the monotonic clock. ``buffered``: as in Frame; ``sigma_s``: 1-sigma about the
    exposure, once the stated latency is taken off."""

    t_ns: int
    buffered: bool
    sigma_s: float


class Capture(Protocol):
    why: str  # ``grab`` has returned False: the reason

    def grab(self) -> bool:
        """Waits for the next image. False: the camera is lost."""

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        """-> whether the grabbed image could be decoded, and the image (H, W, 3) uint8 BGR."""

    def stamp(self, arrival_ns: int) -> Stamp:
        """Of the grabbed image, which arrived at ``arrival_ns``."""

    def size(self) -> tuple[int, int] | None:
        """Width and height; None: unknown before the first image."""

    def described(self) -> str:
        """By what the camera is read, and why by that."""

    def release(self) -> None: ...


class OpenCvCapture:
    """A V4L2 device, or a network stream by the FFmpeg of OpenCV's wheel. An open stream is read without a pause by
    ``LiveCamera``: FFmpeg's own buffers hold what it has not yet decoded, at most."""

    why = "no image"

    def __init__(self, capture: cv2.VideoCapture, described: str, network: bool) -> None:
        self._capture, self._described, self._network = capture, described, network

    def grab(self) -> bool:
        return bool(self._capture.grab())

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        decoded, image = self._capture.retrieve()
        return decoded, image if decoded else None

    def stamp(self, arrival_ns: int) -> Stamp:
        """V4L2 uses the monotonic clock (V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC) and OpenCV returns it as POS_MSEC; that
        of a stream has another zero."""
        if self._network:
            return Stamp(arrival_ns, True, NETWORK_SIGMA_S)
        driver_ns = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        stamped = 0 <= arrival_ns - driver_ns <= MAX_DRIVER_AGE_NS
        return Stamp(driver_ns if stamped else arrival_ns, not stamped, STAMP_SIGMA_S)

    def size(self) -> tuple[int, int] | None:
        size = tuple(int(self._capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        return (size[0], size[1]) if all(size) else None

    def described(self) -> str:
        return self._described

    def release(self) -> None:
        self._capture.release()


def open_device(spec: str, camera: Camera, why: str) -> OpenCvCapture:
    """V4L2 by OpenCV. ``why``: there is no GStreamer. Raises SourceError."""
    capture = cv2.VideoCapture(spec, cv2.CAP_V4L2) if Path(spec).exists() else None
    if capture is not None:
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, camera.width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, camera.height)
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # deliver the newest frame, not the oldest
        capture.set(cv2.CAP_PROP_READ_TIMEOUT_MSEC, READ_TIMEOUT_MS)
        if capture.isOpened():
            return OpenCvCapture(capture, f"V4L2 by OpenCV ({why})", network=False)
        capture.release()
    raise SourceError(f"{spec}: the camera cannot be opened; is it plugged in, and free?")


def open_stream(spec: str, why: str, stopped: Callable[[], bool]) -> OpenCvCapture:
    """A network stream by OpenCV's FFmpeg. ``why``: there is no GStreamer. Raises SourceError."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", FFMPEG_QUIET)
    address, target = parse_network(spec), spec
    transport = "udp" if spec.startswith("rtspu://") else "tcp"
    target = target.replace("rtspu://", "rtsp://").replace("rtspt://", "rtsp://")
    options = f"rtsp_transport;{transport}|fflags;nobuffer|flags;low_delay|protocol_whitelist;{PROTOCOLS}"
    session = None
    if spec.startswith("udp://"):
        codec, payload = listen_for_codec(address, stopped)
        if codec:  # RTP needs a description of the session, a bare transport stream does not
            session = _session(address, codec, payload)
            target = session
        else:
            target = f"udp://{address.host}:{address.port}"
    os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"] = options
    try:
        stall_ms = round(STALL_S * 1e3)
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, 2 * stall_ms, cv2.CAP_PROP_READ_TIMEOUT_MSEC, stall_ms]
        capture = cv2.VideoCapture(target, cv2.CAP_FFMPEG, limits)
    finally:
        if session is not None:
            os.unlink(session)
    if not capture.isOpened():
        capture.release()
        raise SourceError(
            f"{address.url}: OpenCV's FFmpeg cannot open the stream and does not say why: address, user and "
            f"password, or codec; GStreamer would say it ({why})"
        )
    return OpenCvCapture(capture, f"FFmpeg of OpenCV ({why})", network=True)


def _session(address: NetworkAddress, codec: str, payload: int) -> str:
    """File with a session description (RFC 8866) of RTP that arrives on a port."""
    kind = "IP4 " + (address.host or "0.0.0.0")
    lines = [
        "v=0",
        f"o=- 0 0 IN {kind}",
        "s=camera",
        f"c=IN {kind}",
        "t=0 0",
        f"m=video {address.port} RTP/AVP {payload}",
    ]
    with tempfile.NamedTemporaryFile("w", suffix=".sdp", delete=False) as file:
        file.write("\n".join([*lines, f"a=rtpmap:{payload} {codec}/90000", ""]))
    return file.name
