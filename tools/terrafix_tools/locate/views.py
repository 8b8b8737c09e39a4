"""Cameras of the frames of a flight record, and what each frame says of the ground below it."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import UnsetType

from terrafix.core.camera import CameraCalibration, Mount, camera_rotation
from terrafix.core.errors import SourceError, UsageError
from terrafix.core.geodesy import LocalFrame, rot_from_quat
from terrafix.core.pose import exp_so3
from terrafix.estimator.filter_state import focal_scale
from terrafix.estimator.measurements.attitude_height import body_sigma_rad
from terrafix.estimator.measurements.principal_point import PrincipalPointFilter
from terrafix.estimator.state import (
    HORIZONTAL,
    LOG_HEIGHT_SCALE,
    MOUNT_TILT,
    RADIAL_K1,
    UP,
    WORLD_TILT,
)
from terrafix.messages import (
    CalibrationEstimate,
    Camera,
    Frame,
    GroundPlane,
    MapMatch,
    NavEstimate,
    Odometry,
    Origin,
    RefinedPose,
    Refinement,
    VehicleState,
)
from terrafix.recorder.reader import ReadResult, check_format, read_flight
from terrafix_tools.before_after import FINALISED
from terrafix_tools.finalised import SUMMARY, read_flights, read_poses


@dataclass(frozen=True)
class CameraView:
    """The camera of a frame, in the local frame of the flight (ENU, metres; up is AMSL).

    ``cov`` (6, 6): position, then rotation about the world axes. ``ground_m``: AMSL elevation below the camera by the
    estimator. ``ground``: plane of the elevation model there, of the map match of the frame; None: there is none.
    Rays of ``calibration`` and the pose belong together: the estimated lens is in the former, and the height is that in
    which these rays meet the map."""

    frame_id: int
    file: str
    t_ns: int
    p_c_in_w_m: np.ndarray  # (3,)
    r_w_c: np.ndarray  # (3, 3)
    cov: np.ndarray
    calibration: CameraCalibration
    ground_m: float
    fragment_id: int
    ground: GroundPlane | None = None

    @property
    def height_m(self) -> float:
        return float(self.p_c_in_w_m[UP]) - self.ground_m


@dataclass(frozen=True)
class FlightViews:
    """``triples``: odometry messages with points that three keyframes see, in order of time."""

    origin: Origin
    frame: LocalFrame
    views: dict[int, CameraView]
    triples: list[Odometry]
    frames: dict[int, Frame]
    header: dict[str, Any]  # of the record

    def view(self, name: str) -> CameraView:
        """The camera of a frame that is given by its number or its file. Raises UsageError, SourceError."""
        by_file = {frame.file: frame_id for frame_id, frame in self.frames.items() if frame.file}
        frame_id = by_file.get(name, int(name) if name.isdecimal() else -1)
        if frame_id not in self.frames:
            first, last = min(self.frames), max(self.frames)
            raise UsageError(f"--frame {name}: the flight has no such frame; give a file name, or {first} to {last}")
        if frame_id not in self.views:
            raise SourceError(f"frame {name} has no position in this record; choose a later one")
        return self.views[frame_id]


def read_views(record: Path) -> FlightViews:
    """At the finalised pose of each frame, where there is one beside the record; else at the newest refined one; else
    at its last estimate. Raises SourceError, EvaluationError."""
    result = ReadResult()
    origin: Origin | None = None
    frames: dict[int, Frame] = {}
    estimates: dict[int, NavEstimate] = {}
    tilt_reported = False
    grounds: dict[int, GroundPlane] = {}
    calibrations: list[CalibrationEstimate] = []
    triples: list[Odometry] = []
    refined: dict[int, RefinedPose] = {}
    for _, _, message in read_flight(record, result):
        if isinstance(message, Origin):
            origin = message
        elif isinstance(message, Frame):
            frames[message.frame_id] = message
        elif isinstance(message, NavEstimate):
            estimates[message.frame_id] = message  # the last one of a frame has its map match
        elif isinstance(message, VehicleState):
            tilt_reported |= message.pitch_rad is not None and message.roll_rad is not None
        elif isinstance(message, MapMatch) and message.ground is not None:
            grounds[message.frame_id] = message.ground
        elif isinstance(message, CalibrationEstimate):
            calibrations.append(message)
        elif isinstance(message, Odometry) and message.three_view:
            triples.append(message)
        elif isinstance(message, Refinement):
            refined |= {
                pose.frame_id: pose for pose in message.poses if pose.q_w_c is not None and pose.cov is not None
            }
    check_format(record, result)
    if origin is None or not estimates:
        raise SourceError(f"{record}: the record has no position; was a flight recorded?")
    frame = LocalFrame(origin.lat_deg, origin.lon_deg)
    cameras = _Cameras(origin, frame, calibrations, body_sigma_rad(origin, tilt_reported=tilt_reported))
    views = {
        frame_id: replace(cameras.view(estimate), file=frames[frame_id].file, ground=grounds.get(frame_id))
        for frame_id, estimate in estimates.items()
        if frame_id in frames
    }
    for frame_id in views.keys() & refined.keys():
        views[frame_id] = cameras.at(views[frame_id], refined[frame_id])
    folder = record if record.is_dir() else record.parent
    by_time = {round(view.t_ns * 1e-9, 3): frame_id for frame_id, view in views.items()}
    lens = SolvedLens.of(read_flights(folder / SUMMARY), origin.camera)
    for row in read_poses(folder):
        if (finalised := by_time.get(round(row.t_s, 3))) is not None:
            before, view = views[finalised], cameras.at(views[finalised], row.pose(finalised))
            if lens is not None:
                view = replace(view, calibration=lens.on(view.calibration))
            elif finalised in refined:  # height and rays by the described lens, which have its error alike
                view = replace(view, cov=before.cov)
            views[finalised] = view
    return FlightViews(origin, frame, views, triples, frames, result.header)


@dataclass(frozen=True)
class SolvedLens:
    """Of a batch solution: focal length over the described one, and radial coefficient."""

    focal_ratio: float
    radial_k1: float

    @classmethod
    def of(cls, flights: list[dict[str, Any]], camera: Camera) -> "SolvedLens | None":
        """``flights``: of finalised.json. None: no batch solution was kept, and heights are as seen through the
        described lens."""
        if len(flights) != 1 or flights[0].get("solution") != FINALISED or not flights[0]["before_after"]:
            return None
        after = {row["what"]: row["after"] for row in flights[0]["before_after"]}
        return cls(after["focal length"] / camera.fx, after["radial coefficient"])

    def on(self, calibration: CameraCalibration) -> CameraCalibration:
        fx, fy = self.focal_ratio * calibration.fx, self.focal_ratio * calibration.fy
        return replace(calibration, fx=fx, fy=fy, radial_k1=self.radial_k1)


class _Cameras:
    """Cameras from estimates of the body, by the calibration that was estimated nearest in time."""

    def __init__(
        self, origin: Origin, frame: LocalFrame, calibrations: list[CalibrationEstimate], sigma_rad: float
    ) -> None:
        """``sigma_rad``: 1-sigma of the tilt of the body in the camera, which the estimates contain."""
        self._body_sigma_rad = sigma_rad
        self._camera = origin.camera
        self._frame = frame
        self._calibrations = calibrations
        self._times_ns = np.array([calibration.t_ns for calibration in calibrations], np.int64)

    def view(self, estimate: NavEstimate) -> CameraView:
        """Camera of the body in ``estimate``, without file and ground plane."""
        mount, cov = Mount.of(self._camera), np.array(estimate.cov).reshape(6, 6)
        calibration = CameraCalibration.of(self._camera)
        r_w_c = camera_rotation(estimate, self._camera)
        shift_m, height_m = np.zeros(2), estimate.agl_m
        learnt = self._nearest(estimate.t_ns)
        if learnt is None:
            cov[WORLD_TILT, WORLD_TILT] += np.radians(mount.tolerance_deg) ** 2 * np.eye(2)
        else:
            # The camera is known better than the body in it, and the estimate has the covariance of the body.
            cov[WORLD_TILT, WORLD_TILT] -= self._body_sigma_rad**2 * np.eye(2)
            if isinstance(estimate.q_w_c, UnsetType):  # else it has the tilt
                r_w_c = r_w_c @ exp_so3(np.append(learnt.state[MOUNT_TILT], 0.0))
            calibration = replace(calibration, radial_k1=learnt.state[RADIAL_K1])
            height_m /= focal_scale(self._camera, learnt.state[LOG_HEIGHT_SCALE])
            # The published position has the estimated principal point in it. The same offset turns the rays the other
            # way, so that the camera of the graph and rays of the described lens give the same point.
            lens = PrincipalPointFilter(self._camera, learnt.lens)
            shift_m, shift_cov_m2 = lens.shift(height_m * r_w_c[HORIZONTAL, HORIZONTAL])
            cov[HORIZONTAL, HORIZONTAL] -= shift_cov_m2
        e_m, n_m = self._frame.to_local(estimate.lat_deg, estimate.lon_deg)
        ground_m = estimate.alt_amsl_m - estimate.agl_m
        return CameraView(
            frame_id=estimate.frame_id,
            file="",
            t_ns=estimate.t_ns,
            p_c_in_w_m=np.array([*(np.array([e_m, n_m]) - shift_m), ground_m + height_m]),
            r_w_c=r_w_c,
            cov=cov,
            calibration=calibration,
            ground_m=ground_m,
            fragment_id=estimate.fragment_id,
        )

    def at(self, view: CameraView, pose: RefinedPose) -> CameraView:
        """``view`` at its refined ``pose``, which has an orientation and a covariance."""
        assert pose.q_w_c is not None and pose.cov is not None
        r_w_c, learnt, shift_m = rot_from_quat(pose.q_w_c), self._nearest(view.t_ns), np.zeros(2)
        if learnt is not None:
            lens = PrincipalPointFilter(self._camera, learnt.lens)
            shift_m, _ = lens.shift(view.height_m * r_w_c[HORIZONTAL, HORIZONTAL])
        e_m, n_m = np.array(self._frame.to_local(pose.lat_deg, pose.lon_deg)) - shift_m
        up_m = view.p_c_in_w_m[UP] if pose.alt_amsl_m is None else pose.alt_amsl_m
        return replace(view, p_c_in_w_m=np.array([e_m, n_m, up_m]), r_w_c=r_w_c, cov=np.reshape(pose.cov, (6, 6)))

    def _nearest(self, t_ns: int) -> CalibrationEstimate | None:
        if not self._calibrations:
            return None
        return self._calibrations[int(np.argmin(np.abs(self._times_ns - t_ns)))]
