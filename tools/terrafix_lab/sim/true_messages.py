"""Messages of a vehicle and a camera whose truth is known, for flights without images: telemetry, odometry, map
matches, estimates.

Odometry and matches are of flat ground at height zero. Every error is drawn from the distribution that its message
states. A pose is R_w_c (3, 3) and the position (3,) of the camera, east, north, up [m]."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import numpy as np

from terrafix.core.geodesy import quat_from_rot
from terrafix.core.pose import exp_so3
from terrafix.estimator.measurements.map_pose import ROOFS
from terrafix.messages import (
    CovarianceMode,
    GroundPlane,
    Imu,
    MapMatch,
    MapPose,
    MatchPlace,
    Message,
    NavEstimate,
    Odometry,
    Quat,
    SourceLabel,
    VehicleState,
    Verdict,
)
from terrafix_lab.sim.flights.path import states_of
from terrafix_lab.sim.interfaces import Readings, Sensors, State, Vehicle

Pose = tuple[np.ndarray, np.ndarray]

PAIRS, SIGMA_NORM = 40, 1.0 / 560.0
# Sigmas of a map fix: east, north, up [m], rotation about east, north, up [rad].
FIX_SIGMAS = np.array([2.0, 2.0, 3.0, math.radians(1.0), math.radians(1.0), math.radians(0.8)])


def flown(
    vehicle: Vehicle,
    sensors: Sensors,
    count: int,
    state_of: Callable[[Readings], VehicleState],
    *,
    state_every: int,
    imu_batch: int,
) -> Iterator[tuple[State, list[Message]]]:
    """-> ``count`` true states, and the telemetry that follows each: every ``state_every`` steps that of ``state_of``,
    and an Imu of every ``imu_batch`` readings; 0: there is none, and readings are taken for the states alone."""
    batch: list[Readings] = []
    for i, state in enumerate(states_of(vehicle, count)):
        sent: list[Message] = []
        if imu_batch or i % state_every == 0:
            batch.append(sensors.read(state))
        if i % state_every == 0:
            sent.append(state_of(batch[-1]))
        if len(batch) >= imu_batch:
            sent += [imu_of(batch)] if imu_batch else []
            batch = []
        yield state, sent


def vehicle_state(readings: Readings, home_amsl_m: float = 0.0) -> VehicleState:
    """As the link publishes it of a vehicle in the air, with the barometric height above ``home_amsl_m``."""
    return VehicleState(
        t_ns=round(readings.t_s * 1e9),
        source="simulated",
        yaw_rad=readings.yaw_rad,
        pitch_rad=readings.pitch_rad,
        roll_rad=readings.roll_rad,
        agl_m=readings.baro_amsl_m - home_amsl_m,
        armed=True,
        airspeed_mps=readings.airspeed_mps,
    )


def imu_of(batch: list[Readings]) -> Imu:
    """The inertial readings of a batch as one message, at the time of the last."""
    newest_ns = round(batch[-1].t_s * 1e9)
    samples = [(newest_ns - round(r.t_s * 1e9), *r.accel_b_mps2.tolist(), *r.gyro_b_radps.tolist()) for r in batch]
    return Imu(t_ns=newest_ns, source="simulated", samples=samples)


def estimate(
    t_ns: int, lat_deg: float, lon_deg: float, *, sigmas: tuple[float, float, float], **changes: Any
) -> NavEstimate:
    """That of a vehicle at rest at a place, anchored and published at once. ``sigmas``: 1-sigma of each horizontal axis
    and of the height [m], and of the attitude [rad]; ``changes``: fields with other values."""
    horizontal_m, up_m, angle_rad = sigmas
    fields: dict[str, Any] = {
        "t_ns": t_ns,
        "frame_id": t_ns // 1_000_000,
        "lat_deg": lat_deg,
        "lon_deg": lon_deg,
        "alt_amsl_m": 620.0,
        "agl_m": 120.0,
        "velocity_enu_mps": (0.0, 0.0, 0.0),
        "velocity_sigma_mps": 0.5,
        "q_w_b": (1.0, 0.0, 0.0, 0.0),
        "cov": tuple(np.diag(np.square([horizontal_m] * 2 + [up_m] + [angle_rad] * 3)).ravel().tolist()),
        "source_label": SourceLabel.SATELLITE_ANCHORED,
        "covariance_mode": CovarianceMode.MARGINALS,
        "last_anchor_age_ms": 0,
        "emitted_at_ns": t_ns,
    }
    return NavEstimate(**fields | changes)


def homography(from_pose: Pose, to_pose: Pose) -> np.ndarray:
    """-> (3, 3) plane-induced homography: normalised coordinates of ground points in the first camera -> in the
    second."""
    (r_a, p_a), (r_b, p_b) = from_pose, to_pose
    normal = r_a.T @ np.array([0.0, 0.0, -1.0])  # of the ground plane, in camera a, pointing away from the camera
    return np.asarray(r_b.T @ (np.eye(3) + np.outer(p_a - p_b, normal @ r_a.T) / p_a[2]) @ r_a)


def apply(matrix: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Applies a homography (3, 3) to points (N, 2)."""
    q = np.column_stack([xy, np.ones(len(xy))]) @ matrix.T
    return np.asarray(q[:, :2] / q[:, 2:])


