"""Conversion of a match result into the MapMatch message: 2D-3D matches, a camera pose, or the position of the belief's
mode alone."""

from collections.abc import Sequence

import msgspec
import numpy as np

from terrafix.anchor.matching.frame_matcher import PatchFix, View
from terrafix.anchor.matching.point_mass_filter import Mode
from terrafix.core.geodesy import quat_from_rot
from terrafix.core.pnp import map_pose
from terrafix.core.pose import PoseFit, tangent_to_world
from terrafix.messages import MapMatch, MapPose, Verdict

# 1-sigma of the attitude of a position-only match: large enough that the match does not constrain attitude [tuned]
COARSE_TILT_RAD = np.radians(10.0)
# 1-sigma of the height of a position-only match when one scale was correlated, or the best scale is at the end of the
# grid [tuned]
COARSE_HEIGHT_M = 100.0
# relative 1-sigma of the height from a scale that was interpolated between hypotheses, beside the variance of that
# interpolation: roofs and trees lie above the ground of the map [tuned]
COARSE_SCALE = 0.05
# Share of the height, 1-sigma of the horizontal position: leaning buildings and a scale error shift the whole image
# [tuned]
COARSE_SIGMA = 0.03
# Share of the height, 1-sigma per horizontal axis: the error that all patches of a relocalized place have in common.
# The inlier patches lean or have changed together, so their scatter does not contain it. Measured at places that
# searches found. [measured: docs/search.md]
RELOCALIZED_SIGMA = 0.02
# Share of the height: largest distance between the pose and the mode while the tilt is not yet known [tuned]
MAX_MODE_DRIFT = 0.35


def mode_match(
    match: MapMatch, mode: Mode, cell_m: float, view: View, scale: tuple[float, float] | None, *, alone: bool = False
) -> MapMatch:
    """Pose measurement from the position of the belief's mode, with a covariance that constrains position only.

    The correlation measures the ground below the optical axis, so position and tilt errors are correlated: p_e moves by
    +h and p_n by -h per radian of rotation about north and east (h = height above ground). ``scale``: ratio of measured
    to predicted height and its variance; None if no scale was measured. ``alone``: the frame has selected the mode
    without the frames before it.
    """
    agl_m, height_m = view.agl_m, COARSE_HEIGHT_M
    if scale is not None:
        agl_m *= scale[0]
        height_m = float(np.hypot(COARSE_SCALE, np.sqrt(scale[1]))) * agl_m
    jacobian = np.zeros((2, 2))
    jacobian[0, 1], jacobian[1, 0] = view.agl_m, -view.agl_m
    tilt = COARSE_TILT_RAD**2 * np.eye(2)
    cov = np.diag([0.0, 0.0, height_m**2, COARSE_TILT_RAD**2, COARSE_TILT_RAD**2, COARSE_TILT_RAD**2])
    sigma2 = mode.var_m2 + cell_m**2 + (COARSE_SIGMA * view.agl_m) ** 2
    cov[:2, :2] = jacobian @ tilt @ jacobian.T + sigma2 * np.eye(2)
    cov[:2, 3:5] = jacobian @ tilt
    cov[3:5, :2] = cov[:2, 3:5].T
    return msgspec.structs.replace(
        match,
        verdict=Verdict.ACCEPTED,
        inliers=0,  # those of a pose that was rejected
        refined=False,
        reprojection_px=0.0,
        matches=[],
        pnp=None,
        pose=MapPose(
            p_c_in_w_m=(mode.e_m, mode.n_m, view.ground_m + agl_m),
            q_w_c=quat_from_rot(view.r_w_c),
            cov=tuple(float(v) for v in cov.ravel()),
            position_only=not alone,
        ),
    )


