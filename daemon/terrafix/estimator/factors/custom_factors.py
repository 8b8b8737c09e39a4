"""The factors that GTSAM lacks: what an autopilot says of attitude and height, seen through the camera's mount; two
cameras that look at the same ground; and the way from one node to the next by velocity and acceleration.

Variables of a node k: C_k, the camera pose in the world (Pose3); B_k, a vector of six slow errors (mount tilt about
the camera's x and y axes [rad], heading bias [rad], height bias [m], of the lens the first radial coefficient, less
what its description says, and the logarithm of heights that are told over heights that are seen); V_k, velocity and
the acceleration that nobody measured (motion_model.py)."""

import math
from typing import Any

import gtsam
import numpy as np

from terrafix.core.geodesy import local_rotation_up
from terrafix.core.pose import log_so3, project_with_jacobian
from terrafix.estimator.factors.linearization_cache import custom_factor
from terrafix.estimator.models.motion_model import V_SIZE, MotionIncrement
from terrafix.estimator.models.plane_motion import EFFECTIVE_PAIRS, Ground

BIAS_SIZE = 6
HEIGHT, LENS, SCALE = 3, 4, 5  # of B
BLOCK_HUBER_K = 1.5
ROBUST_K = 2.0  # Huber on what is told of poses and ways: what passed its gate but sits in the tail pulls less
# What the lens bends beyond its description (core.camera.straightened) is alike in every frame and looks like a tilt
# that grows with the way, so it is learnt in flight. What one number does not tell of it is noise, as large as this of
# the number itself, and as this share of what was learnt.
LENS_REST, LENS_REST_SHARE = 0.0015, 0.05
# 1-sigma of the part of SCALE that is the barometer's: air that is 14 degrees warmer than the standard atmosphere makes
# all its heights 5 % too small. The other part is the focal length's: what is seen over it is the height that is seen.
BAROMETER_SCALE = 0.05
REDUCED = 11  # residuals of a pair of cameras above a plane, after the reduction


def robust(cov: np.ndarray) -> gtsam.noiseModel.Robust:
    """Gaussian noise of this covariance, with Huber's tail."""
    huber = gtsam.noiseModel.mEstimator.Huber.Create(ROBUST_K)
    return gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Gaussian.Covariance(cov, False))


def tilted(x_rad: float, y_rad: float) -> np.ndarray:
    """R (3x3) of a mount that is tilted about the camera's x and y axes; Rodrigues' formula."""
    angle2 = x_rad * x_rad + y_rad * y_rad
    angle = math.sqrt(angle2)
    s = math.sin(angle) / angle if angle > 1e-9 else 1.0
    c = (1.0 - math.cos(angle)) / angle2 if angle > 1e-9 else 0.5
    return np.array(
        [
            [1.0 - c * y_rad * y_rad, c * x_rad * y_rad, s * y_rad],
            [c * x_rad * y_rad, 1.0 - c * x_rad * x_rad, -s * x_rad],
            [-s * y_rad, s * x_rad, 1.0 - c * angle2],
        ]
    )


