"""PoseEstimator: a map match becomes a camera pose, a factor of the estimator's graph, and an estimate (ON-1)."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import msgspec
import numpy as np

from terrafix.core.camera import CameraCalibration
from terrafix.core.geodesy import LocalFrame, quat_from_rot, rot_from_quat
from terrafix.core.pnp import INLIER_THRESHOLD, PNP_MIN_INLIERS, SEARCH_RADIUS, method_of, solved
from terrafix.core.pose import project_with_jacobian
from terrafix.estimator.claim import Claim, claim
from terrafix.estimator.estimator import Estimator
from terrafix.estimator.filter_state import FilterState, FrameState
from terrafix.estimator.integrity.time_offset import TimeOffset
from terrafix.estimator.map_update import MapResult
from terrafix.estimator.measurements.telemetry_buffer import Telemetry
from terrafix.estimator.monitors.calibration_monitors import Monitors
from terrafix.estimator.output import estimate_of
from terrafix.messages import (
    CovarianceMode,
    Health,
    MapMatch,
    PnpInput,
    PoseSolution,
    SourceLabel,
    ThermalBand,
    Verdict,
)

MIN_AGL_M = 1.0  # of the predicted height, so that it stays positive [spec: as in map_update._height_m]

MatchResult = MapMatch  # 2D-3D matches of a frame, or the camera pose that the matcher has computed
ThermalState = Health


@dataclass(frozen=True)
class MatchOutcome:
    """What was done with a match: the pose that was computed, and the result of the gate and the graph."""

    solution: PoseSolution
    result: MapResult


@dataclass
class EstimatedFlight:
    """The estimator of a flight and what its estimates are published with. ``axes``: of its local frame;
    ``time_offset``: of the camera; ``monitors``: of the calibration, against ``telemetry``."""

    estimator: Estimator
    axes: LocalFrame
    time_offset: TimeOffset
    monitors: Monitors
    telemetry: Telemetry

    def claim(self, frame: FrameState) -> Claim:
        monitors = self.monitors
        return claim(self.estimator, frame, self.time_offset.sigma_s, monitors.sigma_m, monitors.path_error_m)

    def fuse(self, match: MatchResult, mode: CovarianceMode) -> MatchOutcome:
        """Solves ``match``, gates its pose and adds it to the graph. A rejected match is a verdict in the result."""
        state, camera = self.estimator.state, CameraCalibration.of(self.estimator.origin.camera)
        state.covariances.set_mode(mode)
        given = _with_pnp_input(match, camera, state)
        found = solved(given)  # by the same function as in the anchor, which sends no pose (decision 037)
        result = self.estimator.feed_map_match(found)
        self.monitors.on_map_match(found, self.telemetry, accepted=result.verdict is Verdict.ACCEPTED)
        return MatchOutcome(_solution(given, found, camera, result, state.mode), result)


class PnpFailureError(Exception):
    """No estimate by this match: it gave no pose, its geometry is degenerate, or the gate rejected it (``verdict``).
    The estimator continues with odometry (visual_propagated)."""

    def __init__(self, outcome: MatchOutcome) -> None:
        fusion = outcome.result.fusion
        super().__init__(f"{fusion.verdict.value}: {fusion.detail}" if fusion.detail else fusion.verdict.value)
        self.outcome = outcome

    @property
    def verdict(self) -> Verdict:
        return self.outcome.result.verdict


class CovarianceDegradedWarning(UserWarning):
    """Thermal throttle: the covariance is propagated from frame to frame, not the marginal of the graph."""


@dataclass(frozen=True)
class PoseEstimate:
    """Pose of the frame of the match; of the newest frame, where the match has restarted the graph there."""

    frame_id: int
    frame_uid: str  # unique over all flights: UUID of the flight and number of the frame
    position_wgs84: tuple[float, float, float]  # latitude, longitude [deg], height above mean sea level [m]
    orientation_world_T_body: tuple[float, float, float, float]
    covariance_6x6: np.ndarray  # (6, 6) position, then orientation; axes east, north, up; m^2 and rad^2
    covariance_mode: CovarianceMode
    source_label: SourceLabel
    last_satellite_anchor_age_ms: int
    emitted_at: int  # monotonic, ns
    outcome: MatchOutcome


class PoseEstimator(Protocol):
    def current_covariance_mode(self) -> CovarianceMode:
        """Of the newest estimate."""
        ...

    def estimate(self, match: MatchResult, camera: CameraCalibration, thermal: ThermalState) -> PoseEstimate:
        """The pose of the frame of ``match``, with ``match`` in the graph. ``thermal`` decides the covariance mode.

        ``camera`` must be that of the flight (ValueError). Raises PnpFailureError; warns with
        CovarianceDegradedWarning."""
        ...


class OpenCVGtsamPoseEstimator:
    """PnP by OpenCV (core/pnp.py), fusion by the GTSAM graph of ``flight``, which receives the frames and their
    odometry from EstimatorNode."""

    def __init__(self, flight: EstimatedFlight, clock: Callable[[], int] | None = None) -> None:
        """``clock``: monotonic time [ns] for ``emitted_at``; None: the time of the newest measurement, as in a
        replay."""
        self.flight, self._clock = flight, clock

    def current_covariance_mode(self) -> CovarianceMode:
        return self.flight.estimator.state.mode

    def estimate(self, match: MatchResult, camera: CameraCalibration, thermal: ThermalState) -> PoseEstimate:
        flight, state = self.flight, self.flight.estimator.state
        if camera != CameraCalibration.of(state.origin.camera):
            raise ValueError("the camera is not the one that Origin named: give CameraCalibration.of(origin.camera)")
        outcome = flight.fuse(match, covariance_mode(thermal))
        if outcome.result.verdict is not Verdict.ACCEPTED:
            raise PnpFailureError(outcome)
        if state.mode is CovarianceMode.JACOBIAN:
            warnings.warn(CovarianceDegradedWarning(f"propagated covariance: {thermal.cause}"), stacklevel=2)
        node = state.node_of.get(match.frame_id)
        assert state.last is not None
        in_window = node is not None and state.graph.holds(node)
        return self._estimate(state.frame_state(node) if node is not None and in_window else state.last, outcome)

    def _estimate(self, frame: FrameState, outcome: MatchOutcome) -> PoseEstimate:
        flight = self.flight
        assert flight.estimator.last is not None
        newest_ns = round(flight.estimator.last.t_s * 1e9)
        nav = estimate_of(flight.estimator, frame, flight.axes, flight.claim(frame), newest_ns, tracked=True)
        return PoseEstimate(
            frame_id=nav.frame_id,
            frame_uid=nav.frame_uid,
            position_wgs84=(nav.lat_deg, nav.lon_deg, nav.alt_amsl_m),
            orientation_world_T_body=nav.q_w_b,
            covariance_6x6=np.array(nav.cov).reshape(6, 6),
            covariance_mode=nav.covariance_mode,
            source_label=nav.source_label,
            last_satellite_anchor_age_ms=nav.last_anchor_age_ms,
            emitted_at=nav.emitted_at_ns if self._clock is None else self._clock(),
            outcome=outcome,
        )


def covariance_mode(thermal: ThermalState) -> CovarianceMode:
    """JACOBIAN in any thermal band but the normal one (ON-2)."""
    return CovarianceMode.MARGINALS if thermal.band is ThermalBand.NORMAL else CovarianceMode.JACOBIAN


def _with_pnp_input(match: MatchResult, camera: CameraCalibration, state: FilterState) -> MatchResult:
    """``match``; where its matcher states neither a pose nor the input of PnP, with that of the graph and of matches
    that are good to a pixel."""
    node = state.node_of.get(match.frame_id)
    if not match.matches or match.pnp or match.pose or node is None or not state.graph.holds(node):
        return match
    pose = state.graph.state(node).pose
    given = PnpInput(
        q_w_c=quat_from_rot(pose.rotation().matrix()),
        agl_m=max(state.terrain.height_above_m(pose.translation()), MIN_AGL_M),
        sigma_floor=1.0 / camera.fx,
        threshold=INLIER_THRESHOLD,
        search_radius=SEARCH_RADIUS,
        min_inliers=PNP_MIN_INLIERS,
    )
    return msgspec.structs.replace(match, pnp=given)


def _solution(
    given: MatchResult, found: MatchResult, camera: CameraCalibration, result: MapResult, mode: CovarianceMode
) -> PoseSolution:
    """``found``: ``given``, solved; ``result``: of ``found``; ``mode``: of the estimate with it."""
    degenerate = result.verdict is Verdict.DEGENERATE
    return PoseSolution(
        t_ns=found.t_ns,
        frame_id=found.frame_id,
        verdict=result.verdict if degenerate else found.verdict,
        method=method_of(given),
        inliers=found.inliers,
        residual_px=None if degenerate else _residual_px(found, camera),
        covariance_mode=mode,
        pose=None if degenerate else found.pose,
    )


def _residual_px(found: MatchResult, camera: CameraCalibration) -> float | None:
    """RMS distance of the matches from the projections of their points [px]; None: there is no pose, or no match."""
    if found.pose is None or not found.matches:
        return None
    matches = np.array(found.matches)
    xy, _, _ = project_with_jacobian(rot_from_quat(found.pose.q_w_c), np.array(found.pose.p_c_in_w_m), matches[:, 2:5])
    return camera.fx * float(np.sqrt(np.mean(np.sum((matches[:, :2] - xy) ** 2, axis=1))))