def pose_match(match: MapMatch, fix: PatchFix | None, view: View) -> MapMatch:
    """Copies a fix and its verdict into ``match``: all 2D-3D matches with what PnP takes beside them, or the pose if
    another method has computed it. ``match.place`` is the place at which the fix was computed; a pose that is more than
    ``MAX_MODE_DRIFT`` heights away from it is DEGENERATE."""
    if fix is None:
        return msgspec.structs.replace(match, verdict=Verdict.DEGENERATE)
    verdict, fit = fix.pnp.verdict, fix.pnp.fit
    inliers = int(fix.pnp.inliers.sum())
    match = msgspec.structs.replace(match, verdict=verdict, inliers=inliers, refined=fix.refined)
    if fit is None:
        return match
    assert match.place is not None
    drift = np.array([fit.p_c_in_w_m[0] - match.place.e_m, fit.p_c_in_w_m[1] - match.place.n_m])
    match = msgspec.structs.replace(
        match,
        verdict=Verdict.DEGENERATE if float(np.hypot(*drift)) > MAX_MODE_DRIFT * view.agl_m else verdict,
        reprojection_px=float(np.sqrt(np.mean(fit.residuals**2))) * view.agl_m / fix.cell_m,
    )
    if fix.given is None:
        return msgspec.structs.replace(match, matches=_agreeing(fix), pnp=None, pose=map_pose(fit))
    return msgspec.structs.replace(match, matches=_matches(fix), pnp=fix.given, pose=None)


def _matches(fix: PatchFix) -> list[tuple[float, float, float, float, float, float]]:
    """All 2D-3D matches of ``fix``, as in MapMatch."""
    rows = np.column_stack([fix.xy, fix.points_w_m, fix.weights]).tolist()
    return [(x, y, e_m, n_m, up_m, weight) for x, y, e_m, n_m, up_m, weight in rows]


def _agreeing(fix: PatchFix) -> list[tuple[float, float, float, float, float, float]]:
    """Those of them that agree with the pose of ``fix``."""
    return [one for one, agrees in zip(_matches(fix), fix.pnp.inliers, strict=True) if agrees]


def ground_cov_m2(cov: Sequence[float], agl_m: float) -> np.ndarray:
    """(2, 2) covariance in m^2, east and north, of the ground point below the camera. ``cov`` (36,): pose covariance in
    the order of the messages. The correlated part of tilt and position error does not move that point and cancels."""
    # A rotation about north moves the observed ground point west, a rotation about east moves it north.
    jacobian = np.hstack([np.eye(2), np.zeros((2, 1)), agl_m * np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])])
    return np.asarray(jacobian @ np.reshape(cov, (6, 6)) @ jacobian.T)


def ground_sigma_m(fit: PoseFit, agl_m: float) -> float:
    """1-sigma in metres of that ground point along the worst direction."""
    cov = tangent_to_world(fit.cov, fit.r_w_c)
    return float(np.sqrt(np.linalg.eigvalsh(ground_cov_m2(cov.ravel().tolist(), agl_m))[-1]))


def relocalized_match(match: MapMatch, fix: PatchFix, view: View, innovation_m: tuple[float, float]) -> MapMatch:
    """``pose_match`` for a place that a search has found: the first pose there, without a prior from earlier frames.

    ``innovation_m``: east and north, distance of this frame's place from the one predicted by the earlier frames and
    odometry. Its square is added to the covariance: patches with little texture agree under a wrong motion too, and the
    patches of the next frame agree under another one. ``RELOCALIZED_SIGMA`` is added for the common error of the
    patches.
    """
    search = msgspec.structs.replace(match.search, relocalized=True)
    match = pose_match(msgspec.structs.replace(match, search=search), fix, view)
    if fix.pnp.fit is None:
        return match
    pose = map_pose(fix.pnp.fit)
    cov = np.array(pose.cov).reshape(6, 6)
    cov[:2, :2] += (RELOCALIZED_SIGMA * view.agl_m) ** 2 * np.eye(2) + np.outer(innovation_m, innovation_m)
    wider = msgspec.structs.replace(pose, cov=tuple(float(v) for v in cov.ravel()))
    return msgspec.structs.replace(match, matches=_agreeing(fix), pnp=None, pose=wider)
