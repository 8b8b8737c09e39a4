"""Rolling shutter: matches of odometry as they would be if all rows of an image were exposed with its middle row.

How the camera moved at a frame is predicted: it turns as the autopilot's gyroscopes say, and moves with the velocity of
the frame before. Keyframes keep the motion that was predicted for them."""

from typing import TypeVar

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from terrafix.core.camera import CameraCalibration, Mount, Readout
from terrafix.estimator.filter_state import FilterState
from terrafix.estimator.measurements.telemetry_buffer import Attitude, Telemetry
from terrafix.estimator.state import CALIBRATION_SIZE
from terrafix.messages import Camera, KeyframeLink, Odometry, ReadoutMotion, Relocalization, Vec3

KEPT_FRAMES = 5000  # of which a later frame may see the ground again: half an hour at 3 Hz [spec: 3 MB]

Row = TypeVar("Row", bound=tuple[float, ...])


class RollingShutter:
    """``camera``: of the flight. Without ``readout_s`` all matches are returned as they are."""

    def __init__(self, camera: Camera) -> None:
        self._camera, self._lens, self._r_b_c = camera, CameraCalibration.of(camera), Mount.of(camera).r_b_c()
        self._readouts: dict[int, Readout] = {}  # of the newest frames
        self.motion: ReadoutMotion | UnsetType = UNSET  # of the newest frame

    def corrected(self, odometry: Odometry, state: FilterState, attitude: Attitude, telemetry: Telemetry) -> Odometry:
        """``odometry`` of the next frame. ``attitude``: of the platform at it; ``state``: of the frame before."""
        if not self._camera.readout_s:
            return odometry
        before, bias = None, np.zeros(CALIBRATION_SIZE)
        if state.last is not None:
            before, bias = state.last.pose.rotation().matrix(), state.graph.state(state.last.node).calibration
        r_w_c = state.camera.expected(attitude, bias, before)
        self.motion = self._motion(odometry.t_ns, state, r_w_c, telemetry)
        if (readout := Readout.of(self._camera, self.motion, r_w_c)) is not None:
            self._readouts[odometry.frame_id] = readout
        if len(self._readouts) > KEPT_FRAMES:
            del self._readouts[next(iter(self._readouts))]
        own, keyframe = odometry.frame_id, odometry.keyframe_id
        return msgspec.structs.replace(
            odometry,
            two_view=self._moved(odometry.two_view, keyframe, own),
            three_view=self._moved(odometry.three_view, odometry.previous_keyframe_id, keyframe, own),
            links=[self._link(link, own) for link in odometry.links],
        )

    def relocalized(self, seen: Relocalization) -> Relocalization:
        """The same for the match of a frame with an older keyframe."""
        if not self._readouts:
            return seen
        return msgspec.structs.replace(seen, two_view=self._moved(seen.two_view, seen.keyframe_id, seen.frame_id))

    def _link(self, link: KeyframeLink, own: int) -> KeyframeLink:
        return msgspec.structs.replace(link, two_view=self._moved(link.two_view, link.keyframe_id, own))

    def _motion(
        self, t_ns: int, state: FilterState, r_w_c: np.ndarray, telemetry: Telemetry
    ) -> ReadoutMotion | UnsetType:
        """Unset: nothing says how the vehicle turns. A camera on a gimbal turns about the vertical alone. Before the
        first frame the velocity is unknown, and is taken as 0."""
        rate_b, speed_per_s = telemetry.vehicle_rate_radps(t_ns), np.zeros(3)
        if rate_b is None:
            return UNSET
        rate_c = self._r_b_c.T @ rate_b
        if telemetry.gimbal.used:
            rate_c = r_w_c[2] * float(r_w_c[2] @ rate_c)
        if state.last is not None:
            above_m = max(state.terrain.height_above_m(state.last.pose.translation()), 1.0)
            speed_per_s = r_w_c.T @ state.last.velocity_mps / above_m
        return ReadoutMotion(rate_radps=_three(rate_c), speed_per_s=_three(speed_per_s))

    def _moved(self, matches: list[Row], *frames: int) -> list[Row]:
        """``matches``: normalised x and y in each of ``frames``, in this order."""
        if not matches or not any(frame in self._readouts for frame in frames):
            return matches
        columns = np.array(matches)
        for i, frame in enumerate(frames):
            readout, view = self._readouts.get(frame), slice(2 * i, 2 * i + 2)
            if readout is not None:
                xy = columns[:, view]
                row = self._lens.project(np.column_stack([xy, np.ones(len(xy))]))[:, 1]
                columns[:, view] = xy + readout.shift(xy, row)
        return [tuple(row) for row in columns.tolist()]  # type: ignore[misc]


def _three(vector: np.ndarray) -> Vec3:
    x, y, z = vector.tolist()
    return x, y, z
