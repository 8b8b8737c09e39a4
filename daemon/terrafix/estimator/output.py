"""Builds the messages that the estimator publishes from its state."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from msgspec import UNSET, UnsetType

from terrafix.core.flight_id import frame_uid
from terrafix.core.geodesy import LocalFrame, quat_from_rot
from terrafix.core.map_error import shared_variance_m2
from terrafix.core.pose import tangent_to_world
from terrafix.estimator.claim import Claim
from terrafix.estimator.estimator import Estimator
from terrafix.estimator.filter_state import FrameState
from terrafix.estimator.integrity.fragments import Fragment
from terrafix.estimator.integrity.innovation import FusionVerdict, Innovation
from terrafix.estimator.state import HORIZONTAL, UP
from terrafix.messages import (
    CalibrationEstimate,
    MeasurementVerdict,
    NavEstimate,
    Odometry,
    Prediction,
    ReadoutMotion,
    RefinedPose,
    Refinement,
    SourceEnded,
    SourceLabel,
    Verdict,
)

ANCHORED_FOR_S = 1.5  # after a map match the odometry since is too short to matter [tuned]


def verdict_of(t_ns: int, frame_id: int, fusion: FusionVerdict, fragment: Fragment | None = None) -> MeasurementVerdict:
    """MeasurementVerdict of the measurement at ``t_ns``, with the innovation of ``fusion`` where there is one.
    ``fragment``: of its frame."""
    return MeasurementVerdict(
        t_ns=t_ns,
        frame_id=frame_id,
        measurement=fusion.measurement,
        verdict=fusion.verdict,
        detail=fusion.detail,
        **_logged(fusion.innovation),
        **_named(fragment),
    )


def _named(fragment: Fragment | None) -> dict[str, Any]:
    """Fields ``fragment_id`` and ``joined`` of a message."""
    return {} if fragment is None else {"fragment_id": fragment.fragment_id, "joined": fragment.joined}


def _logged(innovation: Innovation | None) -> dict[str, Any]:
    """Fields of a MeasurementVerdict for an innovation; none without one."""
    if innovation is None:
        return {}
    return {
        "mahalanobis2": innovation.mahalanobis2,
        "innovation": tuple(innovation.residual.tolist()),
        "innovation_variance": tuple(np.diag(innovation.covariance).tolist()),
        "test_ratio": innovation.test_ratio,
    }


def odometry_verdict(odometry: Odometry, verdict: Verdict, detail: str = "") -> MeasurementVerdict:
    return verdict_of(odometry.t_ns, odometry.frame_id, FusionVerdict("odometry", verdict, None, detail))


def prediction_of(
    estimator: Estimator,
    frame: FrameState,
    t_ns: int,
    step_m: np.ndarray,
    step_var_m2: float,
    prior_t_ns: int,
    readout_motion: ReadoutMotion | UnsetType,
) -> Prediction:
    """``step_m`` (2,): of the camera since the frame of the Prediction before, with its variance on each axis."""
    r_w_c, p = frame.pose.rotation().matrix(), frame.pose.translation()
    cov = tangent_to_world(frame.cov, r_w_c)
    other = estimator.hypotheses.other
    alternative_m = None if other.weight == 0.0 else (p[HORIZONTAL] + other.offset_m).tolist()
    return Prediction(
        t_ns=t_ns,
        frame_id=frame.frame_id,
        p_c_in_w_m=(float(p[0]), float(p[1]), float(p[UP])),
        q_w_c=quat_from_rot(r_w_c),
        cov=tuple(float(v) for v in cov.ravel()),
        agl_m=estimator.terrain.height_above_m(p),
        agl_sigma_m=float(np.sqrt(cov[UP, UP])),
        step_m=(float(step_m[0]), float(step_m[1])),
        step_cov_m2=(step_var_m2, 0.0, 0.0, step_var_m2),
        radial_k1=estimator.state.radial_k1(frame.node),
        prior_t_ns=max(prior_t_ns, round(estimator.dead_reckoned_s * 1e9)),
        readout_motion=readout_motion,
        alternative_m=alternative_m,
        **_named(estimator.state.fragment_of(frame.frame_id)),
    )


def estimate_of(
    estimator: Estimator, frame: FrameState, axes: LocalFrame, claim: Claim, t_ns: int, *, tracked: bool
) -> NavEstimate:
    """``tracked``: odometry, a relocalisation or a map match of this frame was fused. ``t_ns``: of the newest
    measurement in it."""
    fragment = estimator.state.fragment_of(frame.frame_id)
    connected = fragment is None or fragment.joined or estimator.last_fix_s == frame.t_s
    state, p, v = estimator.state, frame.pose.translation(), frame.velocity_mps
    scale, _ = state.height_scale(frame.node)
    lat_deg, lon_deg = axes.to_wgs84(*claim.position_m.tolist())
    age_ms = -1
    if estimator.last_fix_s is not None:
        age_ms = max(0, round((frame.t_s - estimator.last_fix_s) * 1e3))
    return NavEstimate(
        t_ns=round(frame.t_s * 1e9),
        frame_id=frame.frame_id,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        alt_amsl_m=claim.amsl_m,
        amsl_known=state.amsl_known,
        agl_m=scale * estimator.terrain.height_above_m(p),
        velocity_enu_mps=(float(v[0]), float(v[1]), scale * float(v[UP])),
        velocity_sigma_mps=float(np.sqrt(np.linalg.eigvalsh(frame.velocity_cov)[-1])),  # of the worst direction
        q_w_b=quat_from_rot(state.body(frame)),
        q_w_c=quat_from_rot(frame.pose.rotation().matrix()) if state.on_gimbal else UNSET,
        cov=tuple(float(c) for c in claim.cov.ravel()),
        map_sigma_m=estimator.map_sigma_m,
        source_label=_source(age_ms, tracked=tracked and connected) if state.is_placed else SourceLabel.NOT_PLACED,
        covariance_mode=state.mode,
        last_anchor_age_ms=age_ms,
        emitted_at_ns=max(t_ns, round(frame.t_s * 1e9)),  # the live executor sets the time of publishing here
        frame_uid=frame_uid(state.origin.flight_id, frame.frame_id),
        **_named(fragment),
    )


def _source(age_ms: int, *, tracked: bool) -> SourceLabel:
    if not tracked:
        return SourceLabel.DEAD_RECKONED
    anchored = 0 <= age_ms <= ANCHORED_FOR_S * 1e3
    return SourceLabel.SATELLITE_ANCHORED if anchored else SourceLabel.VISUAL_PROPAGATED


def calibration_of(estimator: Estimator, frame: FrameState) -> CalibrationEstimate:
    """The calibration state of ``frame``, the newest one."""
    bias = estimator.graph.state(frame.node).calibration
    cov = estimator.graph.calibration_covariance(frame.node)
    tilt_x, tilt_y, heading, height, radial_k1, scale = (float(e) for e in bias)
    return CalibrationEstimate(
        t_ns=round(frame.t_s * 1e9),
        frame_id=frame.frame_id,
        state=(tilt_x, tilt_y, heading, height, radial_k1, scale),
        cov=tuple(float(c) for c in cov.ravel()),
        lens=estimator.state.principal_point.learnt,
    )


def refinement_of(estimator: Estimator, axes: LocalFrame, ended: SourceEnded) -> Iterable[Refinement]:
    """Past frames by all that was measured in the flight."""
    poses, map_cov = [], np.diag([shared_variance_m2(estimator.map_sigma_m)] * 2 + [0.0] * 4)
    for frame_id, past in sorted(estimator.refine().items()):
        lat_deg, lon_deg = axes.to_wgs84(float(past.p_m[0]), float(past.p_m[1]))
        cov = past.cov + map_cov
        poses.append(
            RefinedPose(
                frame_id=frame_id,
                lat_deg=lat_deg,
                lon_deg=lon_deg,
                alt_amsl_m=float(past.p_m[UP]) if estimator.state.amsl_known else None,
                sigma_e_m=float(np.sqrt(cov[0, 0])),
                sigma_n_m=float(np.sqrt(cov[1, 1])),
                cov_en_m2=float(cov[0, 1]),
                fragment_id=past.fragment_id,
                q_w_c=quat_from_rot(past.r_w_c),
                cov=tuple(cov.ravel().tolist()),
            )
        )
    yield Refinement(t_ns=ended.t_ns, poses=poses)
