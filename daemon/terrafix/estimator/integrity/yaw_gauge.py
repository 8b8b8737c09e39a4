"""Gauge of an unobservable yaw: the heading while neither a compass nor a pose on the map gives it."""

import gtsam
import numpy as np

from terrafix.core.pose import world_to_tangent
from terrafix.estimator.measurements.attitude_height import UNKNOWN_RAD

GAUGE_SIGMA_RAD = np.radians(1.0)  # rad: 1-sigma of the prior that fixes the gauge [tuned]
# 1-sigma of the turn rate without observations: a copter at a mission's corner, a plane at 15 m/s that banks by 45
# degrees. It is in such turns that odometry is lost. [tuned]
UNOBSERVED_TURN_RADPS = np.radians(45.0)


class YawGauge:
    """A yaw that no measurement observes; odometry and the motion model are invariant to it.

    If the graph left it free, it would soon become overconfident of a wrong yaw, because it is linearised at another
    one each time. So the graph fixes the gauge, and the published covariance has it free: a rotation of the whole
    trajectory about ``pivot_m`` (2,), east and north, with 1-sigma ``sigma_rad``.

    ``fused``: odometry was fused since the gauge was freed."""

    def __init__(self, pivot_m: np.ndarray, sigma_rad: float = UNKNOWN_RAD, fused: bool = True) -> None:
        self._pivot_m = pivot_m.copy()
        self._sigma_rad = sigma_rad
        self.fused = fused

    def after_gap(self, dt_s: float, pivot_m: np.ndarray | None = None) -> "YawGauge":
        """After ``dt_s`` without odometry, in which the vehicle may have turned. ``pivot_m`` (2,): a new pivot."""
        sigma_rad = min(self._sigma_rad + UNOBSERVED_TURN_RADPS * dt_s, UNKNOWN_RAD)
        return YawGauge(self._pivot_m if pivot_m is None else pivot_m, sigma_rad, fused=False)

    def after_odometry(self) -> "YawGauge":
        """After a frame with fused odometry."""
        return YawGauge(self._pivot_m, self._sigma_rad)

    @property
    def sigma_share(self) -> float:
        """1-sigma of a displacement in the axes of the graph, along and across, as a share of its length."""
        return min(self._sigma_rad, 1.0)

    def gauge_fixed_cov(self, cov_world: np.ndarray) -> np.ndarray:
        """``cov_world`` (6, 6) of the camera pose (position first, world axes) with the gauge fixed: for the graph."""
        cov = cov_world.copy()
        cov[5, :] = cov[:, 5] = 0.0
        cov[5, 5] = GAUGE_SIGMA_RAD**2
        return cov

    def marginal_cov(
        self, pose: gtsam.Pose3, cov: np.ndarray, velocity_mps: np.ndarray, velocity_cov: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Covariances of pose (6, 6; tangent order) and velocity (3, 3) with the gauge free, from the graph's."""
        level = np.diag([1.0, 1.0, 0.0])
        turned = np.zeros((6, 6))
        turned[:3, :3] = self.sigma_share**2 * float(np.sum((pose.translation()[:2] - self._pivot_m) ** 2)) * level
        turned[5, 5] = self._sigma_rad**2
        cov = cov + world_to_tangent(turned, pose.rotation().matrix())
        return cov, velocity_cov + self.sigma_share**2 * float(velocity_mps[:2] @ velocity_mps[:2]) * level
