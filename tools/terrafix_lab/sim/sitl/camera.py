"""Camera of a vehicle in ArduPilot SITL: renders the generated world at the simulator's true pose."""

import threading
import time
from collections.abc import Callable

import cv2
import numpy as np

from terrafix.core.camera import Mount
from terrafix.core.geodesy import LocalFrame, rot_w_b
from terrafix_lab.sim.camera.render import Renderer
from terrafix_lab.sim.camera.stream import FrameStream
from terrafix_lab.sim.flights.folder import CAMERA, FRAME_HZ
from terrafix_lab.sim.ground.draped_image import Ground
from terrafix_lab.sim.sitl.observer import Truth

# Rendering delay: a pose can be interpolated when the states around it have arrived; they come at 40 Hz,
RENDER_DELAY_NS = 60_000_000
RETRY_S = 0.01  # or later, when the firmware has to wait for its processor
MIN_CAMERA_HEIGHT_M = 0.3  # least camera height above ground: the simulator's flat ground differs from the world's


class SimulatedCamera:
    """A context manager that pushes images into ``stream`` at FRAME_HZ, exposed at the time of their stamp."""

    def __init__(
        self,
        stream: FrameStream,
        ground: Ground,
        frame: LocalFrame,
        truth_at: Callable[[int], Truth | None],
        seed: int,
    ) -> None:
        self._stream, self._ground, self._frame, self._truth_at = stream, ground, frame, truth_at
        self._renderer = Renderer(ground, CAMERA, seed=seed)
        self._r_b_c = Mount(CAMERA.mount_yaw_deg, CAMERA.mount_pitch_deg, CAMERA.mount_roll_deg).r_b_c()
        self._stopping, self._paused = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="sitl-camera", daemon=True)
        self.frames = 0

    def pose(self, truth: Truth) -> tuple[np.ndarray, np.ndarray]:
        """Returns p_c_in_w_m (3,) and R_w_c (3, 3)."""
        e_m, n_m = self._frame.to_local(truth.lat_deg, truth.lon_deg)
        ground_m = float(self._ground.height_amsl_m(np.array([[e_m]]), np.array([[n_m]]))[0, 0])
        r_w_b = rot_w_b(truth.yaw_rad, truth.pitch_rad, truth.roll_rad)
        return np.array([e_m, n_m, max(truth.amsl_m, ground_m + MIN_CAMERA_HEIGHT_M)]), r_w_b @ self._r_b_c

    def pause(self) -> None:
        """No image is sent until ``resume``."""
        self._paused.set()

    def resume(self) -> None:
        self._paused.clear()

    def __enter__(self) -> "SimulatedCamera":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        cv2.setNumThreads(1)  # the daemon's processes need the cores
        period_ns = round(1e9 / FRAME_HZ)
        due_ns = time.monotonic_ns()
        while not self._stopping.wait(max(0, due_ns + RENDER_DELAY_NS - time.monotonic_ns()) / 1e9):
            truth = self._truth_at(due_ns)
            while truth is None and time.monotonic_ns() < due_ns + period_ns and not self._stopping.wait(RETRY_S):
                truth = self._truth_at(due_ns)
            if truth is not None and not self._paused.is_set():
                self._stream.push(self._renderer.frame(*self.pose(truth), self.frames), due_ns)
                self.frames += 1
            due_ns += period_ns * max(1, (time.monotonic_ns() - due_ns) // period_ns)