def features(rng: np.random.Generator) -> np.ndarray:
    """(PAIRS, 2) features of one image, normalised coordinates."""
    return np.column_stack([rng.uniform(-0.7, 0.7, PAIRS), rng.uniform(-0.3, 0.3, PAIRS)])


def seen_from(keyframe: Pose, frame: Pose, rng: np.random.Generator, xy: np.ndarray | None = None) -> dict[str, Any]:
    """Fields of an Odometry or Relocalization of ``frame`` against ``keyframe``. ``xy`` (N, 2): the features of the
    keyframe; None: drawn."""
    xy = features(rng) if xy is None else xy
    there = apply(homography(keyframe, frame), xy) + rng.normal(0.0, SIGMA_NORM, xy.shape)
    pairs = [(a, b, c, d) for a, b, c, d in np.hstack([xy, there]).tolist()]
    return {"two_view": pairs, "sigma_norm": SIGMA_NORM, "inliers": len(pairs), "tracked": len(pairs)}


def odometry(
    t_ns: int,
    ids: tuple[int, int],
    poses: tuple[Pose, Pose],
    rng: np.random.Generator,
    *,
    becomes_keyframe: bool = False,
    xy: np.ndarray | None = None,
) -> Odometry:
    """An accepted one. ``ids``, ``poses``: of the keyframe and of the frame; ``xy`` as in ``seen_from``."""
    keyframe_id, frame_id = ids
    seen = seen_from(*poses, rng, xy)
    return msgspec.structs.replace(
        first_odometry(t_ns, frame_id), keyframe_id=keyframe_id, becomes_keyframe=becomes_keyframe, **seen
    )


def first_odometry(t_ns: int, frame_id: int = 0, fragment_id: int = 0) -> Odometry:
    """Of a frame that begins a fragment: a keyframe without a predecessor."""
    return Odometry(
        t_ns=t_ns,
        frame_id=frame_id,
        keyframe_id=frame_id,
        verdict=Verdict.ACCEPTED,
        becomes_keyframe=True,
        fragment_id=fragment_id,
    )


def map_match(
    t_ns: int,
    frame_id: int,
    pose: Pose,
    rng: np.random.Generator,
    *,
    offset_m: tuple[float, float] = (0.0, 0.0),
    ground: GroundPlane | None = None,
) -> MapMatch:
    """An accepted match with errors of FIX_SIGMAS and of the roofs that a map without elevation has not.
    ``offset_m``: additional error, east and north."""
    r_w_c, p_m = pose
    error = rng.normal(0.0, np.hypot(FIX_SIGMAS, [0.0, 0.0, ROOFS * p_m[2], 0.0, 0.0, 0.0]))
    match = MapMatch(t_ns=t_ns, frame_id=frame_id, verdict=Verdict.ACCEPTED, matcher="gradient", ground=ground)
    at_m = p_m + error[:3] + (*offset_m, 0.0)
    return placed(match, at_m, quat_from_rot(exp_so3(error[3:]) @ r_w_c), FIX_SIGMAS, inliers=30)


def placed(match: MapMatch, p_m: np.ndarray, q_w_c: Quat, sigmas: np.ndarray, *, inliers: int) -> MapMatch:
    """``match``, accepted with this position (3,) and orientation of the camera. ``sigmas`` (6,): stated, of position
    [m] and rotation [rad]."""
    e_m, n_m, up_m = p_m.tolist()
    return msgspec.structs.replace(
        match,
        verdict=Verdict.ACCEPTED,
        inliers=inliers,
        pose=MapPose(p_c_in_w_m=(e_m, n_m, up_m), q_w_c=q_w_c, cov=tuple(np.diag(sigmas**2).ravel().tolist())),
        place=MatchPlace(e_m=e_m, n_m=n_m, mass=0.99),
    )
