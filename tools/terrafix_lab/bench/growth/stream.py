"""Messages of vision, anchor and autopilot for a long flight over flat ground, without images: a flight of Monte Carlo
without wind and relief, 2 frames a second, a map match at every second one. The messages state their errors."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from terrafix.messages import MapMatch, Message, Odometry, Origin
from terrafix_lab.montecarlo.fault import DrawnFault
from terrafix_lab.montecarlo.flown import SimulatedFlight, fly
from terrafix_lab.montecarlo.ground import Terrain
from terrafix_lab.montecarlo.plan import plan
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.true_messages import first_odometry, map_match, odometry
from terrafix_lab.sim.vehicle.wind import Wind

FRAME_S, SPEED_MPS, HEIGHT_M = 0.5, 12.0, 100.0
SEED = 0
KEYFRAME_EVERY, FIX_EVERY = 3, 2


@dataclass(frozen=True)
class FrameMessages:
    """Messages of one frame, in the order of publication."""

    telemetry: list[Message]  # VehicleState and Imu since the previous frame
    odometry: Odometry
    match: MapMatch | None
    p_m: np.ndarray  # (3,) true position: east, north, up


def origin() -> Origin:
    """Of every flight."""
    return _flown(2).origin


def _flown(frames: int) -> SimulatedFlight:
    drawn = replace(
        plan(SEED, 1, fault=DrawnFault.NONE, duration_s=frames * FRAME_S),
        kind=Kind.COPTER,
        frame_hz=1.0 / FRAME_S,
        agl_m=HEIGHT_M,
        cruise_mps=SPEED_MPS,
        wind=Wind(0.0, 0.0),
        gimbal=False,
        mount_error_rad=(0.0, 0.0),
    )
    return fly(drawn, Terrain(SEED, 0.0, 0.0))


def frame_messages(frames: int) -> Iterator[FrameMessages]:
    """-> the messages frame by frame."""
    flown, rng = _flown(frames), np.random.default_rng([SEED, 100])
    keyframe, keyframe_pose = 0, (flown.frames[0].r_w_c, flown.frames[0].p_m)
    for i, shot in enumerate(flown.frames[:frames]):
        t_ns, pose = round(1e9 * shot.t_s), (shot.r_w_c, shot.p_m)
        seen = first_odometry(t_ns)
        if i:
            due = i % KEYFRAME_EVERY == 0
            seen = odometry(t_ns, (keyframe, i), (keyframe_pose, pose), rng, becomes_keyframe=due)
            keyframe, keyframe_pose = (i, pose) if due else (keyframe, keyframe_pose)
        match = map_match(t_ns, i, pose, rng) if i % FIX_EVERY == 0 else None
        yield FrameMessages(flown.telemetry[i], seen, match, shot.p_m)
