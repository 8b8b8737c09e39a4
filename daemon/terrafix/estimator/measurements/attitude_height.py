"""The camera in a body that turns: what an autopilot says of attitude and height, as the graph takes it."""

import gtsam
import numpy as np

from terrafix.core.camera import Mount
from terrafix.core.geodesy import rot_w_b, yaw_of
from terrafix.core.pose import exp_so3
from terrafix.estimator.factors.custom_factors import attitude_and_height_factor
from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.messages import Origin

UNKNOWN_RAD = 3.0  # sigma of a heading that nobody reports
# Roll and pitch that nobody reports: a copter in cruise leans by 10 to 20 degrees, a plane in a turn banks as much ...
UNKNOWN_ATTITUDE_RAD = np.radians(8.0)
# ... and for about so long in one direction: that it is level is said once in this time, however many frames it has.
LEAN_S = 5.0
DEFAULT_AGL_M = 120.0  # when nobody reports a height: the usual ceiling of small drones ...
DEFAULT_AGL_SIGMA_M = 50.0  # ... and wide enough for all of them


class MountedCamera:
    """``bias`` is B_k of custom_factors.py: tilt of the mount, heading, and what does not count here."""

    def __init__(self, origin: Origin) -> None:
        self._origin = origin
        self._r_b_c = Mount.of(origin.camera).r_b_c()
        self._tilt_said = False  # the autopilot reports roll and pitch

    def yaw_rad(self, r_w_c: np.ndarray) -> float:
        """Heading of the body, the mount taken as nominal."""
        return yaw_of(r_w_c @ self._r_b_c.T)

    def expected(self, attitude: Attitude, bias: np.ndarray, before: np.ndarray | None = None) -> np.ndarray:
        """R_w_c by the autopilot's attitude and the mount as it was learnt; heading as before when nobody says it."""
        r_w_b = rot_w_b(attitude.yaw_rad or 0.0, attitude.pitch_rad or 0.0, attitude.roll_rad or 0.0)
        if attitude.yaw_rad is None and before is not None:
            return before
        return exp_so3(np.array([0.0, 0.0, bias[2]])) @ r_w_b @ self._r_b_c @ exp_so3(np.array([bias[0], bias[1], 0.0]))

    def factor(
        self, keys: tuple[int, int], attitude: Attitude, r_w_c: np.ndarray, ground_m: float, since_s: float = np.inf
    ) -> gtsam.CustomFactor:
        """``keys`` of C and B; ``r_w_c``: the predicted camera, whose heading stands in for one that nobody reports;
        ``ground_m``: AMSL, below it; ``since_s``: since the last one."""
        origin = self._origin
        tilt = UNKNOWN_ATTITUDE_RAD * np.sqrt(max(LEAN_S / since_s, 1.0))
        self._tilt_said = attitude.pitch_rad is not None and attitude.roll_rad is not None
        if self._tilt_said:
            tilt = float(np.hypot(np.radians(max(origin.attitude_sigma_deg, 0.3)), attitude.righted_rad))
        yaw_rad, yaw_sigma = attitude.yaw_rad, np.radians(max(origin.yaw_sigma_deg, 1.0))
        if yaw_rad is None:
            yaw_rad, yaw_sigma = self.yaw_rad(r_w_c), UNKNOWN_RAD * 10
        height = DEFAULT_AGL_SIGMA_M * 20 if attitude.agl_m is None else max(origin.agl_sigma_m, 0.5)
        up = (origin.ground_amsl_m or 0.0) + (DEFAULT_AGL_M if attitude.agl_m is None else attitude.agl_m)
        r_w_b = rot_w_b(yaw_rad, attitude.pitch_rad or 0.0, attitude.roll_rad or 0.0)
        sigmas = np.array([tilt, tilt, yaw_sigma, height])
        return attitude_and_height_factor(*keys, sigmas, r_w_b, self._r_b_c, up, ground_m)

    @property
    def body_sigma_rad(self) -> float:
        """Of the body in the camera: an attitude that is off for long cannot be told from a mount that is."""
        said = self._tilt_said
        return float(np.radians(self._origin.attitude_sigma_deg if said else self._origin.camera.mount_tolerance_deg))

    def body(self, r_w_c: np.ndarray, bias: np.ndarray) -> np.ndarray:
        """R_w_b (3x3), with the mount as it was learnt."""
        r_b_c = self._r_b_c @ exp_so3(np.array([bias[0], bias[1], 0.0]))
        return np.asarray(r_w_c @ r_b_c.T)
