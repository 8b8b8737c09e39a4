"""What vision, anchor and autopilot would say of a long flight, without a picture: for what grows with the flight.

Straight legs over flat ground and level turns, 12 m/s, two frames a second, a map fix at every second frame, inertial
readings at 100 Hz and attitudes at 50 Hz. Errors are drawn from what the messages claim."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from terrafix.core.camera import Mount
from terrafix.core.geodesy import quat_from_rot, rot_w_b
from terrafix.core.mavlink.imu import GRAVITY_MPS2
from terrafix.messages import Camera, Imu, ImuSample, MapMatch, Odometry, Origin, VehicleState, Verdict

FRAME_S, SPEED_MPS, HEIGHT_M = 0.5, 12.0, 100.0
LEG_S, TURN_S, TURN_RADPS = 60.0, 6.0, math.radians(15.0)  # a right turn ends each leg
IMU_S, STATE_EVERY, IMU_BATCH = 0.01, 2, 5  # readings: every second with an attitude, five in a message
FORCE_NOISE_MPS2, FORCE_BIAS_MPS2 = 0.3, 0.05  # of a reading: vibration, and what calibration left
KEYFRAME_EVERY, FIX_EVERY = 3, 2
PAIRS, SIGMA_NORM = 48, 1 / 560  # as many as odometry says at most
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
class Spoken:
    """Of one frame, in the order in which it is said."""

    telemetry: list[VehicleState | Imu]  # since the frame before
    odometry: Odometry
    match: MapMatch | None
    p_m: np.ndarray  # (3,) the truth: east, north, up


def spoken(frames: int, seed: int = 0) -> Iterator[Spoken]:
    """Frame by frame. The truth is a level camera at HEIGHT_M, image top ahead."""
    rng = np.random.default_rng([seed, 100])
    mount = Mount.of(CAMERA).r_b_c()
    p_m, yaw, i = np.array([0.0, 0.0, HEIGHT_M]), 0.0, 0
    keyframe, seen = 0, (np.eye(3), p_m)
    waiting, batch = list[VehicleState | Imu](), list[ImuSample]()
    for step in range((frames - 1) * round(FRAME_S / IMU_S) + 1):
        t_s, t_ns = step * IMU_S, round(step * IMU_S * 1e9)
        turning = TURN_RADPS if t_s % LEG_S >= LEG_S - TURN_S else 0.0
        force = (0.0, SPEED_MPS * turning, -GRAVITY_MPS2) + FORCE_NOISE_MPS2 * rng.normal(size=3) + FORCE_BIAS_MPS2
        before_ns = round((IMU_BATCH - 1 - len(batch)) * IMU_S * 1e9)
        batch.append((before_ns, *force.tolist(), 0.0, 0.0, turning))
        if len(batch) == IMU_BATCH:
            waiting.append(Imu(t_ns=t_ns, source="benchmark", samples=batch))
            batch = []
        if step % STATE_EVERY == 0:
            waiting.append(_state(t_ns, yaw, rng))
        if step % round(FRAME_S / IMU_S) == 0:
            now = (rot_w_b(yaw, 0.0, 0.0) @ mount, p_m)
            odometry = _odometry(i, keyframe, t_ns, seen, now, rng)
            if odometry.becomes_keyframe:
                keyframe, seen = i, now
            yield Spoken(waiting, odometry, _fix(i, t_ns, p_m, now[0], rng) if i % FIX_EVERY == 0 else None, p_m)
            waiting, i = [], i + 1
        middle = yaw + 0.5 * turning * IMU_S
        p_m = p_m + IMU_S * SPEED_MPS * np.array([math.sin(middle), math.cos(middle), 0.0])
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
    before: tuple[np.ndarray, np.ndarray],
    now: tuple[np.ndarray, np.ndarray],
    rng: np.random.Generator,
) -> Odometry:
    """Rays of points on the ground under the keyframe, seen from both."""
    (r_kf, p_kf), (r_k, p_k) = before, now
    if i == 0:
        return Odometry(t_ns=t_ns, frame_id=0, keyframe_id=0, verdict=Verdict.ACCEPTED, becomes_keyframe=True)
    seen = np.column_stack([rng.uniform(-0.7, 0.7, PAIRS), rng.uniform(-0.35, 0.35, PAIRS), np.ones(PAIRS)])
    points = p_kf + (seen * HEIGHT_M) @ r_kf.T
    in_k = (points - p_k) @ r_k
    there = in_k[:, :2] / in_k[:, 2:] + rng.normal(0.0, SIGMA_NORM, (PAIRS, 2))
    pairs = np.column_stack([seen[:, :2], there])
    return Odometry(
        t_ns=t_ns,
        frame_id=i,
        keyframe_id=keyframe,
        verdict=Verdict.ACCEPTED,
        pairs=[(float(a), float(b), float(c), float(d)) for a, b, c, d in pairs],
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
        p_c_in_w_m=(e_m, n_m, up_m),
        q_w_c=quat_from_rot(r_w_c),
        cov=tuple(float(v) for v in np.diag([FIX_SIGMA_M**2] * 3 + [FIX_SIGMA_RAD**2] * 3).ravel()),
        inliers=40,
        mode_mass=0.99,
        mode_e_m=e_m,
        mode_n_m=n_m,
    )
