"""The estimator as a function call: a match goes in, a pose comes out. For callers without messages (ON-1).

It drives the node that flies, with the same graph, gates and verdicts. Where the node publishes a rejection, a call
raises."""

import warnings
from dataclasses import dataclass

import numpy as np

from terrafix.core.camera import CameraCalibration
from terrafix.estimator.node import EstimatorNode
from terrafix.messages import (
    CovarianceMode,
    Health,
    MapMatch,
    MeasurementVerdict,
    NavEstimate,
    SourceLabel,
    Verdict,
)

MatchResult = MapMatch  # 2D-3D matches of a frame, and the camera pose that PnP made of them
ThermalState = Health


class PnpFailureError(Exception):
    """This match gave no pose: PnP failed, its geometry is degenerate, or the gate rejected it (``verdict``). The
    estimator continues with odometry."""

    def __init__(self, verdict: Verdict, detail: str) -> None:
        super().__init__(f"{verdict.value}: {detail}" if detail else verdict.value)
        self.verdict = verdict


class CovarianceDegradedWarning(UserWarning):
    """Thermal throttle: the covariance is propagated from frame to frame, not the marginal of the graph."""


@dataclass(frozen=True)
class PoseEstimate:
    frame_id: int
    position_wgs84: tuple[float, float, float]  # latitude, longitude [deg], height above mean sea level [m]
    orientation_world_T_body: tuple[float, float, float, float]
    covariance_6x6: np.ndarray  # (6, 6) position, then orientation; axes east, north, up; m^2 and rad^2
    covariance_mode: CovarianceMode
    source_label: SourceLabel
    last_satellite_anchor_age_ms: int
    emitted_at: int  # monotonic, ns


class PoseEstimator:
    """``node`` has received the Origin and receives the odometry of each frame; this adds matches to its graph."""

    def __init__(self, node: EstimatorNode) -> None:
        self._node = node

    def current_covariance_mode(self) -> CovarianceMode:
        return self._node.mode

    def estimate(self, match: MatchResult, camera: CameraCalibration, thermal: ThermalState) -> PoseEstimate:
        """The newest pose, with ``match`` in the graph. ``thermal`` decides the covariance mode.

        ``camera`` must be that of the Origin (ValueError). Raises PnpFailureError; warns with
        CovarianceDegradedWarning."""
        origin = self._node.origin
        if origin is None or camera != CameraCalibration.of(origin.camera):
            raise ValueError("the camera is not the one that Origin named")
        answers = [*self._node.on(thermal), *self._node.on(match)]
        verdict = next(a for a in answers if isinstance(a, MeasurementVerdict))
        estimate = next((a for a in answers if isinstance(a, NavEstimate)), None)
        if verdict.verdict is not Verdict.ACCEPTED or estimate is None:
            raise PnpFailureError(verdict.verdict, verdict.detail)
        if estimate.covariance_mode is CovarianceMode.JACOBIAN:
            warnings.warn(f"propagated covariance: {thermal.cause}", CovarianceDegradedWarning, stacklevel=2)
        return PoseEstimate(
            frame_id=estimate.frame_id,
            position_wgs84=(estimate.lat_deg, estimate.lon_deg, estimate.alt_amsl_m),
            orientation_world_T_body=estimate.q_w_b,
            covariance_6x6=np.array(estimate.cov).reshape(6, 6),
            covariance_mode=estimate.covariance_mode,
            source_label=estimate.source_label,
            last_satellite_anchor_age_ms=estimate.last_anchor_age_ms,
            emitted_at=estimate.emitted_at_ns,
        )
