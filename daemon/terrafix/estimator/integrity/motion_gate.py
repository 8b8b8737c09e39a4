"""Innovation gate of odometry: the motion between two frames against velocity, inertial readings and time."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from terrafix.core.gate import GATE
from terrafix.estimator.integrity.innovation import Innovation

# Squared Mahalanobis distance. A true motion is rejected once in a million frames.
GATE_D2 = 30.66  # [spec: chi-square, 3 degrees of freedom, 1 - 1e-6]
# Acceleration that the process noise of the motion model does not cover, without and with inertial readings [m/s^2].
# Without: the hardest manoeuvre of a small vehicle, 4 g (survey multirotors reach 1 g, aerobatic ones 5 g for tenths
# of a second). With: an attitude of the autopilot with a tilt error of 30 degrees. [tuned]
MAX_MANOEUVRE_MPS2, MAX_MANOEUVRE_WITH_IMU_MPS2 = 40.0, 5.0


@dataclass(frozen=True)
class MotionInnovation:
    """``residual_m`` (3,): camera position by odometry less the predicted one, world axes, with covariance ``cov_m2``
    (3, 3). ``dt_s``: duration of the prediction. ``inertial``: the prediction used inertial readings."""

    residual_m: np.ndarray
    cov_m2: np.ndarray
    dt_s: float
    inertial: bool

    @cached_property
    def gated(self) -> Innovation:
        """The part of the residual that no manoeuvre explains."""
        return Innovation(self._unexplained_m(self._manoeuvre_m), self.cov_m2, GATE_D2)

    @property
    def with_manoeuvre(self) -> Innovation:
        """The whole residual, whose covariance has the hardest manoeuvre in it: for comparing hypotheses."""
        return Innovation(self.residual_m, self.cov_m2 + self._manoeuvre_m**2 * np.eye(3), GATE_D2)

    @property
    def horizontal(self) -> Innovation:
        """(2,) of ``with_manoeuvre``, east and north."""
        whole = self.with_manoeuvre
        return Innovation(whole.residual[:2], whole.covariance[:2, :2], GATE[2])

    @property
    def _manoeuvre_m(self) -> float:
        """Displacement by the hardest manoeuvre."""
        return 0.5 * (MAX_MANOEUVRE_WITH_IMU_MPS2 if self.inertial else MAX_MANOEUVRE_MPS2) * self.dt_s**2

    @property
    def allows_standstill(self) -> bool:
        """For odometry that shows no motion at all. No manoeuvre is allowed for: none ends in a standstill from one
        frame to the next."""
        return Innovation(self._unexplained_m(0.0), self.cov_m2, GATE[3]).is_accepted

    def _unexplained_m(self, manoeuvre_m: float) -> np.ndarray:
        """(3,): the part of the residual beyond ``manoeuvre_m``."""
        scale = max(0.0, 1.0 - manoeuvre_m / max(float(np.linalg.norm(self.residual_m)), 1e-9))
        return self.residual_m * scale
