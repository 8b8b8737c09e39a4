"""A simulated flight with known truth: the messages of vision, autopilot and anchor as input of the estimator.

The ground is flat at height zero, or has hills that the map does not contain. Every error is drawn from the
distribution that its message states."""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np

from map_matches import plane
from terrafix.core.camera import Mount, distort_division
from terrafix.core.geodesy import LocalFrame, rot_w_b
from terrafix.core.pose import exp_so3
from terrafix.estimator.node import EstimatorNode
from terrafix.estimator.prior import CheckpointWriter, EstimatorCheckpoint, load_checkpoint
from terrafix.messages import (
    Camera,
    MapMatch,
    MeasurementVerdict,
    Message,
    NavEstimate,
    Odometry,
    Origin,
    SourceEnded,
    VehicleState,
    Verdict,
)
from terrafix_lab.sim.true_messages import Pose, features, first_odometry, map_match, odometry
from terrafix_lab.sim.vehicle.level import level_path

FRAME_S = 0.5
SPEED_MPS = 12.0
KEYFRAME_EVERY = 3
PLACE = LocalFrame(48.0, 11.0)
CAMERA = Camera(  # calibrated: focal length to 1 %
    width=960, height=540, fx=560.0, fy=560.0, cx=479.5, cy=269.5, focal_sigma=0.01, mount_tolerance_deg=4.0
)
ORIGIN = Origin(
    t_ns=0,
    camera=CAMERA,
    lat_deg=PLACE.lat_deg,
    lon_deg=PLACE.lon_deg,
    ground_amsl_m=0.0,
    start_sigma_m=15.0,
    yaw_sigma_deg=2.0,
    agl_sigma_m=2.0,
    attitude_sigma_deg=1.0,
)


