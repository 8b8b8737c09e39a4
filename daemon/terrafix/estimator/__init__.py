"""Names that other components use."""

from terrafix.estimator.pose_estimator import (
    CovarianceDegradedWarning,
    MatchResult,
    OpenCVGtsamPoseEstimator,
    PnpFailureError,
    PoseEstimate,
    PoseEstimator,
    ThermalState,
)
from terrafix.messages import CovarianceMode

__all__ = [
    "CovarianceDegradedWarning",
    "CovarianceMode",
    "MatchResult",
    "OpenCVGtsamPoseEstimator",
    "PnpFailureError",
    "PoseEstimate",
    "PoseEstimator",
    "ThermalState",
]
