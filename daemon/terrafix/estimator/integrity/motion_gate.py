"""Innovation gate of odometry: the motion between two frames against velocity, inertial readings and time."""

from dataclasses import dataclass

import numpy as np

from terrafix.core.gate import GATE

GATE_D2 = 30.66  # chi-square, 3 degrees of freedom: a true motion is refused once in a million frames
# What the process noise of the motion model leaves out, as an acceleration. Without inertial readings: no small vehicle
# changes its velocity faster (4 g; survey multirotors reach 1 g, aerobatic ones 5 g for tenths of a second). With
# them: a tilt of the autopilot that is wrong by 30 degrees.
UNMEASURED_MPS2, UNMEASURED_BY_IMU_MPS2 = 40.0, 5.0


@dataclass(frozen=True)
class MotionInnovation:
    """``off_m`` (3,): where odometry has the camera, less where velocity leads, world axes. ``cov_m2`` (3, 3) of it.
    ``dt_s``: over which velocity led there. ``inertial``: by inertial readings."""

    off_m: np.ndarray
    cov_m2: np.ndarray
    dt_s: float
    inertial: bool

    @property
    def is_possible(self) -> bool:
        return self.d2(UNMEASURED_BY_IMU_MPS2 if self.inertial else UNMEASURED_MPS2) <= GATE_D2

    @property
    def may_stand(self) -> bool:
        """Of odometry that shows no motion at all: no manoeuvre ends so from one frame to the next."""
        return self.d2(0.0) <= GATE[3]

    def d2(self, manoeuvre_mps2: float) -> float:
        """Squared Mahalanobis distance, 3 degrees of freedom, beyond what such a manoeuvre explains."""
        manoeuvre_m = 0.5 * manoeuvre_mps2 * self.dt_s**2
        beyond_m = self.off_m * max(0.0, 1.0 - manoeuvre_m / max(float(np.linalg.norm(self.off_m)), 1e-9))
        return float(beyond_m @ np.linalg.solve(self.cov_m2, beyond_m))
