"""The pose of a frame by an older keyframe that sees the same ground, as a measurement (loop closure)."""

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C

from terrafix.core.gate import GATE
from terrafix.core.pose import tangent_to_world
from terrafix.estimator.filter_state import FilterState
from terrafix.estimator.integrity.innovation import Innovation
from terrafix.estimator.keyframe_view import KeyframeView
from terrafix.estimator.measurements.ground_plane_motion import plane_motion
from terrafix.estimator.models.plane_motion import RelativePose
from terrafix.estimator.state import HORIZONTAL, ROTATION
from terrafix.messages import Relocalization, Verdict

# Variance of the keyframe's pose over that of the estimate, below which a component is corrected. The measurement that
# stands for safe fusion has the residual over one less this ratio, so that it extrapolates near 1, where there is
# nothing to gain. [spec: a tenth of the variance]
GAINED = 0.9
NO_INFORMATION_M2 = 1e8  # variance of the other components [spec: far beyond any state]


@dataclass(frozen=True)
class RelocalizationMeasurement:
    """``pose`` of the camera with covariance ``cov`` (6, 6), tangent order: that of the keyframe moved on by what both
    cameras see, plus that of this motion.

    It corrects the horizontal position alone, which nothing else bounds without a map; height and attitude are
    reported, and the heading follows by its correlation with the position. Keyframe and estimate descend from each
    other, so that their errors are correlated, and by how much is not known. So they are fused as safe fusion does
    (Gustafsson, "Statistical Sensor Fusion", 2010): in the axes in which both covariances are diagonal, each component
    comes from the one that knows it better, and from it alone. The result claims no component better than its source
    did."""

    pose: gtsam.Pose3
    cov: np.ndarray
    motion: RelativePose  # since the keyframe
    name: str = "relocalization"

    @classmethod
    def of(
        cls, seen: Relocalization, keyframe: KeyframeView, state: FilterState, node: int
    ) -> "RelocalizationMeasurement | Verdict":
        """The pose of ``node``, the frame of ``seen``; or why there is none."""
        r_w_c = state.graph.state(node).pose.rotation().matrix()
        tilt_sigma = float(np.sqrt(np.max(np.diag(state.covariance(node)[ROTATION, ROTATION])[:2])))
        # Cameras whose views overlap are at most about a height apart.
        motion = plane_motion(state, keyframe, seen, (r_w_c, tilt_sigma), keyframe.height_m)
        if isinstance(motion, Verdict):
            return motion
        moved = motion.between.inverse().AdjointMap()
        return cls(keyframe.pose.compose(motion.between), moved @ keyframe.cov @ moved.T + motion.cov, motion)

    def innovation(self, state: FilterState, node: int) -> Innovation:
        """Innovation of the pose, 6 degrees of freedom, tangent order. Its covariance is the largest that both errors
        can have unless they oppose each other."""
        residual = state.graph.state(node).pose.logmap(self.pose)
        return Innovation(residual, state.covariance(node) + self.cov, GATE[6])

    def correction(self, state: FilterState, node: int) -> tuple[np.ndarray, np.ndarray]:
        """Position (3,) and covariance (3, 3), world axes, of an independent measurement of ``node`` after which each
        horizontal component has the value and the variance of the better source."""
        estimate = state.graph.state(node).pose
        ours_m2, theirs_m2 = (
            tangent_to_world(cov, pose.rotation().matrix())[HORIZONTAL, HORIZONTAL]
            for pose, cov in ((estimate, state.covariance(node)), (self.pose, self.cov))
        )
        p_m, cov_m2 = np.array(estimate.translation()), NO_INFORMATION_M2 * np.eye(3)
        value_m, cov_m2[HORIZONTAL, HORIZONTAL] = safe_fusion_measurement(
            (self.pose.translation() - p_m)[HORIZONTAL], ours_m2, theirs_m2
        )
        p_m[HORIZONTAL] += value_m
        return p_m, cov_m2

    def add_to(self, state: FilterState, node: int) -> None:
        p_m, cov_m2 = self.correction(state, node)
        state.add_factors(node, gtsam.GPSFactor(C(node), p_m, gtsam.noiseModel.Gaussian.Covariance(cov_m2)))


def safe_fusion_measurement(
    residual: np.ndarray, ours: np.ndarray, theirs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """``residual`` (n,): their value less ours, with covariances ``ours`` and ``theirs`` (n, n), whose correlation is
    not known. -> residual (n,) and covariance (n, n) of the independent measurement that, fused with ours, gives safe
    fusion: in the common axes of both, their value and variance where that is less than GAINED of ours, else ours."""
    root = np.linalg.cholesky(ours)
    whitened = np.linalg.solve(root, np.linalg.solve(root, theirs).T)
    variances, axes = np.linalg.eigh(0.5 * (whitened + whitened.T))
    axes = root @ axes
    gains = variances < GAINED
    rest = np.where(gains, 1.0 - variances, 1.0)
    value = np.where(gains, np.linalg.solve(axes, residual) / rest, 0.0)
    spread = axes * np.sqrt(np.where(gains, variances / rest, NO_INFORMATION_M2))
    return axes @ value, spread @ spread.T