@dataclass(frozen=True)
class Flight:
    """``messages(i)`` are those of frame i. Truth: ``p_m`` (N, 3) position of the camera in ENU, ``r_w_b`` and
    ``r_w_c`` attitudes of body and camera (N of (3, 3)), ``ground_m`` (N,) height of the ground below."""

    frames: int
    seed: int = 0
    fix_every: int = 9  # frames from one map match to the next: 54 m, so that each sees new ground
    telemetry: frozenset[str] = frozenset({"yaw", "attitude", "height"})  # fields that VehicleState has
    speed_mps: float = SPEED_MPS
    dem: bool = False  # the map has an elevation model (flat)
    climb_amplitude_m: float = 8.0  # of the sinusoidal height
    turn_rad: float = 0.0  # turn from 15 s to 17 s
    stop_and_go: bool = False  # stops and accelerates within a frame, every 10 s
    hills_m: float = 0.0  # 1-sigma of the ground height; wavelength 1 km
    ground_m: np.ndarray = field(init=False, repr=False)
    rng_of: np.random.Generator = field(init=False, repr=False)
    p_m: np.ndarray = field(init=False, repr=False)
    r_w_b: list[np.ndarray] = field(init=False, repr=False)
    r_w_c: list[np.ndarray] = field(init=False, repr=False)
    _messages: list[list[Message]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng([self.seed, 77])
        t_s = np.arange(self.frames) * FRAME_S
        heading = 0.5 + np.cumsum(0.10 * np.sin(t_s / 11.0)) * FRAME_S
        heading += self.turn_rad * np.clip((t_s - 15.0) / 2.0, 0.0, 1.0)
        speed_mps = self.speed_mps * np.where(self.stop_and_go & (t_s % 20.0 >= 10.0), 0.05, 1.0)
        xy = level_path(heading, speed_mps * FRAME_S, rng.normal(0.0, ORIGIN.start_sigma_m, 2))
        path_m = np.arange(self.frames) * self.speed_mps * FRAME_S
        ground = math.sqrt(2.0) * self.hills_m * (np.cos(path_m / 160.0 + self.seed) - math.cos(self.seed))
        up = 100.0 + self.climb_amplitude_m * np.sin(t_s / 17.0) + ground  # terrain following
        angles = np.radians(np.column_stack([2.0 * np.sin(t_s / 1.7), 2.5 * np.sin(t_s / 2.3)]))
        tilt = np.radians(rng.normal(0.0, CAMERA.mount_tolerance_deg / 2, 2))
        mount = Mount.of(CAMERA).r_b_c() @ exp_so3(np.array([*tilt, 0.0]))
        r_w_b = [rot_w_b(float(h), float(p), float(r)) for h, (p, r) in zip(heading, angles, strict=True)]
        for name, value in (
            ("ground_m", ground),
            ("rng_of", rng),
            ("p_m", np.column_stack([xy, up])),
            ("r_w_b", r_w_b),
            ("r_w_c", [r @ mount for r in r_w_b]),
        ):
            object.__setattr__(self, name, value)
        yaw_bias, height_bias = np.radians(rng.normal(0.0, 3.0)), rng.normal(0.0, 2.0)
        messages = [
            [
                self._state(i, float(heading[i]) + yaw_bias, angles[i], float(up[i]) + height_bias),
                self._odometry(i),
                *([self.fix(i)] if i % self.fix_every == 0 else []),
            ]
            for i in range(self.frames)
        ]
        object.__setattr__(self, "_messages", messages)

    def messages(self, i: int) -> list[Message]:
        return list(self._messages[i])

    def all_messages(self) -> Iterator[Message]:
        """Origin, the messages of all frames, SourceEnded."""
        yield ORIGIN
        for messages in self._messages:
            yield from messages
        yield SourceEnded(t_ns=t_ns(self.frames - 1), frames=self.frames)

    def fix(self, i: int, offset_m: tuple[float, float] = (0.0, 0.0)) -> MapMatch:
        """Map match of frame i, with errors of its covariance and an additional ``offset_m`` (east, north)."""
        ground = plane(0.0) if self.dem else None
        return map_match(t_ns(i), i, self.pose_over(i, i), self.rng_of, offset_m=offset_m, ground=ground)

    def pose_over(self, i: int, below: int) -> Pose:
        """Of frame i, above the ground below frame ``below``: the image shows the height above it; the map is flat."""
        return self.r_w_c[i], self.p_m[i] - np.array([0.0, 0.0, self.ground_m[below]])

    def _state(self, i: int, yaw_rad: float, angles: np.ndarray, agl_m: float) -> VehicleState:
        noise = self.rng_of.normal(0.0, 1.0, 4)
        tilt = np.radians(ORIGIN.attitude_sigma_deg) * noise[:2]
        yaw_rad = math.remainder(yaw_rad + math.radians(1.0) * float(noise[2]), 2 * math.pi)
        return VehicleState(
            t_ns=t_ns(i),
            source="simulated",
            yaw_rad=yaw_rad if "yaw" in self.telemetry else None,
            pitch_rad=float(angles[0] + tilt[0]) if "attitude" in self.telemetry else None,
            roll_rad=float(angles[1] + tilt[1]) if "attitude" in self.telemetry else None,
            agl_m=agl_m + float(noise[3]) if "height" in self.telemetry else None,
        )

    def _odometry(self, i: int) -> Odometry:
        if i == 0:
            return first_odometry(0)
        keyframe = keyframe_of(i)
        poses = self.pose_over(keyframe, keyframe), self.pose_over(i, keyframe)
        return odometry(t_ns(i), (keyframe, i), poses, self.rng_of, becomes_keyframe=i % KEYFRAME_EVERY == 0)


Alter = Callable[[Message], Message | None]  # -> the message to use; None: it is left out


def altered(messages: Iterable[Message], alter: Alter) -> list[Message]:
    return [used for message in messages if (used := alter(message)) is not None]


def unaltered(message: Message) -> Message | None:
    return message


def without_fix(message: Message) -> Message | None:
    return None if isinstance(message, MapMatch) else message


def without_sight(message: Message) -> Message | None:
    """Neither map matches nor tracked features."""
    return blind(message) if isinstance(message, Odometry) else without_fix(message)


class EstimatorRun:
    """Feeds an EstimatorNode and records its messages in ``published``."""

    def __init__(self) -> None:
        self.node = EstimatorNode()
        self.published: list[Message] = []

    def feed(self, messages: Iterable[Message]) -> list[Message]:
        """-> the messages that the node publishes for these."""
        published = [reply for message in messages for reply in self.node.on(message)]
        self.published += published
        return published

    def fly(
        self, flight: Flight, first: int, end: int, alter: "Alter | None" = None, origin: Origin = ORIGIN
    ) -> "EstimatorRun":
        """Feeds the frames first .. end - 1, altered, after ``origin`` if ``first`` is 0."""
        if first == 0:
            self.feed([origin])
        for i in range(first, end):
            self.feed(altered(flight.messages(i), alter or unaltered))
        return self

    def checkpoint(self, flight: Flight, killed: int, folder: Path) -> EstimatorCheckpoint | None:
        """-> the last one of an estimator that was killed at the frame ``killed``, through the file."""
        keeper = CheckpointWriter(file := folder / "estimator.checkpoint")
        for message in [flight.fix(killed - 2), *self.fly(flight, 0, killed).published]:
            keeper.on_message(message)
        return load_checkpoint(file)

    def estimates(self) -> list[NavEstimate]:
        """-> the last published estimate of each frame, in their order."""
        last = {m.frame_id: m for m in self.published if isinstance(m, NavEstimate)}
        return [last[i] for i in sorted(last)]

    def estimate(self, frame_id: int) -> NavEstimate:
        """-> the last published estimate of a frame."""
        return [m for m in self.published if isinstance(m, NavEstimate) and m.frame_id == frame_id][-1]

    def verdicts(self, measurement: str) -> dict[int, MeasurementVerdict]:
        """-> the last verdict of a measurement for each frame."""
        verdicts = (m for m in self.published if isinstance(m, MeasurementVerdict))
        return {m.frame_id: m for m in verdicts if m.measurement == measurement}


def same_features(flight: Flight, keyframe: int, i: int, features: np.ndarray) -> Odometry:
    """Odometry of frame i against ``keyframe`` with the same ``features`` (N, 2; normalised coordinates in the
    keyframe) for every frame."""
    poses = flight.pose_over(keyframe, keyframe), flight.pose_over(i, keyframe)
    return odometry(t_ns(i), (keyframe, i), poses, np.random.default_rng([i, 3]), xy=features)


def some_features() -> np.ndarray:
    """(PAIRS, 2) the same each time."""
    return features(np.random.default_rng(3))


def keyframe_of(i: int) -> int:
    """Of frame i."""
    return max(0, (i - 1) // KEYFRAME_EVERY * KEYFRAME_EVERY)


def t_ns(i: int) -> int:
    return round(i * FRAME_S * 1e9)


def error_m(estimate: NavEstimate, flight: Flight, offset_m: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """-> (3,) error of the estimate: east, north, up; the truth is shifted by ``offset_m`` (east, north)."""
    e_m, n_m = PLACE.to_local(estimate.lat_deg, estimate.lon_deg)
    return np.array([e_m, n_m, estimate.alt_amsl_m]) - flight.p_m[estimate.frame_id] - (*offset_m, 0.0)


def cov_of(estimate: NavEstimate) -> np.ndarray:
    return np.array(estimate.cov).reshape(6, 6)


def sigma_m(estimate: NavEstimate) -> float:
    """Horizontal 1-sigma, per axis."""
    return float(np.sqrt((estimate.cov[0] + estimate.cov[7]) / 2))


def blind(odometry: Message, verdict: Verdict = Verdict.FEW_INLIERS) -> Odometry:
    """The odometry message of the same frame without tracked features."""
    assert isinstance(odometry, Odometry)
    return Odometry(t_ns=odometry.t_ns, frame_id=odometry.frame_id, keyframe_id=odometry.keyframe_id, verdict=verdict)


def with_distortion(message: Message, k1: float) -> Message:
    """The pairs of an Odometry as a lens with this radial coefficient shows them; other messages as they are."""
    if not isinstance(message, Odometry) or not message.two_view:
        return message
    seen = [distort_division(np.array(message.two_view)[:, xy], k1) for xy in (slice(0, 2), slice(2, 4))]
    return msgspec.structs.replace(message, two_view=[tuple(pair) for pair in np.hstack(seen).tolist()])