def attitude_and_height_residual(
    pose: gtsam.Pose3, bias: np.ndarray, r_w_b: np.ndarray, r_b_c: np.ndarray, up_m: float, ground_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> residual (4,): rotation about east, north, up [rad] and height [m]; Jacobians by C_k (4x6) and B_k (4x6).

    ``up_m`` is told, AMSL, and ``ground_m`` the level above which heights are stretched. The height bias is one of the
    height that is seen, like the rise of ground that no map tells.

    Jacobians are those of small residuals: exact enough below 15 degrees, and the graph relinearises."""
    r_w_c = pose.rotation().matrix()
    heading = local_rotation_up(float(bias[2]))  # a positive bias reads too far clockwise: turn it back
    expected = heading @ r_w_b @ r_b_c @ tilted(float(bias[0]), float(bias[1]))
    rotation_w = log_so3(r_w_c @ expected.T)
    stretch, seen_m = math.exp(float(bias[SCALE])), float(pose.translation()[2] + bias[HEIGHT]) - ground_m
    height = stretch * seen_m - (up_m - ground_m)
    by_pose = np.zeros((4, 6))
    by_pose[:3, :3] = r_w_c
    by_pose[3, 3:] = stretch * r_w_c[2]
    by_bias = np.zeros((4, BIAS_SIZE))
    by_bias[:3, :2] = -r_w_c[:, :2]
    by_bias[2, 2] = -1.0
    by_bias[3, HEIGHT], by_bias[3, SCALE] = stretch, stretch * seen_m
    return np.array([*rotation_w, height]), by_pose, by_bias


def attitude_and_height_factor(
    pose_key: int,
    bias_key: int,
    sigmas: np.ndarray,
    r_w_b: np.ndarray,
    r_b_c: np.ndarray,
    up_m: float,
    ground_m: float,
) -> gtsam.CustomFactor:
    """``sigmas`` (4,): rotation about east, north, up [rad], height [m]; large where nothing is known."""

    def error(_this: Any, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        residual, by_pose, by_bias = attitude_and_height_residual(
            values.atPose3(pose_key), values.atVector(bias_key), r_w_b, r_b_c, up_m, ground_m
        )
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(by_pose)
            jacobians[1] = np.asfortranarray(by_bias)
        return residual

    return custom_factor(gtsam.noiseModel.Diagonal.Sigmas(sigmas), [pose_key, bias_key], error)


def map_fix_factor(
    pose_key: int, bias_key: int, pose: gtsam.Pose3, cov: np.ndarray, by_lens: np.ndarray, seen_through: float
) -> gtsam.CustomFactor:
    """A camera ``pose`` with its covariance (tangent order), computed from rays through a lens that bends by
    ``seen_through``; one that bends by one more would have moved it by ``by_lens`` (6,). All fixes are wrong by the
    same lens: as noise of each of them it would average away."""
    by_bias = np.zeros((6, BIAS_SIZE), order="F")
    by_bias[:, LENS] = -by_lens

    def error(_this: Any, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        moved = by_lens * (values.atVector(bias_key)[LENS] - seen_through)
        if jacobians is not None:
            jacobians[0], jacobians[1] = np.eye(6, order="F"), by_bias
        return np.asarray(-values.atPose3(pose_key).localCoordinates(pose) - moved)

    return custom_factor(robust(cov), [pose_key, bias_key], error)


def same_ground_residual(
    keyframe: gtsam.Pose3, pose: gtsam.Pose3, pairs: np.ndarray, normal: np.ndarray, offset: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rays of the keyframe meet the plane ``normal . X = offset`` and are projected into the other camera.

    -> residual (2N,) normalised, Jacobians by both poses (2N x 6), the points X (N, 3), and the change of the residual
    by the height of the plane at each point (2N,). Both cameras move the points: a tilt of the keyframe that is wrong
    must not turn into a turn of the next camera."""
    r_kf, p_kf = keyframe.rotation().matrix(), keyframe.translation()
    r_k, p_k = pose.rotation().matrix(), pose.translation()
    rays = np.column_stack([pairs[:, :2], np.ones(len(pairs))])
    d = rays @ r_kf.T
    along = d @ normal
    along = np.where(np.abs(along) < 1e-3, -1e-3, along)
    depth = (offset - float(normal @ p_kf)) / along
    points = p_kf + d * depth[:, None]
    predicted, by_pose, _ = project_with_jacobian(r_k, p_k, points)
    residual = (predicted - pairs[:, 2:]).ravel()
    # Moving the point X moves its image like moving the camera the other way: d(image)/dX = -by_pose[translation] R^T.
    by_point = -by_pose[:, :, 3:] @ r_k.T
    by_height = np.einsum("nij,nj->ni", by_point, d / along[:, None])
    x, y, z = np.moveaxis((by_point - by_height[:, :, None] * normal) @ r_kf, 2, 0)  # along the ray, back to the plane
    by_keyframe = np.empty_like(by_pose)
    by_keyframe[:, :, 0] = depth[:, None] * (z * rays[:, 1:2] - y)  # of a turn: the cross product with the ray
    by_keyframe[:, :, 1] = depth[:, None] * (x - z * rays[:, :1])
    by_keyframe[:, :, 2] = depth[:, None] * (y * rays[:, :1] - x * rays[:, 1:2])
    by_keyframe[:, :, 3:] = np.stack([x, y, z], 2)
    n = 2 * len(pairs)
    return residual, by_keyframe.reshape(n, 6), by_pose.reshape(n, 6), points, by_height.ravel()


def plane_two_view_factor(
    keyframe_key: int,
    pose_key: int,
    bias_key: int,
    keyframe: gtsam.Pose3,
    pose: gtsam.Pose3,
    pairs: np.ndarray,
    sigma: float,
    ground: Ground,
    keyframe_bias_key: int | None = None,
    seen_through: float = 0.0,
) -> gtsam.CustomFactor:
    """``pairs`` (N, 4) normalised with the 1-sigma ``sigma`` of a coordinate, straightened by ``seen_through``. The
    plane below the keyframe is not known exactly: what its height and slope leave open is in the noise of the factor.

    Two cameras above a plane are nine numbers: one in the other, its way in units of the keyframe's height, and the
    keyframe's tilt against the plane; what the lens bends is one more. In these the residuals of all pairs are linear
    enough to be reduced by QR, here, to eleven that have the same norm (the last is what nothing explains). Where north
    is and where the cameras are does not enter, so that a heading or a position that is corrected later does no harm.
    With a way in metres what the pairs leave unexplained would weigh less the lower the camera is, and pull it down.

    ``keyframe_bias_key``: of B of the keyframe; it counts where ``ground`` rises and no map tells
    (``motion_factor``)."""
    if not ground.rise_sigma_m:
        keyframe_bias_key = None
    normal = np.array([-ground.slope_e, -ground.slope_n, 1.0])
    p = keyframe.translation()
    offset = float(p[2]) - ground.height_m - ground.slope_e * float(p[0]) - ground.slope_n * float(p[1])
    rest = float(np.hypot(LENS_REST, LENS_REST_SHARE * seen_through))
    seen, tilt, lens = _reduced(keyframe, pose, pairs, sigma, ground, normal, offset, rest)
    by_bias = np.zeros((REDUCED, BIAS_SIZE), order="F")
    by_bias[:, LENS] = lens
    at_first = keyframe.between(pose)
    up_first = keyframe.rotation().matrix().T @ normal
    up_unit = up_first / float(np.linalg.norm(up_first))
    turned = tilt @ (np.eye(3) - np.outer(up_unit, up_unit))

    def error(_this: Any, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        c0, c1 = values.atPose3(keyframe_key), values.atPose3(pose_key)
        bias, r0 = values.atVector(bias_key), c0.rotation().matrix()
        if keyframe_bias_key is not None:
            risen_m = float(bias[HEIGHT] - values.atVector(keyframe_bias_key)[HEIGHT])
            c1 = gtsam.Pose3(c1.rotation(), c1.translation() + np.array([0.0, 0.0, risen_m]))
        # The plane was fitted to the ground at one place and lies as high wherever the camera turns out to be: on its
        # slope a camera that is lost by a hillside would seem to read its position from its height.
        height_m = max(ground.height_m + float(c0.translation()[2] - p[2]), 1.0)
        unit = ground.height_m / height_m
        way = c0.between(c1)
        step = gtsam.Pose3(way.rotation(), unit * way.translation())
        up = r0.T @ normal
        # Small rotations w of the keyframe change up by up x w: turned back into w, without the part about up itself.
        back = np.array(
            [
                up[1] * up_unit[2] - up[2] * up_unit[1],
                up[2] * up_unit[0] - up[0] * up_unit[2],
                up[0] * up_unit[1] - up[1] * up_unit[0],
            ]
        )
        by_step = seen[:, :6]
        residual = seen[:, 6] + by_step @ at_first.logmap(step) + tilt @ back + lens * (bias[LENS] - seen_through)
        if jacobians is not None:
            by_way = np.hstack([by_step[:, :3], unit * by_step[:, 3:]])
            by_c0 = -by_way @ way.inverse().AdjointMap()
            by_c0[:, :3] += turned
            by_height = by_way[:, 3:] @ way.rotation().matrix().T @ way.translation() / -height_m
            by_c0[:, 3:] += np.outer(by_height, r0[2])
            jacobians[0] = np.asfortranarray(by_c0)
            jacobians[1] = np.asfortranarray(by_way)
            jacobians[2] = by_bias
            if keyframe_bias_key is not None:
                by_rise = np.zeros_like(by_bias)
                by_rise[:, HEIGHT] = by_way[:, 3:] @ c1.rotation().matrix()[2]
                jacobians[2], jacobians[3] = np.asfortranarray(by_bias + by_rise), np.asfortranarray(-by_rise)
        return np.asarray(residual)

    # Huber on the whole block: its whitened norm is about sqrt(2 * EFFECTIVE_PAIRS) when all is well.
    huber = gtsam.noiseModel.mEstimator.Huber.Create(BLOCK_HUBER_K * float(np.sqrt(2 * EFFECTIVE_PAIRS)))
    noise = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Unit.Create(REDUCED))
    keys = [keyframe_key, pose_key, bias_key]
    return custom_factor(noise, keys if keyframe_bias_key is None else [*keys, keyframe_bias_key], error)


def _reduced(
    keyframe: gtsam.Pose3,
    pose: gtsam.Pose3,
    pairs: np.ndarray,
    sigma: float,
    ground: Ground,
    normal: np.ndarray,
    offset: float,
    lens_rest: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whitened residuals, REDUCED of them: by the step and constant (R, 7), by the tilt (R, 3), by the radial
    coefficient (R,), of which ``lens_rest`` is noise."""
    residual, by_keyframe, by_pose, points, by_height = same_ground_residual(keyframe, pose, pairs, normal, offset)
    # The keyframe alone, while the other camera keeps its place in it.
    by_both = by_keyframe + by_pose @ keyframe.between(pose).inverse().AdjointMap()
    by_lens = _by_lens(keyframe, pairs, residual, by_keyframe, points)
    full = np.column_stack([by_pose, by_both[:, :3], by_lens, residual]) / sigma
    away = np.repeat(points[:, :2] - keyframe.translation()[:2], 2, axis=0)
    by_plane = np.column_stack([by_height, by_height * away[:, 0], by_height * away[:, 1]])
    by_plane = by_plane * (np.array([ground.level_sigma_m, ground.slope_sigma, ground.slope_sigma]) / sigma)
    by_plane = np.column_stack([by_plane, lens_rest / sigma * by_lens])
    if ground.bend_sigma:
        by_plane = np.column_stack([by_plane, ground.bend_sigma / sigma * _by_bend(by_height, away)])
    # (1 + P P^T)^(-1/2), where only a few directions of the noise are not white: from the eigenvalues of P^T P.
    s2, v = np.linalg.eigh(by_plane.T @ by_plane)
    root = np.sqrt(1.0 + s2)
    full -= by_plane @ ((v / (root * (1.0 + root))) @ (v.T @ (by_plane.T @ full)))
    r = np.asarray(np.linalg.qr(full, mode="r"))
    return r[:, [0, 1, 2, 3, 4, 5, 10]], r[:, 6:9], r[:, 9]


def _by_bend(by_height: np.ndarray, away_m: np.ndarray) -> np.ndarray:
    """(2N, 3) the change of the residual by the curvature of the ground: along east, along north, and the twist, which
    in a field that is alike in all directions has a third of the variance. ``away_m`` (2N, 2): from the keyframe.

    Ground that bends turns the camera, by a tenth or so of what its slope changes from keyframe to keyframe, and the
    same way for as long as a hill is in sight."""
    east_m, north_m = away_m.T
    rises_m = np.column_stack([0.5 * east_m**2, 0.5 * north_m**2, east_m * north_m / np.sqrt(3.0)])
    return np.asarray(by_height[:, None] * rises_m)


def _by_lens(
    keyframe: gtsam.Pose3, pairs: np.ndarray, residual: np.ndarray, by_keyframe: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """(2N,) the change of the residual by the first radial coefficient: both cameras see farther out what it bends. A
    ray of the keyframe that turns moves its point as the camera would, by the depth as much.

    The other camera's rays are taken where they should be and not where they were seen, noise and all: what noise does
    to both sides of an equation looks like a lens."""
    there = pairs[:, 2:] + residual.reshape(-1, 2)
    bent = [np.sum(np.square(xy), axis=1, keepdims=True) * xy for xy in (pairs[:, :2], there)]
    depth = (points - keyframe.translation()) @ keyframe.rotation().matrix()[:, 2]
    by_ray = by_keyframe.reshape(-1, 2, 6)[:, :, 3:5] * depth[:, None, None]
    return np.asarray((bent[1] - np.einsum("nij,nj->ni", by_ray, bent[0])).ravel())


def motion_factor(
    before: tuple[int, int], after: tuple[int, int], bias_keys: tuple[int, int], leg: MotionIncrement
) -> gtsam.CustomFactor:
    """``before`` and ``after``: keys of C and V; ``bias_keys``: of B at both ends. The heading bias at the end turns
    what was felt.

    Where no map tells the ground (``MotionIncrement.lifted``), C is above whatever ground is seen, as if all of it were
    at one level, and its rise is in the height bias, which the barometer shows: how far the vehicle rose is what both
    say.

    What drones do, where nobody felt it, has a tail: they cruise for minutes and then brake as hard as they can. A leg
    that is taken for Gaussian holds on to the cruise, and what gives way is the height, in which the camera sees it.
    GTSAM weighs it where it is linear, before anything is solved: a velocity there that does not go with the way counts
    like a manoeuvre. Where no camera saw the way (``MotionIncrement.over``) a leg has no tail: nothing else would have
    to give way.

    Linear but for the heading, the axes of the poses, and the height that a leg is told in
    (``MotionIncrement.over``)."""
    rows = 3 + V_SIZE
    by_before, by_after = -leg.by_before(), np.zeros((rows, V_SIZE))
    by_after[3:, :] = np.eye(V_SIZE)
    by_pose = np.zeros((rows, 6))
    felt = np.concatenate([leg.way_m, leg.gain_mps])

    def error(_this: Any, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        c0, c1 = values.atPose3(before[0]), values.atPose3(after[0])
        v0, v1 = values.atVector(before[1]), values.atVector(after[1])
        b1 = values.atVector(bias_keys[1])
        turn = float(b1[2]) if leg.inertial else 0.0
        c, s = math.cos(turn), math.sin(turn)
        turned = np.array(
            [
                c * felt[0] - s * felt[1], s * felt[0] + c * felt[1], felt[2],
                c * felt[3] - s * felt[4], s * felt[3] + c * felt[4], felt[5],
            ]
        )  # fmt: skip
        start = by_before @ v0
        start[:6] -= turned
        start[:3] += c1.translation() - c0.translation()
        if leg.lifted:
            start[2] += float(b1[HEIGHT] - values.atVector(bias_keys[0])[HEIGHT])
        unit0, unit1 = 1.0, 1.0  # of what is told in the height at the beginning, and at the end
        if leg.over is not None:
            height_m, ground_m = leg.over
            unit1 = height_m / max(float(c1.translation()[2]) - ground_m, 1.0)
            unit0 = unit1 if leg.inertial else height_m / max(float(c0.translation()[2]) - ground_m, 1.0)
        residual = unit0 * start
        residual[3:] += unit1 * v1
        if jacobians is not None:
            by_c0, by_c1, by_bias = by_pose.copy(), by_pose.copy(), np.zeros((rows, BIAS_SIZE))
            by_c0[:3, 3:] = -unit0 * c0.rotation().matrix()
            by_c1[:3, 3:] = unit0 * c1.rotation().matrix()
            if leg.inertial:
                by_bias[:6, 2] = unit0 * np.array([turned[1], -turned[0], 0.0, turned[4], -turned[3], 0.0])
            if leg.over is not None:
                up0, up1 = c0.rotation().matrix()[2], c1.rotation().matrix()[2]
                of_start, above = (by_c1, up1) if leg.inertial else (by_c0, up0)
                of_start[:, 3:] -= np.outer(start, above) * (unit0**2 / leg.over[0])
                by_c1[3:, 3:] -= np.outer(v1, up1) * (unit1**2 / leg.over[0])
            if leg.lifted:
                by_bias[2, HEIGHT] += unit0
                jacobians[5] = np.zeros((rows, BIAS_SIZE), order="F")
                jacobians[5][2, HEIGHT] = -unit0
            for i, jacobian in enumerate((by_c0, unit0 * by_before, by_c1, unit1 * by_after, by_bias)):
                jacobians[i] = np.asfortranarray(jacobian)
        return residual

    has_tail = not leg.inertial and leg.over is not None
    noise = robust(leg.cov) if has_tail else gtsam.noiseModel.Gaussian.Covariance(leg.cov, False)
    keys = [*before, *after, bias_keys[1]]
    return custom_factor(noise, [*keys, bias_keys[0]] if leg.lifted else keys, error)
