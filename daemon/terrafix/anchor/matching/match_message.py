"""What the matcher found, as MapMatch says it: a pose from 2D-3D matches, or the position of the mode alone."""

from collections.abc import Sequence

import msgspec
import numpy as np

from terrafix.anchor.matching.frame_matcher import Fix, View
from terrafix.anchor.matching.point_mass_filter import Mode
from terrafix.core.geodesy import quat_from_rot
from terrafix.core.pose import tangent_to_world
from terrafix.messages import MapMatch, Verdict

COARSE_TILT_RAD = np.radians(10.0)  # a coarse fix says nothing of attitude: as good as unknown
COARSE_HEIGHT_M = 100.0  # ... nor of height, unless several scales were looked at, and one between them fits best
COARSE_SCALE = 0.05  # ... to this share of it, and what they leave open: what is seen lies above the ground, or below
COARSE_SIGMA = 0.03  # of the height: buildings that lean and a scale that is not quite right shift the whole picture
# Of the height, for each axis: what a whole place may be aside. The patches that a pose stands on lean and have changed
# together, and their scatter does not show it. Measured at places that searches found: docs/search.md.
FOUND_SIGMA = 0.02
MODE_DRIFT = 0.35  # of the height: how far the pose may lie from the mode while the tilt is not yet known


def mode_match(answer: MapMatch, mode: Mode, cell_m: float, view: View, scale: tuple[float, float] | None) -> MapMatch:
    """The position of the mode, as a pose factor. What is seen is the place of the ground, so the camera's position
    goes with its tilt: p_e moves by +h, p_n by -h per radian of rotation about north and east. ``scale``: of the height
    that was predicted, and its variance."""
    agl_m, height_m = view.agl_m, COARSE_HEIGHT_M
    if scale is not None:
        agl_m *= scale[0]
        height_m = float(np.hypot(COARSE_SCALE, np.sqrt(scale[1]))) * agl_m
    lever = np.zeros((2, 2))
    lever[0, 1], lever[1, 0] = view.agl_m, -view.agl_m
    tilt = COARSE_TILT_RAD**2 * np.eye(2)
    cov = np.diag([0.0, 0.0, height_m**2, COARSE_TILT_RAD**2, COARSE_TILT_RAD**2, COARSE_TILT_RAD**2])
    sigma2 = mode.var_m2 + cell_m**2 + (COARSE_SIGMA * view.agl_m) ** 2
    cov[:2, :2] = lever @ tilt @ lever.T + sigma2 * np.eye(2)
    cov[:2, 3:5] = lever @ tilt
    cov[3:5, :2] = cov[:2, 3:5].T
    return msgspec.structs.replace(
        answer,
        verdict=Verdict.ACCEPTED,
        coarse=True,
        p_c_in_w_m=(mode.e_m, mode.n_m, view.ground_m + agl_m),
        q_w_c=quat_from_rot(view.r_w_c),
        cov=tuple(float(v) for v in cov.ravel()),
    )


def pose_match(answer: MapMatch, fix: Fix | None, view: View) -> MapMatch:
    """The pose of a fix with its matches and its verdict. ``answer`` has the mode that it was looked for in."""
    if fix is None:
        return msgspec.structs.replace(answer, verdict=Verdict.DEGENERATE)
    pnp = fix.pnp
    verdict = pnp.verdict
    if pnp.fit is None:
        return msgspec.structs.replace(answer, verdict=verdict, inliers=int(pnp.inliers.sum()))
    p = pnp.fit.p_c_in_w_m
    drift = np.array([p[0] - answer.mode_e_m, p[1] - answer.mode_n_m])
    if float(np.hypot(*drift)) > MODE_DRIFT * view.agl_m:
        verdict = Verdict.DEGENERATE
    matches = np.column_stack([fix.xy, fix.points_w_m, fix.weights])[pnp.inliers]
    cov = tangent_to_world(pnp.fit.cov, pnp.fit.r_w_c)
    return msgspec.structs.replace(
        answer,
        verdict=verdict,
        matches=[(float(a), float(b), float(c), float(d), float(e), float(f)) for a, b, c, d, e, f in matches],
        p_c_in_w_m=(float(p[0]), float(p[1]), float(p[2])),
        q_w_c=quat_from_rot(pnp.fit.r_w_c),
        cov=tuple(float(v) for v in cov.ravel()),
        inliers=int(pnp.inliers.sum()),
        reprojection_px=float(np.sqrt(np.mean(pnp.fit.residuals**2))) * view.agl_m / fix.cell_m,
    )


def ground_cov_m2(cov: Sequence[float], agl_m: float) -> np.ndarray:
    """(2, 2), east and north, of the ground that a pose shows below the camera. ``cov`` (36,) of the pose, in the order
    of the messages: what tilt and position trade against each other does not move that ground."""
    # A rotation about north moves what is seen to the west, one about east to the north.
    lever = np.hstack([np.eye(2), np.zeros((2, 1)), agl_m * np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])])
    return np.asarray(lever @ np.reshape(cov, (6, 6)) @ lever.T)


def ground_sigma_m(answer: MapMatch, agl_m: float) -> float:
    """1-sigma of that ground, in the worst direction; infinite without a pose."""
    if answer.cov is None:
        return float(np.inf)
    return float(np.sqrt(np.linalg.eigvalsh(ground_cov_m2(answer.cov, agl_m))[-1]))


def found(answer: MapMatch, fix: Fix, view: View, jump_m: tuple[float, float]) -> MapMatch:
    """As ``pose_match``, of a place that a search has found: its first pose, which nothing that came before holds.
    ``jump_m``: east and north, of its frame against where the frames before have it. Where patches say little, they
    agree with a wrong motion as well, and those of the next frame with another one."""
    said = pose_match(msgspec.structs.replace(answer, found=True), fix, view)
    if said.cov is None:
        return said
    cov = np.array(said.cov).reshape(6, 6)
    cov[:2, :2] += (FOUND_SIGMA * view.agl_m) ** 2 * np.eye(2) + np.outer(jump_m, jump_m)
    return msgspec.structs.replace(said, cov=tuple(float(v) for v in cov.ravel()))
