"""The camera of the fault matrix: streams the images of the flight, edited by the fault."""

import math
import threading
import time
from collections.abc import Callable, Iterator
from itertools import chain, islice

import cv2
import numpy as np
from msgspec import UnsetType

from terrafix.messages import Camera, Frame
from terrafix.vision.sources import Shot
from terrafix_lab.faults.edits import Edit, unchanged
from terrafix_lab.sim.camera.stream import FrameStream
from terrafix_lab.sim.flights.folder import FRAME_HZ

REPEATED_AFTER = 0.1  # of a period: between images with the same time
SLACK = 1e-3  # share of a period: an image that is sent so much too early is the one that is due


class StreamedCamera:
    """A context manager. ``edit`` may be changed at any time; it sees the shots
    from then on, with times of the monotonic clock."""

    def __init__(
        self,
        stream: FrameStream,
        image_at: Callable[[float], bytes],
        flight_s: Callable[[], float],
        frame_hz: float = FRAME_HZ,
    ) -> None:
        """``image_at``: JPEG by the time of the flight; ``flight_s``: that time now.

        Images exist at multiples of 1 / ``frame_hz``: each is sent at its own time, and stamped with it."""
        self.edit: Edit = unchanged
        self.past_s = 0.0  # of the time before it that an edit sees; set it first
        self.pushed_s: list[float] = []  # monotonic time of each image
        self.image_at = image_at  # may be changed at any time
        self._stream, self._flight_s = stream, flight_s
        self._frame_hz, self._wait_s = frame_hz, 0.0
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="chaos-camera", daemon=True)

    def __enter__(self) -> "StreamedCamera":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stopping.is_set():
            edit = self.edit
            jpegs = _Jpegs(decoded=edit is not unchanged)
            before_ns, past = 0, self._past(jpegs)
            for shot in islice(edit(chain(past, self._shots(edit, jpegs))), len(past), None):
                if shot.frame.t_ns == before_ns:  # another one of the same time
                    self._stopping.wait(REPEATED_AFTER / self._frame_hz)
                before_ns = shot.frame.t_ns
                self._stream.push_jpeg(jpegs.of(shot), shot.frame.t_ns)
                self.pushed_s.append(time.monotonic())

    def _past(self, jpegs: "_Jpegs") -> list[Shot]:
        """Those of ``past_s`` before now; the edit gives one for each."""
        now_ns, flight_s = time.monotonic_ns(), self._flight_s()
        ago_s = [count / self._frame_hz for count in range(round(self.past_s * self._frame_hz), 0, -1)]
        return [jpegs.shot(self.image_at(flight_s - s), now_ns - round(1e9 * s)) for s in ago_s]

    def _shots(self, edit: Edit, jpegs: "_Jpegs") -> Iterator[Shot]:
        """Each when its time has come, until there is another edit."""
        while not self._stopping.wait(self._wait_s):
            self._wait_s = 0.0
            if self.edit is not edit:
                return
            now_ns, flight_s = time.monotonic_ns(), self._flight_s()
            late_s = flight_s - math.floor(flight_s * self._frame_hz + SLACK) / self._frame_hz
            t_ns = now_ns - round(1e9 * late_s)
            yield jpegs.shot(self.image_at(flight_s - late_s), t_ns)
            spent_s = (time.monotonic_ns() - now_ns) / 1e9
            self._wait_s = max(0.0, 1.0 / self._frame_hz - spent_s - late_s)


class _Jpegs:
    """Shots from JPEG, and JPEG of shots: the same bytes if the image is the same."""

    def __init__(self, *, decoded: bool) -> None:
        self._decoded = decoded
        self._image: np.ndarray = np.zeros(0, np.uint8)
        self._jpeg = b""

    def shot(self, jpeg: bytes, t_ns: int) -> Shot:
        self._image, self._jpeg = np.frombuffer(jpeg, np.uint8), jpeg
        if self._decoded:
            image = cv2.imdecode(self._image, cv2.IMREAD_COLOR)
            assert image is not None
            self._image = image
        return Shot(Frame(t_ns=t_ns, frame_id=0, file="", width=0, height=0), (), self._image)

    def of(self, shot: Shot) -> bytes:
        """Of a shot without an image bytes that are no JPEG."""
        if shot.image is None:
            return self._jpeg[: len(self._jpeg) // 3][::-1]
        if shot.image is self._image:
            return self._jpeg
        return cv2.imencode(".jpg", shot.image)[1].tobytes()


def camera_toml(camera: Camera, attitude_sigma_deg: float | None = None) -> str:
    """The description of the camera for `terrafix run`."""
    telemetry = "" if attitude_sigma_deg is None else f"[telemetry]\nattitude_sigma_deg = {attitude_sigma_deg}\n"
    gimbal = "" if isinstance(camera.gimbal, UnsetType) else 'gimbal = "mavlink"\n'
    return (
        f'name = "chaos"\n[camera]\nwidth = {camera.width}\nheight = {camera.height}\n'
        f"fx = {camera.fx}\nfy = {camera.fy}\ncx = {camera.cx}\ncy = {camera.cy}\nfocal_sigma = {camera.focal_sigma}\n"
        f"distortion = {list(camera.distortion)}\n"
        f"[mount]\ntolerance_deg = {camera.mount_tolerance_deg}\n{gimbal}{telemetry}"
    )
