"""The camera on the body, and the factor of the attitude and height that an autopilot reports."""

import gtsam
import numpy as np

from terrafix.core.camera import Mount
from terrafix.core.geodesy import rot_w_b, yaw_of
from terrafix.core.pose import exp_so3
from terrafix.estimator.factors.attitude_height import attitude_height_factor
from terrafix.estimator.measurements.telemetry_buffer import UNKNOWN_ATTITUDE_RAD, Attitude
from terrafix.estimator.state import HEADING, MOUNT_TILT_X, MOUNT_TILT_Y
from terrafix.messages import Origin

UNKNOWN_RAD = 3.0  # 1-sigma of an unreported heading [tuned]
# A vehicle leans in one direction (UNKNOWN_ATTITUDE_RAD) for about this long: a level attitude that stands for an
# unreported one counts once in this time, at any frame rate.
LEAN_S = 5.0  # [tuned]
DEFAULT_AGL_M = 120.0  # of an unreported height: the usual ceiling of small drones ... [spec: EU and FAA ceiling]
DEFAULT_AGL_SIGMA_M = 50.0  # ... and wide enough for all of them [tuned]


class MountedCamera:
    """``bias`` is the calibration state B_k (state.py); mount tilt and heading of it count here."""

    def __init__(self, origin: Origin) -> None:
        self._origin = origin
        self._r_b_c = Mount.of(origin.camera).r_b_c()
        self._tilt_reported = False  # the autopilot reports roll and pitch
        self._r_p_b = np.eye(3)  # of the newest frame: from the vehicle to what the camera is fixed to

    def yaw_rad(self, r_w_c: np.ndarray) -> float:
        """Heading of what the camera is fixed to, the mount taken as nominal."""
        return yaw_of(r_w_c @ self._r_b_c.T)

    def expected(self, attitude: Attitude, bias: np.ndarray, before: np.ndarray | None = None) -> np.ndarray:
        """R_w_c (3, 3) by the reported attitude and the estimated mount; ``before`` without a reported heading."""
        r_w_b = rot_w_b(attitude.yaw_rad or 0.0, attitude.pitch_rad or 0.0, attitude.roll_rad or 0.0)
        if attitude.yaw_rad is None and before is not None:
            return before
        return (
            exp_so3(np.array([0.0, 0.0, bias[HEADING]]))
            @ r_w_b
            @ self._r_b_c
            @ exp_so3(np.array([bias[MOUNT_TILT_X], bias[MOUNT_TILT_Y], 0.0]))
        )

    def factor(
        self, keys: tuple[int, int], attitude: Attitude, r_w_c: np.ndarray, ground_m: float, since_s: float = np.inf
    ) -> gtsam.CustomFactor:
        """``keys`` of C and B; ``r_w_c`` (3, 3): of the predicted camera, whose heading replaces an unreported one;
        ``ground_m``: AMSL, below it; ``since_s``: since the factor before."""
        origin = self._origin
        tilt = UNKNOWN_ATTITUDE_RAD * np.sqrt(max(LEAN_S / since_s, 1.0))
        self._tilt_reported = attitude.pitch_rad is not None and attitude.roll_rad is not None
        if self._tilt_reported:
            tilt = float(np.hypot(np.radians(max(origin.attitude_sigma_deg, 0.3)), attitude.righted_rad))
        yaw_rad = attitude.yaw_rad
        yaw_sigma = float(np.hypot(np.radians(max(origin.yaw_sigma_deg, 1.0)), attitude.turned_rad))
        if yaw_rad is None:
            yaw_rad, yaw_sigma = self.yaw_rad(r_w_c), UNKNOWN_RAD * 10
        height = DEFAULT_AGL_SIGMA_M * 20 if attitude.agl_m is None else max(origin.agl_sigma_m, 0.5)
        up = (origin.ground_amsl_m or 0.0) + (DEFAULT_AGL_M if attitude.agl_m is None else attitude.agl_m)
        r_w_b = rot_w_b(yaw_rad, attitude.pitch_rad or 0.0, attitude.roll_rad or 0.0)
        body, self._r_p_b = attitude.of_vehicle, np.eye(3)
        if (
            body is not attitude
            and body.yaw_rad is not None
            and body.pitch_rad is not None
            and body.roll_rad is not None
        ):
            self._r_p_b = r_w_b.T @ rot_w_b(body.yaw_rad, body.pitch_rad, body.roll_rad)
        sigmas = np.array([tilt, tilt, yaw_sigma, height])
        return attitude_height_factor(*keys, sigmas, r_w_b, self._r_b_c, up, ground_m)

    @property
    def body_sigma_rad(self) -> float:
        """1-sigma of the body in the camera: a constant attitude error cannot be distinguished from one of the
        mount."""
        return body_sigma_rad(self._origin, tilt_reported=self._tilt_reported)

    def body(self, r_w_c: np.ndarray, bias: np.ndarray) -> np.ndarray:
        """R_w_b (3, 3) of the newest frame, with the estimated mount."""
        r_b_c = self._r_b_c @ exp_so3(np.array([bias[MOUNT_TILT_X], bias[MOUNT_TILT_Y], 0.0]))
        return np.asarray(r_w_c @ r_b_c.T @ self._r_p_b)


def body_sigma_rad(origin: Origin, *, tilt_reported: bool) -> float:
    """1-sigma of the tilt of the body in the camera. ``tilt_reported``: the autopilot reports roll and pitch."""
    return float(np.radians(origin.attitude_sigma_deg if tilt_reported else origin.camera.mount_tolerance_deg))
