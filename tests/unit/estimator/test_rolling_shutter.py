"""Rolling shutter in flight: by the body rates, map matches and odometry are those of the middle row."""

from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest

from simulated_flight import CAMERA, FRAME_S, ORIGIN, EstimatorRun, Flight, cov_of, error_m
from terrafix.core.camera import CameraCalibration, Mount, Readout
from terrafix.core.geodesy import euler_from_rot
from terrafix.core.pose import exp_so3
from terrafix.messages import Camera, Message, Odometry, Prediction, ReadoutMotion, VehicleState

FRAMES = 40
ROLLING = msgspec.structs.replace(CAMERA, readout_s=0.06)
FLIGHT = Flight(FRAMES, seed=4)
LENS = CameraCalibration.of(CAMERA)


def rates_b(i: int) -> np.ndarray:
    """Body rates at frame ``i``: it sways, so that two frames are sheared by different amounts."""
    return np.array([0.5, 0.3, -0.2]) * (1.0 if i % 4 < 2 else -1.0)


def readout(i: int) -> Readout:
    velocity = (FLIGHT.p_m[min(i + 1, FRAMES - 1)] - FLIGHT.p_m[max(i - 1, 0)]) / (2 * FRAME_S)
    motion = ReadoutMotion(
        rate_radps=tuple(Mount.of(CAMERA).r_b_c().T @ rates_b(i)),
        speed_per_s=tuple(FLIGHT.r_w_c[i].T @ velocity / FLIGHT.p_m[i, 2]),
    )
    found = Readout.of(ROLLING, motion, FLIGHT.r_w_c[i])
    assert found is not None
    return found


def rolled(xy: np.ndarray, i: int) -> np.ndarray:
    """Where frame ``i`` shows what the middle row's camera would see at ``xy`` (N, 2)."""
    px = replace(LENS, readout=readout(i)).project(np.column_stack([xy, np.ones(len(xy))]))
    return LENS.normalise(px)


def shown(odometry: Odometry) -> Odometry:
    frames = {
        "two_view": (odometry.keyframe_id, odometry.frame_id),
        "three_view": (odometry.previous_keyframe_id, odometry.keyframe_id, odometry.frame_id),
    }
    changed = {}
    for name, ids in frames.items():
        rays = np.array(getattr(odometry, name))
        if len(rays):
            columns = [rolled(rays[:, 2 * k : 2 * k + 2], i) for k, i in enumerate(ids)]
            changed[name] = [tuple(row) for row in np.hstack(columns).tolist()]
    return msgspec.structs.replace(odometry, **changed)


def turning(state: VehicleState, i: int) -> list[VehicleState]:
    """The attitudes about that of ``state``, at 50 Hz."""
    reports = []
    for after_s in (-0.04, -0.02, 0.0, 0.02, 0.04):
        yaw, pitch, roll = euler_from_rot(FLIGHT.r_w_b[i] @ exp_so3(rates_b(i) * after_s))
        at_ns = state.t_ns + round(after_s * 1e9)
        at = VehicleState(t_ns=at_ns, source="mavlink", yaw_rad=yaw, pitch_rad=pitch, roll_rad=roll)
        reports.append(state if after_s == 0 else at)
    return reports


def flown(described: Camera, *, rolls: bool = True) -> EstimatorRun:
    """``rolls``: the images are of a rolling shutter."""
    run = EstimatorRun()
    run.feed([msgspec.structs.replace(ORIGIN, camera=described)])
    for i in range(FRAMES):
        sent: list[Message] = []
        for message in FLIGHT.messages(i):
            if isinstance(message, VehicleState):
                sent += turning(message, i)
            elif isinstance(message, Odometry) and rolls:
                sent.append(shown(message))
            elif isinstance(message, Odometry) or i == 0:  # the map places the start alone
                sent.append(message)
        run.feed(sent)
    return run


@cache
def errors_m(described: Camera, *, rolls: bool = True) -> np.ndarray:
    """(N, 2) of each frame: error, and that over its claim."""
    found = []
    for estimate in flown(described, rolls=rolls).estimates():
        off = error_m(estimate, FLIGHT)[:2]
        found.append((np.hypot(*off), np.sqrt(off @ np.linalg.solve(cov_of(estimate)[:2, :2], off))))
    return np.array(found)


def test_odometry_of_a_rolling_shutter_is_as_good_as_that_of_a_global_one() -> None:
    corrected, exact = errors_m(ROLLING), errors_m(CAMERA, rolls=False)
    assert corrected[:, 0].mean() < 1.1 * exact[:, 0].mean() + 0.2
    assert corrected[:, 1].max() < 3.5
    assert errors_m(CAMERA)[:, 0].mean() > corrected[:, 0].mean() + 1.0


def test_the_anchor_gets_the_motion_of_the_camera_only_with_a_rolling_shutter() -> None:
    predicted = [m for m in flown(ROLLING).published if isinstance(m, Prediction)]
    motion = predicted[-1].readout_motion
    assert isinstance(motion, ReadoutMotion)
    assert motion.rate_radps == pytest.approx(Mount.of(CAMERA).r_b_c().T @ rates_b(FRAMES - 1), abs=1e-6)
    assert np.linalg.norm(motion.speed_per_s) == pytest.approx(12.0 / FLIGHT.p_m[-1, 2], rel=0.2)
    still = [m for m in flown(CAMERA).published if isinstance(m, Prediction)]
    assert not any(isinstance(m.readout_motion, ReadoutMotion) for m in still)
