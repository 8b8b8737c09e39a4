"""A keyframe above the ground, which later frames see again."""

from dataclasses import dataclass

import gtsam
import numpy as np

from terrafix.estimator.state import UP


@dataclass(frozen=True, slots=True)
class KeyframeView:
    """A keyframe above the ground: ``pose`` with covariance ``cov`` (6, 6), tangent order; ``ground_m``: AMSL elevation
    below it."""

    pose: gtsam.Pose3
    cov: np.ndarray
    ground_m: float

    @property
    def height_m(self) -> float:
        return float(self.pose.translation()[UP]) - self.ground_m
