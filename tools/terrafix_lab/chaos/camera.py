"""The camera of the fault matrix: streams the images of the flight, and what is wrong with them."""

import math
import threading
import time
from collections.abc import Callable
from enum import StrEnum

import cv2
import numpy as np

from terrafix.messages import Camera
from terrafix_lab.sim.camera.stream import FrameStream
from terrafix_lab.sim.flights.folder import FRAME_HZ

EXPOSURE_GAIN = 6.0  # of the overexposed image: all but the darkest ground is white
DEFOCUS_PX = 12.0  # 1-sigma of the blur
SLACK = 1e-3  # share of a period: an image that is sent so much too early is the one that is due
NS = 1_000_000_000


class Look(StrEnum):
    """What the camera sends."""

    GOOD = "good"
    NOTHING = "nothing"  # the cable is unplugged
    FROZEN = "frozen"  # the same image again and again, with new time stamps
    BLACK = "black"
    OVEREXPOSED = "overexposed"
    DEFOCUSED = "defocused"
    SMALL = "small"  # half the width and height
    TORN = "torn"  # bytes that are no JPEG
    TEN_TIMES = "ten times"  # each image ten times, 20 a second
    AHEAD = "stamps ahead"  # time stamps 5 s in the future
    LATE = "stamps late"  # time stamps 3 s in the past


SHIFT_NS = {Look.AHEAD: 5 * NS, Look.LATE: -3 * NS}


class StreamedCamera:
    """A context manager. ``look`` may be changed at any time."""

    def __init__(
        self,
        stream: FrameStream,
        image_at: Callable[[float], bytes],
        flight_s: Callable[[], float],
        frame_hz: float = FRAME_HZ,
    ) -> None:
        """``image_at``: JPEG by the time of the flight; ``flight_s``: that time now.

        Images exist at multiples of 1 / ``frame_hz``: each is sent at its own time, and stamped with it."""
        self.look = Look.GOOD
        self.pushed = 0
        self._stream, self._image_at, self._flight_s = stream, image_at, flight_s
        self._frozen, self._frame_hz = b"", frame_hz
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="chaos-camera", daemon=True)

    def __enter__(self) -> "StreamedCamera":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        wait_s = 0.0
        while not self._stopping.wait(wait_s):
            look, now_ns, flight_s = self.look, time.monotonic_ns(), self._flight_s()
            late_s = flight_s - math.floor(flight_s * self._frame_hz + SLACK) / self._frame_hz
            good = self._image_at(flight_s - late_s)
            self._frozen = good if look is not Look.FROZEN else self._frozen
            if look is not Look.NOTHING:
                stamp_ns = now_ns - round(1e9 * late_s) + SHIFT_NS.get(look, 0)
                self._stream.push_jpeg(self._frozen if look is Look.FROZEN else altered(good, look), stamp_ns)
                self.pushed += 1
            spent_s = (time.monotonic_ns() - now_ns) / 1e9
            period_s = 1.0 / self._frame_hz / (10.0 if look is Look.TEN_TIMES else 1.0)
            wait_s = max(0.0, period_s - spent_s - (late_s if look is not Look.TEN_TIMES else 0.0))


def altered(jpeg: bytes, look: Look) -> bytes:
    """The image as a camera with this fault sends it."""
    if look is Look.TORN:
        return jpeg[: len(jpeg) // 3][::-1]
    if look not in (Look.BLACK, Look.OVEREXPOSED, Look.DEFOCUSED, Look.SMALL):
        return jpeg
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    if look is Look.BLACK:
        image = np.zeros_like(image)
    elif look is Look.OVEREXPOSED:
        image = cv2.convertScaleAbs(image, alpha=EXPOSURE_GAIN, beta=60)
    elif look is Look.DEFOCUSED:
        image = cv2.GaussianBlur(image, (0, 0), DEFOCUS_PX)
    else:
        image = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", image)[1].tobytes()


def camera_toml(camera: Camera, attitude_sigma_deg: float | None = None) -> str:
    """The description of the camera for `terrafix run`."""
    telemetry = "" if attitude_sigma_deg is None else f"[telemetry]\nattitude_sigma_deg = {attitude_sigma_deg}\n"
    return (
        f'name = "chaos"\n[camera]\nwidth = {camera.width}\nheight = {camera.height}\n'
        f"fx = {camera.fx}\nfy = {camera.fy}\ncx = {camera.cx}\ncy = {camera.cy}\nfocal_sigma = {camera.focal_sigma}\n"
        f"distortion = {list(camera.distortion)}\n"
        f"[mount]\ntolerance_deg = {camera.mount_tolerance_deg}\n{telemetry}"
    )
