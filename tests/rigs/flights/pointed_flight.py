"""Record of a flight with exact poses over ground with a house, and points of it that three keyframes see."""

import math
from pathlib import Path

import numpy as np

from flight_records import ORIGIN, PERIOD_NS, write_record
from terrafix import messages as m
from terrafix.core.camera import CameraCalibration, Mount
from terrafix.core.geodesy import quat_from_rot, rot_w_b
from terrafix_lab.sim.true_messages import estimate as true_estimate
from terrafix_tools.locate.views import CameraView

CAMERA = m.Camera(width=800, height=600, fx=500.0, fy=500.0, cx=399.5, cy=299.5, focal_sigma=0.01)
START_AMSL_M = 500.0
AGL_M = 100.0
STEP_M = 20.0  # between frames, towards east
HOUSE_E_M, HOUSE_HALF_M, HOUSE_M = 60.0, 15.0, 12.0  # centre (on the track), half side, height
YAW_RAD = math.radians(90.0)
SIGMA_M, TILT_SIGMA_RAD = 1.0, math.radians(0.5)


def origin(ground_amsl_m: float | None = START_AMSL_M) -> m.Origin:
    return m.Origin(
        t_ns=0,
        camera=CAMERA,
        lat_deg=48.0,
        lon_deg=11.0,
        ground_amsl_m=ground_amsl_m,
        start_sigma_m=10.0,
        yaw_sigma_deg=3.0,
        agl_sigma_m=3.0,
        attitude_sigma_deg=0.3,
    )


def ground_m(e_m: np.ndarray, n_m: np.ndarray) -> np.ndarray:
    """AMSL height of the ground with the house."""
    house = (np.abs(e_m - HOUSE_E_M) < HOUSE_HALF_M) & (np.abs(n_m) < HOUSE_HALF_M)
    return START_AMSL_M + HOUSE_M * house


def r_w_c() -> np.ndarray:
    return rot_w_b(YAW_RAD, 0.0, 0.0) @ Mount.of(CAMERA).r_b_c()


def camera_m(i: int) -> np.ndarray:
    return np.array([STEP_M * i, 0.0, START_AMSL_M + AGL_M])


def view(i: int, cov: np.ndarray) -> CameraView:
    """Camera of frame ``i`` with ``cov`` (6, 6)."""
    return CameraView(i, "", 0, camera_m(i), r_w_c(), cov, CameraCalibration.of(CAMERA), START_AMSL_M, fragment_id=0)


def normalised(i: int, points_m: np.ndarray) -> np.ndarray:
    """Points (N, 3) -> normalised image coordinates (N, 2) in frame ``i``."""
    in_c = (points_m - camera_m(i)) @ r_w_c()
    return in_c[:, :2] / in_c[:, 2:]


def pixel(i: int, point_m: np.ndarray) -> tuple[float, float]:
    x, y = normalised(i, point_m[None])[0]
    return CAMERA.fx * x + CAMERA.cx, CAMERA.fy * y + CAMERA.cy


def estimate(i: int, fragment_id: int = 0) -> m.NavEstimate:
    lat_deg, lon_deg = ORIGIN.to_wgs84(*camera_m(i)[:2].tolist())
    return true_estimate(
        i * PERIOD_NS,
        lat_deg,
        lon_deg,
        sigmas=(SIGMA_M, SIGMA_M, TILT_SIGMA_RAD),
        frame_id=i,
        alt_amsl_m=START_AMSL_M + AGL_M,
        agl_m=AGL_M,
        velocity_enu_mps=(40.0, 0.0, 0.0),
        velocity_sigma_mps=1.0,
        q_w_b=quat_from_rot(rot_w_b(YAW_RAD, 0.0, 0.0)),
        fragment_id=fragment_id,
    )


def calibration(i: int, state: tuple[float, ...] = (0.0,) * 6) -> m.CalibrationEstimate:
    assert len(state) == 6
    cov = tuple((1e-6 * np.eye(6)).ravel().tolist())
    return m.CalibrationEstimate(t_ns=i * PERIOD_NS, frame_id=i, state=state, cov=cov)


def attitude() -> m.VehicleState:
    return m.VehicleState(t_ns=0, source="mavlink", yaw_rad=YAW_RAD, pitch_rad=0.0, roll_rad=0.0)


def messages(frames: int = 7, fragment_id: int = 0) -> list[m.Message]:
    """Every frame is a keyframe."""
    grid = np.arange(-200.0, 320.0, 4.0)
    e_m, n_m = (axis.ravel() for axis in np.meshgrid(grid, grid))
    ground = np.column_stack([e_m, n_m, ground_m(e_m, n_m)])
    sent: list[m.Message] = [origin(), attitude()]
    for i in range(frames):
        views = [normalised(k, ground) for k in (i - 2, i - 1, i)]
        seen = np.all([np.abs(xy) < (0.8, 0.6) for xy in views], axis=(0, 2))
        triples = np.hstack([xy[seen] for xy in views])
        sent.append(m.Frame(t_ns=i * PERIOD_NS, frame_id=i, file=f"{i:04d}.jpg", width=800, height=600))
        sent.append(
            m.Odometry(
                t_ns=i * PERIOD_NS,
                frame_id=i,
                keyframe_id=max(i - 1, 0),
                verdict=m.Verdict.ACCEPTED,
                becomes_keyframe=True,
                previous_keyframe_id=i - 2,
                three_view=[tuple(row) for row in triples.tolist()] if i >= 2 else [],
                three_view_sigma_norm=5e-4,
                fragment_id=fragment_id,
            )
        )
        sent += [estimate(i, fragment_id), calibration(i)]
    return sent


def write_flight(path: Path) -> Path:
    write_record(path, messages())
    return path
