"""Motion of a camera against a keyframe by what both see of the ground plane: for odometry and for relocalisation."""

from dataclasses import replace

import numpy as np

from terrafix.estimator.filter_state import FilterState
from terrafix.estimator.keyframe_view import KeyframeView
from terrafix.estimator.models.plane_motion import Ground, RelativePose, relative_pose
from terrafix.estimator.models.terrain import RELIEF_REPEATS
from terrafix.estimator.state import RADIAL_K1, TRANSLATION, UP
from terrafix.messages import Odometry, Relocalization, Verdict

# Share of the height by which the level of the ground below may be unknown. Beyond it odometry tells no distance, and
# its noise, a share of the estimated distance, would make the graph sure that there is none.
MAX_LEVEL_SIGMA = 0.5  # [tuned]
MIN_PLANE_HEIGHT_M = 2.0  # above the ground: below it the ground is no plane to a camera [tuned]


def plane_motion(
    state: FilterState,
    keyframe: KeyframeView,
    seen: Odometry | Relocalization,
    expected: tuple[np.ndarray, float],
    way_m: float,
) -> RelativePose | Verdict:
    """Motion from a keyframe by the ray pairs of ``seen``, whose points lie on the ground plane; or why there is none.

    ``expected``: R_w_c (3, 3) of the camera as a first guess, and the 1-sigma of its tilt [rad]. ``way_m``: about the
    horizontal distance of the two cameras."""
    height_m, r_w_kf, newest = keyframe.height_m, keyframe.pose.rotation().matrix(), state.graph.newest
    if height_m < MIN_PLANE_HEIGHT_M:
        return Verdict.TOO_LOW
    ground = ground_below(state, keyframe, min(1.0, seen.inliers / max(seen.tracked, 1)))
    if ground.level_sigma_m > MAX_LEVEL_SIGMA * height_m:
        return Verdict.DEGENERATE
    ground = replace(ground, rise_sigma_m=state.terrain.rise_sigma_m(way_m))
    pairs, radial_k1 = np.array(seen.two_view), float(state.graph.state(newest).calibration[RADIAL_K1])
    motion = relative_pose(pairs, seen.sigma_norm, r_w_kf, *expected, ground, radial_k1)
    return Verdict.FEW_INLIERS if motion is None else motion


def ground_below(state: FilterState, keyframe: KeyframeView, share: float) -> Ground:
    """The plane below a keyframe. ``share``: of inliers among the matches."""
    r_w_kf, height_m = keyframe.pose.rotation().matrix(), keyframe.height_m
    place_cov = r_w_kf @ keyframe.cov[TRANSLATION, TRANSLATION] @ r_w_kf.T
    p_m, height_sigma_m = keyframe.pose.translation(), float(np.sqrt(place_cov[UP, UP]))
    ground = state.terrain.ground_plane(p_m, height_m, height_sigma_m, share)
    # Its slope was fitted at one place: where the camera may be elsewhere, the ground may lie higher or lower.
    slope = np.array([ground.slope_e, ground.slope_n])
    level_m = RELIEF_REPEATS * float(np.sqrt(slope @ place_cov[:2, :2] @ slope))
    return replace(ground, level_share=float(np.hypot(ground.level_share, level_m / height_m)))
