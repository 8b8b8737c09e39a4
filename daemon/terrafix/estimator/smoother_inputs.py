"""What the smoother gets of each measurement: relative poses without the map matches, and the poses of these."""

from collections.abc import Iterable
from typing import Any

import gtsam
import numpy as np

from terrafix.core.geodesy import quat_from_rot
from terrafix.estimator.estimator import Estimator
from terrafix.estimator.filter_state import FilterState
from terrafix.estimator.measurements.map_pose import FixedPose
from terrafix.estimator.measurements.odometry import KeyframeMotion
from terrafix.estimator.measurements.relocalization import RelocalizationMeasurement
from terrafix.estimator.models.plane_motion import RelativePose
from terrafix.estimator.propagation import PropagationResult
from terrafix.estimator.state import MOUNT_TILT, TRANSLATION
from terrafix.messages import MapMatch, PoseAnchor, PoseLink, Relocalization


def odometry_link(estimator: Estimator, result: PropagationResult, t_ns: int) -> Iterable[PoseLink]:
    """The link of the newest frame to its keyframe; none without odometry, and where a graph has begun with it."""
    state, motion = estimator.state, result.motion
    if motion is None:
        return
    frame_id, ambiguous = result.placed.frame_id, estimator.hypotheses.other
    fragment = state.fragments.of(result.placed.node)
    yield PoseLink(
        t_ns=t_ns,
        frame_id=frame_id,
        parent_id=state.frames[motion.parent],
        fragment_id=fragment.fragment_id,
        agl_m=state.terrain.height_above_m(result.placed.pose.translation()),
        ambiguity_m2=_flat2(ambiguous.moments_m2()) if ambiguous.weight > 0.0 else (0.0, 0.0, 0.0, 0.0),
        **_relative(_between(state, motion, result), motion.motion),
    )


def _between(state: FilterState, motion: KeyframeMotion, result: PropagationResult) -> gtsam.Pose3:
    """The frame in the camera of its keyframe: where odometry was fused, with what attitude, height, airspeed and
    inertial readings have added to it."""
    if state.graph.holds(motion.parent) and result.fused:
        return state.graph.state(motion.parent).pose.between(result.placed.pose)
    return motion.motion.between


def relocalization_link(estimator: Estimator, seen: Relocalization, by: RelocalizationMeasurement) -> PoseLink:
    """The link of an accepted relocalisation."""
    motion = by.motion
    return PoseLink(
        t_ns=seen.t_ns,
        frame_id=seen.frame_id,
        parent_id=seen.keyframe_id,
        fragment_id=seen.fragment_id,
        agl_m=estimator.state.terrain.height_above_m(by.pose.translation()),
        relocalization=True,
        **_relative(motion.between, motion),
    )


def map_anchor(estimator: Estimator, match: MapMatch, by: FixedPose) -> PoseAnchor:
    """The pose of an accepted map match."""
    state, p = estimator.state, by.pose.translation()
    # A tilt of the mount moves what is seen as the principal point does: about x it is down, about y to the right.
    (xx, xy), (_, yy) = state.covariances.calibration(state.graph.newest)[MOUNT_TILT, MOUNT_TILT]
    axis_cov = state.principal_point.cov + np.array([[yy, -xy], [-xy, xx]])
    fragment = state.fragment_of(match.frame_id)
    return PoseAnchor(
        t_ns=match.t_ns,
        frame_id=match.frame_id,
        fragment_id=-1 if fragment is None else fragment.fragment_id,
        p_c_in_w_m=(float(p[0]), float(p[1]), float(p[2])),
        q_w_c=quat_from_rot(by.pose.rotation().matrix()),
        cov=_flat6(by.cov),
        map_sigma_m=match.map_sigma_m,
        covariance_mode=state.mode,
        axis=(float(state.principal_point.offset[0]), float(state.principal_point.offset[1])),
        axis_cov=_flat2(axis_cov),
    )


def _relative(between: gtsam.Pose3, motion: RelativePose) -> dict[str, Any]:
    """Fields of a PoseLink. An error of the height is the scale of the whole fragment, not of the step."""
    cov, scale_sigma, p = motion.cov.copy(), 0.0, between.translation()
    if motion.rays is not None:
        scale_sigma = motion.rays.ground.height_sigma_m / motion.rays.ground.height_m
        translation = motion.r.T @ motion.p_m
        cov[TRANSLATION, TRANSLATION] -= scale_sigma**2 * np.outer(translation, translation)
    return {
        "p_in_parent_m": (float(p[0]), float(p[1]), float(p[2])),
        "q_parent_c": quat_from_rot(between.rotation().matrix()),
        "cov": _flat6(cov),
        "scale_sigma": float(scale_sigma),
    }


def _flat6(cov: np.ndarray) -> tuple[float, ...]:
    return tuple(float(v) for v in cov.ravel())


def _flat2(cov: np.ndarray) -> tuple[float, float, float, float]:
    (ee, en), (ne, nn) = cov.tolist()
    return ee, en, ne, nn
