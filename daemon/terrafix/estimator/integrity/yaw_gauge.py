"""A heading that nobody says, until a pose on the map tells it."""

import gtsam
import numpy as np

from terrafix.core.pose import world_to_tangent
from terrafix.estimator.measurements.attitude_height import UNKNOWN_RAD

CHOSEN_RAD = np.radians(1.0)  # 1-sigma of a heading that is chosen, in axes of its own
# 1-sigma of how fast a vehicle turns when nobody sees it: a copter at the corner of a mission, a plane at 15 m/s that
# banks by 45 degrees. It is then that odometry breaks.
TURN_RADPS = np.radians(45.0)


class YawGauge:
    """A heading that nobody says is a choice of axes, not something to be estimated: no pair and no leg tells it. A
    graph that leaves it open is soon sure of a wrong one, because it is linearised at another one each time. So it is
    chosen there, and what is said has it open: all may turn about a place (2,), east and north, by ``sigma_rad``.

    ``dark``: nothing was seen since it opened."""

    def __init__(self, about_m: np.ndarray, sigma_rad: float = UNKNOWN_RAD, dark: bool = False) -> None:
        self._about_m = about_m.copy()
        self._sigma_rad = sigma_rad
        self.dark = dark

    def after_unseen(self, dt_s: float, about_m: np.ndarray | None = None) -> "YawGauge":
        """It may have turned on, where nobody saw; ``about_m``: from there on all may turn about that place."""
        sigma_rad = min(self._sigma_rad + TURN_RADPS * dt_s, UNKNOWN_RAD)
        return YawGauge(self._about_m if about_m is None else about_m, sigma_rad, dark=True)

    @property
    def share(self) -> float:
        """1-sigma, across and along, of what is flown in these axes, as a share of it."""
        return min(self._sigma_rad, 1.0)

    def chosen(self, cov_world: np.ndarray) -> np.ndarray:
        """``cov_world`` (6, 6) of the camera's pose, position first, in the axes that were chosen."""
        cov = cov_world.copy()
        cov[5, :] = cov[:, 5] = 0.0
        cov[5, 5] = CHOSEN_RAD**2
        return cov

    def opened(
        self, pose: gtsam.Pose3, cov: np.ndarray, velocity_mps: np.ndarray, velocity_cov: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """What is known of a pose and its velocity in no axes: covariances (6, 6), tangent order, and (3, 3)."""
        level = np.diag([1.0, 1.0, 0.0])
        turned = np.zeros((6, 6))
        turned[:3, :3] = self.share**2 * float(np.sum((pose.translation()[:2] - self._about_m) ** 2)) * level
        turned[5, 5] = self._sigma_rad**2
        cov = cov + world_to_tangent(turned, pose.rotation().matrix())
        return cov, velocity_cov + self.share**2 * float(velocity_mps[:2] @ velocity_mps[:2]) * level
