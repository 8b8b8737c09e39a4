"""Synthetic messages of vision, anchor and autopilot for a long flight, without images.

Straight legs and level turns over flat ground at 12 m/s; 2 frames per second, a map match at every second frame, IMU
at 100 Hz and attitudes at 50 Hz. Errors are drawn from the distributions that the messages state."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from terrafix.core.camera import Mount
from terrafix.core.geodesy import quat_from_rot, rot_w_b
from terrafix.core.mavlink.imu import GRAVITY_MPS2
from terrafix.messages import (
    Camera,
    Imu,
    ImuSample,
    MapMatch,
    MapPose,
    MatchPlace,
    Odometry,
    Origin,
    VehicleState,
    Verdict,
)

FRAME_S, SPEED_MPS, HEIGHT_M = 0.5, 12.0, 100.0
LEG_S, TURN_S, TURN_RADPS = 60.0, 6.0, math.radians(15.0)  # each leg ends with a right turn
IMU_S, STATE_EVERY, IMU_BATCH = 0.01, 2, 5  # period; readings per attitude; readings per message
FORCE_NOISE_MPS2, FORCE_BIAS_MPS2 = 0.3, 0.05  # vibration; residual bias after calibration
KEYFRAME_EVERY, FIX_EVERY = 3, 2
PAIRS, SIGMA_NORM = 48, 1 / 560  # PAIRS: the most that odometry publishes
FIX_SIGMA_M, FIX_SIGMA_RAD = 2.0, math.radians(1.0)
CAMERA = Camera(width=960, height=540, fx=560.0, fy=560.0, cx=479.5, cy=269.5, mount_tolerance_deg=2.0)
ORIGIN = Origin(
    t_ns=0,
    camera=CAMERA,
    lat_deg=48.0,
    lon_deg=11.0,
    ground_amsl_m=0.0,
    start_sigma_m=10.0,
    yaw_sigma_deg=2.0,
    agl_sigma_m=2.0,
    attitude_sigma_deg=1.0,
)


@dataclass(frozen=True)
class FrameMessages:
    """Messages of one frame, in the order of publication."""

    telemetry: list[VehicleState | Imu]  # since the previous frame
    odometry: Odometry
    match: MapMatch | None
    p_m: np.ndarray  # (3,) true position: east, north, up


def frame_messages(frames: int, seed: int = 0) -> Iterator[FrameMessages]:
    """-> the messages frame by frame. Truth: a camera at HEIGHT_M that looks straight down, image top forward."""
    rng = np.random.default_rng([seed, 100])
    mount = Mount.of(CAMERA).r_b_c()
    p_m, yaw, i = np.array([0.0, 0.0, HEIGHT_M]), 0.0, 0
    keyframe, keyframe_pose = 0, (np.eye(3), p_m)
    telemetry, batch = list[VehicleState | Imu](), list[ImuSample]()
    for step in range((frames - 1) * round(FRAME_S / IMU_S) + 1):
        t_s, t_ns = step * IMU_S, round(step * IMU_S * 1e9)
        turning = TURN_RADPS if t_s % LEG_S >= LEG_S - TURN_S else 0.0
        force = (0.0, SPEED_MPS * turning, -GRAVITY_MPS2) + FORCE_NOISE_MPS2 * rng.normal(size=3) + FORCE_BIAS_MPS2
        before_ns = round((IMU_BATCH - 1 - len(batch)) * IMU_S * 1e9)
        batch.append((before_ns, *force.tolist(), 0.0, 0.0, turning))
        if len(batch) == IMU_BATCH:
            telemetry.append(Imu(t_ns=t_ns, source="benchmark", samples=batch))
            batch = []
        if step % STATE_EVERY == 0:
            telemetry.append(_state(t_ns, yaw, rng))
        if step % round(FRAME_S / IMU_S) == 0:
            pose = (rot_w_b(yaw, 0.0, 0.0) @ mount, p_m)
            odometry = _odometry(i, keyframe, t_ns, keyframe_pose, pose, rng)
            if odometry.becomes_keyframe:
                keyframe, keyframe_pose = i, pose
            match = _fix(i, t_ns, p_m, pose[0], rng) if i % FIX_EVERY == 0 else None
            yield FrameMessages(telemetry, odometry, match, p_m)
            telemetry, i = [], i + 1
        mean_yaw = yaw + 0.5 * turning * IMU_S
        p_m = p_m + IMU_S * SPEED_MPS * np.array([math.sin(mean_yaw), math.cos(mean_yaw), 0.0])
        yaw += turning * IMU_S


def _state(t_ns: int, yaw_rad: float, rng: np.random.Generator) -> VehicleState:
    return VehicleState(
        t_ns=t_ns,
        source="benchmark",
        yaw_rad=math.remainder(yaw_rad + math.radians(0.2) * float(rng.normal()), math.tau),
        pitch_rad=math.radians(0.1) * float(rng.normal()),
        roll_rad=math.radians(0.1) * float(rng.normal()),
        agl_m=HEIGHT_M + float(rng.normal()),
    )


def _odometry(
    i: int,
    keyframe: int,
    t_ns: int,
    keyframe_pose: tuple[np.ndarray, np.ndarray],
    pose: tuple[np.ndarray, np.ndarray],
    rng: np.random.Generator,
) -> Odometry:
    """Correspondences of ground points seen from the keyframe and the frame. Poses: R_w_c, position."""
    (r_kf, p_kf), (r_k, p_k) = keyframe_pose, pose
    if i == 0:
        return Odometry(t_ns=t_ns, frame_id=0, keyframe_id=0, verdict=Verdict.ACCEPTED, becomes_keyframe=True)
    keyframe_xy = np.column_stack([rng.uniform(-0.7, 0.7, PAIRS), rng.uniform(-0.35, 0.35, PAIRS), np.ones(PAIRS)])
    points = p_kf + (keyframe_xy * HEIGHT_M) @ r_kf.T
    in_k = (points - p_k) @ r_k
    frame_xy = in_k[:, :2] / in_k[:, 2:] + rng.normal(0.0, SIGMA_NORM, (PAIRS, 2))
    pairs = np.column_stack([keyframe_xy[:, :2], frame_xy])
    return Odometry(
        t_ns=t_ns,
        frame_id=i,
        keyframe_id=keyframe,
        verdict=Verdict.ACCEPTED,
        two_view=[(float(a), float(b), float(c), float(d)) for a, b, c, d in pairs],
        sigma_norm=SIGMA_NORM,
        inliers=PAIRS,
        tracked=PAIRS,
        becomes_keyframe=i % KEYFRAME_EVERY == 0,
    )


def _fix(i: int, t_ns: int, p_m: np.ndarray, r_w_c: np.ndarray, rng: np.random.Generator) -> MapMatch:
    e_m, n_m, up_m = (p_m + rng.normal(0.0, FIX_SIGMA_M, 3)).tolist()
    return MapMatch(
        t_ns=t_ns,
        frame_id=i,
        verdict=Verdict.ACCEPTED,
        matcher="gradient",
        inliers=40,
        pose=MapPose(
            p_c_in_w_m=(e_m, n_m, up_m),
            q_w_c=quat_from_rot(r_w_c),
            cov=tuple(float(v) for v in np.diag([FIX_SIGMA_M**2] * 3 + [FIX_SIGMA_RAD**2] * 3).ravel()),
        ),
        place=MatchPlace(e_m=e_m, n_m=n_m, mass=0.99),
    )
